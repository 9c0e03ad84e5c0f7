"""The file of live sessions: whatever was acknowledged to a robot survives kill -9 and a power cut."""

from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.errors import DamagedFileError
from deepsimbad.store import clock_table, journal_table, layout, session_table
from deepsimbad.store.connection import check_integrity, migrate, open_database, use_write_ahead_log
from deepsimbad.store.data_dir import make_data_dir
from deepsimbad.store.durable import sync_folder
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.group_commit import GroupCommit
from deepsimbad.store.list_page import ListPage
from deepsimbad.store.open_file import OpenFile
from deepsimbad.store.row_checksums import SESSION_TABLES, RowChecksums
from deepsimbad.store.session_records import ClockRecord, JournalRow, ListedSession, SessionRecord, StateSnapshot
from deepsimbad.store.write_ahead_log import check_log
from deepsimbad_migrations.session.migrations import migrations

PURGED_AT_ONCE = 1000  # rows
_CHECKED_AT_START_BYTES = 64 * 1024 * 1024  # a service shall be ready soon; `deepsimbad check` reads more


class SessionStore(OpenFile):
    """Sessions and their journals; usable from any thread.

    Writes are futures: done when they are on the disk, those of one moment in one transaction. Reads see what is
    done. Every method, and every future, raises UnavailableError or DamagedFileError where the file cannot be used.

    Args:
        path: The file.
        reading: The open file, for reads.
        writing: The open file a second time, for writes.
        checksums: Of the rows that are written.
        on_commit: Called with the number of writes of every transaction.
    """

    def __init__(
        self,
        path: Path,
        reading: Database,
        writing: Database,
        checksums: RowChecksums,
        on_commit: Callable[[int], None],
    ) -> None:
        super().__init__(path, reading)
        self._writing = writing
        self._commits = GroupCommit(writing, path, on_commit, checksums.note)

    @classmethod
    def open(cls, data_dir: Path, on_commit: Callable[[int], None] = lambda _: None) -> Self:
        """Open the sessions of a data directory; makes the file where it is missing."""
        path = layout.sessions_path(data_dir)
        make_data_dir(data_dir)
        with storage_faults(path), ExitStack() as on_error:
            check_log(path)
            writing = open_database(path, create=True)
            on_error.callback(writing.close)
            use_write_ahead_log(writing)
            if path.stat().st_size <= _CHECKED_AT_START_BYTES:
                check_integrity(writing, path)
            migrate(writing, migrations, path)
            checksums = RowChecksums(writing, SESSION_TABLES)
            checksums.fill_if_new()
            reading = open_database(path)
            on_error.callback(reading.close)
            sync_folder(data_dir)
            on_error.pop_all()
        return cls(path, reading, writing, checksums, on_commit)

    def close(self) -> None:
        """Commit what waits, then close the file."""
        self._commits.close()
        with self._lock:
            super().close()
            self._writing.close()

    def check(self) -> None:
        """Raise what keeps the file from being read."""
        with self._reading() as db:
            db.execute("SELECT number FROM session LIMIT 1").fetchall()
        if not self._path.exists():  # an open file goes on without its name, until it is closed
            raise DamagedFileError(f"{self._path.name} was removed under the running service", file=self._path.name)

    @property
    def is_committing(self) -> bool:
        """Whether the thread that writes is alive."""
        return self._commits.is_alive

    # Their clock

    def clock(self) -> tuple[ClockRecord | None, float | None]:
        """The moment that was noted last, and when the last thing happened that the sessions tell of."""
        with self._reading() as db:
            return clock_table.read(db), clock_table.latest_event(db)

    def note_clock(self, record: ClockRecord) -> Future[None]:
        """Note a moment, in place of the one before."""
        return self._commits.submit(lambda db: clock_table.save(db, record))

    # Sessions

    def create(self, record: SessionRecord) -> Future[SessionRecord]:
        """Keep a new session; answers with the number that it got, or the session that has this id already."""
        return self._commits.submit(lambda db: session_table.insert(db, record))

    def find(self, session_id: str) -> SessionRecord:
        """One session, living or ended; raises UnknownSessionError."""
        with self._reading() as db:
            return session_table.get(db, session_id)

    def living(self) -> list[SessionRecord]:
        """Every session that has not ended, oldest first."""
        with self._reading() as db:
            return session_table.living(db)

    def pins(self) -> set[tuple[str, int]]:
        """Domain and map version of every session that has not ended."""
        with self._reading() as db:
            return session_table.pins(db)

    def newest_living(
        self, domain: str | None, before: int | None, limit: int, at: float
    ) -> ListPage[ListedSession, int]:
        """A page of the sessions that live at a moment, of a domain or all, newest first, behind number `before`.

        Counting views can take a while, so it reads through a connection of its own: no robot waits for a list.
        """
        with storage_faults(self._path), open_database(self._path, read_only=True) as db, db.atomic():
            page = session_table.newest_living(db, domain, before, limit, at)
            listed = [ListedSession(one, journal_table.n_observations(db, one.number)) for one in page.records]
            return ListPage(tuple(listed), page.last_key)

    def end(self, number: int, ending: str, ended_at: float) -> Future[bool]:
        """End a session ("deleted", "expired"); answers whether it lived until now, and has expired if that is why."""
        return self._commits.submit(lambda db: session_table.end(db, number, ending, ended_at))

    def purge(self, ended_before: float) -> Future[bool]:
        """Forget some of what ended before a moment, so little that no robot waits for it; answers if more is left."""
        return self._commits.submit(lambda db: session_table.purge(db, ended_before, PURGED_AT_ONCE))

    # What happened to them

    def append(
        self, number: int, row: JournalRow, written_at: float, snapshot: StateSnapshot | None = None
    ) -> Future[None]:
        """Write the next row of a session's journal, and with it a snapshot of the state after an earlier row.

        The future raises InvalidInputError where another process has written a row of that sequence number.
        """

        def write(db: Database) -> None:
            journal_table.append(db, number, row, written_at)
            if snapshot is not None:
                journal_table.save_snapshot(db, number, snapshot)

        return self._commits.submit(write)

    def history(self, number: int, until: int) -> tuple[StateSnapshot | None, list[JournalRow]]:
        """What makes up the state after a row: the snapshot, if it is from before that row, and the rows since."""
        with self._reading() as db:
            snapshot = _snapshot_before(db, number, until)
            return snapshot, journal_table.read(db, number, snapshot.sequence if snapshot else 0, until)

    def snapshot_before(self, number: int, until: int) -> StateSnapshot | None:
        """A session's snapshot, if it is from before a row."""
        with self._reading() as db:
            return _snapshot_before(db, number, until)

    def journal(self, number: int) -> list[JournalRow]:
        """All that happened to a session, in order."""
        with self._reading() as db:
            return journal_table.read(db, number, 0, 2**62)

    def journal_part(self, number: int, after: int, until: int) -> list[JournalRow]:
        """The rows after one, up to and with another, in order."""
        with self._reading() as db:
            return journal_table.read(db, number, after, until)

    def named(self, number: int, key: str) -> tuple[int, bytes] | None:
        """Sequence number and request digest of the observation with this idempotency key."""
        with self._lock, storage_faults(self._path):  # one statement needs no transaction, and this is on the hot path
            return journal_table.named(self._db, number, key)

    # Experience

    def n_observations(self, number: int) -> int:
        """How many observations a session's journal holds."""
        with self._reading() as db:
            return journal_table.n_observations(db, number)

    def save_true_positions(
        self, number: int, position_m: NDArray[np.float64], received_at: float
    ) -> Future[NDArray[np.float64] | None]:
        """Keep where the robot truly was at every observation of a session, as far as it is known.

        Answers with what was kept before; NaN, unknown now, leaves it.
        """
        return self._commits.submit(lambda db: journal_table.save_true_positions(db, number, position_m, received_at))

    def true_positions(self, number: int) -> NDArray[np.float64] | None:
        """What was fed back of a session, one position for every observation."""
        with self._reading() as db:
            return journal_table.true_positions(db, number)


def _snapshot_before(db: Database, number: int, until: int) -> StateSnapshot | None:
    snapshot = journal_table.read_snapshot(db, number)
    return snapshot if snapshot is not None and snapshot.sequence < until else None
