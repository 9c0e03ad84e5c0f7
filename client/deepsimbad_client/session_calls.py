"""The calls of a session: one robot's belief, kept by the service."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from deepsimbad_client.answers import float_array, model, next_best_view_of, nothing, page
from deepsimbad_client.call import JSON, Call, json_body, name_in_path, query
from deepsimbad_client.errors import InvalidArgumentError
from deepsimbad_client.models import ListedSession, NextBestView, SessionAnswer, SessionState, TruthScore
from deepsimbad_client.observation import Numbers, Observation
from deepsimbad_client.page import PAGE_LENGTH, Page

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

KEY_HEADER = "Idempotency-Key"


def start(
    domain: str,
    *,
    start_position_m: float | None,
    start_std_m: float | None,
    seed: int | None,
    planner: str | None,
    belief: str | None,
    update: str | None,
    idempotency_key: str | None = None,
) -> Call[SessionState]:
    """Begin a session; its key makes it one session however often it is sent."""
    document = {
        "start_position_m": start_position_m,
        "start_std_m": start_std_m,
        "seed": seed,
        "planner": planner,
        "belief": belief,
        "update": update,
    }
    return Call(
        "POST",
        f"/v1/domains/{name_in_path('domain', domain)}/sessions",
        model(SessionState),
        headers={**JSON, KEY_HEADER: idempotency_key or uuid4().hex},
        body=json_body(document),
    )


def living(domain: str | None, after: str | None) -> Call[Page[ListedSession]]:
    """A page of the living sessions, newest first, of one domain or all; it needs a key of scope `admin`."""
    return Call(
        "GET",
        "/v1/admin/sessions",
        page(ListedSession, "sessions"),
        params=query(domain=domain, limit=PAGE_LENGTH, after=after),
    )


def observe(
    session_id: str,
    seen: Observation,
    *,
    action_m: float | None,
    action_std_m: float | None,
    shortlist: int | None,
    idempotency_key: str | None,
) -> Call[SessionAnswer]:
    """Tell of a move and the view after it; its key makes it count once however often it is sent.

    Raises:
        InvalidArgumentError: A move that is no finite number.
    """
    for name, value in (("action_m", action_m), ("action_std_m", action_std_m)):
        if value is not None and not math.isfinite(value):
            raise InvalidArgumentError(f"{name} is {value}: give metres, or nothing when the robot stood still")
    return Call(
        "POST",
        f"{_session(session_id)}/observations",
        model(SessionAnswer),
        params=query(
            action_m=None if action_m is None else float(action_m),
            action_std_m=None if action_std_m is None else float(action_std_m),
            shortlist=shortlist,
        ),
        headers={
            **seen.headers,
            "Accept": "application/json",
            KEY_HEADER: idempotency_key or uuid4().hex,
        },
        body=seen.body,
    )


def state(session_id: str) -> Call[SessionState]:
    """What the session believes now."""
    return Call("GET", _session(session_id), model(SessionState))


def belief_masses(session_id: str) -> "Call[NDArray[np.float32]]":
    """The whole belief: [n] float32 over the map images, sums to 1."""
    return Call("GET", f"{_session(session_id)}/belief", float_array, headers={"Accept": "application/octet-stream"})


def next_best_view(session_id: str) -> Call[NextBestView | None]:
    """The move to make next, without another view."""
    return Call("GET", f"{_session(session_id)}/next-best-view", next_best_view_of)


def set_prior(session_id: str, position_m: float, std_m: float) -> Call[SessionState]:
    """Replace the belief by one around a position; the same again changes nothing."""
    document = {"position_m": float(position_m), "std_m": float(std_m)}
    return Call("PUT", f"{_session(session_id)}/prior", model(SessionState), headers=JSON, body=json_body(document))


def truths(
    session_id: str,
    true_positions_m: Numbers,
    true_map_images: Sequence[Sequence[int]] | None = None,
    first_observation: int = 0,
) -> Call[TruthScore]:
    """Tell where the robot truly was, None or NaN where unknown; the same again counts once.

    Raises:
        InvalidArgumentError: A position is infinite or no number.
    """
    document: dict[str, Any] = {"true_positions_m": known_positions(true_positions_m)}
    if true_map_images is not None:
        document["true_map_images"] = [[int(image) for image in images] for images in true_map_images]
    if first_observation:
        document["first_observation"] = first_observation
    return Call("POST", f"{_session(session_id)}/truths", model(TruthScore), headers=JSON, body=json_body(document))


def known_positions(true_positions_m: Numbers) -> list[float | None]:
    """Positions as JSON takes them: NaN becomes None."""
    plain = true_positions_m.tolist() if hasattr(true_positions_m, "tolist") else list(true_positions_m)
    return [None if isinstance(each, float) and math.isnan(each) else each for each in plain]


def delete(session_id: str) -> Call[None]:
    """End the session."""
    return Call("DELETE", _session(session_id), nothing, gone_is_done=True)


def _session(session_id: str) -> str:
    return f"/v1/sessions/{name_in_path('session', session_id)}"
