"""A robot's live belief: begun, moved on by observations, asked, told the truth, ended."""

import hashlib
import math
from datetime import UTC, datetime
from functools import partial
from typing import Annotated, cast

from anyio.to_thread import run_sync
from fastapi import APIRouter, Query, Request, Response
from pydantic import FailFast, Field, StrictFloat, StrictInt
from typing_extensions import TypedDict

from deepsimbad.api.localizations import (
    OBSERVATION_BODY,
    OBSERVATION_TYPES,
    BeliefAnswer,
    Brief,
    NextBestViewAnswer,
    RetrievedAnswer,
    Shortlist,
    Timings,
    empty_lists,
    npy_response,
    render_belief,
    render_plan,
    render_shortlist,
    view_in,
    warnings_of,
)
from deepsimbad.api.problems import binary, declare_json, location, problems
from deepsimbad.api.requests import (
    BINARY,
    GREATEST_EXACT_INTEGER,
    GREATEST_ID,
    JSON,
    Answer,
    DomainName,
    JsonBody,
    KeyOfCreation,
    KeyWord,
    LandmarkModelTag,
    Next,
    OfDomain,
    Page,
    QuickRoute,
    RunningServices,
    Services,
    SessionId,
    StrictRoute,
    id_under_key,
    idempotency_header,
    key_id_of,
    media_type_of,
    page_of,
    prefers,
    read_bytes,
    read_json,
    required_tags,
    robot_of,
)
from deepsimbad.core.belief.particles import FilterKind
from deepsimbad.core.belief.summary import DEFAULT_CONFIDENCE
from deepsimbad.core.planners import INFORMED
from deepsimbad.core.relevance import UpdateRule
from deepsimbad.engine.session import DEFAULT_START_STD_M, Observation, SessionConfig, SessionView
from deepsimbad.engine.worker import Stopwatch
from deepsimbad.errors import DeepSimbadError, InvalidInputError
from deepsimbad.evaluators.image_files import MEDIA_TYPES
from deepsimbad.store.sessions import IdempotencyKey, ListedSession

router = APIRouter(prefix="/v1", tags=["sessions"], route_class=QuickRoute)
listing = APIRouter(prefix="/v1/admin/sessions", tags=["admin: sessions"], route_class=StrictRoute)

MAX_OBSERVATIONS_FED_BACK = 100_000

# Bodies


class SessionBody(JsonBody):
    """How a session begins. NaN and infinity are refused by what knows the route."""

    start_position_m: Annotated[StrictFloat | None, Field(description="Where it begins; null: anywhere.")] = None
    start_std_m: Annotated[
        StrictFloat | None, Field(description=f"How sure that is, a standard deviation; null: {DEFAULT_START_STD_M:g}.")
    ] = None
    seed: Annotated[
        Annotated[int, Field(strict=True, ge=0, le=GREATEST_EXACT_INTEGER)] | None, Field(description="null: 0.")
    ] = None
    planner: Annotated[
        Annotated[str, Field(min_length=1, max_length=64)] | None,
        Field(description="`informed`, `nnql`, `random` or `constant:<m>`; null: the default."),
    ] = None
    belief: Annotated[FilterKind | None, Field(description="The filter; null: grid.")] = None
    update: Annotated[UpdateRule | None, Field(description="null: as the map's relevance wants.")] = None
    confidence: Annotated[
        Annotated[float, Field(strict=True, gt=0, lt=1)] | None,
        Field(description=f"Mass within 5 m of the mode from which on it may stop; null: {DEFAULT_CONFIDENCE:g}."),
    ] = None
    price_bits_per_m: Annotated[
        Annotated[float, Field(strict=True, ge=0, le=100)] | None,
        Field(description="What a metre costs the planner `informed`, in bits; null: 0."),
    ] = None

    def config(self) -> SessionConfig:
        """The configuration as the engine takes it; raises InvalidInputError where the planner knows no price."""
        if self.price_bits_per_m and self.planner not in {None, INFORMED}:
            raise InvalidInputError(
                f"price_bits_per_m is for the planner {INFORMED}, and {self.planner!a} knows no price of metres: leave "
                "one of the two out",
                field="price_bits_per_m",
            )
        return SessionConfig(**{name: value for name, value in self if value is not None})


class PriorBody(JsonBody):
    """Where the robot is, from someone who knows."""

    position_m: Annotated[StrictFloat, Field(description="Metres along the route.")]
    std_m: Annotated[StrictFloat, Field(description="Standard deviation, above 0.")]


class TruePositions(JsonBody):
    """Where the robot truly was, known later."""

    true_positions_m: Annotated[
        list[StrictFloat | None],
        Field(
            min_length=1,
            max_length=MAX_OBSERVATIONS_FED_BACK,
            description="One route position an observation; null: unknown, which takes back nothing told before.",
        ),
        FailFast(),
    ]


class TruthsBody(TruePositions):
    """Where the robot truly was, known later; truths may be told bit by bit."""

    true_map_images: Annotated[
        list[list[Annotated[StrictInt, Field(ge=0, le=GREATEST_ID)]]] | None,
        Field(
            max_length=MAX_OBSERVATIONS_FED_BACK,
            description="For each of the same observations the map images that show its place, to rank its retrieval.",
        ),
        FailFast(),
    ] = None
    first_observation: Annotated[
        int, Field(strict=True, ge=0, description="The observation, from 0, that the first of the lists belongs to.")
    ] = 0


# Answers


class SessionAnswer(TypedDict):
    """A session as it stands."""

    session_id: str
    domain: str
    map_version: Annotated[int, Field(description="The map it began on and keeps.")]
    n_observations: Annotated[int, Field(description="Views that its belief rests on.")]
    expires_at: Annotated[str, Field(description="When it ends unless something happens to it; ISO 8601, UTC.")]
    belief: BeliefAnswer
    next_best_view: Annotated[NextBestViewAnswer | None, Field(description="null where the map can name none.")]


class ObservationAnswer(SessionAnswer):
    """A session after one more observation."""

    timings_ms: Timings
    informative: Annotated[bool, Field(description="Whether the view told anything of the place.")]
    warnings: Annotated[list[str], Field(description="What a person should know, in sentences.")]
    retrieval: Annotated[list[RetrievedAnswer], Field(description="Map images most relevant to this view, best first.")]


class ListedSessionAnswer(Answer):
    """A session in a list, without its belief."""

    session_id: str
    domain: str
    map_version: Annotated[int, Field(description="The map it began on and keeps.")]
    key_id: Annotated[str | None, Field(description="The key it was begun with; null where none was asked.")]
    n_observations: Annotated[int, Field(description="Views that were told.")]
    created_at: Annotated[str, Field(description="ISO 8601, UTC.")]
    expires_at: Annotated[str, Field(description="When it ends unless something happens to it; ISO 8601, UTC.")]


class SessionList(Answer):
    """Living sessions, newest first."""

    sessions: list[ListedSessionAnswer]
    next: Next


class TruthsAnswer(Answer):
    """How well a session knew where its robot was."""

    n_scored: Annotated[int, Field(description="Observations whose true position is known.", ge=0)]
    n_left_out: Annotated[int, Field(description="Observations whose true position is unknown.", ge=0)]
    anr: Annotated[
        float | None,
        Field(description="ANR of the belief, in percent: 0 is perfect, 50 chance; null: none is known.", ge=0, le=100),
    ]
    retrieval_ranks: Annotated[
        list[float | None] | None,
        Field(description="How many map images each view placed before the best of its `true_map_images`, ties half."),
    ]
    map_version: Annotated[int, Field(description="The map that the session is pinned to.")]


def render_session(view: SessionView) -> SessionAnswer:
    """A session as it stands."""
    snapshot = view.snapshot
    return {
        "session_id": view.session_id,
        "domain": snapshot.domain,
        "map_version": snapshot.version,
        "n_observations": view.n_observations,
        "expires_at": _iso(view.expires_at),
        "belief": render_belief(snapshot, view.belief, view.is_confident),
        "next_best_view": render_plan(view.plan, snapshot.actions_m, view.is_confident),
    }


def render_observation(view: SessionView, watch: Stopwatch, brief: bool = False) -> ObservationAnswer:
    """A session after an observation; the watch runs since the request arrived."""
    retrieval = [] if view.relevance is None else render_shortlist(view.snapshot, view.shortlist, view.relevance)
    answer: ObservationAnswer = {
        **render_session(view),
        "informative": view.is_informative,
        "warnings": [*view.remarks, *warnings_of(view.is_informative, view.belief, view.plan)],
        "retrieval": retrieval,
        "timings_ms": watch.timings_ms(),
    }
    if brief:
        empty_lists(answer)
    return answer


def render_listed(listed_session: ListedSession) -> ListedSessionAnswer:
    """The answer's form of a session in a list."""
    answer = vars(listed_session.session) | {"n_observations": listed_session.n_observations}
    times = {name: _iso(answer[name]) for name in ("created_at", "expires_at")}
    return ListedSessionAnswer.model_validate(answer | times)


def _iso(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


async def _session_response(
    services: Services, view: SessionView, status: int = 200, location: str | None = None
) -> Response:
    headers = None if location is None else {"Location": location}
    _, body = await services.render_json(view.belief.top.size, render_session, view)
    return Response(body, status, headers, JSON)


# Handlers


@router.post(
    "/domains/{domain}/sessions",
    status_code=201,
    response_model=SessionAnswer,
    responses={**location(201, "The session."), **problems(404, 409, 410, 413, 415, 422, 429)},
    openapi_extra=declare_json(SessionBody),
)
async def post_session(
    domain: DomainName, request: Request, services: RunningServices, idempotency_key: KeyOfCreation = None
) -> Response:
    """Begin a session on the domain's active map, which it keeps whatever is activated later."""
    mapped_domain = await services.active(domain)
    config = (await read_json(request, SessionBody)).config()
    session_id = id_under_key(request, "session", domain, idempotency_key)
    view = await services.sessions.begin(mapped_domain, config, session_id, key_id_of(request))
    return await _session_response(services, view, 201, f"/v1/sessions/{view.session_id}")


@router.post(
    "/sessions/{session_id}/observations",
    response_model=ObservationAnswer,
    responses=problems(404, 409, 410, 413, 415, 422),
    openapi_extra=OBSERVATION_BODY,
)
async def post_observation(
    session_id: SessionId,
    request: Request,
    action_m: Annotated[
        float,
        Query(
            description="Metres moved since the last view, to ten of the longest action, and backward where the "
            "domain's actions are; ignored for the first."
        ),
    ] = 0.0,
    action_std_m: Annotated[
        float | None,
        Query(description="How sure that is, a standard deviation; absent: usual odometry; 0: exact."),
    ] = None,
    shortlist: Shortlist = None,
    brief: Brief = False,
    idempotency_key: Annotated[
        KeyWord | None, idempotency_header("observation again counts once, and has the same answer.")
    ] = None,
    if_match: LandmarkModelTag = None,
) -> Response:
    """Move the belief on by a move and the view after it.

    When this has answered, the observation survives whatever happens to the service. Two at once are both answered, in
    order of arrival. The body is what `localizations` takes.
    """
    watch, services = Stopwatch(), cast("Services", request.app.state.services)
    try:
        media_type = media_type_of(request, OBSERVATION_TYPES)
        body = await read_bytes(request)
        watch.lap("receive")
        idempotency = None
        if idempotency_key is not None:
            query = f"{media_type}\n{action_m!r}\n{action_std_m!r}\n".encode()
            idempotency = IdempotencyKey(idempotency_key, hashlib.sha256(query + body).digest())
        decode = partial(view_in, body, services, media_type)
        landmark_models = None if if_match is None else required_tags(if_match)
        observation = Observation(decode, action_m, action_std_m, shortlist, idempotency, landmark_models)
        view = await services.sessions.observe(session_id, observation, watch, robot_of(request))
    except DeepSimbadError as error:
        services.metrics.count_observation(error.code)
        raise
    if media_type in MEDIA_TYPES and await _keeps_pictures(services, view.snapshot.domain):
        services.pictures.hold_view(session_id, body)
    answer, body = await services.render_json(view.belief.top.size, render_observation, view, watch, brief)
    domain = request.scope["state"]["domain"] = answer["domain"]
    outcome = "repeated" if view.is_repeated else "accepted"
    services.metrics.record_localization(domain, answer["timings_ms"], answer["belief"]["entropy_bits"], outcome)
    return Response(body, media_type=JSON)


async def _keeps_pictures(services: Services, domain: str) -> bool:
    """Whether a domain keeps small pictures; False where it has no map that answers."""
    try:
        return bool((await services.active(domain)).record.options.get("thumbnails"))
    except DeepSimbadError:
        return False


@router.get("/sessions/{session_id}", response_model=SessionAnswer, responses=problems(404, 410, 422))
async def get_session(
    session_id: SessionId, request: Request, services: RunningServices, shortlist: Shortlist = None
) -> Response:
    """A session as it stands; asking does not keep it from expiring."""
    return await _session_response(services, await services.sessions.view(session_id, shortlist, robot_of(request)))


@router.get(
    "/sessions/{session_id}/belief",
    response_model=BeliefAnswer,
    responses={
        200: {"content": binary("float32 npy [n]: the mass of every map image, in route order; sums to 1")},
        **problems(404, 410, 422),
    },
)
async def get_belief(
    session_id: SessionId, request: Request, services: RunningServices, shortlist: Shortlist = None
) -> Response:
    """The belief alone; with `Accept: application/octet-stream` the mass of every map image."""
    if prefers(request, BINARY):
        return npy_response(await services.sessions.mass(session_id, robot_of(request)))
    view = await services.sessions.view(session_id, shortlist, robot_of(request))
    _, body = await services.render_json(
        view.belief.top.size, render_belief, view.snapshot, view.belief, view.is_confident
    )
    return Response(body, media_type=JSON)


@router.get("/sessions/{session_id}/next-best-view", responses=problems(404, 410, 422))
async def get_next_best_view(
    session_id: SessionId, request: Request, services: RunningServices
) -> NextBestViewAnswer | None:
    """The move that would tell most, without a new view; null where the map can name none."""
    view = await services.sessions.view(session_id, key_id=robot_of(request))
    return render_plan(view.plan, view.snapshot.actions_m, view.is_confident)


@router.put(
    "/sessions/{session_id}/prior",
    response_model=SessionAnswer,
    responses=problems(404, 410, 413, 415, 422),
    openapi_extra=declare_json(PriorBody),
)
async def put_prior(session_id: SessionId, request: Request, services: RunningServices) -> Response:
    """Replace the belief by one around a position: the robot was carried, or got a fix."""
    body = await read_json(request, PriorBody)
    view = await services.sessions.set_prior(session_id, body.position_m, body.std_m, robot_of(request))
    return await _session_response(services, view)


@router.delete("/sessions/{session_id}", status_code=204, responses=problems(404, 410, 422))
async def delete_session(session_id: SessionId, request: Request, services: RunningServices) -> None:
    """End a session; nothing more can be asked of it."""
    await services.sessions.end(session_id, robot_of(request))


@router.post(
    "/sessions/{session_id}/truths", responses=problems(404, 410, 413, 415, 422), openapi_extra=declare_json(TruthsBody)
)
async def post_truths(session_id: SessionId, request: Request, services: RunningServices) -> TruthsAnswer:
    """Rank the truth in the belief as it was after every observation, and keep the positions to learn from.

    The session may have ended, up to a day ago unless the settings say otherwise. The answer's ANR is that of this
    session; the metric `deepsimbad_live_anr_percent` counts every observation once.
    """
    body = await read_json(request, TruthsBody)
    ranking, before_m = await services.truths.keep(
        session_id, body.true_positions_m, body.true_map_images, body.first_observation, robot_of(request)
    )
    await run_sync(services.metrics.record_truths, ranking.session.domain, ranking.new_since(before_m).tolist())
    ranks = None if ranking.retrieval_rank is None else ranking.retrieval_rank[ranking.first :].tolist()
    return TruthsAnswer(
        n_scored=ranking.n_scored,
        n_left_out=ranking.n_left_out,
        anr=ranking.anr,
        retrieval_ranks=None if ranks is None else [None if math.isnan(rank) else rank for rank in ranks],
        map_version=ranking.session.map_version,
    )


@listing.get("", responses=problems(404, 422))
async def list_sessions(
    services: RunningServices, page: Annotated[Page, page_of("sessions")], domain: OfDomain = None
) -> SessionList:
    """Living sessions, newest first; whoever may list them may also ask and end them by their ids."""
    if domain is not None:
        await run_sync(services.catalog.domain, domain)
    session_page = await services.sessions.newest(domain, page.number, page.limit)
    return SessionList(
        sessions=[render_listed(session) for session in session_page.records], next=page.next(session_page.last_key)
    )
