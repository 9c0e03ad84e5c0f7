"""Making and removing domains."""

import logging
from typing import Any

from anyio.to_thread import run_sync
from fastapi import APIRouter, Request, Response

from deepsimbad.api.bodies import DomainBody, declare_json, read_json
from deepsimbad.api.dependencies import DomainName, Running, Services
from deepsimbad.api.domain_answers import describe_domain
from deepsimbad.api.openapi import problems
from deepsimbad.api.schemas import DomainAnswer
from deepsimbad.errors import UnknownDomainError
from deepsimbad.evaluators.registry import EvaluatorConfig, evaluator_config

router = APIRouter(prefix="/v1/admin/domains", tags=["admin: domains"])
log = logging.getLogger(__name__)


@router.put(
    "/{domain}",
    status_code=201,
    responses={200: {"model": DomainAnswer, "description": "It was there already"}, **problems(409, 413, 415, 422)},
    openapi_extra=declare_json(DomainBody),
)
async def put_domain(domain: DomainName, request: Request, response: Response, running: Running) -> DomainAnswer:
    """Make a domain; the same again changes nothing, a different one is a 409."""
    body = await read_json(request, DomainBody)
    evaluator_config(body.evaluator)

    def make() -> tuple[DomainAnswer, bool]:
        evaluator = _completed(body.evaluator, running, domain)
        record, created = running.catalog.create_domain(
            domain, dict(evaluator.as_dict()), body.closed, body.actions_m, running.settings.max_domains
        )
        return describe_domain(record, running.evaluators, running.maps), created

    answer, created = await run_sync(make)
    response.status_code = 201 if created else 200
    if created:
        log.info("domain made", extra={"domain": domain})
    return answer


@router.delete("/{domain}", status_code=204, responses=problems(404, 409, 422))
async def delete_domain(domain: DomainName, running: Running) -> None:
    """Remove a domain with its traverses and maps, and end its sessions; a job that still works on it is a 409."""
    await run_sync(running.open_traverses.forget, domain)
    deleted = False
    try:
        await run_sync(running.catalog.delete_domain, domain)
        deleted = True
    finally:  # where only its folder could not be removed, the domain is gone all the same
        if deleted or await run_sync(_is_gone, running, domain):
            running.maps.forget(domain)
            await running.sessions.end_those(lambda session: session.domain == domain)
            running.metrics.forget_domain(domain)
    log.info("domain deleted", extra={"domain": domain})


def _completed(given: dict[str, Any], running: Services, domain: str) -> EvaluatorConfig:
    """The configuration of a domain that is made now, loaded once; where it exists, what was left out is as it has it.

    The default may have changed since it was made.
    """
    try:
        present = running.catalog.domain(domain).evaluator
    except UnknownDomainError:
        config = evaluator_config(given)
        running.evaluators.evaluator(config.as_dict()).load()  # one that cannot be loaded should not be stored
        return config
    return evaluator_config({**present, **given} if present.get("kind") == given["kind"] else given)


def _is_gone(running: Running, domain: str) -> bool:
    try:
        running.catalog.domain(domain)
    except UnknownDomainError:
        return True
    return False
