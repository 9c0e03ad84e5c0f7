"""How files are named, opened and locked, and what the disk and SQLite answer."""

import errno
import os
import signal
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from sqlite_utils import Database

from deepsimbad.errors import DamagedFileError, DataDirInUseError, InvalidInputError, UnavailableError
from deepsimbad.store import layout
from deepsimbad.store.connection import OpenFile, open_database, open_working_file, write_transaction
from deepsimbad.store.durable import service_lock, storage_faults
from deepsimbad_migrations.catalog.migrations import migrations as catalog_migrations
from deepsimbad_migrations.traverse.migrations import migrations as traverse_migrations

from .conftest import at_once


@pytest.fixture
def db(tmp_path: Path) -> Database:
    with open_database(tmp_path / "a.sqlite", create=True) as db:
        db.execute("CREATE TABLE a (b NOT NULL)")
        yield db


@pytest.mark.parametrize("name", ["a", "9", "Summer-2012_01.08", "a" * 64, "a..b"])
def test_good_names_stay_inside_the_data_directory(name: str, tmp_path: Path) -> None:
    path = layout.traverse_path(tmp_path, name, name)
    assert path.resolve().parent == (tmp_path / "domains" / name / "traverses").resolve()


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../x", "a/b", "a\\b", "-a", "_a", ".a", "a b", "a\n", "a\0", "é", "\ud800", "a" * 65]
)
def test_bad_names_never_become_paths(name: str, tmp_path: Path) -> None:
    for path_of in (
        lambda: layout.traverse_path(tmp_path, "campus", name),
        lambda: layout.traverse_path(tmp_path, name, "summer"),
        lambda: layout.map_path(tmp_path, name, 1),
    ):
        with pytest.raises(InvalidInputError):
            path_of()


def test_map_files_are_named_by_version(tmp_path: Path) -> None:
    assert layout.map_path(tmp_path, "campus", 7) == tmp_path / "domains/campus/maps/000007.sqlite"
    assert layout.map_path(tmp_path, "campus", 1_234_567).name == "1234567.sqlite"
    for version in (0, -1, 2**60):
        with pytest.raises(InvalidInputError):
            layout.map_path(tmp_path, "campus", version)


def test_a_missing_file_is_not_made_by_looking(tmp_path: Path) -> None:
    path = tmp_path / "missing.sqlite"
    for options in ({}, {"read_only": True}, {"immutable": True}):
        with pytest.raises(UnavailableError) as caught, storage_faults(path):
            open_database(path, **options)
        assert caught.value.hints["reason"] == "cannot_open"
    assert not path.exists()


def test_a_write_transaction_is_undone_on_any_error(db: Database) -> None:
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


def test_what_sqlite_says_is_named(db: Database, tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"

    def reason(db: Database, statement: str) -> object:
        with pytest.raises(UnavailableError) as caught, storage_faults(path):
            db.execute(statement)
        assert isinstance(caught.value.__cause__, sqlite3.Error)
        return caught.value.hints["reason"]

    with open_database(path, read_only=True) as reader:
        assert reason(reader, "INSERT INTO a VALUES (1)") == "read_only"
    with open_database(path) as other, write_transaction(db):
        other.conn.execute("PRAGMA busy_timeout = 10")
        assert reason(other, "INSERT INTO a VALUES (1)") == "busy"
    db.conn.execute("PRAGMA max_page_count = 2")
    assert reason(db, "INSERT INTO a VALUES (zeroblob(100000))") == "disk_full"
    with pytest.raises(InvalidInputError), storage_faults(path):
        db.execute("INSERT INTO a VALUES (NULL)")


@pytest.mark.parametrize(
    ("number", "reason"),
    [
        (errno.ENOSPC, "disk_full"),
        (errno.EFBIG, "disk_full"),
        (errno.EROFS, "read_only"),
        (errno.EACCES, "read_only"),
        (errno.EIO, "io_error"),
        (errno.ENOLCK, "no_locks"),
    ],
)
def test_what_the_system_says_is_named(number: int, reason: str, tmp_path: Path) -> None:
    with pytest.raises(UnavailableError) as caught, storage_faults(tmp_path / "a.sqlite"):
        raise OSError(number, "as the kernel says it")
    assert caught.value.hints["reason"] == reason


def test_a_file_that_is_made_by_many_at_once_is_whole(tmp_path: Path) -> None:
    at_once(4 * [lambda: open_working_file(tmp_path / "a.sqlite", catalog_migrations, create=True).close()])


def test_a_file_that_another_one_makes_at_this_moment_is_waited_for(tmp_path: Path) -> None:
    with open_database(tmp_path / "a.sqlite", create=True) as first:
        first.conn.execute("BEGIN IMMEDIATE")
        timer = threading.Timer(0.3, first.conn.execute, ["COMMIT"])
        timer.start()
        open_working_file(tmp_path / "a.sqlite", catalog_migrations, create=True).close()
        timer.join()


def test_a_file_of_another_kind_or_of_a_newer_release_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    with open_working_file(path, catalog_migrations, create=True) as db:
        db.execute(
            "INSERT INTO _sqlite_migrations (migration_set, name, applied_at) VALUES (?, 'm999_future', '')",
            [catalog_migrations.name],
        )
    with pytest.raises(DamagedFileError, match="another kind"):
        open_working_file(path, traverse_migrations)
    with pytest.raises(DamagedFileError, match="m999_future"):
        open_working_file(path, catalog_migrations)


def test_a_closed_file_keeps_its_log_empty(tmp_path: Path) -> None:
    """On a full disk the next one to open it could not make a log."""
    path = tmp_path / "a.sqlite"
    OpenFile(path, open_working_file(path, catalog_migrations, create=True), open_database(path)).close()
    sizes = {file.name: file.stat().st_size for file in tmp_path.iterdir()}
    assert sizes.pop("a.sqlite") > 0
    assert sizes == {"a.sqlite-wal": 0, "a.sqlite-shm": 32768}


CHILD = """
import sys
from pathlib import Path
from deepsimbad.store.durable import service_lock
with service_lock(Path(sys.argv[1]), "127.0.0.1:8000"):
    print("locked", flush=True)
    sys.stdin.read()
"""


def take(data_dir: Path) -> None:
    with service_lock(data_dir, "127.0.0.1:8001"):
        pass


def test_the_second_is_refused_and_told_whose_it_is(tmp_path: Path) -> None:
    data_dir = tmp_path / "a" / "b"
    with service_lock(data_dir, "127.0.0.1:8000"):
        with pytest.raises(DataDirInUseError, match=f"process {os.getpid()}, listening on 127.0.0.1:8000") as caught:
            take(data_dir)
        assert caught.value.hints == {"pid": os.getpid(), "address": "127.0.0.1:8000"}
        take(tmp_path / "other")
        (data_dir / "service.lock").write_bytes(b'{"pid": 1')
        with pytest.raises(DataDirInUseError, match="process unknown"):
            take(data_dir)
        (data_dir / "service.lock").unlink()
        with pytest.raises(DataDirInUseError, match="process unknown"):
            take(data_dir)
    take(data_dir)


def test_a_killed_service_holds_nothing(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "locked\n"
        with pytest.raises(DataDirInUseError, match=f"process {child.pid}"):
            take(tmp_path)
        child.send_signal(signal.SIGKILL)
        child.wait()
    take(tmp_path)


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("mine")
    for folder in (Path("/proc/nowhere/here"), tmp_path / "data"):
        with pytest.raises(UnavailableError, match=folder.name):
            take(folder)
