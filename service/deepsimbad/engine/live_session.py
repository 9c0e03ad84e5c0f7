"""A session in memory, and what may be asked of it."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

from deepsimbad.engine.observation import View
from deepsimbad.engine.session_state import SessionEngine, SessionState
from deepsimbad.errors import EndedSessionError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.store.session_records import IdempotencyKey, SessionRecord


@dataclass(frozen=True)
class Loaded:
    """What answers: published whole, by one assignment, after it is on the disk."""

    engine: SessionEngine
    state: SessionState


@dataclass
class LiveSession:
    """A session that has not ended; touched from the event loop alone.

    Attributes:
        record: As it was begun.
        expires_at: When it ends unless something happens to it; seconds since 1970.
        loaded: What answers; None until it is first needed after a start.
        lock: Held by whoever moves it on; waiting for it is first come, first served.
        ending: How it ended; whoever waited for the lock meanwhile comes too late.
    """

    record: SessionRecord
    expires_at: float
    loaded: Loaded | None = None
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    ending: str | None = None

    @property
    def session_id(self) -> str:
        """Its key outside."""
        return self.record.session_id


@dataclass(frozen=True)
class Observation:
    """A move and the view after it, as a robot reports them.

    Attributes:
        view: Gives the view, at the size of the evaluator it is given; called when the session's turn has come, so that
            order is that of arrival.
        action_m: Metres moved since the last view; ignored for the first one.
        action_std_m: Their standard deviation; None: the usual one.
        n_shortlist: Length of the answer's lists; None: the usual one.
        idempotency: How a repetition is known; None: it is not.
        landmark_models: Digests of landmark models, by one of which the view was ranked; None: nobody said.
    """

    view: Callable[[Evaluator], Awaitable[View]]
    action_m: float = 0.0
    action_std_m: float | None = None
    n_shortlist: int | None = None
    idempotency: IdempotencyKey | None = None
    landmark_models: frozenset[str] | None = None


def ended(session_id: str, ending: str) -> EndedSessionError:
    """The error that a session of the past answers with."""
    return EndedSessionError(f"session {session_id} has ended ({ending}): begin a new one", ending=ending)
