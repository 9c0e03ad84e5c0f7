"""Feeding back where a session's robot truly was."""

import logging
import time

import numpy as np
from anyio.to_thread import run_sync
from fastapi import APIRouter, Request, Response
from numpy.typing import NDArray

from deepsimbad.api.bodies import declare_json, read_json
from deepsimbad.api.dependencies import DomainName, Running
from deepsimbad.api.idempotency import KeyOfJob, id_under_key
from deepsimbad.api.openapi import problems
from deepsimbad.api.rendering import render_job
from deepsimbad.api.schemas import JobAnswer
from deepsimbad.api.session_bodies import ExperienceBody
from deepsimbad.errors import DeepSimbadError
from deepsimbad.jobs.session_walks import EXPERIENCE, ExperienceConfig, keep_true_positions
from deepsimbad.store.records import JobRecord

log = logging.getLogger(__name__)

router = APIRouter(prefix="/v1/admin/domains", tags=["admin: maps"])


@router.post(
    "/{domain}/experience",
    status_code=202,
    responses={
        202: {"headers": {"Location": {"description": "The job.", "schema": {"type": "string"}}}},
        **problems(404, 409, 410, 413, 415, 422, 429),
    },
    openapi_extra=declare_json(ExperienceBody),
)
async def post_experience(
    domain: DomainName, request: Request, response: Response, running: Running, idempotency_key: KeyOfJob = None
) -> JobAnswer:
    """Let the next map version learn from a session, whose true positions are known by now, as a job.

    The next version is the active one with a better experience database; the session may have ended, up to
    a day ago unless the settings say otherwise. What it tells of the live answers counts as it does for `truths`.
    """
    body = await read_json(request, ExperienceBody)
    config = ExperienceConfig.of(body.session_id, body.true_positions_m)
    job_id = id_under_key(request, EXPERIENCE, domain, idempotency_key)

    def keep() -> NDArray[np.float64] | None:
        return keep_true_positions(
            running.session_store, running.catalog, domain, body.session_id, body.true_positions_m, time.time()
        )

    async def learn() -> JobRecord:
        before_m = await run_sync(keep)
        try:
            return await run_sync(running.runner.submit, domain, config, job_id)
        finally:  # what was kept counts now or never, though the job be refused
            await count(before_m)

    async def count(before_m: NDArray[np.float64] | None) -> None:
        try:
            ranked = await running.truths.rank(body.session_id, body.true_positions_m)
        except DeepSimbadError as error:  # the job is on its way all the same
            about = {"domain": domain, "session_id": body.session_id}
            log.warning("truths could not be ranked: %s", error, extra=about)
        else:
            await run_sync(running.metrics.fed_back, domain, ranked.new_since(before_m).tolist())

    job = await run_sync(running.runner.made_before, job_id, config) or await learn()
    response.headers["Location"] = f"/v1/admin/jobs/{job.job_id}"
    return render_job(job)
