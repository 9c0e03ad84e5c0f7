"""Sessions that several nodes share: what is written is an object of all first, then a row of the node's own file.

`sessions/<id>/0000000000` is a session as it began, every following object a row of its journal, the last its ending.
Objects are created and never replaced: of two nodes that would write one row, one is told, and reads it.
"""

import base64
import json
import re
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Self

from sqlite_utils import Database

from deepsimbad.errors import SessionMovedError, UnknownSessionError
from deepsimbad.store.objects import Objects
from deepsimbad.store.sessions import (
    INSERT_ROW,
    JournalRow,
    SessionRecord,
    SessionStore,
    StateSnapshot,
    columns_of,
    session_columns,
)

_ID = re.compile(r"[0-9a-f]{32}")
_CREATED_AT = 5  # among the columns of a session
_AT_ONCE = 16  # objects written, and as many read
_INSERT_ROW = INSERT_ROW.replace("INSERT", "INSERT OR IGNORE", 1)
# Numbers order sessions by their beginning, to ten microseconds, and are the same on every node.
_INSERT_SESSION = """
    INSERT OR IGNORE INTO session
        (number, session_id, domain, map_version, map_sha256, config, created_at, expires_at, key_id)
    VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)
"""


class SharedSessionStore(SessionStore):
    """Sessions of one node among several. Its file is a copy of what the node has needed; the objects are the truth.

    What it writes raises SessionMovedError where another node has moved the session on.
    """

    shares = True
    _objects: Objects
    _writers: ThreadPoolExecutor
    _readers: ThreadPoolExecutor

    @classmethod
    def sharing(cls, objects: Objects, data_dir: Path, on_commit: Callable[[int], None]) -> Self:
        """Open a node's own file; its sessions are read from the objects as they are asked for."""
        store = cls.open(data_dir, on_commit)
        store._objects = objects
        store._db.execute("PRAGMA synchronous = OFF")  # the objects are what has to survive
        store._writers = ThreadPoolExecutor(_AT_ONCE, "shared journal")
        store._readers = ThreadPoolExecutor(_AT_ONCE, "shared journal, read")
        return store

    def close(self) -> None:
        """Write what waits, then close the file."""
        self._writers.shutdown()
        self._readers.shutdown()
        super().close()

    def create(self, record: SessionRecord) -> Future[SessionRecord]:
        """As where nothing is shared."""

        def write() -> SessionRecord:
            self._objects.create(_name(record.session_id, 0), _packed(session_columns(record)))
            self._pull(record.session_id, -1)
            return SessionStore.find(self, record.session_id)

        return self._writers.submit(write)

    def find(self, session_id: str) -> SessionRecord:
        """One session, living or ended, from wherever it was; raises UnknownSessionError."""
        try:
            return super().find(session_id)
        except UnknownSessionError:
            if _ID.fullmatch(session_id) is None:
                raise
        self._pull(session_id, -1)
        return super().find(session_id)

    def catch_up(self, session_id: str) -> SessionRecord:
        """A session that is in the file, with what other nodes have written since."""
        self._pull(session_id, super().find(session_id).n_events)
        return super().find(session_id)

    def append(
        self, number: int, row: JournalRow, written_at: float, snapshot: StateSnapshot | None = None
    ) -> Future[None]:
        """As where nothing is shared."""

        def write() -> None:
            self._create(self._id(number), row.sequence, columns_of(row, written_at))
            SessionStore.append(self, number, row, written_at, snapshot).result()

        return self._writers.submit(write)

    def end(self, number: int, ending: str, ended_at: float) -> Future[bool]:
        """As where nothing is shared; False where another node has ended it, or moved it on since it was to expire."""

        def write() -> bool:
            record = self.catch_up(self._id(number))
            if record.ending is not None or (ending == "expired" and ended_at < record.expires_at):
                return False
            self._create(record.session_id, record.n_events + 1, [ending, ended_at])
            return SessionStore.end(self, number, ending, ended_at).result()

        return self._writers.submit(write)

    def _id(self, number: int) -> str:
        with self._reading() as db:
            (session_id,) = db.execute("SELECT session_id FROM session WHERE number = ?", [number]).fetchone()
            return str(session_id)

    def _create(self, session_id: str, sequence: int, columns: Any) -> None:
        if not self._objects.create(_name(session_id, sequence), _packed(columns)):
            raise SessionMovedError(
                f"session {session_id} was moved on elsewhere this moment: try again", retry_after_s=1
            )

    def _pull(self, session_id: str, after: int) -> None:
        """Copy the objects of a session that follow one into the file."""
        # One that is missing is quicker to ask for than a list, and is what is answered nearly always.
        if (next_one := self._objects.get(_name(session_id, after + 1))) is None:
            return
        names = sorted(self._objects.names(f"sessions/{session_id}/", _name(session_id, after + 1)))
        bodies = [next_one, *(body for body in self._readers.map(self._objects.get, names) if body is not None)]

        def write(db: Database) -> None:
            for sequence, columns in enumerate(map(_unpacked, bodies), after + 1):
                if sequence == 0:
                    began, tie = int(1e5 * columns[_CREATED_AT]), int(session_id[-4:], 16) % 1000
                    db.conn.execute(_INSERT_SESSION, (1000 * began + tie, *columns))
                    continue
                (number,) = db.execute("SELECT number FROM session WHERE session_id = ?", [session_id]).fetchone()
                if len(columns) == 2:  # an ending
                    statement = "UPDATE session SET ending = ?, ended_at = ? WHERE number = ?"
                    db.conn.execute(statement, (*columns, number))
                else:
                    db.conn.execute(_INSERT_ROW, (number, sequence, *columns))

        self._commits.submit(write).result()


def _name(session_id: str, sequence: int) -> str:
    return f"sessions/{session_id}/{sequence:010d}"


def _packed(columns: Any) -> bytes:
    """What the file would hold, as JSON; blobs in base 64."""
    return json.dumps(columns, default=lambda blob: {"blob": base64.b64encode(blob).decode()}).encode()


def _unpacked(body: bytes) -> list[Any]:
    columns: list[Any] = json.loads(body, object_hook=lambda held: base64.b64decode(held["blob"]))
    return columns
