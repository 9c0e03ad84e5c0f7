"""What domains there are."""

from anyio.to_thread import run_sync
from fastapi import APIRouter

from deepsimbad.api.dependencies import DomainName, Running
from deepsimbad.api.domain_answers import describe_domain
from deepsimbad.api.openapi import problems
from deepsimbad.api.schemas import DomainAnswer, DomainList
from deepsimbad.errors import UnknownDomainError

router = APIRouter(prefix="/v1/domains", tags=["domains"])


@router.get("", responses=problems())
async def list_domains(running: Running) -> DomainList:
    """All domains, by name."""

    def described() -> DomainList:
        answers = []
        for record in running.catalog.domains():
            try:
                answers.append(describe_domain(record, running.evaluators, running.active_maps))
            except UnknownDomainError:  # deleted since it was listed
                continue
        return DomainList(domains=answers)

    return await run_sync(described)


@router.get("/{domain}", responses=problems(404, 422))
async def get_domain(domain: DomainName, running: Running) -> DomainAnswer:
    """One domain and its active map."""
    return await run_sync(
        lambda: describe_domain(running.catalog.domain(domain), running.evaluators, running.active_maps)
    )
