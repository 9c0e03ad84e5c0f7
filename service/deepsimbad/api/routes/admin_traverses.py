"""Traverses of a domain."""

import logging

from anyio.to_thread import run_sync
from fastapi import APIRouter, Request, Response

from deepsimbad.api.bodies import TraverseBody, declare_json, read_json
from deepsimbad.api.dependencies import DomainName, Running, TraverseName
from deepsimbad.api.openapi import problems
from deepsimbad.api.paging import USUALLY_AT_ONCE, AfterTraverse, Limit, cursor_of, name_of
from deepsimbad.api.schemas import TraverseAnswer, TraverseList
from deepsimbad.errors import ConflictError, TraverseInUseError, UnknownTraverseError
from deepsimbad.store.records import ListPage
from deepsimbad.store.traverses import Traverse

router = APIRouter(prefix="/v1/admin/domains/{domain}/traverses", tags=["admin: traverses"])
log = logging.getLogger(__name__)


@router.post(
    "",
    status_code=201,
    responses={
        200: {"model": TraverseAnswer, "description": "It was there already"},
        **problems(404, 413, 415, 422),
    },
    openapi_extra=declare_json(TraverseBody),
)
async def post_traverse(domain: DomainName, request: Request, response: Response, running: Running) -> TraverseAnswer:
    """Make an empty traverse; one of that name that is there stays as it is."""
    body = await read_json(request, TraverseBody)
    data_dir = running.settings.data_dir

    def make() -> tuple[TraverseAnswer, bool]:
        running.catalog.domain(domain)
        try:
            with Traverse.create(data_dir, domain, body.name) as traverse:
                return _describe(traverse), True
        except ConflictError:
            with Traverse.open(data_dir, domain, body.name) as traverse:
                return _describe(traverse), False

    answer, created = await run_sync(make)
    response.status_code = 201 if created else 200
    if created:
        log.info("traverse made", extra={"domain": domain, "traverse": body.name})
    return answer


@router.get("", responses=problems(404, 422))
async def list_traverses(
    domain: DomainName, running: Running, limit: Limit = USUALLY_AT_ONCE, after: AfterTraverse = None
) -> TraverseList:
    """The traverses of a domain, by name."""
    data_dir = running.settings.data_dir
    first = name_of(after)

    def described() -> TraverseList:
        running.catalog.domain(domain)
        names = [name for name in Traverse.list(data_dir, domain) if first is None or name > first]
        page = ListPage.of(((name, name) for name in names), limit)
        answers = []
        for name in page.records:  # a file each, so that those of other pages stay closed
            try:
                with Traverse.open(data_dir, domain, name) as traverse:
                    answers.append(_describe(traverse))
            except UnknownTraverseError:  # deleted since it was listed
                continue
        return TraverseList(traverses=answers, next=cursor_of("traverses", page.last_key))

    return await run_sync(described)


@router.get("/{name}", responses=problems(404, 422))
async def get_traverse(domain: DomainName, name: TraverseName, running: Running) -> TraverseAnswer:
    """One traverse: how many frames have arrived, and which are missing."""

    def described() -> TraverseAnswer:
        running.catalog.domain(domain)
        with Traverse.open(running.settings.data_dir, domain, name) as traverse:
            return _describe(traverse)

    return await run_sync(described)


@router.delete("/{name}", status_code=204, responses=problems(404, 409, 422))
async def delete_traverse(domain: DomainName, name: TraverseName, running: Running) -> None:
    """Remove a traverse and its frames; the maps made from it stay. A job that needs it is a 409."""

    def delete() -> None:
        for job in running.catalog.jobs(domain):
            needed = {job.config.get(role) for role in ("training_traverse", "landmark_traverse", "check_traverse")}
            if name in needed and not job.state.is_final:
                raise TraverseInUseError(
                    f"job {job.job_id} needs traverse {name}: cancel it or wait for its end", job_id=job.job_id
                )
        running.open_traverses.forget(domain, name)
        Traverse.delete(running.settings.data_dir, domain, name)

    await run_sync(delete)
    log.info("traverse deleted", extra={"domain": domain, "traverse": name})


def _describe(traverse: Traverse) -> TraverseAnswer:
    return TraverseAnswer(name=traverse.name, n_frames=traverse.n_frames, missing=traverse.missing)
