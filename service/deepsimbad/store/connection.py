"""How every SQLite file is opened, brought to today's schema, read and written."""

import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Self, TypeVar

from sqlite_utils import Database, Migrations

from deepsimbad.errors import DamagedFileError, DamagedMapError
from deepsimbad.store.faults import storage_faults

BUSY_TIMEOUT_S = 10.0
_STRANGE_SCHEMA = "SELECT 1 FROM sqlite_schema WHERE type NOT IN ('table', 'index') OR rootpage = 0 LIMIT 1"

_Answer = TypeVar("_Answer")


def open_database(path: Path, *, read_only: bool = False, create: bool = False, immutable: bool = False) -> Database:
    """Open a file with foreign keys on and a busy timeout, usable from any thread (its owner brings the lock).

    Args:
        path: The file.
        read_only: Refuse every write.
        create: Make the file where it is missing; else a missing file is an error.
        immutable: Read a sealed file: no locks, no journal, no side files. Never for a file that may change: the newest
            rows would silently be missing.

    Raises:
        sqlite3.Error: As SQLite says it; callers stand inside `storage_faults`.
    """
    if immutable:
        mode = "mode=ro&immutable=1"
    elif read_only:
        mode = "mode=ro"
    else:
        mode = "mode=rwc" if create else "mode=rw"
    connection = sqlite3.connect(
        f"{path.resolve().as_uri()}?{mode}",
        uri=True,
        timeout=BUSY_TIMEOUT_S,
        isolation_level=None,  # no transaction begins behind our back
        check_same_thread=False,
    )
    try:
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA trusted_schema = OFF")  # files travel; their schema shall run no code
        connection.execute("PRAGMA cell_size_check = ON")
        return Database(connection, execute_plugins=False)
    except BaseException:
        connection.close()
        raise


def look_at(path: Path, ask: Callable[[Database], _Answer]) -> _Answer:
    """Ask a file something without writing anything, whether others write to it meanwhile or not.

    A file whose log is empty is read as one that does not change, which works on a read-only disk too, and is read
    again where it has changed meanwhile.

    Args:
        path: The file.
        ask: Called with the open file; a second time if need be, so it should begin from the beginning.

    Raises:
        sqlite3.Error: As SQLite says it; callers stand inside `storage_faults`.
    """
    before = _state(path)
    if before[-1] == 0:
        try:
            with open_database(path, immutable=True) as db:
                answer = ask(db)
        except BaseException:
            if _state(path) == before:
                raise
        else:
            if _state(path) == before:
                return answer
    with open_database(path, read_only=True) as db:
        return ask(db)


def _state(path: Path) -> tuple[int, ...]:
    """What changes with every write: the file's inode, size and time, and the size of its log."""
    file, log = path.stat(), path.with_name(f"{path.name}-wal")
    return file.st_ino, file.st_size, file.st_mtime_ns, log.stat().st_size if log.exists() else 0


def use_write_ahead_log(db: Database) -> None:
    """Let readers go on during writes; an acknowledged commit survives a power cut too (synchronous FULL)."""
    db.conn.execute("PRAGMA journal_mode = WAL")
    db.conn.execute("PRAGMA synchronous = FULL")


@contextmanager
def write_transaction(db: Database) -> Iterator[Database]:
    """One transaction that holds the write lock from its beginning and is undone on any error.

    `db.atomic()` begins deferred: two processes that first read and then write would both hold a read lock, and one
    would fail at once, busy timeout or not. Where it is used inside, it nests as a savepoint.
    """
    db.conn.execute("BEGIN IMMEDIATE")
    try:
        yield db
        db.conn.execute("COMMIT")
    except BaseException:
        db.rollback()
        raise


def check_integrity(
    db: Database, path: Path, damaged: type[DamagedFileError | DamagedMapError] = DamagedFileError
) -> None:
    """Check every page and index of the file; raises DamagedFileError (or `damaged`)."""
    (verdict,) = db.execute("PRAGMA integrity_check(1)").fetchone()
    if verdict != "ok":
        raise damaged(f"{path.name} is damaged: {' '.join(str(verdict).split())}", file=path.name)


def pending_migrations(
    db: Database,
    migrations: Migrations,
    path: Path,
    damaged: type[DamagedFileError | DamagedMapError] = DamagedFileError,
) -> bool:
    """Whether the file has an older schema than ours; an empty file has the oldest.

    Raises:
        DamagedFileError: (or `damaged`) The file is of another kind, a newer release wrote it, or it holds triggers,
            views or virtual tables, which no release writes: using it would run what its maker wrote.
    """
    if db.execute(_STRANGE_SCHEMA).fetchone() is not None:
        raise damaged(f"{path.name} is damaged: it holds what no release writes", file=path.name)
    try:
        pending = {migration.name for migration in migrations.pending(db)}
        applied = {migration.name for migration in migrations.applied(db)}
    except (AttributeError, LookupError, TypeError, ValueError) as error:  # a bookkeeping table of another shape
        raise damaged(f"{path.name} is damaged: its schema cannot be read", file=path.name) from error
    if not applied and db.table_names():
        raise damaged(f"{path.name} is a SQLite file of another kind", file=path.name)
    with Database(memory=True, execute_plugins=False) as nothing:
        known = {migration.name for migration in migrations.pending(nothing)}
    if applied - known:
        raise damaged(
            f"{path.name} was written by a newer release (schema {max(applied - known)}): upgrade this one",
            file=path.name,
        )
    return bool(pending)


@contextmanager
def in_todays_schema(
    db: Database,
    migrations: Migrations,
    path: Path,
    damaged: type[DamagedFileError | DamagedMapError] = DamagedFileError,
) -> Iterator[Database]:
    """The file as it is where its schema is today's, else a copy in memory that is brought to it.

    Raises:
        DamagedFileError: (or `damaged`) As `pending_migrations`.
    """
    if not pending_migrations(db, migrations, path, damaged):
        yield db
        return
    with Database(sqlite3.connect(":memory:", isolation_level=None), execute_plugins=False) as copy:
        db.conn.backup(copy.conn)
        migrations.apply(copy)
        yield copy


def migrate(db: Database, migrations: Migrations, path: Path) -> None:
    """Bring the file to today's schema, in one transaction; two processes that try at once both succeed.

    Raises:
        DamagedFileError: As `pending_migrations`.
    """
    if pending_migrations(db, migrations, path):
        with write_transaction(db):
            migrations.apply(db)


def open_working_file(path: Path, migrations: Migrations, *, create: bool = False, is_checked: bool = True) -> Database:
    """Open a file to work on: with a write-ahead log, of today's schema, and whole unless that is not to be checked."""
    db = open_database(path, create=create)
    try:
        if not create and not db.table_names():
            raise DamagedFileError(f"{path.name} is damaged: it is empty", file=path.name)
        if is_checked:
            check_integrity(db, path)
        use_write_ahead_log(db)
        migrate(db, migrations, path)
    except BaseException:
        db.close()
        raise
    return db


class OpenFile:
    """What every kind of working file has in common; usable from any thread.

    Args:
        path: The file, for messages.
        db: The same, open.
    """

    def __init__(self, path: Path, db: Database) -> None:
        self._path = path
        self._db = db
        self._lock = threading.RLock()
        self._inode = path.stat().st_ino

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @contextmanager
    def _reading(self) -> Iterator[Database]:
        """One consistent state of the file."""
        with self._lock, storage_faults(self._path), self._db.atomic() as db:
            yield db

    @property
    def is_deleted(self) -> bool:
        """Whether the file is gone, or another lies in its place."""
        with storage_faults(self._path):
            try:
                return self._path.stat().st_ino != self._inode
            except FileNotFoundError:
                return True

    def check_is_there(self) -> None:
        """Raise DamagedFileError where the file is gone: an open one goes on without its name, until it is closed."""
        if self.is_deleted:
            raise DamagedFileError(f"{self._path.name} was removed under the running service", file=self._path.name)


def close_with_log(db: Database, path: Path) -> None:
    """Close a file's last writer so that its log, empty, stays: on a full disk the next start could make no new one."""
    with suppress(sqlite3.Error), open_database(path, read_only=True) as last:
        db.conn.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        last.execute("SELECT 1 FROM sqlite_schema LIMIT 1").fetchall()  # a reader that is the last leaves it
        db.close()
    db.close()
