"""A robot's live belief: begun, moved on by observations, asked, ended."""

import hashlib
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request, Response

from deepsimbad.api.bodies import (
    GREATEST_ID,
    JSON,
    declare_json,
    media_type_of,
    read_bytes,
    read_json,
)
from deepsimbad.api.dependencies import DomainName, Running, SessionId
from deepsimbad.api.entity_tags import LandmarkModelTag, insisted_on
from deepsimbad.api.idempotency import KEY_HEADER, KeyWord, id_under_key
from deepsimbad.api.long_work import written
from deepsimbad.api.openapi import binary, problems
from deepsimbad.api.rendering import render_belief, render_plan
from deepsimbad.api.routes.localizations import (
    OBSERVATION_BODY,
    OBSERVATION_TYPES,
    npy_response,
    prefers_binary,
    view_in,
)
from deepsimbad.api.schemas import BeliefAnswer, NextBestViewAnswer
from deepsimbad.api.session_bodies import PriorBody, SessionBody
from deepsimbad.api.session_rendering import render_observation, render_session
from deepsimbad.api.session_schemas import ObservationAnswer, SessionAnswer
from deepsimbad.engine.session import Observation
from deepsimbad.engine.views import Stopwatch
from deepsimbad.errors import DeepSimbadError
from deepsimbad.store.session_records import IdempotencyKey

router = APIRouter(prefix="/v1", tags=["sessions"])

Shortlist = Annotated[
    int | None,
    Query(
        ge=1,
        le=GREATEST_ID,
        description="Length of `retrieval` and `top`, up to the number of map images; absent: 10 or all.",
    ),
]
Key = Annotated[
    KeyWord | None,
    Header(
        alias=KEY_HEADER,
        description="The same key with the same observation again counts once, and has the same answer.",
    ),
]
KeyOfSession = Annotated[
    KeyWord | None,
    Header(
        alias=KEY_HEADER,
        description="The same key with the same body again begins no second session: the first one is answered, as it "
        "stands. Choose one that nobody else will, such as a UUID.",
    ),
]


@router.post(
    "/domains/{domain}/sessions",
    status_code=201,
    response_model=SessionAnswer,
    responses={
        201: {"headers": {"Location": {"description": "The session.", "schema": {"type": "string"}}}},
        **problems(404, 409, 410, 413, 415, 422, 429),
    },
    openapi_extra=declare_json(SessionBody),
)
async def post_session(
    domain: DomainName, request: Request, running: Running, idempotency_key: KeyOfSession = None
) -> Response:
    """Begin a session on the domain's active map, which it keeps whatever is activated later."""
    active = await running.active(domain)
    config = (await read_json(request, SessionBody)).config()
    session_id = id_under_key(request, "session", domain, idempotency_key)
    view = await running.sessions.begin(active, config, session_id)
    _, text = await written(view.belief.top.size, lambda: render_session(view))
    return Response(text, 201, {"Location": f"/v1/sessions/{view.session_id}"}, JSON)


@router.post(
    "/sessions/{session_id}/observations",
    response_model=ObservationAnswer,
    responses=problems(404, 409, 410, 413, 415, 422),
    openapi_extra=OBSERVATION_BODY,
)
async def post_observation(
    session_id: SessionId,
    request: Request,
    running: Running,
    action_m: Annotated[
        float,
        Query(description="Metres moved since the last view, 0 to ten of the longest action; ignored for the first."),
    ] = 0.0,
    action_std_m: Annotated[
        float | None, Query(description="How sure that is, a standard deviation; absent: usual odometry.")
    ] = None,
    shortlist: Shortlist = None,
    idempotency_key: Key = None,
    if_match: LandmarkModelTag = None,
) -> Response:
    """Move the belief on by a move and the view after it.

    When this has answered, the observation survives whatever happens to the service. Two at once are both answered, in
    order of arrival. The body is what `localizations` takes.
    """
    watch = Stopwatch()
    try:
        media_type = media_type_of(request, OBSERVATION_TYPES)
        body = await read_bytes(request)
        watch.lap("receive")
        named = None
        if idempotency_key is not None:
            told = f"{media_type}\n{action_m!r}\n{action_std_m!r}\n".encode()
            named = IdempotencyKey(idempotency_key, hashlib.sha256(told + body).digest())
        observation = Observation(
            partial(view_in, body, running, media_type),
            action_m,
            action_std_m,
            shortlist,
            named,
            insisted_on(if_match),
        )
        view = await running.sessions.observe(session_id, observation, watch)
    except DeepSimbadError as error:
        running.metrics.observed(error.code)
        raise
    answer, text = await written(view.belief.top.size, lambda: render_observation(view, watch))
    request.state.domain = answer.domain
    running.metrics.observed("repeated" if view.is_repeated else "accepted")
    running.metrics.localized(answer.domain, answer.timings_ms, answer.belief.entropy_bits)
    return Response(text, media_type=JSON)


@router.get("/sessions/{session_id}", response_model=SessionAnswer, responses=problems(404, 410, 422))
async def get_session(session_id: SessionId, running: Running, shortlist: Shortlist = None) -> Response:
    """A session as it stands; asking does not keep it from expiring."""
    view = await running.sessions.view(session_id, shortlist)
    _, text = await written(view.belief.top.size, lambda: render_session(view))
    return Response(text, media_type=JSON)


@router.get(
    "/sessions/{session_id}/belief",
    response_model=BeliefAnswer,
    responses={
        200: {"content": dict(binary("float32 npy [n]: the mass of every map image, in route order; sums to 1"))},
        **problems(404, 410, 422),
    },
)
async def get_belief(
    session_id: SessionId, request: Request, running: Running, shortlist: Shortlist = None
) -> Response:
    """The belief alone; with `Accept: application/octet-stream` the mass of every map image."""
    if prefers_binary(request):
        return npy_response((await running.sessions.mass(session_id)).astype("<f4"))
    view = await running.sessions.view(session_id, shortlist)
    _, text = await written(view.belief.top.size, lambda: render_belief(view.snapshot.route, view.belief))
    return Response(text, media_type=JSON)


@router.get("/sessions/{session_id}/next-best-view", responses=problems(404, 410, 422))
async def get_next_best_view(session_id: SessionId, running: Running) -> NextBestViewAnswer | None:
    """The move that would tell most, without a new view; null where the map can name none."""
    plan, actions_m = await running.sessions.next_best_view(session_id)
    return render_plan(plan, actions_m)


@router.put(
    "/sessions/{session_id}/prior",
    response_model=SessionAnswer,
    responses=problems(404, 410, 413, 415, 422),
    openapi_extra=declare_json(PriorBody),
)
async def put_prior(session_id: SessionId, request: Request, running: Running) -> Response:
    """Replace the belief by one around a position: the robot was carried, or got a fix."""
    body = await read_json(request, PriorBody)
    view = await running.sessions.set_prior(session_id, body.position_m, body.std_m)
    _, text = await written(view.belief.top.size, lambda: render_session(view))
    return Response(text, media_type=JSON)


@router.delete("/sessions/{session_id}", status_code=204, responses=problems(404, 410, 422))
async def delete_session(session_id: SessionId, running: Running) -> None:
    """End a session; nothing more can be asked of it."""
    await running.sessions.end(session_id)
