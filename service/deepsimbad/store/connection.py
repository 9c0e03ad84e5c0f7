"""How every SQLite file is opened, brought to today's schema, read and written."""

import asyncio
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Self, TypeAlias, TypeVar

from sqlite_utils import Database, Migrations

from deepsimbad.errors import DamagedFileError, DeepSimbadError, UnavailableError
from deepsimbad.store.durable import storage_faults

T = TypeVar("T")
FileState: TypeAlias = tuple[int, ...]
_Write: TypeAlias = tuple[Callable[[Database], Any], Future[Any]]

BUSY_TIMEOUT_S = 10.0
MAX_BATCH = 256  # writes in one transaction; with so many no more are added
_STRANGE_SCHEMA = "SELECT 1 FROM sqlite_schema WHERE type NOT IN ('table', 'index') OR rootpage = 0 LIMIT 1"


def open_database(path: Path, *, read_only: bool = False, create: bool = False, immutable: bool = False) -> Database:
    """Open a file with foreign keys on and a busy timeout, usable from any thread (its owner brings the lock).

    An `immutable` file is read without locks, journal or side files. Never for one that may change: the newest rows
    would silently be missing.
    """
    mode = "ro&immutable=1" if immutable else "ro" if read_only else "rwc" if create else "rw"
    connection = sqlite3.connect(
        f"{path.resolve().as_uri()}?mode={mode}",
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


def look_at(path: Path, ask: Callable[[Database], T]) -> T:
    """Ask a file something, twice if need be, without writing anything, whether others write to it meanwhile or not.

    A file whose log is empty is read as one that does not change, which works on a read-only disk too, and is read
    again where it has changed meanwhile.
    """
    state = file_state(path)
    if state[-1] == 0:
        try:
            with open_database(path, immutable=True) as db:
                answer = ask(db)
        except BaseException:
            if file_state(path) == state:
                raise
        else:
            if file_state(path) == state:
                return answer
    with open_database(path, read_only=True) as db:
        return ask(db)


def file_state(path: Path) -> FileState:
    """What changes with every write: the file's inode, size and time, and the time and size of its log.

    A log that begins anew is written over: it keeps its size.
    """
    file = path.stat()
    try:  # the last one that closes the file removes its log
        log = path.with_name(f"{path.name}-wal").stat()
    except FileNotFoundError:
        return file.st_ino, file.st_size, file.st_mtime_ns, 0, 0
    return file.st_ino, file.st_size, file.st_mtime_ns, log.st_mtime_ns, log.st_size


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


def check_integrity(db: Database, path: Path) -> None:
    """Check every page and index of the file; raises DamagedFileError."""
    (verdict,) = db.execute("PRAGMA integrity_check(1)").fetchone()
    if verdict != "ok":
        raise DamagedFileError(f"{path.name} is damaged: {' '.join(str(verdict).split())}", file=path.name)


def pending_migrations(db: Database, migrations: Migrations, path: Path) -> bool:
    """Whether the file has an older schema than ours; an empty file has the oldest.

    Raises DamagedFileError where it is of another kind, of a newer release, or holds triggers, views or virtual tables,
    which no release writes: using it would run what its maker wrote.
    """
    if db.execute(_STRANGE_SCHEMA).fetchone() is not None:
        raise DamagedFileError(f"{path.name} is damaged: it holds what no release writes", file=path.name)
    try:
        pending_names = {migration.name for migration in migrations.pending(db)}
        applied_names = {migration.name for migration in migrations.applied(db)}
    except (AttributeError, LookupError, TypeError, ValueError) as error:  # a bookkeeping table of another shape
        raise DamagedFileError(f"{path.name} is damaged: its schema cannot be read", file=path.name) from error
    if not applied_names and db.table_names():
        raise DamagedFileError(f"{path.name} is a SQLite file of another kind", file=path.name)
    with Database(memory=True, execute_plugins=False) as empty_db:
        newer_names = applied_names - {migration.name for migration in migrations.pending(empty_db)}
    if newer_names:
        raise DamagedFileError(
            f"{path.name} was written by a newer release (schema {max(newer_names)}): upgrade this one", file=path.name
        )
    return bool(pending_names)


@contextmanager
def in_todays_schema(db: Database, migrations: Migrations, path: Path) -> Iterator[Database]:
    """The file as it is where its schema is today's, else a copy in memory brought to it; as `pending_migrations`."""
    if not pending_migrations(db, migrations, path):
        yield db
        return
    with Database(sqlite3.connect(":memory:", isolation_level=None), execute_plugins=False) as copy:
        db.conn.backup(copy.conn)
        migrations.apply(copy)
        yield copy


def open_working_file(path: Path, migrations: Migrations, *, create: bool = False, is_checked: bool = True) -> Database:
    """Open a file to work on, brought to today's schema, whole unless that is not to be checked.

    With a write-ahead log readers go on during writes, and an acknowledged commit survives a power cut.
    """
    db = open_database(path, create=create)
    try:
        if not create and not db.table_names():
            raise DamagedFileError(f"{path.name} is damaged: it is empty", file=path.name)
        if is_checked:
            check_integrity(db, path)
        _write_ahead(db)
        db.conn.execute("PRAGMA synchronous = FULL")
        if pending_migrations(db, migrations, path):
            with write_transaction(db):  # two processes that try at once both succeed
                migrations.apply(db)
    except BaseException:
        db.close()
        raise
    return db


def _write_ahead(db: Database) -> None:
    """Give the file a write-ahead log: where many make one file at once SQLite refuses that without waiting."""
    give_up_at_s = time.monotonic() + BUSY_TIMEOUT_S
    while True:
        try:
            db.conn.execute("PRAGMA journal_mode = WAL")
            return
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() > give_up_at_s:
                raise
            time.sleep(0.01)


class OpenFile:
    """A working file, usable from any thread; with a `reader`, open a second time, no reader waits for a writer."""

    def __init__(self, path: Path, db: Database, reader: Database | None = None) -> None:
        self._path = path
        self._db = db
        self._lock = threading.RLock()
        self._reader = reader or db
        self._reader_lock = threading.RLock() if reader else self._lock
        self._inodes = {path: path.stat().st_ino}
        # SQLite removes its log only when the last connection closes, and this one is open.
        if (log := path.with_name(f"{path.name}-wal")).exists():
            self._inodes[log] = log.stat().st_ino

    def close(self) -> None:
        """Close the file; where readers have their own connection its log, empty, stays.

        On a full disk the next start could make no new one.
        """
        with self._lock, self._reader_lock:
            if self._reader is not self._db:
                self._reader.close()
                with suppress(sqlite3.Error), open_database(self._path, read_only=True) as reader:
                    self._db.conn.execute("PRAGMA wal_checkpoint(TRUNCATE)")
                    reader.execute("SELECT 1 FROM sqlite_schema LIMIT 1").fetchall()  # the last to close leaves the log
                    self._db.close()
            self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @contextmanager
    def _reading(self) -> Iterator[Database]:
        """One consistent state of the file, of what was committed before."""
        with self._reader_lock, storage_faults(self._path), self._reader.atomic() as db:
            yield db

    @contextmanager
    def _writing(self) -> Iterator[Database]:
        with self._lock, storage_faults(self._path), write_transaction(self._db) as db:
            self.check_is_there()
            yield db

    def check(self) -> None:
        """Raise what keeps the file from being read."""
        with self._reading() as db:
            for table in db.table_names():
                next(db.table(table).rows_where(limit=1), None)
        self.check_is_there()

    def check_is_there(self) -> None:
        """Raise `_removal_error` where the file or its log is gone or another: whoever has them open would not notice.

        Without the log a crash would lose commits.
        """
        with storage_faults(self._path):
            for path, inode in self._inodes.items():
                try:
                    is_there = path.stat().st_ino == inode
                except FileNotFoundError:
                    is_there = False
                if not is_there:
                    raise self._removal_error(path)

    def _removal_error(self, path: Path) -> DeepSimbadError:
        return DamagedFileError(f"{path.name} was removed under the running service", file=path.name)


class GroupCommit:
    """One thread that commits what others hand in; a write counts when its future has a result, not earlier.

    Many writers, one disk: whatever waits while a transaction is being synced goes into the next one together.
    `on_commit` is told the number of writes of every transaction.
    """

    def __init__(
        self, transaction: Callable[[], AbstractContextManager[Database]], on_commit: Callable[[int], None]
    ) -> None:
        self._transaction = transaction
        self._on_commit = on_commit
        self._queue: SimpleQueue[list[_Write] | None] = SimpleQueue()
        self._turn_writes: list[_Write] = []
        self._is_crowded = False  # whether there were several at the last turn
        self._is_idle = False
        self._is_open = True
        self._lock = threading.Lock()
        self.thread = threading.Thread(target=self._work, name="commits", daemon=True)
        self.thread.start()

    def submit(self, run: Callable[[Database], T], *, by_turns: bool = False) -> Future[T]:
        """Queue a write that is made inside a transaction, perhaps a second time in another one.

        Its future has a result once it is on the disk, or its error, and then nothing of it was kept.

        Args:
            run: The write.
            by_turns: Whether it may be handed over with all that the event loop, where one runs here, submits so at
                this turn, which it is while many are, or another transaction is under way: then it cannot be waited for
                before the turn ends.
        """
        future: Future[T] = Future()
        future.set_running_or_notify_cancel()  # whoever stops waiting does not undo it; before the thread can end it
        try:
            loop = asyncio.get_running_loop() if by_turns else None
        except RuntimeError:
            loop = None
        with self._lock:
            if not self._is_open:
                raise UnavailableError("the service is shutting down")
            if loop is None or (self._is_idle and not self._is_crowded):
                self._is_idle = False
                self._queue.put([(run, future)])
                return future
            if not self._turn_writes:
                loop.call_soon(self._hand_over)  # behind all that is ready now
            self._turn_writes.append((run, future))
        return future

    def _hand_over(self) -> None:
        with self._lock:
            self._queue.put(self._turn_writes)
            self._is_crowded = len(self._turn_writes) > 1
            self._turn_writes = []

    def close(self) -> None:
        """Commit what waits, then end the thread."""
        with self._lock:
            was_open, self._is_open = self._is_open, False
        if was_open:
            self._hand_over()
            self._queue.put(None)
        self.thread.join()

    def _work(self) -> None:
        while True:
            self._is_idle = self._queue.empty()
            writes = self._queue.get()
            if writes is None:
                return
            batch = writes
            while len(batch) < MAX_BATCH and not self._queue.empty():
                writes = self._queue.get()
                if writes is None:
                    break
                batch += writes
            if batch:
                self._commit(batch)
            if writes is None:
                return

    def _commit(self, batch: list[_Write]) -> None:
        results: list[Any] | None = None  # until a transaction has begun
        try:
            with self._transaction() as db:
                results = []
                for run, _ in batch:
                    results.append(run(db))
        except BaseException as error:
            if len(batch) == 1 or results is None:  # where none begins, every one would wait as long as the first
                for _, future in batch:
                    future.set_exception(error)
                return
            for write in batch:  # one that cannot be written should not take the others with it
                self._commit([write])
            return
        self._on_commit(len(batch))
        for (_, future), result in zip(batch, results, strict=True):
            future.set_result(result)
