import errno
import sqlite3
import threading
from pathlib import Path
from typing import Any, cast

import pytest

from deepsimbad.errors import DamagedFileError, InvalidInputError, UnavailableError
from deepsimbad.store.connection import migrate, open_database, use_write_ahead_log, write_transaction
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


class FailingCommits:
    """A connection whose next COMMIT fails, as one does whose sync the disk refused."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    def execute(self, statement: str, *values: Any) -> sqlite3.Cursor:
        if statement == "COMMIT":
            raise sqlite3.OperationalError("disk I/O error")
        return self._connection.execute(statement, *values)


def test_after_a_commit_that_failed_the_log_begins_anew(tmp_path: Path) -> None:
    """What the failed one may have left in it would look like lost commits behind a shorter one."""
    path = tmp_path / "a.sqlite"
    log = path.with_name("a.sqlite-wal")
    with open_database(path, create=True) as db:
        use_write_ahead_log(db)
        with write_transaction(db):
            db.execute("CREATE TABLE t (x)")
        salts = log.read_bytes()[16:24]
        connection = db.conn
        db.conn = cast("sqlite3.Connection", FailingCommits(connection))
        with pytest.raises(sqlite3.OperationalError), write_transaction(db):
            db.execute("INSERT INTO t VALUES (1)")
        db.conn = connection
        with write_transaction(db):
            db.execute("INSERT INTO t VALUES (2)")
        assert log.read_bytes()[16:24] != salts
        assert db.execute("SELECT x FROM t").fetchall() == [(2,)]


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
