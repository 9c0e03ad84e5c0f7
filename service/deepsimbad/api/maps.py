"""A domain's map versions: their history, switching between them, their files."""

import base64
import logging
import re
from http import HTTPStatus
from typing import Annotated, Any, Literal

from anyio.to_thread import run_sync
from fastapi import APIRouter, Request
from fastapi import Path as PathParameter
from pydantic import Field
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse, Response, StreamingResponse

from deepsimbad.api.problems import declare_json, problems
from deepsimbad.api.requests import (
    GREATEST_ID,
    REVALIDATE,
    Answer,
    DomainName,
    JsonBody,
    Next,
    Page,
    RunningServices,
    StrictRoute,
    has_tag,
    page_of,
    read_json,
)
from deepsimbad.engine.maps import load_snapshot, unreadable_error
from deepsimbad.errors import ConflictError, DamagedMapError
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.records import MapState

router = APIRouter(prefix="/v1/admin/domains", tags=["admin: maps"], route_class=StrictRoute)
log = logging.getLogger(__name__)

Headers = list[tuple[bytes, bytes]]
MEDIA_TYPE = "application/vnd.sqlite3"
MapVersion = Annotated[int, PathParameter(ge=1, le=GREATEST_ID, description="A map version's number.")]
_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")

_TEXT = {"type": "string"}
_FILE = {
    "description": "The file",
    "content": {MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}},
    "headers": {
        "ETag": {"description": 'The SHA-256 of the whole file, as `"sha256:..."` in hex.', "schema": _TEXT},
        "Repr-Digest": {"description": "The same, as RFC 9530 writes it.", "schema": _TEXT},
    },
}


class ActiveMapBody(JsonBody):
    """Which version to activate, and which one must be active for that."""

    version: Annotated[int, Field(strict=True, ge=1, le=GREATEST_ID)]
    expected: Annotated[
        Annotated[int, Field(strict=True, ge=1, le=GREATEST_ID)] | None,
        Field(description="The version thought active, null: none; another is a 409. Absent: whichever it is."),
    ] = None


class MapAnswer(Answer):
    """One version in a domain's history."""

    version: int
    state: Literal["building", "sealed", "active", "retired"]
    created_at: str
    activated_at: Annotated[str | None, Field(description="When it last began to serve.")]
    retired_at: Annotated[str | None, Field(description="When it last ceased to serve.")]
    removed_at: Annotated[str | None, Field(description="When its file was removed; it cannot serve again.")]
    sha256: str | None
    file_bytes: int | None
    config: dict[str, Any]
    metrics: dict[str, Any]


class MapList(Answer):
    """The versions of a domain's map, newest first."""

    maps: list[MapAnswer]
    next: Next


@router.get("/{domain}/maps", responses=problems(404, 422))
def list_maps(domain: DomainName, services: RunningServices, page: Annotated[Page, page_of("maps")]) -> MapList:
    """The history of a domain's map, newest version first."""
    map_page = services.catalog.newest_maps(domain, page.number, page.limit)
    return MapList.model_validate({"maps": map_page.records, "next": page.next(map_page.last_key)})


@router.put(
    "/{domain}/active-map", responses=problems(404, 409, 410, 413, 415, 422), openapi_extra=declare_json(ActiveMapBody)
)
async def put_active_map(domain: DomainName, request: Request, services: RunningServices) -> MapAnswer:
    """Activate a version, forward or back, if the active one is still `expected`.

    The version's file is checked first, so that a damaged one never takes over. One whose file was removed is a 410.
    """
    body = await read_json(request, ActiveMapBody)
    expected = body.expected if "expected" in body.model_fields_set else ANY

    def switch() -> MapAnswer:
        if services.catalog.map_anywhere(domain, body.version).state is MapState.BUILDING:
            raise ConflictError(f"map {body.version} of domain {domain} is still being built")
        load_snapshot(services.catalog, domain, body.version)
        record = services.catalog.activate(domain, body.version, expected)
        services.maps.refresh(domain)
        services.retention.prune(domain)
        return MapAnswer.model_validate(record)

    return await run_sync(switch)  # what switches it logs it too, whoever asked


@router.delete("/{domain}/maps/{version}", status_code=204, responses=problems(404, 409, 410, 422))
def delete_map(domain: DomainName, version: MapVersion, services: RunningServices) -> None:
    """Remove the file of a version; it stays in the history, retired.

    The version that serves, one being built and one that a session lives on are a 409.
    """
    services.retention.remove(domain, version)
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
def get_map_file(domain: DomainName, version: MapVersion, request: Request, services: RunningServices) -> Response:
    """A sealed version whole, as one SQLite file that another server can import.

    It is read against its digest before the first byte is sent; `Repr-Digest` and `ETag` tell that digest.
    """
    sha256 = services.catalog.sealed_digest(domain, version)
    try:
        path = services.catalog.map_file(domain, version)
        status = path.stat()
    except (DamagedMapError, FileNotFoundError) as error:
        raise unreadable_error(services.catalog, domain, version) from error
    etag = f'"sha256:{sha256}"'
    if has_tag(request.headers.get("if-none-match"), etag):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers={**REVALIDATE, "ETag": etag})
    request.scope["headers"] = one_range(request.scope["headers"], status.st_size)
    repr_digest = base64.b64encode(bytes.fromhex(sha256)).decode()
    headers = {**REVALIDATE, "ETag": etag, "Repr-Digest": f"sha-256=:{repr_digest}:"}
    filename = f"{domain}-{version:06d}.sqlite"
    return FileResponse(path, headers=headers, media_type=MEDIA_TYPE, filename=filename, stat_result=status)


def one_range(headers: Headers, n_bytes: int) -> Headers:
    """A request's headers, without a Range that is malformed or names several: that is answered with the whole file.

    Raises HTTPException, 416, for a range that begins behind the end.
    """
    range_header = next((value.decode("latin-1").replace(" ", "") for name, value in headers if name == b"range"), "")
    match = _RANGE.fullmatch(range_header)
    first, last = match.groups() if match else ("", "")
    if (first and last and int(first) > int(last)) or not (first or last):
        return [(name, value) for name, value in headers if name != b"range"]
    if int(first) >= n_bytes if first else int(last) == 0:
        raise HTTPException(
            HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE,
            f"the file has {n_bytes} bytes",
            {"Content-Range": f"bytes */{n_bytes}"},
        )
    return headers
