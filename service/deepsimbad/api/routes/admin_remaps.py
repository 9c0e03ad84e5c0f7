"""Asking for the next map of a domain."""

from anyio.to_thread import run_sync
from fastapi import APIRouter, Request, Response

from deepsimbad.api.bodies import RemapBody, declare_json, read_json
from deepsimbad.api.dependencies import DomainName, Running
from deepsimbad.api.idempotency import KeyOfJob, id_under_key
from deepsimbad.api.openapi import problems
from deepsimbad.api.rendering import render_job
from deepsimbad.api.schemas import JobAnswer
from deepsimbad.errors import NoActiveMapError
from deepsimbad.jobs.known_frames import refuse_known_traverse
from deepsimbad.jobs.runner import REMAP
from deepsimbad.store.traverses import Traverse

router = APIRouter(prefix="/v1/admin/domains", tags=["admin: maps"])


@router.post(
    "/{domain}/remaps",
    status_code=202,
    responses={
        202: {"headers": {"Location": {"description": "The job.", "schema": {"type": "string"}}}},
        **problems(404, 409, 413, 415, 422, 429),
    },
    openapi_extra=declare_json(RemapBody),
)
async def post_remap(
    domain: DomainName, request: Request, response: Response, running: Running, idempotency_key: KeyOfJob = None
) -> JobAnswer:
    """Build the next map of a domain as a job; what serves stays until the new map is sealed.

    Without `landmark_traverse` the active map's landmarks stay, which is the cheap way to retrain; with `append` its
    images stay too, and the training traverse is added to them. The new map is compared with the active one
    (`metrics.check` of the result), and with a `gate_margin` sealed but not activated where it is worse by more.
    """
    body = await read_json(request, RemapBody)
    config = body.config()
    job_id = id_under_key(request, REMAP, domain, idempotency_key)

    def submit() -> JobAnswer:
        made = running.runner.made_before(job_id, config)
        if made is not None:
            return render_job(made)
        record = running.catalog.domain(domain)
        for name in (config.training_traverse, config.landmark_traverse, config.check_traverse):
            if name is not None:
                Traverse.open(running.settings.data_dir, domain, name).close()
        if config.landmark_traverse is None and record.active_version is None:
            wanted = (
                "that could be appended to; make one first, without append"
                if config.append
                else "whose landmarks could stay; give a landmark_traverse"
            )
            raise NoActiveMapError(f"domain {domain} has no active map {wanted}", domain=domain)
        if config.append and record.active_version is not None:
            active = running.catalog.map(domain, record.active_version)
            refuse_known_traverse(active.config, active.version, config.training_traverse)
        return render_job(running.runner.submit(domain, config, job_id))

    job = await run_sync(submit)
    response.headers["Location"] = f"/v1/admin/jobs/{job.job_id}"
    return job
