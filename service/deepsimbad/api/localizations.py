"""Where a single view places the robot, from a uniform prior; and what every answer to a view is made of."""

import math
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Annotated, Any, cast

import numpy as np
from anyio.to_thread import run_sync
from fastapi import APIRouter, Query, Request, Response
from numpy.typing import NDArray
from pydantic import FailFast, Field, StrictFloat, StrictInt
from pydantic_core import to_json
from typing_extensions import TypedDict

from deepsimbad.api.problems import binary, declare, invalid_body, problems
from deepsimbad.api.requests import (
    BINARY,
    GREATEST_ID,
    JSON,
    MAX_NUMBERS,
    DomainName,
    JsonBody,
    LandmarkModelTag,
    QuickRoute,
    Services,
    media_type_of,
    parse_json,
    prefers,
    read_bytes,
    required_tags,
)
from deepsimbad.api.scenes import MOST_PARTS, SCENE_BODIES, SCENE_MEMBERS, SCENE_SCHEMA, scene_in
from deepsimbad.core.belief.summary import DEFAULT_CONFIDENCE, BeliefSummary
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import Map
from deepsimbad.core.on_board import RANKS, UNIT_ENCODING
from deepsimbad.core.planners import PROBABLY, Plan
from deepsimbad.core.route import on_earth
from deepsimbad.engine.localizer import (
    Dissimilarities,
    Localization,
    NothingSeen,
    PackedRanks,
    PackedUnitEncoding,
    RankedLandmarks,
    ReadyEncoding,
    View,
    describe,
    is_short,
    localize,
    shortlist_length,
)
from deepsimbad.engine.worker import EncodedImage, Priority, Stopwatch
from deepsimbad.errors import NotAcceptableError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.grey_levels import levels_in
from deepsimbad.evaluators.image_files import MEDIA_TYPES

WARNING_PROBABILITY = 0.5
router = APIRouter(prefix="/v1/domains", tags=["localization"], route_class=QuickRoute)

MAX_LANDMARKS = 0xFFFF
GEOPOSE = "application/geopose+json"

# Bodies


class ObservationBody(JsonBody):
    """What a robot made of a view on board: exactly one of the first three, or what it tells of it.

    The engine refuses NaN and infinity.
    """

    most_parts = MOST_PARTS

    ranked_landmarks: Annotated[tuple[StrictInt, ...], FailFast()] = ()
    dissimilarities: Annotated[tuple[StrictFloat, ...], FailFast()] = ()
    encoding: Annotated[tuple[StrictFloat, ...], FailFast()] = ()
    objects: Any = None
    text: Any = None


def list_schema(name: str, items: dict[str, Any], description: str) -> dict[str, Any]:
    """The schema of an object with one list of numbers."""
    values = {"type": "array", "items": items, "minItems": 1, "maxItems": MAX_NUMBERS, "description": description}
    return {"type": "object", "required": [name], "properties": {name: values}, "additionalProperties": False}


IMAGE_SCHEMA: dict[str, Any] = {"type": "string", "format": "binary"}
_FORMS = (
    list_schema(
        "ranked_landmarks",
        {"type": "integer", "minimum": 0, "maximum": MAX_LANDMARKS - 1},
        "Distinct landmark ids from 0, nearest first, 1..r of them; the rest are farther.",
    ),
    list_schema("dissimilarities", {"type": "number"}, "r finite numbers in landmark order, smaller is nearer."),
    list_schema("encoding", {"type": "number"}, "A ready encoding, as long as those the map was made of."),
    SCENE_SCHEMA,
)
_RANKS_SCHEMA: dict[str, Any] = {
    **IMAGE_SCHEMA,
    "description": "The same in fewest bytes: their number m in two, big-endian, then m landmark ids, nearest first, "
    "of ceil(log2 r) bits each, most significant bit first; zero bits fill the last byte.",
}
_UNIT_ENCODING_SCHEMA: dict[str, Any] = {
    **IMAGE_SCHEMA,
    "description": "What a `composed` map compares, in few bytes: b, 2 to 8, in one, then k numbers of b bits each, "
    "most significant bit first, code c standing for c - (2^(b-1) - 1); zero bits fill the last byte. They are brought "
    "to unit length.",
}
MADE_ON_BOARD: dict[str, type[PackedRanks | PackedUnitEncoding]] = {
    RANKS: PackedRanks,
    UNIT_ENCODING: PackedUnitEncoding,
}
OBSERVATION_TYPES = (*MEDIA_TYPES, JSON, *MADE_ON_BOARD, *SCENE_BODIES)


def observation_body(extra_members: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The body of an observation in the OpenAPI document; a JSON body has `extra_members` too, by schema."""
    forms = [{**form, "properties": {**form["properties"], **(extra_members or {})}} for form in _FORMS]
    packed_schemas = {RANKS: _RANKS_SCHEMA, UNIT_ENCODING: _UNIT_ENCODING_SCHEMA}
    return declare(
        {**dict.fromkeys(MEDIA_TYPES, IMAGE_SCHEMA), JSON: {"oneOf": forms}, **packed_schemas, **SCENE_BODIES}
    )


OBSERVATION_BODY = observation_body()
Shortlist = Annotated[
    int | None, Query(ge=1, le=GREATEST_ID, description="Length of `retrieval` and `top`; absent: 10 or all.")
]
Brief = Annotated[
    bool,
    Query(description="Whether `histogram`, `top`, `retrieval`, `actions` stay empty: a tenth of the bytes."),
]

# Answers: plain dictionaries, because every answer to a view holds some forty of them


FrameName = Annotated[str | None, Field(description="What the map image is called in its recording.")]


class HistogramAnswer(TypedDict):
    """The belief in equal bins along the whole route, at most 200 of them whatever the number of map images."""

    edges_m: Annotated[list[float], Field(description="One longer than `mass`; none in brief.", max_length=201)]
    mass: Annotated[list[float], Field(description="Sums to 1; none in brief.", max_length=200)]


class PlaceAnswer(TypedDict):
    """A map image that the belief favours."""

    map_image: int
    frame: FrameName
    route_position_m: float
    x_m: float | None
    y_m: float | None
    mass: float


class BeliefAnswer(TypedDict):
    """Where on the route the robot probably is."""

    mean_m: float
    mode_m: Annotated[float, Field(description="Position of the likeliest map image.")]
    std_m: float
    credible_95_m: Annotated[
        tuple[float, float],
        Field(description="Hull of the smallest set that holds 95 % of the mass; lo > hi crosses the start."),
    ]
    entropy_bits: Annotated[float, Field(description="Over map images.", ge=0)]
    credible_95_sets_m: Annotated[list[tuple[float, float]], Field(description="The pieces of that set.")]
    off_route: Annotated[float, Field(description="Probability to be lost: off the route, or carried along it.")]
    confident: Annotated[bool, Field(description="Whether enough mass is within 5 m of the mode.")]
    histogram: HistogramAnswer
    top: Annotated[list[PlaceAnswer], Field(description="Likeliest map images, best first.")]


class RetrievedAnswer(TypedDict):
    """A map image and how well it answers the view."""

    map_image: int
    frame: FrameName
    route_position_m: float
    relevance: Annotated[float, Field(description="Larger is better.")]


class ActionAnswer(TypedDict):
    """What the experience database expects of a move."""

    action_m: float
    q_value: float | None
    expected_bits: Annotated[float | None, Field(description="That the view after it would tell; null: unknown.")]


class NextBestViewAnswer(TypedDict):
    """The move that would tell most."""

    planner: str
    action_m: float
    stop: Annotated[bool, Field(description="Whether the robot is as sure of its place as it asked to be.")]
    actions: list[ActionAnswer]


Timings = Annotated[
    dict[str, float],
    Field(
        description="Milliseconds by stage: `receive` (the body), `wait` (for its turn and the worker), `decode`, "
        "`describe`, `retrieve`, ..., `commit` (to the disk); and their `total`, with what is in no stage."
    ),
]


class LocalizationAnswer(TypedDict):
    """Where one view places the robot, from a uniform prior."""

    map_version: int
    timings_ms: Timings
    belief: BeliefAnswer
    informative: Annotated[bool, Field(description="Whether the view told anything.")]
    warnings: Annotated[list[str], Field(description="What a person should know, in sentences.")]
    retrieval: Annotated[list[RetrievedAnswer], Field(description="Most relevant map images, best first.")]
    next_best_view: Annotated[NextBestViewAnswer | None, Field(description="null until the map was trained for it.")]


def render_localization(
    localization: Localization, watch: Stopwatch, remarks: Sequence[str] = (), brief: bool = False
) -> LocalizationAnswer:
    """The answer to one view, with remarks on its picture; the watch runs since the request arrived."""
    snapshot, relevance = localization.snapshot, localization.relevance
    is_confident = localization.belief.near_mode >= DEFAULT_CONFIDENCE
    answer: LocalizationAnswer = {
        "map_version": snapshot.version,
        "belief": render_belief(snapshot, localization.belief, is_confident),
        "informative": localization.is_informative,
        "warnings": [*remarks, *warnings_of(localization.is_informative, localization.belief, localization.plan)],
        "retrieval": render_shortlist(snapshot, localization.shortlist, relevance),
        "next_best_view": render_plan(localization.plan, snapshot.actions_m, is_confident),
        "timings_ms": watch.timings_ms(),
    }
    if brief:
        empty_lists(answer)
    return answer


def empty_lists(answer: Any) -> None:
    """Empty the long lists of an answer to a view, by which no robot drives."""
    answer["retrieval"] = answer["belief"]["top"] = []
    answer["belief"]["histogram"] = {"edges_m": [], "mass": []}
    if answer["next_best_view"] is not None:
        answer["next_best_view"]["actions"] = []


def render_shortlist(snapshot: Map, ids: NDArray[np.int64], relevance: NDArray[np.float32]) -> list[RetrievedAnswer]:
    """Map images with their frames, places and relevances."""
    rows: list[RetrievedAnswer] = []
    columns = (ids, snapshot.frames[ids], snapshot.route.position_m[ids], relevance[ids])
    for image, frame, at_m, worth in zip(*map(np.ndarray.tolist, columns), strict=True):
        rows.append({"map_image": image, "frame": frame, "route_position_m": at_m, "relevance": worth})
    return rows


def render_plan(plan: Plan | None, actions_m: NDArray[np.float64], is_confident: bool) -> NextBestViewAnswer | None:
    """A recommended move, or to stop where the robot is sure of its place; None where there is none."""
    if plan is None:
        return None
    nulls = [None] * actions_m.size
    values = nulls if plan.values is None else plan.values.tolist()
    bits = nulls if plan.bits is None else plan.bits.tolist()
    actions: list[ActionAnswer] = []
    for action_m, value, expected_bits in zip(actions_m.tolist(), values, bits, strict=True):
        actions.append({"action_m": action_m, "q_value": value, "expected_bits": expected_bits})
    return {"planner": plan.planner, "action_m": plan.action_m, "stop": is_confident, "actions": actions}


def warnings_of(is_informative: bool, belief: BeliefSummary, plan: Plan | None) -> list[str]:
    """Warnings for a person, in sentences, about an answer."""
    warnings = [] if is_informative else ["the view told nothing of the place"]
    if belief.off_route > WARNING_PROBABILITY:
        warnings.append(f"the robot is probably off the route, or was carried: off_route is {belief.off_route:.2f}")
    elif plan is not None and plan.chance_on_route < PROBABLY:
        warnings.append("every move probably leads past the end of the mapped route")
    return warnings


def render_belief(snapshot: Map, belief: BeliefSummary, is_confident: bool) -> BeliefAnswer:
    """The answer's form of a belief, with the coordinates of its likeliest places."""
    route, ids, top = snapshot.route, belief.top, list[PlaceAnswer]()
    coordinates = []
    for metres in (route.x_m, route.y_m):
        column = np.full(ids.size, None)
        if metres is not None:
            is_known = np.isfinite(metres[ids])
            column[is_known] = metres[ids][is_known]
        coordinates.append(column)
    columns = (ids, snapshot.frames[ids], route.position_m[ids], *coordinates, belief.top_mass)
    for image, frame, at_m, x, y, mass in zip(*map(np.ndarray.tolist, columns), strict=True):
        top.append({"map_image": image, "frame": frame, "route_position_m": at_m, "x_m": x, "y_m": y, "mass": mass})
    return {
        "mean_m": belief.mean_m,
        "mode_m": belief.mode_m,
        "std_m": belief.std_m,
        "credible_95_m": belief.credible_95_m,
        "credible_95_sets_m": belief.credible_95_sets_m,
        "confident": is_confident,
        "entropy_bits": belief.entropy_bits,
        "off_route": belief.off_route,
        "histogram": {"edges_m": belief.histogram_edges_m.tolist(), "mass": belief.histogram_mass.tolist()},
        "top": top,
    }


def render_geopose(snapshot: Map, anchor: Mapping[str, float] | None, image: int) -> dict[str, dict[str, float]]:
    """A map image as a GeoPose (OGC 21-056r11, Basic-YPR): where on Earth, and which way the route leads there.

    Degrees, and metres above the ellipsoid; yaw runs from east towards north.

    Args:
        anchor: The members of the domain's `AnchorBody`; None: it has none.

    Raises:
        NotAcceptableError: The domain has no anchor, or nobody knows where that image was taken, or which way.
    """
    if anchor is None:
        raise NotAcceptableError(
            f"domain {snapshot.domain} has no anchor: PUT it with anchor {{lat_deg, lon_deg, bearing_deg}} first",
            reason="no_anchor",
        )
    route = snapshot.route
    heading_rad = float(route.heading_rad[image])
    if route.x_m is None or route.y_m is None or not math.isfinite(heading_rad):
        raise NotAcceptableError(
            f"map {snapshot.version} of domain {snapshot.domain} knows no x and y there: map a traverse that has them",
            reason="no_heading",
        )
    latitude_deg, longitude_deg = on_earth(float(route.x_m[image]), float(route.y_m[image]), **anchor)
    yaw_deg = (math.degrees(heading_rad - math.radians(anchor["bearing_deg"])) + 180) % 360 - 180
    return {
        "position": {"lat": latitude_deg, "lon": longitude_deg, "h": anchor["height_m"]},
        "angles": {"yaw": yaw_deg, "pitch": 0.0, "roll": 0.0},
    }


# Handlers


@router.post(
    "/{domain}/localizations",
    response_model=LocalizationAnswer,
    responses={
        200: {
            "content": {
                **binary("float32 npy [n]: the relevance of every map image, in route order"),
                GEOPOSE: {"schema": {"type": "object", "required": ["position", "angles"]}},
            }
        },
        **problems(404, 406, 409, 413, 415, 422),
    },
    openapi_extra=OBSERVATION_BODY,
)
async def post_localization(
    domain: DomainName,
    request: Request,
    shortlist: Shortlist = None,
    brief: Brief = False,
    if_match: LandmarkModelTag = None,
) -> Response:
    """Localize one view: an image, whatever image type the header names, or what a robot made of it on board.

    With `Accept: application/octet-stream` the answer is the relevance of every map image; with
    `application/geopose+json` the likeliest place on Earth, where the domain has an anchor.
    """
    watch, services = Stopwatch(), cast("Services", request.app.state.services)
    mapped_domain = await services.active(domain)
    snapshot = mapped_domain.snapshot
    media_type = media_type_of(request, OBSERVATION_TYPES)
    shortlist_length(snapshot, shortlist)  # a bad query should not cost an upload
    landmark_models = None if if_match is None else required_tags(if_match)
    body = await read_bytes(request)
    watch.lap("receive")
    evaluator = services.evaluators.evaluator(mapped_domain.record.evaluator)
    view, remarks = await view_in(body, services, media_type, evaluator, snapshot)
    snapshot.check_landmark_model(landmark_models)
    watch.lap("decode")
    view = await services.encoded(evaluator, view)
    if prefers(request, BINARY):

        def compare() -> NDArray[np.float32]:
            return relevances(snapshot, describe(snapshot, evaluator, view))

        return npy_response(await services.worker.computed(compare, is_short=is_short(snapshot, view)))

    def look() -> Localization:
        watch.lap("wait", {"encode": view.encode_ms} if isinstance(view, EncodedImage) else None)
        return localize(snapshot, evaluator, view, shortlist, watch)

    localization = await services.worker.computed(look, is_short=is_short(snapshot, view, shortlist))
    if prefers(request, GEOPOSE):
        record = await run_sync(services.catalog.domain, domain)  # as it is now
        geopose = render_geopose(snapshot, record.options.get("anchor"), int(localization.belief.top[0]))
        return Response(to_json(geopose), media_type=GEOPOSE)
    answer, body = await services.render_json(
        localization.belief.top.size, render_localization, localization, watch, remarks, brief
    )
    services.metrics.record_localization(domain, answer["timings_ms"], answer["belief"]["entropy_bits"])
    return Response(body, media_type=JSON)


async def view_in(
    body: bytes,
    services: Services,
    media_type: str,
    evaluator: Evaluator,
    snapshot: Map,
    observation: ObservationBody | None = None,
) -> tuple[View, list[str]]:
    """The view in a body, and remarks for a person on its picture.

    An image is returned at its evaluator's size, shown by its map's grey levels.

    Args:
        observation: The JSON body where it has been parsed already.
    """
    document: dict[str, Any] = {}
    if media_type == JSON:
        observation = observation or await parse_json(body, ObservationBody, services)
        members = observation.model_fields_set & ObservationBody.model_fields.keys()
        is_scene = bool(members) and members <= SCENE_MEMBERS
        if not is_scene and len(members) != 1:
            raise invalid_body(
                "give exactly one of ranked_landmarks, dissimilarities, encoding; or objects, text, or both"
            )
        if "ranked_landmarks" in members:
            return RankedLandmarks(observation.ranked_landmarks), []
        if "dissimilarities" in members:
            return Dissimilarities(np.array(observation.dissimilarities, np.float64)), []
        if "encoding" in members:
            return ReadyEncoding(np.array(observation.encoding, np.float64)), []
        document = observation.model_dump(include=set(SCENE_MEMBERS))
    if media_type in MADE_ON_BOARD:
        return MADE_ON_BOARD[media_type](body), []
    levels = levels_in(snapshot.landmark_model)
    if media_type not in MEDIA_TYPES:
        scene, picture = await scene_in(
            body, media_type, document, services, evaluator, Priority.LIVE, levels, snapshot.cameras
        )
        picture_remarks = [] if picture is None else picture.remarks
        return NothingSeen() if scene.is_blank else scene, [*scene.remarks, *picture_remarks]
    decoded_picture = await services.decoders.decoded(body, evaluator, Priority.LIVE, levels, snapshot.cameras)
    return NothingSeen() if decoded_picture.is_blank else decoded_picture.image, decoded_picture.remarks


def npy_response(values: NDArray[np.floating]) -> Response:
    """An array as a float32 npy file."""
    file = BytesIO()
    np.save(file, values.astype("<f4", copy=False), allow_pickle=False)
    return Response(file.getvalue(), media_type=BINARY)
