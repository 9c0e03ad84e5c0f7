"""Checkpoints: what is read is what was written of the same inputs, or nothing."""

import logging
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from deepsimbad.errors import CancelledError, InvalidInputError, UnavailableError
from deepsimbad.store.checkpoints import Checkpoints, remove_checkpoints, sweep_checkpoints

JOB = "0123456789abcdef" * 2
ARRAYS = {
    "lists": np.arange(12, dtype=np.uint16).reshape(3, 4),
    "columns first": np.asfortranarray(np.random.default_rng(0).normal(size=(5, 3))),
    "nothing": np.empty((0, 7), np.float32),
}
DOCUMENT = {"seconds": 0.1 + 0.2, "curve": [1, None, "ä"]}


@pytest.fixture
def checkpoints(tmp_path: Path) -> Iterator[Checkpoints]:
    with Checkpoints.open(tmp_path, JOB) as opened:
        yield opened


def file_of(tmp_path: Path) -> Path:
    (path,) = (tmp_path / "jobs" / JOB).iterdir()
    return path


def test_what_was_saved_is_loaded_bit_for_bit(checkpoints: Checkpoints, tmp_path: Path) -> None:
    assert checkpoints.load("select landmarks", "a") is None
    checkpoints.save("select landmarks", "a", ARRAYS, DOCUMENT)
    checkpoints.close()
    with Checkpoints.open(tmp_path, JOB) as again:
        found = again.load("select landmarks", "a")
        assert found is not None
        assert again.load("train", "a") is None
    assert found.document == DOCUMENT
    assert found.arrays.keys() == ARRAYS.keys()
    for name, array in found.arrays.items():
        assert array.dtype == ARRAYS[name].dtype
        assert array.flags.f_contiguous == ARRAYS[name].flags.f_contiguous
        assert np.array_equal(array, ARRAYS[name])


def test_a_checkpoint_of_other_inputs_is_not_used(
    checkpoints: Checkpoints, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    checkpoints.save("train", "a", {}, {"n": 1})
    with caplog.at_level(logging.WARNING):
        assert checkpoints.load("train", "b") is None
    assert caplog.records[0].__dict__["why"] == "it was made of other inputs"
    checkpoints.save("train", "b", {}, {"n": 2})
    assert checkpoints.load("train", "a") is None
    file_of(tmp_path).rename(file_of(tmp_path).with_name("seal.checkpoint"))
    assert checkpoints.load("seal", "b") is None, "it is that of another stage"


def test_a_damaged_checkpoint_is_not_used(checkpoints: Checkpoints, tmp_path: Path) -> None:
    checkpoints.save("train", "a", {"q": np.arange(3)}, {})
    path = file_of(tmp_path)
    whole = path.read_bytes()
    damaged = [b"", whole[:31], whole[:-1], whole + b"\0", *(flipped(whole, at) for at in range(0, len(whole), 7))]
    for content in damaged:
        path.write_bytes(content)
        assert checkpoints.load("train", "a") is None
    path.write_bytes(whole)
    assert checkpoints.load("train", "a") is not None
    path.unlink()
    path.mkdir()
    assert checkpoints.load("train", "a") is None, "what cannot be read is not there"


def flipped(content: bytes, at: int) -> bytes:
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


def test_a_file_that_was_cut_short_while_written_is_not_seen(checkpoints: Checkpoints, tmp_path: Path) -> None:
    checkpoints.save("train", "a", {}, {})
    path = file_of(tmp_path)
    path.rename(path.with_suffix(".new"))
    assert checkpoints.load("train", "a") is None


def test_one_works_on_a_job_at_a_time(checkpoints: Checkpoints, tmp_path: Path) -> None:
    def give_up() -> None:
        raise CancelledError("enough")

    with pytest.raises(CancelledError):
        Checkpoints.open(tmp_path, JOB, give_up)
    assert not remove_checkpoints(tmp_path, JOB)
    assert sweep_checkpoints(tmp_path, []) == []
    waiting, taken = threading.Event(), threading.Event()

    def take() -> None:
        with Checkpoints.open(tmp_path, JOB, waiting.set):
            taken.set()

    other = threading.Thread(target=take)
    other.start()
    assert waiting.wait(10)
    assert not taken.is_set()
    checkpoints.close()
    other.join(10)
    assert taken.is_set()


def test_the_dead_hold_nothing(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys; from pathlib import Path; from deepsimbad.store.checkpoints import Checkpoints\n"
        "held = Checkpoints.open(Path(sys.argv[1]), sys.argv[2]); os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path), JOB], check=False).returncode == -9
    with Checkpoints.open(tmp_path, JOB, lambda: pytest.fail("it is free")):
        pass


def test_folders_of_ended_jobs_go(tmp_path: Path) -> None:
    other = "f" * 32
    for job_id in (JOB, other):
        with Checkpoints.open(tmp_path, job_id) as opened:
            opened.save("train", "a", {}, {})
    assert sweep_checkpoints(tmp_path, [JOB]) == [other]
    assert [path.name for path in (tmp_path / "jobs").iterdir()] == [JOB]
    assert remove_checkpoints(tmp_path, JOB)
    assert remove_checkpoints(tmp_path, JOB), "gone is gone"
    assert list((tmp_path / "jobs").iterdir()) == []


def test_what_is_no_job_and_where_nothing_can_be_written(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError):
        Checkpoints.open(tmp_path, "../escape")
    (tmp_path / "jobs").write_bytes(b"a file in its place")
    with pytest.raises(UnavailableError):
        Checkpoints.open(tmp_path, JOB)
