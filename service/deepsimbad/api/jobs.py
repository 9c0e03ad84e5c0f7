"""Jobs: asking for the next map of a domain, following and cancelling; what operators learn of them."""

import asyncio
import logging
import time
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Annotated, Any, Literal

from anyio.to_thread import run_sync
from fastapi import APIRouter, Depends, Path, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import Field

from deepsimbad.api.localizations import MAX_LANDMARKS
from deepsimbad.api.problems import declare_json, location, problems
from deepsimbad.api.requests import (
    GREATEST_EXACT_INTEGER,
    NAME_PATTERN,
    Answer,
    DomainName,
    JsonBody,
    KeyOfCreation,
    Name,
    Next,
    OfDomain,
    Page,
    RunningServices,
    StrictRoute,
    id_under_key,
    key_id_of,
    page_of,
    read_json,
)
from deepsimbad.api.sessions import TruePositions
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.errors import DeepSimbadError, NoActiveMapError, UnavailableError, UnknownJobError
from deepsimbad.jobs.append import camera_domain, refuse_known_traverse
from deepsimbad.jobs.remap_config import DEFAULT_LIST_LENGTH, DEFAULT_TRAINING_EPISODES, RemapConfig, refuse_impossible
from deepsimbad.jobs.runner import REMAP
from deepsimbad.jobs.versions import EXPERIENCE, TRAVERSE_ROLES, ExperienceConfig, keep_true_positions
from deepsimbad.store.records import JobRecord
from deepsimbad.store.traverses import Traverse

router = APIRouter(prefix="/v1/admin/jobs", tags=["admin: jobs"], route_class=StrictRoute)
making = APIRouter(prefix="/v1/admin/domains", tags=["admin: maps"], route_class=StrictRoute)
log = logging.getLogger(__name__)

JobId = Annotated[str, Path(pattern=NAME_PATTERN, description="A job's id.")]

# Bodies and answers


class RemapBody(JsonBody):
    """What to build the next map of a domain from."""

    training_traverse: Annotated[Name, Field(description="Its frames become the map images.")]
    landmark_traverse: Annotated[
        Name | None,
        Field(description="Where landmarks are chosen; null: the active map's, else the training traverse's."),
    ] = None
    n_landmarks: Annotated[
        Annotated[int, Field(strict=True, ge=1, le=MAX_LANDMARKS)] | None,
        Field(description="r; null: 500, all frames of a shorter drive, or the active map's where they stay."),
    ] = None
    list_length: Annotated[int, Field(strict=True, ge=1, le=MAX_LANDMARKS, description="h, at most r")] = (
        DEFAULT_LIST_LENGTH
    )
    relevance: Relevance = DEFAULT_RELEVANCE
    training_episodes: Annotated[
        int, Field(strict=True, ge=0, le=10_000_000, description="Of what the planner `nnql` knows; 0: nothing.")
    ] = DEFAULT_TRAINING_EPISODES
    seed: Annotated[int, Field(strict=True, ge=0, le=GREATEST_EXACT_INTEGER)] = 0
    activate: Annotated[bool, Field(strict=True, description="Switch to the new map when it is sealed.")] = True
    check_traverse: Annotated[
        Name | None,
        Field(description="Drive that both maps are compared on; null: every tenth training frame, held out."),
    ] = None
    gate_margin: Annotated[
        Annotated[float, Field(strict=True, ge=0, le=100, allow_inf_nan=False)] | None,
        Field(description="Percentage points of ANR that an activated map may be worse by; null: no gate."),
    ] = None
    append: Annotated[
        bool,
        Field(
            strict=True,
            description="Add the traverse to a copy of the active map: of composed, places seen again become the mean "
            "of their seasons (metrics.fused tells); landmark_traverse must be null.",
        ),
    ] = False
    same_route: Annotated[
        Annotated[bool, Field(strict=True)] | None,
        Field(
            description="Whether the two traverses count positions along one route, so that a second season can be "
            "learnt; null: only where both know x, y. metrics.second_season says what became of it."
        ),
    ] = None

    camera_of: Annotated[
        Name | None,
        Field(
            description="Another domain of the same camera, whose active map knows two seasons of its route: where "
            "this route was seen in one, what a season changes is learnt there (composed; metrics.camera_of says so)."
        ),
    ] = None

    def config(self) -> RemapConfig:
        """The configuration of the job; raises InvalidMapConfigError."""
        return RemapConfig(**{name: getattr(self, name) for name in type(self).model_fields})


class ExperienceBody(TruePositions):
    """Where the robot of a session truly was."""

    session_id: Name


class JobResult(Answer):
    """What a remap made."""

    map_version: int
    active: bool
    metrics: dict[str, Any]


class JobError(Answer):
    """Why a job failed."""

    code: str
    detail: Annotated[str, Field(validation_alias="message")]


class JobAnswer(Answer):
    """A job on its way, or ended."""

    job_id: str
    domain: str
    kind: str
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"]
    stage: str | None
    progress: Annotated[float, Field(ge=0, le=1)]
    eta_s: float | None
    result: JobResult | None
    error: JobError | None
    config: dict[str, Any]
    created_at: str
    started_at: str | None
    finished_at: str | None


class JobList(Answer):
    """Jobs, newest first."""

    jobs: list[JobAnswer]
    next: Next


# Handlers


@making.post(
    "/{domain}/remaps",
    status_code=202,
    responses={**location(202, "The job."), **problems(404, 409, 413, 415, 422, 429)},
    openapi_extra=declare_json(RemapBody),
)
async def post_remap(
    domain: DomainName,
    request: Request,
    response: Response,
    services: RunningServices,
    idempotency_key: KeyOfCreation = None,
) -> JobAnswer:
    """Build the next map of a domain as a job; what serves stays until the new map is sealed.

    Without `landmark_traverse` the active map's landmarks stay, which is the cheap way to retrain, or where there are
    none the training traverse's own are taken; with `append` the active map's images stay too, and the training
    traverse is added to them. The new map is compared with the active one
    (`metrics.check` of the result), and with a `gate_margin` sealed but not activated where it is worse by more.
    """
    body = await read_json(request, RemapBody)
    config = body.config()
    job_id = id_under_key(request, REMAP, domain, idempotency_key)

    def submit() -> JobAnswer:
        earlier_job = services.runner.earlier_job(job_id, config)
        if earlier_job is not None:
            return JobAnswer.model_validate(earlier_job)
        record = services.catalog.domain(domain)
        if config.camera_of is not None:
            camera_domain(services.catalog, config.camera_of, record)
        n_frames: dict[str, int] = {}
        for name in (getattr(config, role) for role in TRAVERSE_ROLES):
            if name is not None:
                with Traverse.open(services.settings.data_dir, domain, name) as traverse:
                    n_frames[name] = traverse.n_frames
        if config.append and record.active_version is None:
            raise NoActiveMapError(
                f"domain {domain} has no active map to append to: make one first, without append", domain=domain
            )
        if config.append and record.active_version is not None:
            refuse_known_traverse(services.catalog.map(domain, record.active_version), config.training_traverse)
        with suppress(NoActiveMapError, UnavailableError):  # a damaged one keeps nobody from making another
            snapshot = None if record.active_version is None else services.maps.active(domain).snapshot
            refuse_impossible(config, n_frames, snapshot)
        return JobAnswer.model_validate(services.runner.submit(domain, config, job_id))

    job = await run_sync(submit)
    response.headers["Location"] = f"/v1/admin/jobs/{job.job_id}"
    return job


@making.post(
    "/{domain}/experience",
    status_code=202,
    responses={**location(202, "The job."), **problems(404, 409, 410, 413, 415, 422, 429)},
    openapi_extra=declare_json(ExperienceBody),
)
async def post_experience(
    domain: DomainName,
    request: Request,
    response: Response,
    services: RunningServices,
    idempotency_key: KeyOfCreation = None,
) -> JobAnswer:
    """Let the next map version learn from a session, whose true positions are known by now, as a job.

    The next version is the active one with a better experience database; the session may have ended, up to
    a day ago unless the settings say otherwise. What it tells of the live answers counts as it does for `truths`.
    """
    body = await read_json(request, ExperienceBody)
    config = ExperienceConfig.of(body.session_id, body.true_positions_m)
    job_id = id_under_key(request, EXPERIENCE, domain, idempotency_key)

    async def learn() -> JobRecord:
        truths = (domain, body.session_id, body.true_positions_m, time.time())
        before_m = await run_sync(keep_true_positions, services.session_store, services.catalog, *truths)
        try:
            return await run_sync(services.runner.submit, domain, config, job_id)
        finally:  # what was kept counts now or never, though the job be refused
            try:
                ranking = await services.truths.rank(body.session_id, body.true_positions_m)
                await run_sync(services.metrics.record_truths, domain, ranking.new_since(before_m).tolist())
            except DeepSimbadError as error:  # the job is on its way all the same
                labels = {"domain": domain, "session_id": body.session_id}
                log.warning("truths could not be ranked: %s", error, extra=labels)

    job = await run_sync(services.runner.earlier_job, job_id, config) or await learn()
    response.headers["Location"] = f"/v1/admin/jobs/{job.job_id}"
    return JobAnswer.model_validate(job)


def _job(job_id: JobId, services: RunningServices) -> JobRecord:
    """The job of the path, so that an unknown one is refused before a stream begins."""
    return services.catalog.job(job_id)


async def room_for_a_stream(services: RunningServices) -> AsyncIterator[None]:
    """Room for one more stream, until it ends."""
    with services.event_streams.slot():
        yield


@router.get("", responses=problems(404, 422))
def list_jobs(services: RunningServices, page: Annotated[Page, page_of("jobs")], domain: OfDomain = None) -> JobList:
    """Jobs, newest first."""
    job_page = services.newest_jobs(domain, page.number, page.limit)
    return JobList.model_validate({"jobs": job_page.records, "next": page.next(job_page.last_key)})


@router.get("/{job_id}", responses=problems(404, 422))
async def get_job(job: Annotated[JobRecord, Depends(_job)]) -> JobAnswer:
    """A job as it stands."""
    return JobAnswer.model_validate(job)


@router.get(
    "/{job_id}/events",
    response_class=EventSourceResponse,
    dependencies=[Depends(room_for_a_stream)],
    responses={
        200: {"description": "`progress` events holding the job whenever it changed, and `done` at its end."},
        **problems(404, 422),
    },
)
async def get_job_events(
    job: Annotated[JobRecord, Depends(_job)], request: Request, services: RunningServices
) -> AsyncIterator[ServerSentEvent]:
    """Follow a job: server-sent events, each holding the job as JSON; the last one is named `done`.

    The stream may end earlier, when the service shuts down or the key is revoked: ask for the job again.
    """
    last_job: JobRecord | None = None
    key_id = key_id_of(request)
    while not services.stopping.is_set() and services.keys.still_opens(key_id):
        if job != last_job:
            last_job = job
            yield ServerSentEvent(
                data=JobAnswer.model_validate(job), event="done" if job.state.is_final else "progress"
            )
        if job.state.is_final:
            return
        await asyncio.sleep(services.settings.event_poll_s)
        try:
            job = await run_sync(services.catalog.job, job.job_id)
        except UnknownJobError:  # its domain was deleted
            return


@router.delete("/{job_id}", status_code=204, responses=problems(404, 422))
def cancel_job(job_id: JobId, services: RunningServices) -> None:
    """Ask a job to stop; one that has ended stays as it is."""
    services.runner.cancel(job_id)
