"""From a session's view to its answers' models."""

from datetime import UTC, datetime
from typing import Any

from deepsimbad.api.rendering import render_belief, render_plan, render_shortlist
from deepsimbad.api.session_schemas import ListedSessionAnswer, ObservationAnswer, SessionAnswer
from deepsimbad.engine.session import SessionView
from deepsimbad.engine.views import Stopwatch
from deepsimbad.store.session_records import ListedSession


def render_session(view: SessionView) -> SessionAnswer:
    """A session as it stands."""
    return SessionAnswer.model_construct(**_members(view))


def render_observation(view: SessionView, watch: Stopwatch) -> ObservationAnswer:
    """A session after an observation.

    Args:
        view: The session.
        watch: Runs since the request arrived.
    """
    retrieval = [] if view.relevance is None else render_shortlist(view.snapshot.route, view.shortlist, view.relevance)
    members = _members(view)
    return ObservationAnswer.model_construct(**members, retrieval=retrieval, timings_ms=watch.timings_ms())


def render_listed(listed: ListedSession) -> ListedSessionAnswer:
    """A session in a list."""
    session = listed.session
    return ListedSessionAnswer(
        session_id=session.session_id,
        domain=session.domain,
        map_version=session.map_version,
        n_observations=listed.n_observations,
        created_at=_iso(session.created_at),
        expires_at=_iso(session.expires_at),
    )


def _iso(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _members(view: SessionView) -> dict[str, Any]:
    snapshot = view.snapshot
    return {
        "session_id": view.session_id,
        "domain": snapshot.domain,
        "map_version": snapshot.version,
        "n_observations": view.n_observations,
        "expires_at": _iso(view.expires_at),
        "belief": render_belief(snapshot.route, view.belief),
        "next_best_view": render_plan(view.plan, snapshot.actions_m),
    }
