"""A domain's map versions, and switching between them."""

import logging

from anyio.to_thread import run_sync
from fastapi import APIRouter, Request
from starlette.responses import Response, StreamingResponse

from deepsimbad.api.bodies import ActiveMapBody, declare_json, read_json
from deepsimbad.api.dependencies import DomainName, MapVersion, Running
from deepsimbad.api.map_download import MEDIA_TYPE, MapFile, map_response
from deepsimbad.api.openapi import problems
from deepsimbad.api.paging import USUALLY_AT_ONCE, AfterMap, Limit, cursor_of, number_of
from deepsimbad.api.rendering import render_map
from deepsimbad.api.schemas import MapAnswer, MapList
from deepsimbad.engine.maps import load_snapshot, unreadable
from deepsimbad.errors import ConflictError, DamagedMapError, UnknownMapVersionError
from deepsimbad.store.catalog_maps import ANY, removed
from deepsimbad.store.records import MapState

router = APIRouter(prefix="/v1/admin/domains", tags=["admin: maps"])
log = logging.getLogger(__name__)

_TEXT = {"type": "string"}
_FILE = {
    "description": "The file",
    "content": {MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}},
    "headers": {
        "ETag": {"description": 'The SHA-256 of the whole file, as `"sha256:..."` in hex.', "schema": _TEXT},
        "Repr-Digest": {"description": "The same, as RFC 9530 writes it.", "schema": _TEXT},
    },
}


@router.get("/{domain}/maps", responses=problems(404, 422))
async def list_maps(
    domain: DomainName, running: Running, limit: Limit = USUALLY_AT_ONCE, after: AfterMap = None
) -> MapList:
    """The history of a domain's map, newest version first."""
    page = await run_sync(running.catalog.newest_maps, domain, number_of(after), limit)
    return MapList(maps=[render_map(record) for record in page.records], next=cursor_of("maps", page.last_key))


@router.put(
    "/{domain}/active-map", responses=problems(404, 409, 410, 413, 415, 422), openapi_extra=declare_json(ActiveMapBody)
)
async def put_active_map(domain: DomainName, request: Request, running: Running) -> MapAnswer:
    """Activate a version, forward or back, if the active one is still `expected`.

    The version's file is checked first, so that a damaged one never takes over. One whose file was removed is a 410.
    """
    body = await read_json(request, ActiveMapBody)
    expected = body.expected if "expected" in body.model_fields_set else ANY

    def switch() -> MapAnswer:
        if running.catalog.map(domain, body.version).state is MapState.BUILDING:
            raise ConflictError(f"map {body.version} of domain {domain} is still being built")
        load_snapshot(running.catalog, domain, body.version)
        record = running.catalog.activate(domain, body.version, expected)
        running.maps.refresh(domain)
        running.retention.prune(domain)
        return render_map(record)

    return await run_sync(switch)  # what switches it logs it too, whoever asked


@router.delete("/{domain}/maps/{version}", status_code=204, responses=problems(404, 409, 410, 422))
async def delete_map(domain: DomainName, version: MapVersion, running: Running) -> None:
    """Remove the file of a version; it stays in the history, retired.

    The version that serves, one being built and one that a session lives on are a 409.
    """
    await run_sync(running.retention.remove, domain, version)
    log.info("map removed", extra={"domain": domain, "map_version": version})


@router.get(
    "/{domain}/maps/{version}/file",
    response_class=StreamingResponse,
    responses={
        200: _FILE,
        206: {**_FILE, "description": "The range that was asked for"},
        304: {"description": "`If-None-Match` names these bytes"},
        **problems(404, 410, 416, 422),
    },
)
async def get_map_file(domain: DomainName, version: MapVersion, request: Request, running: Running) -> Response:
    """A sealed version whole, as one SQLite file that another server can import.

    It is read against its digest before the first byte is sent; `Repr-Digest` and `ETag` tell that digest.
    """

    def opened() -> MapFile:
        record = running.catalog.map(domain, version)
        if record.removed_at is not None:
            raise removed(domain, version)
        if record.sha256 is None:
            raise UnknownMapVersionError(f"map {version} of domain {domain} is still being built", version=version)
        try:
            return MapFile.open(running.catalog.map_path(domain, version), record.sha256)
        except DamagedMapError as error:
            raise unreadable(running.catalog, domain, version) from error

    return map_response(await run_sync(opened), f"{domain}-{version:06d}.sqlite", request.headers)
