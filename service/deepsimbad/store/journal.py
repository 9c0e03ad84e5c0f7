"""What the file of live sessions knows, a session and what happened to it, and the statements on journals.

Every function stands inside a transaction of its caller.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.errors import DamagedFileError
from deepsimbad.store.records import from_json, to_json

_INSERT = """
    INSERT INTO journal (session, sequence, kind, written_at, expires_at, idempotency_key, request_digest,
                         action_m, action_std_m, ranks, dissimilarities, encoding, position_m, std_m)
    VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)
"""
_SELECT = """
    SELECT sequence, kind, expires_at, idempotency_key, request_digest, action_m, action_std_m, ranks,
           dissimilarities, encoding, position_m, std_m
    FROM journal
"""
_MOST_IN_TWO_BYTES = 0xFFFF // 2


@dataclass(frozen=True)
class SessionRecord:
    """One session; times are seconds since 1970.

    Attributes:
        number: Its key in the file.
        session_id: Its key outside.
        domain, map_version, map_sha256: The map it began on and keeps.
        config: What it was begun with.
        created_at: When.
        expires_at: When it ends unless something happens to it.
        n_events: Rows of its journal; the last row's sequence number.
        ending: How it ended ("deleted", "expired"); None while it lives.
        key_id: Of the API key that it was begun with; None where none was asked.
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
    """A session in a list.

    Attributes:
        session: As it stands.
        n_observations: How many views its journal holds.
    """

    session: SessionRecord
    n_observations: int


@dataclass(frozen=True)
class IdempotencyKey:
    """By which a request that comes again is known.

    Attributes:
        key: The sender's word.
        digest: Of the request it named.
    """

    key: str
    digest: bytes


@dataclass(frozen=True)
class ObservedRow:
    """A move and the view after it, as the filter took them.

    Attributes:
        sequence: Its place in the journal, from 1.
        expires_at: When the session ends after it.
        action_m: Metres moved before the view.
        action_std_m: Their standard deviation; None: the usual one.
        ranks: [r] float32, whole or half ranks; all alike where the view had nothing to rank by.
        dissimilarities: [r] float32, where the map's relevance compares them.
        encoding: [d] float32, where the map's relevance compares it.
        idempotency: How a repetition is known, if it can be.
    """

    sequence: int
    expires_at: float
    action_m: float
    action_std_m: float | None
    ranks: NDArray[np.float32]
    dissimilarities: NDArray[np.float32] | None = None
    encoding: NDArray[np.float32] | None = None
    idempotency: IdempotencyKey | None = None


@dataclass(frozen=True)
class PriorRow:
    """The belief was replaced by one around a position.

    Attributes:
        sequence, expires_at: As of `ObservedRow`.
        position_m, std_m: Of the new belief.
    """

    sequence: int
    expires_at: float
    position_m: float
    std_m: float


JournalRow = ObservedRow | PriorRow


@dataclass(frozen=True)
class StateSnapshot:
    """A session's state after a row of its journal.

    Attributes:
        sequence: That row's.
        arrays: All of the state.
    """

    sequence: int
    arrays: dict[str, NDArray[Any]]


def append(
    db: Database, session: int, row: JournalRow, written_at: float, snapshot: StateSnapshot | None = None
) -> None:
    """Write a row, and a snapshot; an IntegrityError where the sequence number or the key is taken."""
    if isinstance(row, PriorRow):
        values: tuple[Any, ...] = ("prior", written_at, row.expires_at, *[None] * 7, row.position_m, row.std_m)
    else:
        named = row.idempotency
        values = (
            *("observation", written_at, row.expires_at),
            *((named.key, named.digest) if named else (None, None)),
            *(row.action_m, row.action_std_m, pack_ranks(row.ranks)),
            None if row.dissimilarities is None else np.ascontiguousarray(row.dissimilarities, "<f4").tobytes(),
            None if row.encoding is None else np.ascontiguousarray(row.encoding, "<f4").tobytes(),
            *(None, None),
        )
    db.conn.execute(_INSERT, (session, row.sequence, *values))
    if snapshot is not None:
        _save_snapshot(db, session, snapshot)


def read(db: Database, session: int, after: int = 0, until: int = 2**62) -> list[JournalRow]:
    """The rows after one, up to and with another, in order."""
    rows = db.execute(
        f"{_SELECT} WHERE session = ? AND sequence > ? AND sequence <= ? ORDER BY sequence", [session, after, until]
    )
    return [_row(row) for row in rows]


def _row(row: tuple[Any, ...]) -> JournalRow:
    sequence, kind, expires_at, key, digest, action_m, action_std_m, ranks, *views, position_m, std_m = row
    if kind == "prior":
        return PriorRow(sequence, expires_at, position_m, std_m)
    dissimilarities, encoding = (None if view is None else np.frombuffer(view, "<f4") for view in views)
    return ObservedRow(
        sequence,
        expires_at,
        action_m,
        action_std_m,
        unpack_ranks(ranks),
        dissimilarities,
        encoding,
        None if key is None else IdempotencyKey(key, digest),
    )


def _save_snapshot(db: Database, session: int, snapshot: StateSnapshot) -> None:
    """Put a session's snapshot in place of its earlier one."""
    db.execute("DELETE FROM snapshot WHERE session = ?", [session])
    rows = []
    for name, array in snapshot.arrays.items():
        numbers = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        shape = to_json(list(array.shape))
        rows.append((session, name, snapshot.sequence, numbers.dtype.str, shape, numbers.tobytes()))
    db.conn.executemany(
        "INSERT INTO snapshot (session, name, sequence, dtype, shape, body) VALUES (?, ?, ?, ?, ?, ?)", rows
    )


def read_snapshot(db: Database, session: int, until: int = 2**62) -> StateSnapshot | None:
    """A session's snapshot, if it has one from before a row; raises DamagedFileError."""
    rows = db.execute(
        "SELECT name, sequence, dtype, shape, body FROM snapshot WHERE session = ? AND sequence < ?", [session, until]
    ).fetchall()
    arrays = {}
    for name, _, dtype, shape, body in rows:
        dimensions = tuple(from_json(shape))
        if len(body) != math.prod(dimensions) * np.dtype(dtype).itemsize:
            raise DamagedFileError(f"the snapshot of a session is damaged: array {name} is not whole")
        arrays[name] = np.frombuffer(body, dtype).reshape(dimensions)
    return StateSnapshot(rows[0][1], arrays) if rows else None


def save_true_positions(
    db: Database, session: int, position_m: NDArray[np.float64], received_at: float
) -> NDArray[np.float64] | None:
    """Keep where the robot truly was at every observation of a session; returns what was kept before, if anything.

    A position replaces an earlier one of its observation; NaN, unknown now, leaves it.
    """
    before = true_positions(db, session)
    position_m = position_m.copy()
    if before is not None:
        of_before = position_m[: before.size]
        np.copyto(of_before, before[: of_before.size], where=np.isnan(of_before))
    db.execute(
        "INSERT OR REPLACE INTO true_positions (session, received_at, position_m) VALUES (?, ?, ?)",
        [session, received_at, np.ascontiguousarray(position_m, "<f8").tobytes()],
    )
    return before


def true_positions(db: Database, session: int) -> NDArray[np.float64] | None:
    """What was fed back of a session, one position for every observation."""
    row = db.execute("SELECT position_m FROM true_positions WHERE session = ?", [session]).fetchone()
    return None if row is None else np.frombuffer(row[0], "<f8")


def n_observations(db: Database, session: int) -> int:
    """How many of a session's rows are observations."""
    return int(db.table("journal").count_where("session = ? AND kind = 'observation'", [session]))


def pack_ranks(ranks: NDArray[np.float32]) -> bytes:
    """Twice the ranks, which are whole or half numbers, as unsigned integers: 2 bytes each where they fit."""
    doubled = np.rint(2.0 * ranks.astype(np.float64))
    return doubled.astype("<u2" if ranks.size <= _MOST_IN_TWO_BYTES else "<u4").tobytes()


def unpack_ranks(body: bytes) -> NDArray[np.float32]:
    """What `pack_ranks` packed."""
    n_two = len(body) // 2  # more than fit in two bytes each can only be half as many of four
    dtype = "<u2" if n_two <= _MOST_IN_TWO_BYTES else "<u4"
    return np.asarray(np.frombuffer(body, dtype) / 2, np.float32)
