"""Sessions that several nodes share: what is written is an object of all first, then a row of the node's own file.

`sessions/<id>/0000000000` is a session as it began, every following object a row of its journal, the last its ending.
Objects of it are created and never replaced: of two nodes that would write one row, one is told, and reads it. Beside
it stand, as long as it lives, an empty object whose name says whose it is (`living/...`), which is what lists, limits
and the removal of maps ask, and now and then its newest snapshot (`snapshots/<id>`), so that whoever takes it over
follows few rows. `truths/<id>` are the true positions that were told of it.
"""

import base64
import json
import math
import re
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.errors import SessionMovedError, UnknownSessionError
from deepsimbad.store.objects import Objects
from deepsimbad.store.sessions import (
    INSERT_ROW,
    INSERT_SESSION,
    JournalRow,
    ListedSession,
    SessionRecord,
    SessionStore,
    StateSnapshot,
    columns_of,
    replace_snapshot,
    session_columns,
    snapshot_columns,
)

_ID = re.compile(r"[0-9a-f]{32}")
_CREATED_AT = 5  # among the columns of a session
_N_THREADS = 16  # objects written, and as many read
_MANY_ROWS = 16  # from so many on a snapshot is looked for
_NO_KEY = "-"
_LISTING_AGE_S = 60.0  # most of a list of living sessions, to which those are added that began since
_LATE_S = 60.0  # by which clocks may differ, or a mark be written after its session began


@dataclass(frozen=True)
class Mark:
    """That a session lives, and whose it is: all of it is the name of an object."""

    domain: str
    map_version: int
    key_id: str | None
    number: int
    session_id: str

    @classmethod
    def of(cls, record: SessionRecord) -> Self:
        """The mark of a session."""
        return cls(record.domain, record.map_version, record.key_id, record.number, record.session_id)

    @classmethod
    def parse(cls, name: str) -> Self:
        """Read the mark that an object's name is."""
        _, number, session_id, domain, version, key_id = name.split("/")
        return cls(domain, int(version), None if key_id == _NO_KEY else key_id, int(number), session_id)

    @property
    def name(self) -> str:
        """The name of its object."""
        owner = f"{self.domain}/{self.map_version}/{self.key_id or _NO_KEY}"
        return f"living/{_digits(self.number)}/{self.session_id}/{owner}"


class SharedSessionStore(SessionStore):
    """Sessions of one node among several. Its file is a copy of what the node has needed; the objects are the truth.

    What it writes raises SessionMovedError where another node has moved the session on.
    """

    is_shared = True
    _insert_row = INSERT_ROW.replace("INSERT", "INSERT OR IGNORE", 1)  # who looked meanwhile has copied it already
    _objects: Objects
    _is_own: Callable[[str], bool]
    _writers: ThreadPoolExecutor
    _readers: ThreadPoolExecutor
    _listing: tuple[float, dict[str, Mark]]  # when all living sessions were listed, and their marks by object name

    @classmethod
    def open_shared(
        cls,
        objects: Objects,
        data_dir: Path,
        on_commit: Callable[[int], None],
        is_own: Callable[[str], bool] = lambda _: False,
    ) -> Self:
        """Open a node's own file; its sessions are read from the objects as they are asked for.

        Args:
            objects: Where sessions are shared.
            data_dir: Where the node's own file lies.
            on_commit: As `SessionStore.open`.
            is_own: Whether this node is the one that looks after a session, by its id: lets it expire, say.
        """
        store = cls.open(data_dir, on_commit)
        store._objects, store._is_own, store._listing = objects, is_own, (-math.inf, {})
        store._db.execute("PRAGMA synchronous = OFF")  # the objects are what has to survive
        store._writers = ThreadPoolExecutor(_N_THREADS, "shared journal")
        store._readers = ThreadPoolExecutor(_N_THREADS, "shared journal, read")
        return store

    def close(self) -> None:
        """Write what waits, then close the file."""
        self._writers.shutdown()
        self._readers.shutdown()
        super().close()

    # Living sessions

    def marks(self) -> list[Mark]:
        """The marks of all sessions that live on any node; one request a thousand."""
        listed_at, marks = time.time(), self._list()
        self._listing = listed_at, marks
        return list(marks.values())

    def _list(self, previous_name: str | None = None) -> dict[str, Mark]:
        return {name: Mark.parse(name) for name in self._objects.names("living/", previous_name)}

    def holders(self, *, may_have_ended: bool = False) -> list[str | None]:
        """As `SessionStore.holders`, of all nodes.

        Args:
            may_have_ended: Whether sessions that have ended since all were listed, a minute ago at most, may count:
                then only those that began since are asked for, which is one request however many live.
        """
        listed_at, marks = self._listing
        if not may_have_ended or time.time() - listed_at > _LISTING_AGE_S:
            return [mark.key_id for mark in self.marks()]
        new_marks = self._list(f"living/{_digits(_number_at(listed_at - _LATE_S))}")
        return [mark.key_id for mark in (marks | new_marks).values()]

    def pins(self) -> set[tuple[str, int]]:
        """As `SessionStore.pins`, of all nodes."""
        return {(mark.domain, mark.map_version) for mark in self.marks()}

    def living_sessions(self) -> list[SessionRecord]:
        """Those in the file and, as they began, those in the objects that this node looks after."""
        names = [_name(mark.session_id, 0) for mark in self.marks() if self._is_own(mark.session_id)]
        sessions = [_unpack(body) for body in self._readers.map(self._objects.get, names) if body is not None]

        def write(db: Database) -> None:
            for columns in sessions:
                _insert_session(db, columns)

        self._commits.submit(write).result()
        return super().living_sessions()

    def listed_sessions(self, session_ids: Sequence[str]) -> list[ListedSession]:
        """Sessions as they are now, for a list; unknown ids are left out."""

        def look(session_id: str) -> list[ListedSession]:
            try:
                record = self.find(session_id)
            except UnknownSessionError:
                return []
            return [ListedSession(record, self.n_observations(record.number))]

        with ThreadPoolExecutor(_N_THREADS) as readers:
            return [entry for entries in readers.map(look, session_ids) for entry in entries]

    # One session

    def create(self, record: SessionRecord) -> Future[SessionRecord]:
        """As `SessionStore.create`."""

        def write() -> SessionRecord:
            columns = session_columns(record)
            if self._objects.create(_name(record.session_id, 0), _pack(columns)):
                self._copy(record.session_id, -1, [columns])
            else:
                self._pull(record.session_id, -1)
            return SessionStore.find(self, record.session_id)

        return self._writers.submit(write)

    def find(self, session_id: str) -> SessionRecord:
        """One session, living or ended, with what any node has written of it; raises UnknownSessionError."""
        n_events = -1
        try:
            record = super().find(session_id)
        except UnknownSessionError:
            if _ID.fullmatch(session_id) is None:
                raise
        else:
            if record.ending is not None:
                return record
            n_events = record.n_events
        self._pull(session_id, n_events)
        return super().find(session_id)

    def append(
        self, number: int, row: JournalRow, written_at: float, snapshot: StateSnapshot | None = None
    ) -> Future[None]:
        """As `SessionStore.append`."""

        def write() -> None:
            session_id = self._id(number)
            self._create(session_id, row.sequence, columns_of(row, written_at))
            SessionStore.append(self, number, row, written_at, snapshot).result()
            if snapshot is not None:
                body = _pack(snapshot_columns(snapshot))
                with suppress(RuntimeError):  # nobody waits for it, nor does the end of the node
                    self._writers.submit(self._objects.put, _snapshot_name(session_id), body)

        return self._writers.submit(write)

    def end(self, number: int, ending: str, ended_at: float) -> Future[bool]:
        """As `SessionStore.end`; False where another node has ended it, or moved it on since it was to expire."""

        def write() -> bool:
            record = self.find(self._id(number))
            if record.ending is not None or (ending == "expired" and ended_at < record.expires_at):
                return False
            self._create(record.session_id, record.n_events + 1, [ending, ended_at])
            has_ended = SessionStore.end(self, number, ending, ended_at).result()
            self._unmark(record)
            return has_ended

        return self._writers.submit(write)

    def save_true_positions(
        self, number: int, position_m: NDArray[np.float64], received_at: float
    ) -> Future[NDArray[np.float64] | None]:
        """As `SessionStore.save_true_positions`; of two nodes that save at once one may be lost."""

        def write() -> NDArray[np.float64] | None:
            save, name = super(SharedSessionStore, self).save_true_positions, f"truths/{self._id(number)}"
            if (shared_body := self._objects.get(name)) is not None:
                save(number, np.frombuffer(shared_body, "<f8"), received_at).result()
            earlier_m = save(number, position_m, received_at).result()
            if (merged_m := self.true_positions(number)) is not None:  # else the session was purged this moment
                self._objects.put(name, merged_m.tobytes())
            return earlier_m

        return self._writers.submit(write)

    def _id(self, number: int) -> str:
        with self._reading() as db:
            (session_id,) = db.execute("SELECT session_id FROM session WHERE number = ?", [number]).fetchone()
            return str(session_id)

    def _create(self, session_id: str, sequence: int, columns: Any) -> None:
        if not self._objects.create(_name(session_id, sequence), _pack(columns)):
            raise SessionMovedError(
                f"session {session_id} was moved on elsewhere this moment: try again", retry_after_s=1
            )

    def _unmark(self, record: SessionRecord) -> None:
        """Delete all objects of a session that has ended but its journal."""
        self._objects.delete(Mark.of(record).name)
        self._objects.delete(_snapshot_name(record.session_id))

    # Copies

    def _pull(self, session_id: str, last_sequence: int) -> None:
        """Copy the objects of a session behind number `last_sequence` into the file."""
        # One that is missing is quicker to ask for than a list, and is what is answered nearly always.
        if (next_body := self._objects.get(_name(session_id, last_sequence + 1))) is None:
            return
        names = sorted(self._objects.names(f"sessions/{session_id}/", _name(session_id, last_sequence + 1)))
        bodies = [next_body, *(body for body in self._readers.map(self._objects.get, names) if body is not None)]
        self._copy(session_id, last_sequence, [_unpack(body) for body in bodies])

    def _copy(self, session_id: str, last_sequence: int, rows: Sequence[Sequence[Any]]) -> None:
        """Write a session's rows behind number `last_sequence` into the file; mark it, or unmark it where it ended."""
        snapshot = self._objects.get(_snapshot_name(session_id)) if len(rows) > _MANY_ROWS else None

        def write(db: Database) -> None:
            for sequence, columns in enumerate(rows, last_sequence + 1):
                if sequence == 0:
                    _insert_session(db, columns)
                    continue
                (number,) = db.execute("SELECT number FROM session WHERE session_id = ?", [session_id]).fetchone()
                if len(columns) == 2:  # an ending
                    statement = "UPDATE session SET ending = ?, ended_at = ? WHERE number = ?"
                    db.conn.execute(statement, (*columns, number))
                else:
                    db.conn.execute(self._insert_row, (number, sequence, *columns))
            if snapshot is not None:
                replace_snapshot(db, number, _unpack(snapshot))

        self._commits.submit(write).result()
        record = super().find(session_id)
        if record.ending is not None:
            self._unmark(record)
        elif last_sequence < 0:  # the node that created it may have stopped before it was marked
            self._objects.put(Mark.of(record).name, b"")


def _insert_session(db: Database, columns: Sequence[Any]) -> None:
    # Numbers order sessions by their beginning, to ten microseconds, and are the same on every node.
    number = _number_at(columns[_CREATED_AT]) + int(columns[0][-4:], 16) % 1000
    db.conn.execute(INSERT_SESSION, (number, *columns))


def _number_at(created_at: float) -> int:
    """The least number of a session that begins at `created_at` (seconds since 1970)."""
    return 1000 * int(1e5 * created_at)


def _digits(number: int) -> str:
    """A number as text of one length, so that texts sort as numbers do."""
    return f"{number:019d}"


def _name(session_id: str, sequence: int) -> str:
    return f"sessions/{session_id}/{sequence:010d}"


def _snapshot_name(session_id: str) -> str:
    return f"snapshots/{session_id}"


def _pack(columns: Any) -> bytes:
    """Columns of the file as JSON, blobs in base 64."""
    return json.dumps(columns, default=lambda blob: {"blob": base64.b64encode(blob).decode()}).encode()


def _unpack(body: bytes) -> list[Any]:
    columns: list[Any] = json.loads(body, object_hook=lambda blob: base64.b64decode(blob["blob"]))
    return columns
