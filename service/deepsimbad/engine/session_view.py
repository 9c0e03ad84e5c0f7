"""What a session answers with."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief_summary import BeliefSummary, summarise
from deepsimbad.core.planners import Plan
from deepsimbad.core.retrieval import shortlist
from deepsimbad.engine.localizer import shortlist_length
from deepsimbad.engine.session_state import SessionEngine, SessionState
from deepsimbad.engine.snapshot import MapSnapshot


@dataclass(frozen=True)
class SessionView:
    """A session as of one row of its journal.

    Attributes:
        session_id: Which session.
        expires_at: When it ends unless something happens to it; seconds since 1970.
        snapshot: The map it is pinned to.
        n_observations: How many views its belief rests on.
        belief: The belief in a few numbers.
        plan: The move to make next; None where the map can name none.
        relevance: [n] float32 of the last view; None before any.
        shortlist: Ids of the map images most relevant to the last view, best first.
        is_repeated: Whether the observation had been counted before.
    """

    session_id: str
    expires_at: float
    snapshot: MapSnapshot
    n_observations: int
    belief: BeliefSummary
    plan: Plan | None
    relevance: NDArray[np.float32] | None
    shortlist: NDArray[np.int64]
    is_repeated: bool = False


def view_of(
    session_id: str, expires_at: float, engine: SessionEngine, state: SessionState, n_shortlist: int | None = None
) -> SessionView:
    """Summarise a state; milliseconds of work.

    Args:
        session_id: Given on.
        expires_at: Given on.
        engine: The session's.
        state: Of the session.
        n_shortlist: Length of the shortlist and of the belief's top; None: the usual one.
    """
    length = shortlist_length(engine.snapshot, n_shortlist)
    known, step = state.belief, state.step
    summary = summarise(engine.snapshot.route, known.belief.mass, length, known.off_route)
    best = np.empty(0, np.int64) if known.relevance is None else shortlist(known.relevance, length)
    return SessionView(
        session_id=session_id,
        expires_at=expires_at,
        snapshot=engine.snapshot,
        n_observations=known.n_observations,
        belief=summary,
        plan=engine.localizer.plan(known) if step is None else step.plan,
        relevance=known.relevance,
        shortlist=best,
    )
