"""Feeding back where a session's robot truly was."""

import time

from anyio.to_thread import run_sync
from fastapi import APIRouter, Request, Response

from deepsimbad.api.bodies import declare_json, read_json
from deepsimbad.api.dependencies import DomainName, Running
from deepsimbad.api.openapi import problems
from deepsimbad.api.rendering import render_job
from deepsimbad.api.schemas import JobAnswer
from deepsimbad.api.session_bodies import ExperienceBody
from deepsimbad.jobs.session_walks import ExperienceConfig, keep_true_positions

router = APIRouter(prefix="/v1/admin/domains", tags=["admin: maps"])


@router.post(
    "/{domain}/experience",
    status_code=202,
    responses={
        202: {"headers": {"Location": {"description": "The job.", "schema": {"type": "string"}}}},
        **problems(404, 409, 413, 415, 422),
    },
    openapi_extra=declare_json(ExperienceBody),
)
async def post_experience(domain: DomainName, request: Request, response: Response, running: Running) -> JobAnswer:
    """Let the next map version learn from a session, whose true positions are known by now, as a job.

    The next version is the active one with a better experience database; the session may have ended up to a day ago.
    """
    body = await read_json(request, ExperienceBody)

    def submit() -> JobAnswer:
        keep_true_positions(
            running.session_store, running.catalog, domain, body.session_id, body.true_positions_m, time.time()
        )
        return render_job(running.runner.submit(domain, ExperienceConfig(body.session_id)))

    answer = await run_sync(submit)
    response.headers["Location"] = f"/v1/admin/jobs/{answer.job_id}"
    return answer
