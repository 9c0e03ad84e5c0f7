"""What the file of live sessions knows: a session, and what happened to it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


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
