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
    """The evaluators are loaded, the catalog and the sessions can be read; 503 until then and while shutting down."""
    if running.stopping.is_set():
        raise UnavailableError("the service is shutting down")
    await run_sync(running.catalog.domains)
    await run_sync(running.session_store.check)
    return Readiness(status="ready", damaged_maps=list(running.damaged_at_start))


@router.get("/metrics", response_class=MetricsResponse, responses=problems())
async def metrics(running: Running) -> Response:
    """What Prometheus scrapes."""
    return Response(running.metrics.render(), media_type=running.metrics.content_type)
