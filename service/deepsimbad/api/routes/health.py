"""Whether the service lives, whether it answers, and what it counts."""

from anyio.to_thread import run_sync
from fastapi import APIRouter, Response

from deepsimbad.api.dependencies import Running
from deepsimbad.api.openapi import problems
from deepsimbad.api.schemas import Health, Readiness
from deepsimbad.errors import UnavailableError

router = APIRouter(tags=["health"])


class MetricsResponse(Response):
    """Prometheus' text format."""

    media_type = "text/plain"


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
        raise UnavailableError("the service is shutting down", faults=["the service is shutting down"])
    faults = await run_sync(running.readiness.faults, limiter=running.health)
    if faults:
        raise UnavailableError("; ".join(faults), faults=list(faults))
    return Readiness(status="ready", damaged_maps=list(await run_sync(running.maps.damaged, limiter=running.health)))


@router.get("/metrics", response_class=MetricsResponse, responses=problems())
async def metrics(running: Running) -> Response:
    """What Prometheus scrapes."""
    return Response(
        await run_sync(running.metrics.render, limiter=running.health), media_type=running.metrics.content_type
    )
