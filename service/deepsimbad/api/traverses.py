"""Traverses of a domain: what was recorded, and by what."""

import logging
from contextlib import suppress
from dataclasses import replace
from typing import Annotated, Literal

from anyio.to_thread import run_sync
from fastapi import APIRouter, Path, Request, Response
from pydantic import Field, field_validator

from deepsimbad.api.problems import declare_json, problems
from deepsimbad.api.requests import (
    NAME_PATTERN,
    Answer,
    DomainName,
    JsonBody,
    Name,
    Next,
    Page,
    RunningServices,
    StrictRoute,
    page_of,
    read_json,
)
from deepsimbad.errors import ConflictError, TraverseInUseError, UnknownTraverseError
from deepsimbad.evaluators.grey_levels import DEEPEST, GreyLevels
from deepsimbad.jobs.versions import TRAVERSE_ROLES
from deepsimbad.store.records import JobState, ListPage
from deepsimbad.store.traverses import Traverse

router = APIRouter(prefix="/v1/admin/domains/{domain}/traverses", tags=["admin: traverses"], route_class=StrictRoute)
log = logging.getLogger(__name__)

TraverseName = Annotated[str, Path(alias="name", pattern=NAME_PATTERN, description="A traverse's name.")]

# Bodies and answers


class TraverseBody(JsonBody):
    """A traverse to be made."""

    name: Name
    grey_levels: Annotated[
        GreyLevels | None,
        Field(
            description="What is shown black and what white of pictures of more than 8 bits, 0 <= black < white <= "
            "65535; null: by the first one that shows anything."
        ),
    ] = None

    @field_validator("grey_levels")
    @classmethod
    def _ascend(cls, levels: GreyLevels | None) -> GreyLevels | None:
        if levels is not None and not 0 <= levels[0] < levels[1] <= DEEPEST:
            raise ValueError(f"grey levels are black and white, 0 <= black < white <= {DEEPEST}")
        return levels


IndexRange = Annotated[tuple[int, int], Field(description="First and last index of a gap, both inside it.")]


class CameraAnswer(Answer):
    """What took a drive's pictures."""

    name: Annotated[str | None, Field(description="As frames gave it.")]
    width: Annotated[int, Field(description="Of a picture as it is shown, upright, in pixels.")]
    height: int
    aspect_ratio: Annotated[float, Field(description="Width by height.")]
    orientation: Literal["landscape", "portrait", "square"]


class TraverseAnswer(Answer):
    """A recorded drive and what of it has arrived."""

    name: str
    n_frames: int
    missing: Annotated[list[IndexRange], Field(description="Gaps below the greatest index that has arrived.")]
    length_m: Annotated[float | None, Field(description="From the least position to the greatest.")]
    span_us: Annotated[tuple[int, int] | None, Field(description="First and last known time of a frame.")]
    digest: Annotated[
        str | None,
        Field(description="SHA-256 over indices, contents, places and times: one drive, one digest; null: unknown."),
    ]
    n_uninformative: Annotated[
        int,
        Field(
            description="Frames whose pictures show nothing: one grey, noise, the dark; or are so unlike all others "
            "that they may show nothing of the route: glare."
        ),
    ]
    n_spooled: Annotated[
        int, Field(description="Pictures that wait until a map is made of the traverse, for an evaluator to be fitted.")
    ]
    spooled_bytes: Annotated[int, Field(description="Of these.")]
    grey_levels: Annotated[
        GreyLevels | None,
        Field(description="By which pictures of more than 8 bits are shown as 8, black and white; null: none came."),
    ]
    cameras: Annotated[list[CameraAnswer], Field(description="Which took its pictures, that of most first.")]
    warnings: Annotated[
        tuple[str, ...],
        Field(description="What a person should know of its pictures; beside other drives' where one is asked for."),
    ]


class TraverseList(Answer):
    """The traverses of a domain, by name."""

    traverses: list[TraverseAnswer]
    next: Next


# Handlers


@router.post(
    "",
    status_code=201,
    responses={200: {"model": TraverseAnswer, "description": "It was there already"}, **problems(404, 413, 415, 422)},
    openapi_extra=declare_json(TraverseBody),
)
async def post_traverse(
    domain: DomainName, request: Request, response: Response, services: RunningServices
) -> TraverseAnswer:
    """Make an empty traverse; one of that name that is there stays as it is, but for grey levels it did not know."""
    body = await read_json(request, TraverseBody)
    data_dir = services.settings.data_dir

    def make() -> tuple[TraverseAnswer, bool]:
        services.catalog.domain(domain)
        try:
            traverse, is_new = Traverse.create(data_dir, domain, body.name), True
        except ConflictError:
            traverse, is_new = Traverse.open(data_dir, domain, body.name), False
        with traverse:
            if body.grey_levels is not None:
                traverse.keep_levels(body.grey_levels)
            return TraverseAnswer.model_validate(traverse.summary()), is_new

    answer, is_new = await run_sync(make)
    response.status_code = 201 if is_new else 200
    if is_new:
        log.info("traverse made", extra={"domain": domain, "traverse": body.name})
    return answer


@router.get("", responses=problems(404, 422))
def list_traverses(
    domain: DomainName,
    services: RunningServices,
    page: Annotated[Page, page_of("traverses", NAME_PATTERN.removeprefix("^"))],
) -> TraverseList:
    """The traverses of a domain, by name."""
    data_dir = services.settings.data_dir
    services.catalog.domain(domain)
    names = [name for name in Traverse.list(data_dir, domain) if name > (page.key or "")]
    name_page = ListPage.of(((name, name) for name in names), page.limit)
    answers = []
    for name in name_page.records:  # a file each, so that those of other pages stay closed
        with suppress(UnknownTraverseError), Traverse.open(data_dir, domain, name) as traverse:
            answers.append(TraverseAnswer.model_validate(traverse.summary()))
    return TraverseList(traverses=answers, next=page.next(name_page.last_key))


@router.get("/{name}", responses=problems(404, 422))
def get_traverse(domain: DomainName, name: TraverseName, services: RunningServices) -> TraverseAnswer:
    """What has arrived of a traverse, and which of its frames are missing."""
    services.catalog.domain(domain)
    data_dir = services.settings.data_dir
    with Traverse.open(data_dir, domain, name) as traverse:
        summary = traverse.summary()
    warnings = [*summary.warnings]
    for other in Traverse.list(data_dir, domain) if summary.cameras else ():
        camera = None
        with suppress(UnknownTraverseError):
            camera = None if other == name else Traverse.main_camera(data_dir, domain, other)
        other_pictures = f"those of traverse {other}"
        if camera is not None and (difference := summary.cameras[0].unlike([camera], other_pictures)) is not None:
            warnings.append(f"its pictures are not like {other_pictures}: {difference}")
    return TraverseAnswer.model_validate(replace(summary, warnings=tuple(warnings)))


@router.delete("/{name}", status_code=204, responses=problems(404, 409, 422))
def delete_traverse(domain: DomainName, name: TraverseName, services: RunningServices) -> None:
    """Remove a traverse and its frames; the maps made from it stay. A job that needs it is a 409."""
    for job in services.catalog.jobs(domain, (JobState.QUEUED, JobState.RUNNING)):
        if name in {job.config.get(role) for role in TRAVERSE_ROLES}:
            raise TraverseInUseError(
                f"job {job.job_id} needs traverse {name}: cancel it or wait for its end", job_id=job.job_id
            )
    services.open_traverses.forget(domain, name)
    Traverse.delete(services.settings.data_dir, domain, name)
    log.info("traverse deleted", extra={"domain": domain, "traverse": name})
