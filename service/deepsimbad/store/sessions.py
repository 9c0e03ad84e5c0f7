"""The file of live sessions: whatever was acknowledged to a robot survives kill -9 and a power cut."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.errors import UnavailableError, UnknownSessionError
from deepsimbad.store import journal, layout
from deepsimbad.store.connection import (
    OpenFile,
    close_with_log,
    open_database,
    open_working_file,
    write_transaction,
)
from deepsimbad.store.data_dir import make_data_dir
from deepsimbad.store.durable import sync
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.journal import JournalRow, ListedSession, SessionRecord, StateSnapshot
from deepsimbad.store.records import ListPage, from_json, to_json
from deepsimbad_migrations.session.migrations import migrations

T = TypeVar("T")
_Write = tuple[Callable[[Database], Any], "Future[Any]"]

MAX_BATCH = 256  # writes in one transaction
PURGED_AT_ONCE = 1000  # rows
_CHECKED_AT_START_BYTES = 64 * 1024 * 1024  # a service shall be ready soon; `deepsimbad check` reads more
_MAX_NUMBER = 2**63 - 1
_SELECT = """
    SELECT session.number, session_id, domain, map_version, map_sha256, config, created_at,
           coalesce(latest.expires_at, session.expires_at), coalesce(latest.sequence, 0), ending, key_id
    FROM session LEFT JOIN journal AS latest
      ON latest.session = session.number
     AND latest.sequence = (SELECT max(sequence) FROM journal WHERE session = session.number)
"""


class SessionStore(OpenFile):
    """Sessions and their journals; usable from any thread.

    Writes are futures: done when they are on the disk, those of one moment in one transaction. Reads see what is
    done. Every method, and every future, raises UnavailableError or DamagedFileError where the file cannot be used.

    Args:
        path: The file.
        reading: The open file, for reads.
        writing: The open file a second time, for writes.
        on_commit: Called with the number of writes of every transaction.
    """

    def __init__(self, path: Path, reading: Database, writing: Database, on_commit: Callable[[int], None]) -> None:
        super().__init__(path, reading)
        self._writing = writing
        self._commits = GroupCommit(self._transaction, on_commit)

    @classmethod
    def open(cls, data_dir: Path, on_commit: Callable[[int], None] = lambda _: None) -> Self:
        """Open the sessions of a data directory; makes the file where it is missing."""
        path = layout.sessions_path(data_dir)
        make_data_dir(data_dir)
        with storage_faults(path):
            is_small = not path.exists() or path.stat().st_size <= _CHECKED_AT_START_BYTES
            writing = open_working_file(path, migrations, create=True, is_checked=is_small)
            sync(data_dir)
            return cls(path, open_database(path), writing, on_commit)

    def close(self) -> None:
        """Commit what waits, then close the file."""
        self._commits.close()
        with self._lock:
            super().close()
            close_with_log(self._writing, self._path)

    @contextmanager
    def _transaction(self) -> Iterator[Database]:
        with storage_faults(self._path):
            self.check_is_there()
            with write_transaction(self._writing) as db:
                yield db

    def check(self) -> None:
        """Raise what keeps the file from being read."""
        with self._reading() as db:
            db.execute("SELECT number FROM session LIMIT 1").fetchall()
        self.check_is_there()

    def try_writing(self) -> Future[None]:
        """Write something to the disk that means nothing."""

        def write(db: Database) -> None:
            (version,) = db.execute("PRAGMA user_version").fetchone()
            db.execute(f"PRAGMA user_version = {1 - min(version, 1)}")

        return self._commits.submit(write)

    @property
    def is_committing(self) -> bool:
        """Whether the thread that writes is alive."""
        return self._commits.is_alive

    # Sessions

    def create(self, record: SessionRecord) -> Future[SessionRecord]:
        """Keep a new session; answers with the number that it got, or the session that has this id already."""

        def write(db: Database) -> SessionRecord:
            db.execute(
                """
                INSERT INTO session
                    (session_id, domain, map_version, map_sha256, config, created_at, expires_at, key_id)
                VALUES (?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT (session_id) DO NOTHING
                """,
                [
                    *(record.session_id, record.domain, record.map_version, record.map_sha256),
                    *(to_json(record.config), record.created_at, record.expires_at, record.key_id),
                ],
            )
            return _get(db, record.session_id)

        return self._commits.submit(write)

    def find(self, session_id: str) -> SessionRecord:
        """One session, living or ended; raises UnknownSessionError."""
        with self._reading() as db:
            return _get(db, session_id)

    def living(self) -> list[SessionRecord]:
        """Every session that has not ended, oldest first."""
        with self._reading() as db:
            rows = db.execute(f"{_SELECT} WHERE session.ended_at IS NULL ORDER BY session.number")
            return [_session(row) for row in rows]

    def pins(self) -> set[tuple[str, int]]:
        """Domain and map version of every session that has not ended."""
        with self._reading() as db:
            return set(db.execute("SELECT DISTINCT domain, map_version FROM session WHERE ended_at IS NULL"))

    def newest_living(
        self, domain: str | None, before: int | None, limit: int, at: float
    ) -> ListPage[ListedSession, int]:
        """A page of the sessions that live at a moment, of a domain or all, newest first, behind number `before`.

        Counting views can take a while, so it reads through a connection of its own: no robot waits for a list.
        """
        with storage_faults(self._path), open_database(self._path, read_only=True) as db, db.atomic():
            rows = db.execute(
                f"""
                {_SELECT}
                WHERE session.ended_at IS NULL AND session.number < ? AND domain = coalesce(?, domain)
                  AND coalesce(latest.expires_at, session.expires_at) > ?
                ORDER BY session.number DESC LIMIT ?
                """,
                [_MAX_NUMBER if before is None else before, domain, at, limit + 1],
            ).fetchall()
            listed = [ListedSession(_session(row), journal.n_observations(db, row[0])) for row in rows]
            return ListPage.of(((entry.session.number, entry) for entry in listed), limit)

    def end(self, number: int, ending: str, ended_at: float) -> Future[bool]:
        """End a session ("deleted", "expired"); its journal stays until it is purged.

        Answers whether it has ended by this: it had not before, and has indeed expired where that is to be its ending.
        """

        def write(db: Database) -> bool:
            n_ended = db.execute(
                """
                UPDATE session SET ended_at = :at, ending = :ending
                WHERE number = :number AND ended_at IS NULL AND (:ending != 'expired' OR :at >= coalesce(
                    (SELECT expires_at FROM journal WHERE session = :number ORDER BY sequence DESC LIMIT 1),
                    expires_at))
                """,
                {"at": ended_at, "ending": ending, "number": number},
            ).rowcount
            if n_ended:
                db.execute("DELETE FROM snapshot WHERE session = ?", [number])
            return bool(n_ended)

        return self._commits.submit(write)

    def purge(self, ended_before: float) -> Future[bool]:
        """Forget some of what ended before a moment, journals first, so little that no robot waits for it.

        Answers whether there is more to forget.
        """

        def write(db: Database) -> bool:
            n_rows = db.execute(
                """
                DELETE FROM journal WHERE rowid IN (
                    SELECT journal.rowid FROM session JOIN journal ON journal.session = session.number
                    WHERE ended_at < ? LIMIT ?
                )
                """,
                [ended_before, PURGED_AT_ONCE],
            ).rowcount
            if n_rows < PURGED_AT_ONCE:
                db.execute("DELETE FROM session WHERE ended_at < ?", [ended_before])
            return bool(n_rows >= PURGED_AT_ONCE)

        return self._commits.submit(write)

    # What happened to them

    def append(
        self, number: int, row: JournalRow, written_at: float, snapshot: StateSnapshot | None = None
    ) -> Future[None]:
        """Write the next row of a session's journal, and with it a snapshot of the state after an earlier row.

        The future raises InvalidInputError where a row of that sequence number is there.
        """
        return self._commits.submit(
            partial(journal.append, session=number, row=row, written_at=written_at, snapshot=snapshot)
        )

    def history(self, number: int, until: int) -> tuple[StateSnapshot | None, list[JournalRow]]:
        """What makes up the state after a row: the snapshot, if it is from before that row, and the rows since."""
        with self._reading() as db:
            snapshot = journal.read_snapshot(db, number, until)
            return snapshot, journal.read(db, number, snapshot.sequence if snapshot else 0, until)

    def snapshot_before(self, number: int, until: int) -> StateSnapshot | None:
        """A session's snapshot, if it is from before a row."""
        with self._reading() as db:
            return journal.read_snapshot(db, number, until)

    def journal(self, number: int) -> list[JournalRow]:
        """All that happened to a session, in order."""
        with self._reading() as db:
            return journal.read(db, number)

    def journal_part(self, number: int, after: int, until: int) -> list[JournalRow]:
        """The rows after one, up to and with another, in order."""
        with self._reading() as db:
            return journal.read(db, number, after, until)

    def named(self, number: int, key: str) -> tuple[int, bytes] | None:
        """Sequence number and request digest of the observation with this idempotency key."""
        with self._lock, storage_faults(self._path):  # one statement needs no transaction, and this is on the hot path
            row: tuple[int, bytes] | None = self._db.conn.execute(
                "SELECT sequence, request_digest FROM journal WHERE session = ? AND idempotency_key = ?", (number, key)
            ).fetchone()
            return row

    # Experience

    def n_observations(self, number: int) -> int:
        """How many observations a session's journal holds."""
        with self._reading() as db:
            return journal.n_observations(db, number)

    def save_true_positions(
        self, number: int, position_m: NDArray[np.float64], received_at: float
    ) -> Future[NDArray[np.float64] | None]:
        """Keep where the robot truly was at every observation of a session, as far as it is known.

        Answers with what was kept before; NaN, unknown now, leaves it.
        """
        return self._commits.submit(lambda db: journal.save_true_positions(db, number, position_m, received_at))

    def true_positions(self, number: int) -> NDArray[np.float64] | None:
        """What was fed back of a session, one position for every observation."""
        with self._reading() as db:
            return journal.true_positions(db, number)


def _get(db: Database, session_id: str) -> SessionRecord:
    row = None
    if session_id.isascii():
        row = db.execute(f"{_SELECT} WHERE session_id = ?", [session_id]).fetchone()
    if row is None:
        raise UnknownSessionError(f"there is no session {session_id!a}")
    return _session(row)


def _session(row: tuple[Any, ...]) -> SessionRecord:
    number, session_id, domain, map_version, map_sha256, config, *rest = row
    return SessionRecord(number, session_id, domain, map_version, map_sha256, from_json(config), *rest)


class GroupCommit:
    """One thread that commits what others hand in; a write counts when its future has a result, not earlier.

    Many writers, one disk: whatever waits while a transaction is being synced goes into the next one together.

    Args:
        transaction: Gives a write transaction.
        on_commit: Called with the number of writes of every transaction.
    """

    def __init__(
        self, transaction: Callable[[], AbstractContextManager[Database]], on_commit: Callable[[int], None]
    ) -> None:
        self._transaction = transaction
        self._on_commit = on_commit
        self._waiting: SimpleQueue[_Write | None] = SimpleQueue()
        self._is_open = True
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._work, name="commits", daemon=True)
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether the thread is there to commit."""
        return self._thread.is_alive()

    def submit(self, run: Callable[[Database], T]) -> Future[T]:
        """Queue a write.

        Args:
            run: Called inside a transaction, perhaps a second time in another one.

        Returns:
            Its result to come, once it is on the disk; or its error, and then nothing of it was kept.

        Raises:
            UnavailableError: The file has been closed.
        """
        done: Future[T] = Future()
        done.set_running_or_notify_cancel()  # whoever stops waiting does not undo it; before the thread can end it
        with self._lock:
            if not self._is_open:
                raise UnavailableError("the service is shutting down")
            self._waiting.put((run, done))
        return done

    def close(self) -> None:
        """Commit what waits, then end the thread."""
        with self._lock:
            if self._is_open:
                self._is_open = False
                self._waiting.put(None)
        self._thread.join()

    def _work(self) -> None:
        while (write := self._waiting.get()) is not None:
            batch = [write]
            while len(batch) < MAX_BATCH and not self._waiting.empty():
                write = self._waiting.get()
                if write is None:
                    break
                batch.append(write)
            self._commit(batch)
            if write is None:
                return

    def _commit(self, batch: list[_Write]) -> None:
        try:
            with self._transaction() as db:
                results = [run(db) for run, _ in batch]
        except BaseException as error:
            if len(batch) == 1:
                batch[0][1].set_exception(error)
                return
            for write in batch:  # one that cannot be written should not take the others with it
                self._commit([write])
            return
        self._on_commit(len(batch))
        for (_, done), result in zip(batch, results, strict=True):
            done.set_result(result)
