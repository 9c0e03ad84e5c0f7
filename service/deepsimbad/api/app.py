"""The application: its parts, in the order in which they start and stop."""

import asyncio
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, ExitStack, asynccontextmanager

from anyio.to_thread import run_sync
from fastapi import FastAPI
from starlette.routing import Route

from deepsimbad.api import domains, health, jobs, localizations, maps, sessions, traverses
from deepsimbad.api.door import Door
from deepsimbad.api.health import ReadinessCheck
from deepsimbad.api.keys import KeyRing
from deepsimbad.api.metrics import Metrics, WatchedState
from deepsimbad.api.openapi import install_openapi
from deepsimbad.api.problems import install_problem_handlers
from deepsimbad.api.requests import Decoders, Services, Slots
from deepsimbad.engine.localizer import warm_up
from deepsimbad.engine.maps import Maps, Retention
from deepsimbad.engine.sessions import Sessions
from deepsimbad.engine.traverses import OpenTraverses
from deepsimbad.engine.truths import Truths
from deepsimbad.engine.worker import EvaluatorPool, InferenceWorker
from deepsimbad.errors import DeepSimbadError, UnavailableError
from deepsimbad.evaluators.registry import fallback
from deepsimbad.jobs.runner import InAnotherProcess, JobRunner, RunJob, job_threads
from deepsimbad.release import release
from deepsimbad.settings import Settings
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.durable import service_lock
from deepsimbad.store.sessions import SessionRecord, SessionStore

log = logging.getLogger(__name__)

_ROUTERS = (
    health.router,
    domains.router,
    localizations.router,
    sessions.router,
    domains.admin,
    traverses.router,
    jobs.making,
    jobs.router,
    maps.router,
    sessions.listing,
)
_DESCRIPTION = (
    "Where on a prelearned route a robot is, from what it sees; every error is an RFC 9457 problem document. "
    "Ids count from 0, ranks from 1, units stand in the names."
)


def create_app(settings: Settings, run_job: RunJob | None = None) -> FastAPI:
    """The service as an ASGI application; its files are opened when it starts.

    Args:
        settings: All it is told; it reads no environment.
        run_job: Does jobs; None: each in a process of its own (decision 0011).
    """
    n_threads = job_threads(settings.job_threads)
    run_job = run_job or InAnotherProcess(settings.data_dir, n_threads, settings.job_priority)
    metrics = Metrics()
    keys = KeyRing()
    app = FastAPI(
        title="Deep SIMBAD",
        version=release(),
        description=_DESCRIPTION,
        lifespan=_lifespan(settings, metrics, keys, run_job),
        redirect_slashes=False,
        openapi_url=None,  # `install_openapi` answers it
        docs_url=None,  # the framework's page loads its script from another host
        redoc_url=None,
    )
    for router in _ROUTERS:
        app.include_router(router)
    install_problem_handlers(app, [route for router in _ROUTERS for route in router.routes if isinstance(route, Route)])
    install_openapi(app)
    app.add_middleware(Door, settings=settings, keys=keys, metrics=metrics)
    return app


def _lifespan(
    settings: Settings, metrics: Metrics, keys: KeyRing, run_job: RunJob
) -> Callable[[FastAPI], AbstractAsyncContextManager[None]]:
    @asynccontextmanager
    async def run(app: FastAPI) -> AsyncIterator[None]:
        with ExitStack() as parts:
            try:
                services = await run_sync(_start, settings, metrics, keys, run_job, parts)
            except DeepSimbadError as error:
                app.state.startup_error = error  # the server only reports that there was one
                raise
            app.state.services = services
            sweeping = asyncio.create_task(_sweep(services, settings.session_sweep_s))
            following = asyncio.create_task(keys.follow())
            yield
            sweeping.cancel()
            following.cancel()
            services.stopping.set()
            # Jobs and the worker are waited for, which must not hold up the loop that their answers go through.
            await run_sync(parts.close)

    return run


async def _sweep(services: Services, every_s: float) -> None:
    """End sessions as they expire, so that their memory is free though nobody asks."""
    while True:
        await asyncio.sleep(every_s)
        try:
            await services.sessions.sweep()
            await _end_of_nobody(services)
            await run_sync(services.retention.prune)
        except DeepSimbadError:
            log.exception("expired sessions could not be ended")


async def _end_of_nobody(services: Services) -> None:
    """End the sessions whose key was revoked, or whose domain a command beside the service has deleted."""
    domains = {record.name for record in await run_sync(services.catalog.domains)}

    def is_over(session: SessionRecord) -> bool:
        has_no_key = session.key_id is not None and not services.keys.still_opens(session.key_id)
        return has_no_key or session.domain not in domains

    await services.sessions.end_those(is_over)


def _start(settings: Settings, metrics: Metrics, keys: KeyRing, run_job: RunJob, parts: ExitStack) -> Services:
    """Open everything; `parts` closes it again, last opened first."""
    parts.enter_context(service_lock(settings.data_dir, f"{settings.host}:{settings.port}"))
    catalog = parts.enter_context(Catalog.open(settings.data_dir))
    keys.load(catalog.keys)
    settings.check_exposure(len(keys.by_id))
    try:
        for line in catalog.discard_unfinished():
            log.warning("discarded at start", extra={"what": line})
    except UnavailableError as error:
        if error.hints.get("reason") != "disk_full":
            raise
        log.warning("nothing was discarded at start", extra={"why": error.message})  # who only reads is answered
    if (missing := fallback()) is not None:
        log.warning("the default network is not installed", extra={"why": missing})
    evaluators = EvaluatorPool(settings.compute())
    evaluators.load_all({record.name: record.evaluator for record in catalog.domains()})
    maps_ = Maps(catalog)
    damaged = maps_.load_all()
    worker = InferenceWorker(max_waiting=settings.max_queue, longest_wait_s=settings.encode_wait_ms / 1000)
    parts.callback(worker.close)
    worker.submit(warm_up).result()
    store = parts.enter_context(SessionStore.open(settings.data_dir, metrics.committed))
    live = Sessions(
        store,
        maps_,
        evaluators,
        worker,
        ttl_s=settings.session_ttl_s,
        max_sessions=settings.max_sessions,
        max_sessions_per_key=settings.max_sessions_per_key,
        snapshot_every=settings.snapshot_every,
        keep_ended_s=settings.keep_ended_sessions_s,
    )
    parts.callback(live.close)
    open_traverses = OpenTraverses(settings.data_dir)
    parts.callback(open_traverses.close)

    retention = Retention(catalog, store, maps_, settings.keep_maps)
    retention.prune()

    def switched(domain: str) -> None:
        try:
            maps_.refresh(domain)
            retention.prune(domain)
        except DeepSimbadError:
            log.exception("a new map cannot be served", extra={"domain": domain})

    runner = JobRunner(catalog, run_job, switched, settings.max_jobs, metrics.job_ended)
    parts.callback(runner.close)
    readiness = ReadinessCheck(
        catalog,
        store,
        [
            ("the inference worker", lambda: worker.is_alive),
            ("the thread that writes sessions", lambda: store.is_committing),
            ("the thread that runs jobs", lambda: runner.is_alive),
        ],
    )
    metrics.watch(
        WatchedState(
            data_dir=settings.data_dir,
            catalog=catalog,
            maps=maps_,
            faults=readiness.faults,
            queue_length=lambda: worker.n_waiting,
            n_sessions=lambda: live.n_living,
        )
    )
    exposure = {"host": settings.host, "port": settings.port, "n_keys": keys.n_usable}
    if not keys.by_id:
        log.warning("runs open: no key was ever created, so whoever reaches this address may do all", extra=exposure)
    else:
        log.info("asks for keys", extra=exposure)
    counts = {"n_domains": len(catalog.domains()), "n_maps": maps_.n_loaded, "n_sessions": live.n_living}
    log.info("opened", extra={**counts, "damaged": damaged})
    return Services(
        settings=settings,
        metrics=metrics,
        catalog=catalog,
        maps=maps_,
        evaluators=evaluators,
        open_traverses=open_traverses,
        sessions=live,
        session_store=store,
        retention=retention,
        truths=Truths(store, worker, live),
        worker=worker,
        decoders=Decoders(settings.max_pixels),
        runner=runner,
        keys=keys,
        faults=readiness.faults,
        uploads=Slots(settings.max_uploads, "batches of frames are on their way", "max_uploads"),
        event_streams=Slots(settings.max_event_streams, "event streams are open", "max_event_streams"),
    )
