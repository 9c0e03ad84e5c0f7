"""Traverse files kept open, and let go in time."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from deepsimbad.core.drive import Drive
from deepsimbad.engine.traverses import MAX_IDLE, OpenTraverses
from deepsimbad.errors import UnknownTraverseError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.traverses import Traverse

from .conftest import add_domain


def frame(index: int) -> Drive:
    return Drive(index=np.array([index]), position_m=np.zeros(1), encodings=np.ones((1, 4), np.float32))


@pytest.fixture
def lending(catalog: Catalog, tmp_path: Path) -> Iterator[OpenTraverses]:
    add_domain(catalog, "d")
    for n in range(MAX_IDLE + 4):
        Traverse.create(tmp_path, "d", f"t{n}").close()
    lending = OpenTraverses(tmp_path)
    yield lending
    lending.close()


def test_one_file_serves_all_who_ask_and_idle_ones_are_closed_beyond_a_number(lending: OpenTraverses) -> None:
    with lending.lend("d", "t0") as oldest:
        for n in range(MAX_IDLE + 4):
            with lending.lend("d", f"t{n}") as traverse:
                assert (traverse is oldest) == (n == 0)
        oldest.put_frames(frame(0))  # in use, so still open
    assert len(lending._open) <= MAX_IDLE + 1
    with lending.lend("d", "t0") as traverse_again:
        assert traverse_again is oldest
    lending.close()
    assert not lending._open


def test_a_forgotten_file_is_closed_after_its_last_use(lending: OpenTraverses) -> None:
    with lending.lend("d", "t0") as traverse:
        lending.forget("d", "t0")
        traverse.put_frames(frame(0))
        with lending.lend("d", "t0") as other:
            assert other is not traverse
            assert other.n_frames == 1


def test_one_deleted_by_another_process_is_not_lent_again(lending: OpenTraverses, tmp_path: Path) -> None:
    with lending.lend("d", "t0") as traverse:
        traverse.put_frames(frame(0))
    Traverse.delete(tmp_path, "d", "t0")
    with pytest.raises(UnknownTraverseError), lending.lend("d", "t0") as traverse:
        traverse.put_frames(frame(1))
    with pytest.raises(UnknownTraverseError), lending.lend("d", "t0"):
        pass
    Traverse.create(tmp_path, "d", "t0").close()
    with lending.lend("d", "t0") as old_traverse:
        assert old_traverse.n_frames == 0
        Traverse.delete(tmp_path, "d", "t0")
        Traverse.create(tmp_path, "d", "t0").close()
        with lending.lend("d", "t0") as traverse:
            assert traverse is not old_traverse
            traverse.put_frames(frame(1))
    assert [loan.traverse for loan in lending._open.values()] == [traverse], "the old one is closed"


def test_many_threads(lending: OpenTraverses) -> None:
    def put(start: int) -> None:
        for n in range(start, start + 10):
            with lending.lend("d", f"t{n % 3}") as traverse:
                traverse.put_frames(frame(n))
            if n % 5 == 0:
                lending.forget("d")

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(put, range(0, 40, 10)))
    n_frames = 0
    for n in range(3):
        with lending.lend("d", f"t{n}") as traverse:
            n_frames += traverse.n_frames
    assert n_frames == 40
