"""How files are opened and locked, and what the disk and SQLite answer."""

import errno
import fcntl
import os
import signal
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from deepsimbad.errors import DamagedFileError, DataDirInUseError, InvalidInputError, UnavailableError
from deepsimbad.store.connection import close_with_log, migrate, open_database, use_write_ahead_log, write_transaction
from deepsimbad.store.data_dir import ServiceLock
from deepsimbad.store.faults import storage_faults
from deepsimbad_migrations.catalog.migrations import migrations as catalog_migrations
from deepsimbad_migrations.traverse.migrations import migrations as traverse_migrations


def test_a_connection_enforces_foreign_keys_waits_and_crosses_threads(tmp_path: Path) -> None:
    with open_database(tmp_path / "a b?#.sqlite", create=True) as db:
        assert db.conn.execute("PRAGMA foreign_keys").fetchone() == (1,)
        assert db.conn.execute("PRAGMA busy_timeout").fetchone() == (10_000,)
        use_write_ahead_log(db)
        assert db.conn.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        assert db.conn.execute("PRAGMA synchronous").fetchone() == (2,)
        seen: list[object] = []
        thread = threading.Thread(target=lambda: seen.append(db.execute("SELECT 1").fetchone()))
        thread.start()
        thread.join()
        assert seen == [(1,)]
    assert (tmp_path / "a b?#.sqlite").exists()


def test_a_missing_file_is_not_made_by_looking(tmp_path: Path) -> None:
    path = tmp_path / "missing.sqlite"
    for options in ({}, {"read_only": True}, {"immutable": True}):
        with pytest.raises(UnavailableError) as caught, storage_faults(path):
            open_database(path, **options)
        assert caught.value.hints["reason"] == "cannot_open"
    assert not path.exists()


def test_a_read_only_connection_refuses_writes_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    with open_database(path, create=True) as db:
        db.execute("CREATE TABLE a (b)")
    with open_database(path, read_only=True) as db:
        with pytest.raises(UnavailableError) as caught, storage_faults(path):
            db.execute("INSERT INTO a VALUES (1)")
        assert caught.value.hints["reason"] == "read_only"
        assert isinstance(caught.value.__cause__, sqlite3.Error)


def test_a_write_transaction_is_undone_on_any_error(tmp_path: Path) -> None:
    with open_database(tmp_path / "a.sqlite", create=True) as db:
        db.execute("CREATE TABLE a (b)")

        def interrupted() -> None:
            with write_transaction(db):
                db.execute("INSERT INTO a VALUES (1)")
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            interrupted()
        assert db.execute("SELECT count(*) FROM a").fetchone() == (0,)
        with write_transaction(db):
            db.execute("INSERT INTO a VALUES (1)")
        assert db.execute("SELECT count(*) FROM a").fetchone() == (1,)


def test_a_locked_file_is_busy_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    with open_database(path, create=True) as holder, open_database(path) as other:
        other.conn.execute("PRAGMA busy_timeout = 10")
        with write_transaction(holder):
            with pytest.raises(UnavailableError) as caught, storage_faults(path), write_transaction(other):
                pass
            assert caught.value.hints["reason"] == "busy"


@pytest.mark.parametrize(
    ("number", "reason"),
    [(errno.ENOSPC, "disk_full"), (errno.EROFS, "read_only"), (errno.EACCES, "read_only"), (errno.EIO, "io_error")],
)
def test_what_the_system_says_is_named(number: int, reason: str, tmp_path: Path) -> None:
    with pytest.raises(UnavailableError) as caught, storage_faults(tmp_path / "a.sqlite"):
        raise OSError(number, "as the kernel says it")
    assert caught.value.hints["reason"] == reason


def test_a_full_disk_and_a_refused_value_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    with open_database(path, create=True) as db:
        db.execute("CREATE TABLE a (b NOT NULL)")
        db.conn.execute("PRAGMA max_page_count = 2")
        with pytest.raises(UnavailableError) as caught, storage_faults(path):
            db.execute("INSERT INTO a VALUES (zeroblob(100000))")
        assert caught.value.hints["reason"] == "disk_full"
        with pytest.raises(InvalidInputError), storage_faults(path):
            db.execute("INSERT INTO a VALUES (NULL)")


def test_migrating_twice_or_at_once_is_the_same(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    failures: list[BaseException] = []
    start = threading.Barrier(4)

    def run() -> None:
        try:
            with open_database(path, create=True) as db:
                start.wait()
                migrate(db, catalog_migrations, path)
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=run) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []


def test_a_file_of_another_kind_or_of_a_newer_release_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    with open_database(path, create=True) as db:
        migrate(db, catalog_migrations, path)
        with pytest.raises(DamagedFileError, match="another kind"):
            migrate(db, traverse_migrations, path)
        db.execute(
            "INSERT INTO _sqlite_migrations (migration_set, name, applied_at) VALUES (?, 'm999_future', '')",
            [catalog_migrations.name],
        )
        with pytest.raises(DamagedFileError, match="m999_future"):
            migrate(db, catalog_migrations, path)


def test_a_closed_file_keeps_its_log_empty(tmp_path: Path) -> None:
    """On a full disk the next one to open it could not make a log."""
    path = tmp_path / "a.sqlite"
    db = open_database(path, create=True)
    use_write_ahead_log(db)
    db.execute("CREATE TABLE a (b)")
    close_with_log(db, path)
    sizes = {file.name: file.stat().st_size for file in tmp_path.iterdir()}
    assert sizes == {"a.sqlite": 8192, "a.sqlite-wal": 0, "a.sqlite-shm": 32768}


CHILD = """
import sys
from pathlib import Path
from deepsimbad.store.data_dir import ServiceLock
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


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe", b'{"pid": 1'])
def test_a_lock_whose_file_says_nothing_or_is_gone_is_one_all_the_same(tmp_path: Path, content: bytes | None) -> None:
    with ServiceLock.take(tmp_path, "x"):
        (tmp_path / "service.lock").unlink()
        if content is not None:
            (tmp_path / "service.lock").write_bytes(content)
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
    with pytest.raises(UnavailableError, match=r"cannot be locked .* local disk"):
        ServiceLock.take(tmp_path, "x")
