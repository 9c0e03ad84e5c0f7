"""How every SQLite file is opened, brought to today's schema and written to."""

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from sqlite_utils import Database, Migrations

from deepsimbad.errors import DamagedFileError, DamagedMapError

BUSY_TIMEOUT_S = 10.0

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
    """Ask a file something without leaving a trace of the asking, whether others write to it meanwhile or not.

    A reader that SQLite lets join a write-ahead log creates the log where nobody has it open, and leaves it there. So
    a file without a log is read as one that does not change, and read again where it did.

    Args:
        path: The file.
        ask: Called with the open file; a second time if need be, so it should begin from the beginning.

    Raises:
        sqlite3.Error: As SQLite says it; callers stand inside `storage_faults`.
    """
    log = path.with_name(f"{path.name}-wal")
    if not log.exists():
        before = _age(path)
        try:
            with open_database(path, immutable=True) as db:
                answer = ask(db)
        except BaseException:
            if _age(path) == before and not log.exists():
                raise
        else:
            if _age(path) == before and not log.exists():
                return answer
    with open_database(path, read_only=True) as db:
        return ask(db)


def _age(path: Path) -> tuple[int, int, int]:
    found = path.stat()
    return found.st_ino, found.st_size, found.st_mtime_ns


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
        _commit(db)
    except BaseException:
        db.rollback()
        raise


def _commit(db: Database) -> None:
    try:
        db.conn.execute("COMMIT")
    except sqlite3.Error:
        # Where the sync failed, the log holds a transaction that we call failed, with its end. The next one, if
        # shorter, would leave that end behind it, which looks like lost commits: a log begun anew has other salts.
        db.rollback()
        with suppress(sqlite3.Error):
            db.conn.execute("PRAGMA wal_checkpoint(RESTART)")
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
        DamagedFileError: (or `damaged`) The file is of another kind, or a newer release wrote it.
    """
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
        DamagedFileError: (or `damaged`) The file is of another kind, or a newer release wrote it.
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
        DamagedFileError: The file is of another kind, or a newer release wrote it.
    """
    if pending_migrations(db, migrations, path):
        with write_transaction(db):
            migrations.apply(db)
