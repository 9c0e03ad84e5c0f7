"""Where a single view places the robot, on any of many domains."""

from collections.abc import Mapping, Sequence
from functools import partial
from heapq import nlargest
from typing import Annotated, Any, Literal

from anyio.to_thread import run_sync
from fastapi import APIRouter, Query, Request, Response
from pydantic import Field
from typing_extensions import TypedDict

from deepsimbad.api.localizations import (
    MADE_ON_BOARD,
    OBSERVATION_TYPES,
    WARNING_PROBABILITY,
    BeliefAnswer,
    Brief,
    NextBestViewAnswer,
    ObservationBody,
    PlaceAnswer,
    RetrievedAnswer,
    Shortlist,
    Timings,
    empty_lists,
    observation_body,
    render_localization,
    view_in,
)
from deepsimbad.api.problems import invalid_body, problems
from deepsimbad.api.requests import (
    JSON,
    NAME_PATTERN,
    LandmarkModelTag,
    Name,
    RunningServices,
    Services,
    StrictRoute,
    media_type_of,
    parse_json,
    read_bytes,
    required_tags,
)
from deepsimbad.engine.atlas import MOST_IN_FULL, Part, Whereabouts, whereabouts
from deepsimbad.engine.localizer import DEFAULT_SHORTLIST, Localization
from deepsimbad.engine.maps import MappedDomain
from deepsimbad.engine.worker import EncodedImage, Stopwatch
from deepsimbad.errors import (
    DeepSimbadError,
    ForbiddenError,
    LandmarkModelDiffersError,
    NoDomainAnswersError,
    UnknownDomainError,
)
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.grey_levels import levels_in

router = APIRouter(prefix="/v1", tags=["localization"], route_class=StrictRoute)

ALL = "*"
MOST_NAMES = 10_000
_MOST_IN_QUERY = 500  # names, of which the longest make no line too long for the server
_MOST_LISTED = 100  # of domains that could not answer

# Bodies and answers


class WhereaboutsBody(ObservationBody):
    """A view, and the domains that it is asked of."""

    most_parts = 2 * MOST_NAMES + ObservationBody.most_parts

    domains: Annotated[tuple[Name, ...], Field(min_length=1, max_length=MOST_NAMES)] | Literal["*"] = "*"


_DOMAINS_SCHEMA = {
    "description": "Domains that the view is asked of, or `*`: all that the key opens. Absent: `*`.",
    "oneOf": [
        {"type": "array", "minItems": 1, "maxItems": MOST_NAMES, "items": {"type": "string", "pattern": NAME_PATTERN}},
        {"const": ALL},
    ],
}
DomainNames = Annotated[
    list[Annotated[str, Field(pattern=rf"{NAME_PATTERN}|^\*$")]] | None,
    Query(description="The same beside any body, once for every domain; not both.", max_length=_MOST_IN_QUERY),
]
InFull = Annotated[
    int, Query(ge=1, le=MOST_IN_FULL, description="How many of the likeliest domains are told with their beliefs.")
]


class LikelyDomainAnswer(TypedDict):
    """A domain that the robot may be on, and where it is then: all but `probability` as its own answer has it."""

    domain: str
    map_version: int
    probability: Annotated[float, Field(description="That the robot is on this route.")]
    log_evidence: Annotated[
        float, Field(description="By how much likelier the view is here than elsewhere, as a natural logarithm.")
    ]
    belief: BeliefAnswer
    informative: bool
    retrieval: list[RetrievedAnswer]
    next_best_view: NextBestViewAnswer | None


class LikelyPlaceAnswer(PlaceAnswer):
    """A map image of a domain; `mass` is of all domains and `elsewhere` together."""

    domain: str


class OthersAnswer(TypedDict):
    """The domains that answered and are not told."""

    n_domains: int
    probability: Annotated[float, Field(description="Of all of them together.")]


class LeftOutAnswer(TypedDict):
    """A domain that could not answer."""

    domain: str
    code: Annotated[str, Field(description="Of the error that its own localizations would have.")]
    detail: str


class WhereaboutsAnswer(TypedDict):
    """Where one view places the robot among many domains, all as probable before."""

    timings_ms: Timings
    domains: Annotated[list[LikelyDomainAnswer], Field(description="The likeliest, best first.")]
    others: OthersAnswer
    elsewhere: Annotated[float, Field(description="Probability that the robot is on none of these routes.")]
    top: Annotated[list[LikelyPlaceAnswer], Field(description="Likeliest map images of all domains, best first.")]
    informative: Annotated[bool, Field(description="Whether the view told anything, on the likeliest domain.")]
    warnings: list[str]
    left_out: Annotated[list[LeftOutAnswer], Field(description="At most a hundred of them, by name.")]
    n_left_out: int


def render_whereabouts(
    posterior: Whereabouts, watch: Stopwatch, remarks: Sequence[str], n_top: int | None, brief: bool
) -> WhereaboutsAnswer:
    """The answer of a posterior over domains; the watch runs since the request arrived."""
    domains, places = list[LikelyDomainAnswer](), list[LikelyPlaceAnswer]()
    for name, probability in posterior.probabilities.items():
        localization: Any = posterior.likeliest[name]
        answer = render_localization(localization, watch) if isinstance(localization, Localization) else localization
        domains.append(
            {
                "domain": name,
                "map_version": answer["map_version"],
                "probability": probability,
                "log_evidence": posterior.log_evidences[name],
                "belief": answer["belief"],
                "informative": answer["informative"],
                "retrieval": answer["retrieval"],
                "next_best_view": answer["next_best_view"],
            }
        )
        for place in answer["belief"]["top"]:
            places.append({**place, "domain": name, "mass": probability * place["mass"]})
    if brief:
        places = []
        for domain in domains:
            empty_lists(domain)
    is_informative = bool(domains) and domains[0]["informative"]
    warnings = [*remarks] + ([] if is_informative else ["the view told nothing of the place"])
    if posterior.elsewhere_probability > WARNING_PROBABILITY:
        warnings.append(
            f"the robot is probably on none of these routes: elsewhere is {posterior.elsewhere_probability:.2f}"
        )
    left_out = list(posterior.left_out.items())
    return {
        "domains": domains,
        "others": {"n_domains": posterior.n_others, "probability": posterior.others_probability},
        "elsewhere": posterior.elsewhere_probability,
        "top": nlargest(n_top or DEFAULT_SHORTLIST, places, key=lambda place: place["mass"]),
        "informative": is_informative,
        "warnings": warnings,
        "left_out": [_left_out(name, error) for name, error in left_out[:_MOST_LISTED]],
        "n_left_out": len(left_out),
        "timings_ms": watch.timings_ms(),
    }


def _left_out(name: str, error: DeepSimbadError) -> LeftOutAnswer:
    return {"domain": name, "code": error.code, "detail": error.message}


# Handlers


@router.post(
    "/localizations",
    response_model=WhereaboutsAnswer,
    responses=problems(404, 409, 413, 415, 422),
    openapi_extra=observation_body({"domains": _DOMAINS_SCHEMA}),
)
async def post_whereabouts(
    request: Request,
    services: RunningServices,
    domains: DomainNames = None,
    shortlist: Shortlist = None,
    brief: Brief = False,
    in_full: InFull = 5,
    if_match: LandmarkModelTag = None,
) -> Response:
    """Localize one view on any of many domains, of which each is as probable as every other before it.

    An image is encoded once for all domains of one evaluator whose maps are of one kind of picture. Ranks,
    dissimilarities and unit encodings are of one landmark model: `If-Match` chooses the domains that have it, else all
    asked must.
    """
    watch = Stopwatch()
    media_type = media_type_of(request, OBSERVATION_TYPES)
    body = await read_bytes(request)
    watch.lap("receive")
    observation = await parse_json(body, WhereaboutsBody, services) if media_type == JSON else None
    names, is_all = await _domain_names(request, services, domains, observation)
    owners = services.owners
    gathering = run_sync(services.atlas.gather, names, is_all) if owners is None else owners.gather(names, is_all)
    mapped_domains, left_out = await gathering
    if if_match is not None and (tags := required_tags(if_match)) is not None:
        mapped_domains, mismatches = await run_sync(_with_landmark_models, mapped_domains, tags)
        left_out |= mismatches
    elif media_type in MADE_ON_BOARD or (
        observation and observation.model_fields_set & {"ranked_landmarks", "dissimilarities"}
    ):
        await run_sync(_check_one_landmark_model, mapped_domains)
    watch.lap("maps")
    parts, remarks = [Part({}, {}, left_out)], dict[str, Sequence[str]]()  # on the view, beside every domain's pictures
    for evaluator, members in _encoding_groups(services, mapped_domains):
        try:
            view, view_remarks = await view_in(body, services, media_type, evaluator, members[0].snapshot, observation)
            watch.lap("decode")
            view = await services.encoded(evaluator, view)
            watch.lap("wait", {"encode": view.encode_ms} if isinstance(view, EncodedImage) else None)
            if owners is None:
                ask = partial(services.atlas.ask, members, evaluator, view, in_full, shortlist)
                parts.append(await services.worker.computed(ask))
            else:
                parts += await owners.ask(members, view, in_full, shortlist)
        except DeepSimbadError as error:
            parts.append(Part({}, {}, {member.record.name: error for member in members}))
        else:
            remarks |= {member.record.name: view_remarks for member in members}
        watch.lap("compare")
    posterior = whereabouts(parts, in_full)
    if not posterior.likeliest:
        raise _no_answer(posterior.left_out)
    likeliest_remarks = remarks[next(iter(posterior.probabilities))]
    _, answer = await services.render_json(
        in_full * (shortlist or 1), render_whereabouts, posterior, watch, likeliest_remarks, shortlist, brief
    )
    return Response(answer, media_type=JSON)


async def _domain_names(
    request: Request, services: Services, query_names: list[str] | None, observation: WhereaboutsBody | None
) -> tuple[list[str], bool]:
    """The names of the domains that are asked, without repetitions, and whether these are all that the key opens.

    Raises:
        ForbiddenError: The key does not open one that was named.
    """
    in_body = observation is not None and "domains" in observation.model_fields_set
    if in_body and query_names is not None:
        raise invalid_body("domains stand in the body and in the query: name them once")
    names: Any = observation.domains if in_body and observation else query_names or ALL
    key_domains = request.scope["state"].get("domains")  # to this key; None: all
    if ALL in names:
        existing_names = await run_sync(services.catalog.domain_names)
        return sorted(existing_names if key_domains is None else existing_names & set(key_domains)), True
    if key_domains is not None and not set(names) <= set(key_domains):
        raise ForbiddenError("this key is for other domains", domains=list(key_domains))
    return list(dict.fromkeys(names)), False


def _encoding_groups(
    services: Services, mapped_domains: Sequence[MappedDomain]
) -> list[tuple[Evaluator, list[MappedDomain]]]:
    """The domains, grouped by evaluator and kind of picture: for each group a view is decoded and encoded once."""
    groups: dict[Any, tuple[Evaluator, list[MappedDomain]]] = {}
    for mapped_domain in mapped_domains:
        evaluator = services.evaluators.evaluator(mapped_domain.record.evaluator)
        key = id(evaluator), str(levels_in(mapped_domain.snapshot.landmark_model)), mapped_domain.snapshot.cameras
        groups.setdefault(key, (evaluator, []))[1].append(mapped_domain)
    return list(groups.values())


def _with_landmark_models(
    mapped_domains: Sequence[MappedDomain], tags: frozenset[str]
) -> tuple[list[MappedDomain], dict[str, DeepSimbadError]]:
    matches, left_out = list[MappedDomain](), dict[str, DeepSimbadError]()
    for mapped_domain in mapped_domains:
        try:
            mapped_domain.snapshot.check_landmark_model(tags)
            matches.append(mapped_domain)
        except LandmarkModelDiffersError as error:
            left_out[mapped_domain.record.name] = error
    return matches, left_out


def _check_one_landmark_model(mapped_domains: Sequence[MappedDomain]) -> None:
    digests = {mapped_domain.snapshot.landmark_model_digest for mapped_domain in mapped_domains}
    if len(digests) > 1:
        raise LandmarkModelDiffersError(
            f"what is made on board is of one landmark model, and these domains have {len(digests)}: name its digest "
            "in If-Match, and those that have it answer; or send the encoding",
            landmark_model_digests=sorted(digests)[:_MOST_LISTED],
        )


def _no_answer(left_out: Mapping[str, DeepSimbadError]) -> DeepSimbadError:
    if len(left_out) == 1:
        return next(iter(left_out.values()))
    if not left_out:
        return UnknownDomainError("there is no domain that could be asked")
    first_error = next(iter(left_out.values()))
    return NoDomainAnswersError(
        f"none of {len(left_out)} domains can answer; the first says: {first_error.message}",
        left_out=[dict(_left_out(name, error)) for name, error in list(left_out.items())[:_MOST_LISTED]],
    )
