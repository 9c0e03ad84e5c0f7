"""One service a data directory."""

import errno
import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from deepsimbad.errors import DataDirInUseError, UnavailableError
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.service_lock import ServiceLock

CHILD = """
import sys
from pathlib import Path
from deepsimbad.store.service_lock import ServiceLock
lock = ServiceLock.take(Path(sys.argv[1]), "127.0.0.1:8000")
print("locked", flush=True)
sys.stdin.read()
"""


def test_the_second_is_refused_and_told_whose_it_is(tmp_path: Path) -> None:
    data_dir = tmp_path / "a" / "b"
    with ServiceLock.take(data_dir, "127.0.0.1:8000"):
        with pytest.raises(DataDirInUseError) as caught:
            ServiceLock.take(data_dir, "127.0.0.1:8001")
        assert f"process {os.getpid()}, listening on 127.0.0.1:8000" in caught.value.message
        assert caught.value.hints == {"pid": os.getpid(), "address": "127.0.0.1:8000"}
        with ServiceLock.take(tmp_path / "other", "127.0.0.1:8001"):
            pass
    with ServiceLock.take(data_dir, "127.0.0.1:8001"):
        pass


def test_releasing_twice_frees_nothing_of_another(tmp_path: Path) -> None:
    first = ServiceLock.take(tmp_path, "a")
    first.release()
    with ServiceLock.take(tmp_path, "b"):
        first.release()
        with pytest.raises(DataDirInUseError):
            ServiceLock.take(tmp_path, "c")


def test_a_killed_service_holds_nothing(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "locked\n"
        with pytest.raises(DataDirInUseError, match=f"process {child.pid}"):
            ServiceLock.take(tmp_path, "x")
        child.send_signal(signal.SIGKILL)
        child.wait()
    ServiceLock.take(tmp_path, "x").release()


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"[1]", b'{"pid": 1'])
def test_a_lock_file_that_says_nothing_is_a_lock_all_the_same(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "service.lock").write_bytes(content)
    with (tmp_path / "service.lock").open() as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(DataDirInUseError, match="process unknown"):
            ServiceLock.take(tmp_path, "x")
    ServiceLock.take(tmp_path, "x").release()


def test_a_folder_that_cannot_be_made_is_named() -> None:
    with pytest.raises(UnavailableError, match="the data directory /proc/nowhere/here cannot be made"):
        ServiceLock.take(Path("/proc/nowhere/here"), "x")


def test_a_file_in_the_place_of_the_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("mine")
    with pytest.raises(UnavailableError, match=f"the data directory {tmp_path / 'data'} cannot be made: File exists"):
        ServiceLock.take(tmp_path / "data", "x")


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_file_system_without_locks_is_named(tmp_path: Path, number: int) -> None:
    """What flock answers on such a file system; none can be counted on to be at hand."""
    with pytest.raises(UnavailableError, match="local disk") as caught, storage_faults(tmp_path / "lock"):
        raise OSError(number, os.strerror(number))
    assert caught.value.hints["reason"] == "no_locks"


def test_a_lock_that_the_file_system_refuses_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(UnavailableError, match=r"locks no files .* local disk"):
        ServiceLock.take(tmp_path, "x")
