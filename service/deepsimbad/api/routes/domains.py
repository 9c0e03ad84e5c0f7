"""What domains there are."""

from http import HTTPStatus
from typing import Annotated

from anyio.to_thread import run_sync
from fastapi import APIRouter, Query, Request, Response

from deepsimbad.api.bodies import BINARY, GREATEST_ID
from deepsimbad.api.dependencies import DomainName, Running
from deepsimbad.api.domain_answers import describe_domain
from deepsimbad.api.entity_tags import KEPT, names
from deepsimbad.api.long_work import off_the_loop
from deepsimbad.api.openapi import binary, problems
from deepsimbad.api.schemas import DomainAnswer, DomainList
from deepsimbad.errors import UnknownDomainError

router = APIRouter(prefix="/v1/domains", tags=["domains"])

_ETAG = {"description": "The landmark model's digest, quoted.", "schema": {"type": "string"}}
_LANDMARKS = (
    "numpy npz without pickles: the landmark model's arrays by name, and 0-d arrays `map_version`, `n_landmarks`, "
    "`evaluator` (its configuration as JSON) and `weights_sha256` (empty where there are none)"
)


@router.get("", responses=problems())
async def list_domains(running: Running) -> DomainList:
    """All domains, by name."""

    def described() -> DomainList:
        answers = []
        for record in running.catalog.domains():
            try:
                answers.append(describe_domain(record, running.evaluators, running.maps))
            except UnknownDomainError:  # deleted since it was listed
                continue
        return DomainList(domains=answers)

    return await run_sync(described)


@router.get("/{domain}", responses=problems(404, 422))
async def get_domain(domain: DomainName, running: Running) -> DomainAnswer:
    """One domain and its active map."""
    return await run_sync(lambda: describe_domain(running.catalog.domain(domain), running.evaluators, running.maps))


@router.get(
    "/{domain}/landmark-model",
    response_class=Response,
    responses={
        200: {"content": dict(binary(_LANDMARKS)), "headers": {"ETag": _ETAG}},
        304: {"description": "`If-None-Match` names this landmark model"},
        **problems(404, 409, 410, 422),
    },
)
async def get_landmark_model(
    domain: DomainName,
    request: Request,
    running: Running,
    map_version: Annotated[
        int | None,
        Query(ge=1, le=GREATEST_ID, description="A version that a session is pinned to; absent: the active one."),
    ] = None,
) -> Response:
    """The landmarks of a map, for a robot that encodes on board and sends ranks.

    What it sends with the tag in `If-Match` is never compared with other landmarks.
    """

    def packed() -> tuple[str, bytes | None]:
        if map_version is None:
            snapshot = running.maps.active(domain).snapshot
        else:
            snapshot = running.maps.snapshot(domain, map_version)
        etag = f'"{snapshot.landmark_model_digest}"'
        is_known = names(request.headers.get("if-none-match"), etag)
        return etag, None if is_known else snapshot.portable_landmarks()

    etag, content = await off_the_loop(packed)
    told = {**KEPT, "ETag": etag}
    if content is None:
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=told)
    return Response(content, headers=told, media_type=BINARY)
