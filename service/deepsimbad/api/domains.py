"""Domains: what there are, making and removing them, the landmarks of their maps."""

import logging
from contextlib import suppress
from http import HTTPStatus
from typing import Annotated, Any, Self

from anyio.to_thread import run_sync
from fastapi import APIRouter, BackgroundTasks, Request, Response
from pydantic import Field, model_validator

from deepsimbad.api.problems import binary, declare_json, problems
from deepsimbad.api.requests import (
    BINARY,
    NAME_PATTERN,
    REVALIDATE,
    Answer,
    DomainName,
    JsonBody,
    Next,
    Page,
    PinnedVersion,
    RunningServices,
    StrictRoute,
    has_tag,
    page_of,
    read_json,
)
from deepsimbad.core.map import DEFAULT_ACTIONS_M, MOST_ACTION_M, check_actions
from deepsimbad.engine.maps import Maps, no_active_map_error
from deepsimbad.engine.worker import EvaluatorPool, ready
from deepsimbad.errors import (
    DeepSimbadError,
    InvalidMapConfigError,
    NoActiveMapError,
    UnavailableError,
    UnknownDomainError,
)
from deepsimbad.evaluators.grey_levels import GreyLevels, levels_in
from deepsimbad.evaluators.registry import EXTRACTOR_PATTERNS, EvaluatorKind, evaluator_config
from deepsimbad.store.records import DomainRecord

router = APIRouter(prefix="/v1/domains", tags=["domains"], route_class=StrictRoute)
admin = APIRouter(prefix="/v1/admin/domains", tags=["admin: domains"], route_class=StrictRoute)
log = logging.getLogger(__name__)

# Bodies and answers

_EVALUATOR_SCHEMA = {
    "type": "object",
    "required": ["kind"],
    "properties": {
        "kind": {"enum": [kind.value for kind in EvaluatorKind]},
        "of": {"type": "array", "minItems": 2, "maxItems": 2, "items": {"type": "object"}},
        "extractor": {"type": "string", "anyOf": [{"pattern": pattern} for pattern in EXTRACTOR_PATTERNS]},
    },
    "additionalProperties": False,
}


Degrees = Annotated[float, Field(strict=True, allow_inf_nan=False)]


class AnchorBody(JsonBody):
    """Where the origin of x and y lies on Earth, and how they are turned."""

    lat_deg: Annotated[Degrees, Field(ge=-90, le=90)]
    lon_deg: Annotated[Degrees, Field(ge=-180, le=180)]
    bearing_deg: Annotated[Degrees, Field(ge=0, lt=360, description="Of the axis y, clockwise from north.")] = 0.0
    height_m: Annotated[float, Field(strict=True, allow_inf_nan=False, description="Above the ellipsoid.")] = 0.0


class DomainBody(JsonBody):
    """A domain to be made."""

    evaluator: Annotated[
        dict[str, Any], Field(description="Its `kind`, and options.", json_schema_extra=_EVALUATOR_SCHEMA)
    ]
    closed: Annotated[bool, Field(strict=True, description="Whether the end of the route joins its start.")] = False
    actions_m: Annotated[
        tuple[Annotated[float, Field(strict=True, ge=-MOST_ACTION_M, le=MOST_ACTION_M, allow_inf_nan=False)], ...],
        Field(min_length=1, max_length=64, description="Moves in metres, ascending; backward ones are negative."),
    ] = DEFAULT_ACTIONS_M
    thumbnails: Annotated[
        bool | None,
        Field(
            strict=True, description="Whether a small picture of every map image is kept, for people. May be changed."
        ),
    ] = None
    anchor: Annotated[AnchorBody | None, Field(description="Where x and y lie on Earth. May be changed.")] = None

    def options(self) -> dict[str, Any]:
        """The options that may be changed later, as far as the body has them."""
        return self.model_dump(include=self.model_fields_set & {"thumbnails", "anchor"})

    @model_validator(mode="after")
    def _moves(self) -> Self:
        try:
            check_actions(self.actions_m)
        except InvalidMapConfigError as error:
            raise ValueError(error.message) from error
        return self


class DomainAnswer(Answer):
    """A domain and its active map; the map's members are null while it has none or it is damaged."""

    name: str
    evaluator: Annotated[dict[str, Any], Field(description="Its `kind` and options, defaults filled in.")]
    evaluator_problem: Annotated[str | None, Field(description="Code of what keeps it from being loaded.")]
    input_size: Annotated[
        tuple[int, int] | None, Field(description="[width, height] in pixels to resize an image to; null: to none.")
    ]
    takes: Annotated[
        list[str], Field(description="Forms of an observation, beside what is encoded elsewhere: image, objects, text.")
    ]
    encoding_dim: Annotated[int | None, Field(description="Of an image's encoding; null: no images are taken.")]
    weights_sha256: Annotated[str | None, Field(description="Of the file that images are encoded by; null: of none.")]
    closed: Annotated[bool, Field(description="Whether the end of the route joins its start.")]
    actions_m: Annotated[list[float], Field(description="The moves a planner may choose, in metres.")]
    thumbnails: Annotated[bool, Field(description="Whether a small picture of every new map image is kept.")]
    anchor: Annotated[AnchorBody | None, Field(description="Where x and y lie on Earth; null: nobody said.")]
    created_at: str
    map_version: Annotated[int | None, Field(description="The active one.")]
    map_problem: Annotated[str | None, Field(description="Code of what keeps the active map from answering.")]
    relevance: str | None
    route_length_m: float | None
    n_map_images: int | None
    n_landmarks: int | None
    list_length: int | None
    index_bits_per_map_image: float | None
    landmark_model_digest: Annotated[str | None, Field(description="SHA-256 of what `landmark-model` answers.")]
    grey_levels: Annotated[
        GreyLevels | None,
        Field(
            description="What is shown black and white of views of more than 8 bits, as of the map's own pictures; "
            "null: those had 8."
        ),
    ]


DomainPage = Annotated[Page, page_of("domains", NAME_PATTERN.removeprefix("^"), 1000)]


class DomainList(Answer):
    """Domains by name."""

    domains: list[DomainAnswer]
    next: Next


def describe_domain(record: DomainRecord, evaluators: EvaluatorPool, maps: Maps) -> DomainAnswer:
    """A domain and its active map, whatever state they are in; may read files, so it belongs in a thread.

    Raises:
        UnknownDomainError: It was deleted meanwhile.
    """
    evaluator = snapshot = evaluator_problem = map_problem = None
    try:
        evaluator = ready(evaluators.evaluator(record.evaluator))
    except UnavailableError as error:
        evaluator_problem = error.hints.get("reason", error.code)
    try:
        snapshot = maps.active(record.name).snapshot
    except NoActiveMapError:
        pass
    except UnavailableError as error:  # damaged, or not to be read at this moment
        map_problem = error.code
    return DomainAnswer(
        name=record.name,
        evaluator=record.evaluator,
        evaluator_problem=evaluator_problem,
        input_size=evaluator and evaluator.input_size,
        takes=sorted(evaluator.forms) if evaluator else [],
        encoding_dim=evaluator and evaluator.encoding_dim,
        weights_sha256=evaluator and evaluator.weights_sha256,
        closed=record.closed,
        actions_m=list(record.actions_m),
        thumbnails=bool(record.options.get("thumbnails")),
        anchor=record.options.get("anchor"),
        created_at=record.created_at,
        map_version=snapshot.version if snapshot else record.active_version,
        map_problem=map_problem,
        relevance=snapshot and snapshot.relevance.value,
        route_length_m=snapshot and snapshot.route.length_m,
        n_map_images=snapshot and snapshot.n_images,
        n_landmarks=snapshot and snapshot.n_landmarks,
        list_length=snapshot and snapshot.list_length,
        index_bits_per_map_image=snapshot and snapshot.index_bits_per_map_image,
        landmark_model_digest=snapshot and snapshot.landmark_model_digest,
        grey_levels=snapshot and levels_in(snapshot.landmark_model),
    )


# Handlers


@router.get("", responses=problems(422))
def list_domains(request: Request, services: RunningServices, page: DomainPage) -> DomainList:
    """All domains, by name, a thousand an answer; of cold ones the maps are read."""
    key_domains = request.scope["state"].get("domains")  # to this key; None: all
    answers, domain_page = [], services.catalog.domain_page(page.key, page.limit)
    for record in domain_page.records:
        if key_domains is not None and record.name not in key_domains:
            continue
        with suppress(UnknownDomainError):  # deleted since it was listed
            answers.append(describe_domain(record, services.evaluators, services.maps))
    return DomainList(domains=answers, next=page.next(domain_page.last_key))


@router.get("/{domain}", responses=problems(404, 422))
def get_domain(domain: DomainName, services: RunningServices) -> DomainAnswer:
    """One domain and its active map."""
    return describe_domain(services.catalog.domain(domain), services.evaluators, services.maps)


@router.get(
    "/{domain}/landmark-model",
    response_class=Response,
    responses={
        200: {
            "content": binary(
                "npz of the landmark model's arrays by name, and 0-d arrays `map_version`, `n_landmarks`, `evaluator` "
                "(its configuration as JSON) and `weights_sha256` (empty where there are none)"
            ),
            "headers": {"ETag": {"description": "The landmark model's digest, quoted.", "schema": {"type": "string"}}},
        },
        304: {"description": "`If-None-Match` names this landmark model"},
        **problems(404, 409, 410, 422),
    },
)
async def get_landmark_model(
    domain: DomainName,
    request: Request,
    services: RunningServices,
    map_version: PinnedVersion = None,
) -> Response:
    """The landmarks of a map, for a robot that encodes on board and sends ranks.

    What it sends with the tag in `If-Match` is never compared with other landmarks.
    """
    snapshot = await services.snapshot(domain, map_version)

    def pack() -> tuple[str, bytes | None]:
        etag = f'"{snapshot.landmark_model_digest}"'
        is_known = has_tag(request.headers.get("if-none-match"), etag)
        return etag, None if is_known else snapshot.portable_landmarks()

    etag, content = await run_sync(pack, limiter=services.long_work)
    headers = {**REVALIDATE, "ETag": etag}
    if content is None:
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    return Response(content, headers=headers, media_type=BINARY)


@admin.put(
    "/{domain}",
    status_code=201,
    responses={200: {"model": DomainAnswer, "description": "It was there already"}, **problems(409, 413, 415, 422)},
    openapi_extra=declare_json(DomainBody),
)
async def put_domain(
    domain: DomainName, request: Request, response: Response, services: RunningServices
) -> DomainAnswer:
    """Make a domain; the same again changes nothing, a different one is a 409, but for what may be changed."""
    body = await read_json(request, DomainBody)
    evaluator = evaluator_config(body.evaluator)

    def make() -> tuple[DomainAnswer, bool]:
        nonlocal evaluator
        try:
            stored_config = services.catalog.domain(domain).evaluator
        except UnknownDomainError:
            services.evaluators.evaluator(evaluator.as_dict()).load()  # one that cannot be loaded should not be stored
        else:
            if (
                stored_config.get("kind") == body.evaluator["kind"]
            ):  # what was left out is as it is, whatever the default now
                evaluator = evaluator_config({**stored_config, **body.evaluator})
        record, is_new = services.catalog.create_domain(
            domain, dict(evaluator.as_dict()), body.closed, body.actions_m, services.settings.max_domains
        )
        if (options := body.options()) and {**record.options, **options} != record.options:
            record = services.catalog.set_options(domain, options)
        return describe_domain(record, services.evaluators, services.maps), is_new

    answer, is_new = await run_sync(make)
    response.status_code = 201 if is_new else 200
    if is_new:
        log.info("domain made", extra={"domain": domain})
    return answer


@admin.post("/{domain}/warm", status_code=202, response_class=Response, responses=problems(404, 409, 422))
async def post_warm(domain: DomainName, services: RunningServices, later: BackgroundTasks) -> Response:
    """Say that a domain will soon be asked: its map and its evaluator are loaded behind this answer."""
    record = await run_sync(services.catalog.domain, domain)
    if record.active_version is None:
        raise no_active_map_error(domain)

    def load() -> None:
        with suppress(DeepSimbadError):  # who asks is told, and so is the log
            services.maps.active(domain)
            ready(services.evaluators.evaluator(record.evaluator))

    later.add_task(load)
    return Response(status_code=HTTPStatus.ACCEPTED, background=later)


@admin.delete("/{domain}", status_code=204, responses=problems(404, 409, 422))
async def delete_domain(domain: DomainName, services: RunningServices) -> None:
    """Remove a domain with its traverses and maps, and end its sessions; a job that still works on it is a 409."""
    await run_sync(services.open_traverses.forget, domain)
    try:
        await run_sync(services.catalog.delete_domain, domain)
    finally:  # where only its folder could not be removed, the domain is gone all the same
        if domain not in await run_sync(services.catalog.domain_names):
            services.maps.forget(domain)
            await services.sessions.end_those(lambda session: session.domain == domain)
            services.metrics.forget_domain(domain)
    log.info("domain deleted", extra={"domain": domain})
