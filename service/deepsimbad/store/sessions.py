"""The file of live sessions and their journals: whatever was acknowledged survives kill -9 and a power cut."""

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.errors import DamagedFileError, UnknownSessionError
from deepsimbad.store import layout
from deepsimbad.store.connection import GroupCommit, OpenFile, open_database, open_working_file
from deepsimbad.store.durable import make_data_dir, storage_faults, sync
from deepsimbad.store.records import ListPage, from_json, to_json
from deepsimbad_migrations.session.migrations import migrations

PURGED_AT_ONCE = 1000  # rows
_CHECKED_AT_START_BYTES = 64 * 1024 * 1024  # a service shall be ready soon; `deepsimbad check` reads more
_MAX_NUMBER = 2**63 - 1
_MOST_IN_TWO_BYTES = 0xFFFF // 2
_SELECT = """
    SELECT session.number, session_id, domain, map_version, map_sha256, config, created_at,
           coalesce(latest.expires_at, session.expires_at), coalesce(latest.sequence, 0), ending, key_id
    FROM session LEFT JOIN journal AS latest
      ON latest.session = session.number
     AND latest.sequence = (SELECT max(sequence) FROM journal WHERE session = session.number)
"""
INSERT_SESSION = """
    INSERT INTO session
        (number, session_id, domain, map_version, map_sha256, config, created_at, expires_at, key_id)
    VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT DO NOTHING
"""
INSERT_ROW = """
    INSERT INTO journal (session, sequence, kind, written_at, expires_at, idempotency_key, request_digest,
                         action_m, action_std_m, ranks, dissimilarities, encoding, position_m, std_m)
    VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)
"""


@dataclass(frozen=True)
class SessionRecord:
    """One session; times are seconds since 1970.

    `number` is its key in the file, `session_id` outside; it keeps the map that it began on. `n_events` counts the rows
    of its journal, `ending` is "deleted" or "expired" once it has ended, `key_id` that of the API key it began with.
    """

    number: int
    session_id: str
    domain: str
    map_version: int
    map_sha256: str
    config: dict[str, Any]
    created_at: float
    expires_at: float
    n_events: int
    ending: str | None
    key_id: str | None = None


@dataclass(frozen=True)
class ListedSession:
    """A session in a list, and how many views its journal holds."""

    session: SessionRecord
    n_observations: int


@dataclass(frozen=True)
class IdempotencyKey:
    """A sender's key by which a repeated request is known, and the digest of that request."""

    key: str
    digest: bytes


@dataclass(frozen=True)
class ObservedRow:
    """A move and the view after it, as the filter took them; `sequence` counts from 1.

    Where the map's relevance compares `dissimilarities` or the `encoding`, they are there.
    """

    sequence: int
    expires_at: float  # of the session, after it
    action_m: float
    action_std_m: float | None  # None: the usual one
    ranks: NDArray[np.float32]  # [r], whole or half; all alike where the view had nothing to rank by
    dissimilarities: NDArray[np.float32] | None = None  # [r], smaller is nearer
    encoding: NDArray[np.float32] | None = None  # [d]
    idempotency: IdempotencyKey | None = None


@dataclass(frozen=True)
class PriorRow:
    """The belief was replaced by one around a position."""

    sequence: int
    expires_at: float
    position_m: float
    std_m: float


JournalRow = ObservedRow | PriorRow


@dataclass(frozen=True)
class StateSnapshot:
    """All of a session's state after the row of its journal that `sequence` names."""

    sequence: int
    arrays: dict[str, NDArray[Any]]


class SessionStore(OpenFile):
    """Sessions and their journals; usable from any thread.

    Writes are futures: done when they are on the disk, those of one moment in one transaction. Reads see what is
    done. Every method, and every future, raises UnavailableError or DamagedFileError where the file cannot be used.
    """

    is_shared = False  # whether other nodes may have moved a session on
    _insert_row = INSERT_ROW

    def __init__(self, path: Path, db: Database, on_commit: Callable[[int], None]) -> None:
        super().__init__(path, db, open_database(path))
        self._commits = GroupCommit(self._writing, on_commit)

    @classmethod
    def open(cls, data_dir: Path, on_commit: Callable[[int], None] = lambda _: None) -> Self:
        """Open the sessions of a data directory, or make them; `on_commit` is told the writes of every transaction."""
        path = layout.sessions_path(data_dir)
        make_data_dir(data_dir)
        with storage_faults(path):
            is_small = not path.exists() or path.stat().st_size <= _CHECKED_AT_START_BYTES
            db = open_working_file(path, migrations, create=True, is_checked=is_small)
            sync(data_dir)
            return cls(path, db, on_commit)

    def close(self) -> None:
        """Commit what waits, then close the file."""
        self._commits.close()
        super().close()

    def try_writing(self) -> Future[None]:
        """Write something to the disk that means nothing, to see whether that works."""

        def write(db: Database) -> None:
            (version,) = db.execute("PRAGMA user_version").fetchone()
            db.execute(f"PRAGMA user_version = {1 - min(version, 1)}")

        return self._commits.submit(write)

    @property
    def is_committing(self) -> bool:
        """Whether the thread that commits is alive."""
        return self._commits.thread.is_alive()

    def create(self, record: SessionRecord) -> Future[SessionRecord]:
        """Keep a new session; answers with the number that it got, or the session that has this id already."""

        def write(db: Database) -> SessionRecord:
            db.conn.execute(INSERT_SESSION, (None, *session_columns(record)))  # None: the next number
            return _get(db, record.session_id)

        return self._commits.submit(write)

    def find(self, session_id: str) -> SessionRecord:
        """One session, living or ended; raises UnknownSessionError."""
        with self._reading() as db:
            return _get(db, session_id)

    def living_sessions(self) -> list[SessionRecord]:
        """Every session that has not ended, oldest first."""
        with self._reading() as db:
            rows = db.execute(f"{_SELECT} WHERE session.ended_at IS NULL ORDER BY session.number")
            return [_session(row) for row in rows]

    def holders(self, *, may_have_ended: bool = False) -> list[str | None]:  # noqa: ARG002 - of shared sessions
        """The API key (None: none) of every session that has not ended, and perhaps of some that have."""
        with self._reading() as db:
            return [key_id for (key_id,) in db.execute("SELECT key_id FROM session WHERE ended_at IS NULL")]

    def pins(self) -> set[tuple[str, int]]:
        """Domain and map version of every session that has not ended."""
        with self._reading() as db:
            return set(db.execute("SELECT DISTINCT domain, map_version FROM session WHERE ended_at IS NULL"))

    def newest_living(
        self, domain: str | None, last_key: int | None, limit: int, time_s: float
    ) -> ListPage[ListedSession, int]:
        """A page of the sessions that live at a moment, of a domain or all, newest first, behind number `last_key`.

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
                [_MAX_NUMBER if last_key is None else last_key, domain, time_s, limit + 1],
            ).fetchall()
            entries = [ListedSession(_session(row), _n_observations(db, row[0])) for row in rows]
            return ListPage.of(((entry.session.number, entry) for entry in entries), limit)

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
            bounds = {"before": ended_before, "most": PURGED_AT_ONCE}
            n_rows = db.execute(
                """
                DELETE FROM journal WHERE rowid IN (
                    SELECT journal.rowid
                    FROM (SELECT number FROM session WHERE ended_at < :before ORDER BY ended_at LIMIT :most)
                    JOIN journal ON session = number LIMIT :most
                )
                """,
                bounds,
            ).rowcount
            if n_rows < PURGED_AT_ONCE:  # nothing is left of the journals of these
                n_rows = db.execute(
                    """
                    DELETE FROM session WHERE number IN (
                        SELECT number FROM session WHERE ended_at < :before ORDER BY ended_at LIMIT :most
                    )
                    """,
                    bounds,
                ).rowcount
            return bool(n_rows >= PURGED_AT_ONCE)

        return self._commits.submit(write)

    def append(
        self, number: int, row: JournalRow, written_at: float, snapshot: StateSnapshot | None = None
    ) -> Future[None]:
        """Write the next row of a session's journal, and with it a snapshot of the state after an earlier row.

        What an event loop appends at one turn is written together. The future raises InvalidInputError where a row of
        that sequence number, or idempotency key, is there.
        """

        def write(db: Database) -> None:
            db.conn.execute(self._insert_row, (number, row.sequence, *columns_of(row, written_at)))
            if snapshot is not None:
                replace_snapshot(db, number, snapshot_columns(snapshot))

        return self._commits.submit(write, by_turns=True)

    def history(self, number: int, last_sequence: int) -> tuple[StateSnapshot | None, list[JournalRow]]:
        """What makes up the state after row `last_sequence`: the snapshot, if it is from before, and the rows since."""
        snapshot = self.snapshot_before(number, last_sequence)
        return snapshot, self.journal(number, snapshot.sequence if snapshot else 0, last_sequence)

    def snapshot_before(self, number: int, sequence: int) -> StateSnapshot | None:
        """A session's snapshot, if it is from before row `sequence`; raises DamagedFileError."""
        with self._reading() as db:
            rows = db.execute(
                "SELECT name, sequence, dtype, shape, body FROM snapshot WHERE session = ? AND sequence < ?",
                [number, sequence],
            ).fetchall()
        arrays = {}
        for name, _, dtype, shape, body in rows:
            dimensions = tuple(from_json(shape))
            if len(body) != math.prod(dimensions) * np.dtype(dtype).itemsize:
                raise DamagedFileError(f"the snapshot of a session is damaged: array {name} is not whole")
            arrays[name] = np.frombuffer(body, dtype).reshape(dimensions)
        return StateSnapshot(rows[0][1], arrays) if rows else None

    def journal(self, number: int, snapshot_sequence: int = 0, last_sequence: int = 2**62) -> list[JournalRow]:
        """The rows of a session's journal in order, those behind `snapshot_sequence` up to and with `last_sequence`."""
        with self._reading() as db:
            rows = db.execute(
                """
                SELECT sequence, kind, expires_at, idempotency_key, request_digest, action_m, action_std_m, ranks,
                       dissimilarities, encoding, position_m, std_m
                FROM journal WHERE session = ? AND sequence > ? AND sequence <= ? ORDER BY sequence
                """,
                [number, snapshot_sequence, last_sequence],
            )
            return [_row(row) for row in rows]

    def find_observation(self, number: int, key: str) -> tuple[int, bytes] | None:
        """Sequence number and request digest of the observation with this idempotency key."""
        with self._reader_lock, storage_faults(self._path):  # one statement, on the hot path, needs no transaction
            row: tuple[int, bytes] | None = self._reader.conn.execute(
                "SELECT sequence, request_digest FROM journal WHERE session = ? AND idempotency_key = ?", (number, key)
            ).fetchone()
            return row

    def n_observations(self, number: int) -> int:
        """How many observations a session's journal holds; counted as for `newest_living`."""
        with storage_faults(self._path), open_database(self._path, read_only=True) as db:
            return _n_observations(db, number)

    def save_true_positions(
        self, number: int, position_m: NDArray[np.float64], received_at: float
    ) -> Future[NDArray[np.float64] | None]:
        """Keep where the robot truly was at every observation of a session; answers with what was kept before.

        A position replaces an earlier one of its observation; NaN leaves that as it is.
        """

        def write(db: Database) -> NDArray[np.float64] | None:
            earlier_m, merged_m = _true_positions(db, number), position_m.copy()
            if earlier_m is not None:
                overlap_m = merged_m[: earlier_m.size]
                np.copyto(overlap_m, earlier_m[: overlap_m.size], where=np.isnan(overlap_m))
            db.execute(
                "INSERT OR REPLACE INTO true_positions (session, received_at, position_m) VALUES (?, ?, ?)",
                [number, received_at, np.ascontiguousarray(merged_m, "<f8").tobytes()],
            )
            return earlier_m

        return self._commits.submit(write)

    def true_positions(self, number: int) -> NDArray[np.float64] | None:
        """The true positions [n] in metres of a session's observations, NaN where unknown; None: none were fed back."""
        with self._reading() as db:
            return _true_positions(db, number)


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


def _n_observations(db: Database, number: int) -> int:
    return int(db.table("journal").count_where("session = ? AND kind = 'observation'", [number]))


def _true_positions(db: Database, number: int) -> NDArray[np.float64] | None:
    row = db.execute("SELECT position_m FROM true_positions WHERE session = ?", [number]).fetchone()
    return None if row is None else np.frombuffer(row[0], "<f8")


def session_columns(record: SessionRecord) -> tuple[Any, ...]:
    """A new session, from its id on, as the file has it."""
    return (
        record.session_id,
        record.domain,
        record.map_version,
        record.map_sha256,
        to_json(record.config),
        record.created_at,
        record.expires_at,
        record.key_id,
    )


def columns_of(row: JournalRow, written_at: float) -> tuple[Any, ...]:
    """A row from its kind on, as `INSERT_ROW` takes it."""
    if isinstance(row, PriorRow):
        return ("prior", written_at, row.expires_at, *[None] * 7, row.position_m, row.std_m)
    # Twice the ranks, which are whole or half numbers: 2 bytes each where they fit.
    ranks = np.rint(2.0 * row.ranks.astype(np.float64)).astype("<u2" if row.ranks.size <= _MOST_IN_TWO_BYTES else "<u4")
    dissimilarities, encoding = row.dissimilarities, row.encoding
    return (
        "observation",
        written_at,
        row.expires_at,
        *((row.idempotency.key, row.idempotency.digest) if row.idempotency else (None, None)),
        row.action_m,
        row.action_std_m,
        ranks.tobytes(),
        None if dissimilarities is None else np.ascontiguousarray(dissimilarities, "<f4").tobytes(),
        None if encoding is None else np.ascontiguousarray(encoding, "<f4").tobytes(),
        None,
        None,
    )


def snapshot_columns(snapshot: StateSnapshot) -> list[tuple[Any, ...]]:
    """A snapshot's arrays as the file has them."""
    numbers = {
        name: np.ascontiguousarray(array, array.dtype.newbyteorder("<")) for name, array in snapshot.arrays.items()
    }
    return [
        (name, snapshot.sequence, array.dtype.str, to_json(list(snapshot.arrays[name].shape)), array.tobytes())
        for name, array in numbers.items()
    ]


def replace_snapshot(db: Database, number: int, columns: Iterable[Sequence[Any]]) -> None:
    """Let these be a session's snapshot."""
    db.execute("DELETE FROM snapshot WHERE session = ?", [number])
    statement = "INSERT INTO snapshot (session, name, sequence, dtype, shape, body) VALUES (?, ?, ?, ?, ?, ?)"
    db.conn.executemany(statement, [(number, *of_array) for of_array in columns])


def _row(row: tuple[Any, ...]) -> JournalRow:
    sequence, kind, expires_at, key, digest, action_m, action_std_m, ranks, *views, position_m, std_m = row
    if kind == "prior":
        return PriorRow(sequence, expires_at, position_m, std_m)
    # More than fit in two bytes each can only be half as many of four.
    doubled_ranks = np.frombuffer(ranks, "<u2" if len(ranks) // 2 <= _MOST_IN_TWO_BYTES else "<u4")
    dissimilarities, encoding = (None if view is None else np.frombuffer(view, "<f4") for view in views)
    return ObservedRow(
        sequence,
        expires_at,
        action_m,
        action_std_m,
        np.asarray(doubled_ranks / 2, np.float32),
        dissimilarities,
        encoding,
        None if key is None else IdempotencyKey(key, digest),
    )
