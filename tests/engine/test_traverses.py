"""Traverse files kept open, and let go in time."""

import threading

import numpy as np
import pytest

from deepsimbad.engine.traverses import MAX_IDLE, OpenTraverses
from deepsimbad.errors import UnknownTraverseError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.traverses import Traverse

from .conftest import add_domain

ENCODING = np.ones(4, np.float32)


@pytest.fixture
def lending(catalog: Catalog) -> OpenTraverses:
    add_domain(catalog, "d")
    for n in range(MAX_IDLE + 4):
        Traverse.create(catalog.data_dir, "d", f"t{n}").close()
    return OpenTraverses(catalog.data_dir)


def test_one_file_serves_all_who_ask(lending: OpenTraverses) -> None:
    with lending.lend("d", "t0") as first, lending.lend("d", "t0") as second:
        assert first is second
    with lending.lend("d", "t0") as third:
        assert third is first
    lending.close()


def test_idle_files_are_closed_beyond_a_number(lending: OpenTraverses) -> None:
    with lending.lend("d", "t0") as oldest:
        for n in range(1, MAX_IDLE + 4):
            with lending.lend("d", f"t{n}"):
                pass
        oldest.put_frame(0, ENCODING, 0.0)  # in use, so still open
    assert len(lending._open) <= MAX_IDLE + 1
    lending.close()
    assert not lending._open


def test_a_forgotten_file_is_closed_after_its_last_use(lending: OpenTraverses) -> None:
    with lending.lend("d", "t0") as lent:
        lending.forget("d", "t0")
        lent.put_frame(0, ENCODING, 0.0)
        with lending.lend("d", "t0") as other:
            assert other is not lent
            assert other.n_frames == 1
    lending.close()


def test_deleted_and_made_anew(lending: OpenTraverses, catalog: Catalog) -> None:
    with lending.lend("d", "t0") as traverse:
        traverse.put_frame(0, ENCODING, 0.0)
    Traverse.delete(catalog.data_dir, "d", "t0")  # by another process
    with pytest.raises(UnknownTraverseError), lending.lend("d", "t0") as traverse:
        traverse.put_frame(1, ENCODING, 0.0)
    with pytest.raises(UnknownTraverseError), lending.lend("d", "t0"):
        pass
    Traverse.create(catalog.data_dir, "d", "t0").close()
    with lending.lend("d", "t0") as traverse:
        assert traverse.n_frames == 0
    lending.close()


def test_made_anew_by_another_process_between_two_loans(lending: OpenTraverses, catalog: Catalog) -> None:
    with lending.lend("d", "t0") as old:
        old.put_frame(0, ENCODING, 0.0)
        Traverse.delete(catalog.data_dir, "d", "t0")
        Traverse.create(catalog.data_dir, "d", "t0").close()
        with lending.lend("d", "t0") as traverse:
            assert traverse is not old
            traverse.put_frame(1, ENCODING, 0.0)
            assert traverse.n_frames == 1
    assert [each.traverse for each in lending._open.values()] == [traverse], "the old one is closed"
    lending.close()


def test_many_threads(lending: OpenTraverses) -> None:
    failures = []

    def put(start: int) -> None:
        try:
            for n in range(start, start + 10):
                with lending.lend("d", f"t{n % 3}") as traverse:
                    traverse.put_frame(n, ENCODING, 0.0)
                if n % 5 == 0:
                    lending.forget("d")
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=put, args=(10 * k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    total = 0
    for n in range(3):
        with lending.lend("d", f"t{n}") as traverse:
            total += traverse.n_frames
    assert total == 40
    lending.close()
