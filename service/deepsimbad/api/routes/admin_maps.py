"""A domain's map versions, and switching between them."""

import logging

from anyio.to_thread import run_sync
from fastapi import APIRouter, Request

from deepsimbad.api.bodies import ActiveMapBody, declare_json, read_json
from deepsimbad.api.dependencies import DomainName, Running
from deepsimbad.api.openapi import problems
from deepsimbad.api.paging import USUALLY_AT_ONCE, AfterMap, Limit, cursor_of, number_of
from deepsimbad.api.rendering import render_map
from deepsimbad.api.schemas import MapAnswer, MapList
from deepsimbad.engine.active_maps import load_snapshot
from deepsimbad.errors import ConflictError
from deepsimbad.store.map_table import ANY
from deepsimbad.store.records import MapState

router = APIRouter(prefix="/v1/admin/domains", tags=["admin: maps"])
log = logging.getLogger(__name__)


@router.get("/{domain}/maps", responses=problems(404, 422))
async def list_maps(
    domain: DomainName, running: Running, limit: Limit = USUALLY_AT_ONCE, after: AfterMap = None
) -> MapList:
    """The history of a domain's map, newest version first."""
    page = await run_sync(running.catalog.newest_maps, domain, number_of(after), limit)
    return MapList(maps=[render_map(record) for record in page.records], next=cursor_of("maps", page.last_key))


@router.put(
    "/{domain}/active-map", responses=problems(404, 409, 413, 415, 422), openapi_extra=declare_json(ActiveMapBody)
)
async def put_active_map(domain: DomainName, request: Request, running: Running) -> MapAnswer:
    """Activate a version, forward or back, if the active one is still `expected`.

    The version's file is checked first, so that a damaged one never takes over.
    """
    body = await read_json(request, ActiveMapBody)
    expected = body.expected if "expected" in body.model_fields_set else ANY

    def switch() -> MapAnswer:
        if running.catalog.map(domain, body.version).state is MapState.BUILDING:
            raise ConflictError(f"map {body.version} of domain {domain} is still being built")
        load_snapshot(running.catalog, domain, body.version)
        record = running.catalog.activate(domain, body.version, expected)
        running.active_maps.refresh(domain)
        return render_map(record)

    answer = await run_sync(switch)
    log.info("map activated", extra={"domain": domain, "map_version": body.version})
    return answer
