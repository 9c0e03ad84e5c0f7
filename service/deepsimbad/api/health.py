"""Whether the service lives, whether it answers, what it counts, and the page that shows its calls."""

import os
import shutil
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import TimeoutError as TookTooLong
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

from anyio.to_thread import run_sync
from fastapi import APIRouter, Response
from fastapi import Path as PathParameter
from pydantic import Field
from starlette.responses import FileResponse

from deepsimbad.api.openapi import problems
from deepsimbad.api.requests import Answer, Running
from deepsimbad.errors import DeepSimbadError, UnavailableError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.sessions import SessionStore

router = APIRouter(tags=["health"])

MEBIBYTE = 1024 * 1024
LEAST_FREE_BYTES = 16 * MEBIBYTE  # with less, the next map or the write-ahead log may not fit
TRUSTED_S = 1.0  # anybody may ask, and every look writes to the disk
_WRITE_TIMEOUT_S = 2.0
_STOPPING = "the service is shutting down"


class Health(Answer):
    """The process lives."""

    status: Literal["alive"]


class Readiness(Answer):
    """The service answers queries."""

    status: Literal["ready"]
    damaged_maps: Annotated[
        list[str], Field(description="Domains whose active map cannot be loaded; all others are served.")
    ]


class MetricsResponse(Response):
    """Prometheus' text format."""

    media_type = "text/plain"


class ReadinessCheck:
    """What keeps the service from doing what it is there for, told by trying, at most once a second; from any thread.

    Args:
        catalog: Read.
        sessions: Read and written.
        threads: What must be alive, by a name that a person understands.
        monotonic: Seconds that never go back.
    """

    def __init__(
        self,
        catalog: Catalog,
        sessions: SessionStore,
        threads: Sequence[tuple[str, Callable[[], bool]]],
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._catalog = catalog
        self._sessions = sessions
        self._threads = threads
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._looked_at: float | None = None
        self._faults: tuple[str, ...] = ()

    def faults(self) -> tuple[str, ...]:
        """One sentence for everything that is wrong; none where the service is ready. May wait for the disk."""
        with self._lock:
            now = self._monotonic()
            if self._looked_at is None or now - self._looked_at > TRUSTED_S:
                self._faults = tuple(dict.fromkeys(self._look()))
                self._looked_at = self._monotonic()
            return self._faults

    def _look(self) -> list[str]:
        faults = [f"{name} has ended: restart the service" for name, is_alive in self._threads if not is_alive()]
        for look in (self._catalog.check, self._sessions.check, self._write):
            try:
                look()
            except DeepSimbadError as error:
                faults.append(error.message)
            except TookTooLong:
                faults.append(f"sessions.sqlite: a write takes longer than {_WRITE_TIMEOUT_S:g} s")
        return [*faults, *disk_faults(self._catalog.data_dir)]

    def _write(self) -> None:
        self._sessions.try_writing().result(_WRITE_TIMEOUT_S)


def disk_faults(data_dir: Path) -> list[str]:
    """What is wrong with the file system of the data directory."""
    try:
        n_free = shutil.disk_usage(data_dir).free
        is_read_only = bool(os.statvfs(data_dir).f_flag & os.ST_RDONLY)
    except OSError as error:
        return [f"the data directory cannot be looked at: {error.strerror}"]
    faults = ["the data directory lies on a read-only file system"] if is_read_only else []
    if n_free < LEAST_FREE_BYTES:
        n_free_mib, least_mib = n_free / MEBIBYTE, LEAST_FREE_BYTES // MEBIBYTE
        faults.append(f"{n_free_mib:.0f} MiB are free in the data directory, fewer than {least_mib}")
    return faults


@router.head("/healthz", include_in_schema=False)
@router.get("/healthz", responses=problems())
async def healthz() -> Health:
    """The process lives; a supervisor restarts it where this stays unanswered."""
    return Health(status="alive")


@router.head("/readyz", include_in_schema=False)
@router.get("/readyz", responses=problems())
async def readyz(running: Running) -> Readiness:
    """What serves is there: threads that work, a catalog and sessions that can be read and written, room on the disk.

    Else 503, and `faults` says what is wrong; while shutting down too. A damaged map keeps its own domain alone from
    being served, and is told here.
    """
    if running.stopping.is_set():
        raise UnavailableError(_STOPPING, faults=[_STOPPING])
    faults = await run_sync(running.faults, limiter=running.health)
    if faults:
        raise UnavailableError("; ".join(faults), faults=list(faults))
    damaged = await run_sync(running.maps.damaged, limiter=running.health)
    return Readiness(status="ready", damaged_maps=list(damaged))


@router.get("/metrics", response_class=MetricsResponse, responses=problems())
async def metrics(running: Running) -> Response:
    """What Prometheus scrapes."""
    content = await run_sync(running.metrics.render, limiter=running.health)
    return Response(content, media_type=running.metrics.content_type)


# The page that shows the OpenAPI document, and all it needs: a robot's network reaches no other host.

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Deep SIMBAD</title>
<link rel="stylesheet" href="docs/swagger-ui.css">
<link rel="icon" href="data:,">
</head>
<body>
<div id="page"></div>
<script src="docs/swagger-ui-bundle.js"></script>
<script src="docs/start.js"></script>
</body>
</html>
"""
# The validator is another host's; a key that was typed in is forgotten with the page.
_START = """SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#page",
  deepLinking: true,
  persistAuthorization: false,
  validatorUrl: null,
});
"""
# Styles stand in the page's elements, so they cannot be forbidden there; scripts come from here alone.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; font-src data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_KEPT = {"Cache-Control": "public, max-age=3600"}


@router.get("/docs", include_in_schema=False)
async def page() -> Response:
    """Every call, to read and to try."""
    return Response(_PAGE, media_type="text/html", headers={"Content-Security-Policy": _POLICY})


@router.get("/docs/start.js", include_in_schema=False)
async def start() -> Response:
    """What draws the page."""
    return Response(_START, media_type="text/javascript", headers=_KEPT)


@router.get("/docs/{asset}", include_in_schema=False)
async def asset(
    name: Annotated[Literal["swagger-ui-bundle.js", "swagger-ui.css"], PathParameter(alias="asset")],
) -> Response:
    """Swagger UI, from the package that brings it."""
    return FileResponse(Path(str(resources.files("fastapi_offline") / "static")) / name, headers=_KEPT)
