"""Watching and cancelling jobs."""

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated

from anyio.to_thread import run_sync
from fastapi import APIRouter, Depends, Query, Request
from fastapi.sse import EventSourceResponse, ServerSentEvent

from deepsimbad.api.bodies import NAME_PATTERN
from deepsimbad.api.dependencies import JobId, Running
from deepsimbad.api.openapi import problems
from deepsimbad.api.paging import USUALLY_AT_ONCE, AfterJob, Limit, cursor_of, number_of
from deepsimbad.api.rendering import render_job
from deepsimbad.api.schemas import JobAnswer, JobList
from deepsimbad.errors import UnknownJobError
from deepsimbad.store.records import JobRecord

router = APIRouter(prefix="/v1/admin/jobs", tags=["admin: jobs"])


async def _found(job_id: JobId, running: Running) -> JobRecord:
    """The job of the path, so that an unknown one is refused before a stream begins."""
    return await run_sync(running.catalog.job, job_id)


@router.get("", responses=problems(404, 422))
async def list_jobs(
    running: Running,
    domain: Annotated[str | None, Query(pattern=NAME_PATTERN, description="Only this domain's; absent: all.")] = None,
    limit: Limit = USUALLY_AT_ONCE,
    after: AfterJob = None,
) -> JobList:
    """Jobs, newest first."""
    page = await run_sync(running.catalog.newest_jobs, domain, number_of(after), limit)
    return JobList(jobs=[render_job(record) for record in page.records], next=cursor_of("jobs", page.last_key))


@router.get("/{job_id}", responses=problems(404, 422))
async def get_job(job: Annotated[JobRecord, Depends(_found)]) -> JobAnswer:
    """One job."""
    return render_job(job)


@router.get(
    "/{job_id}/events",
    response_class=EventSourceResponse,
    responses={
        200: {"description": "`progress` events holding the job whenever it changed, and `done` at its end."},
        **problems(404, 422),
    },
)
async def get_job_events(
    job: Annotated[JobRecord, Depends(_found)], request: Request, running: Running
) -> AsyncIterator[ServerSentEvent]:
    """Follow a job: server-sent events, each holding the job as JSON; the last one is named `done`.

    The stream may end earlier, when the service shuts down or the key is revoked: ask for the job again.
    """
    told: JobRecord | None = None
    key_id: str | None = request.scope.get("state", {}).get("key_id")
    while not running.stopping.is_set() and running.keys.still_opens(key_id):
        if job != told:
            told = job
            yield ServerSentEvent(data=render_job(job), event="done" if job.state.is_final else "progress")
        if job.state.is_final:
            return
        await asyncio.sleep(running.settings.event_poll_s)
        try:
            job = await run_sync(running.catalog.job, job.job_id)
        except UnknownJobError:  # its domain was deleted
            return


@router.delete("/{job_id}", status_code=204, responses=problems(404, 422))
async def cancel_job(job_id: JobId, running: Running) -> None:
    """Ask a job to stop; one that has ended stays as it is."""
    await run_sync(running.runner.cancel, job_id)
