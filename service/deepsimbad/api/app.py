"""The application: its parts, in the order in which they start and stop."""

import asyncio
import logging
import re
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, ExitStack, asynccontextmanager

from anyio.to_thread import run_sync
from fastapi import FastAPI
from starlette.middleware.cors import CORSMiddleware
from starlette.routing import Route
from starlette.types import Scope

from deepsimbad.api.admission import AdmissionLimits, AdmissionMiddleware
from deepsimbad.api.auth import AuthMiddleware, KeyRing
from deepsimbad.api.decoders import Decoders
from deepsimbad.api.dependencies import Services
from deepsimbad.api.envelope import EnvelopeMiddleware
from deepsimbad.api.limits import BodyLimitMiddleware
from deepsimbad.api.metrics import Metrics
from deepsimbad.api.openapi import install_openapi
from deepsimbad.api.problems import install_problem_handlers
from deepsimbad.api.rate_limit import RateLimit
from deepsimbad.api.readiness import ReadinessCheck
from deepsimbad.api.routes import (
    admin_domains,
    admin_experience,
    admin_frames,
    admin_jobs,
    admin_maps,
    admin_remaps,
    admin_sessions,
    admin_traverses,
    docs,
    domains,
    health,
    localizations,
    sessions,
    truths,
)
from deepsimbad.api.state_metrics import StateCollector, WatchedState
from deepsimbad.engine.encoders import EvaluatorPool
from deepsimbad.engine.maps import Maps, Retention
from deepsimbad.engine.sessions import Sessions
from deepsimbad.engine.traverses import OpenTraverses
from deepsimbad.engine.truths import Truths
from deepsimbad.engine.warm_up import warm_up
from deepsimbad.engine.worker import InferenceWorker, Priority
from deepsimbad.errors import DeepSimbadError, UnavailableError
from deepsimbad.evaluators.registry import fallback
from deepsimbad.jobs.runner import InAnotherProcess, JobRunner, RunJob, job_threads
from deepsimbad.release import release
from deepsimbad.settings import Settings
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.data_dir import ServiceLock
from deepsimbad.store.sessions import SessionStore

log = logging.getLogger(__name__)

_ROUTERS = (
    health,
    docs,
    domains,
    localizations,
    sessions,
    truths,
    admin_domains,
    admin_traverses,
    admin_frames,
    admin_remaps,
    admin_experience,
    admin_jobs,
    admin_maps,
    admin_sessions,
)
_BATCH_PATH = re.compile(r"/v1/admin/domains/[^/]+/traverses/[^/]+/frames")
_CORS_SENT = (
    *("Authorization", "X-API-Key", "Content-Type", "X-Request-ID", "Idempotency-Key"),
    *("Range", "If-Range", "If-None-Match"),
)
_CORS_SHOWN = (
    *("X-Request-ID", "Retry-After", "Location", "WWW-Authenticate"),
    *("ETag", "Repr-Digest", "Content-Range", "Content-Disposition"),
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
    for module in _ROUTERS:
        app.include_router(module.router)
    routes = [route for module in _ROUTERS for route in module.router.routes if isinstance(route, Route)]
    install_problem_handlers(app, routes)
    install_openapi(app)
    app.state.metrics = metrics  # the server counts too
    app.add_middleware(BodyLimitMiddleware, limit_of=_body_limits(settings))

    def queue_is_full(priority: Priority) -> bool:
        services: Services = app.state.services
        return services.worker.is_full(priority)

    app.add_middleware(
        AdmissionMiddleware,
        limits=AdmissionLimits(
            settings.max_requests, settings.max_uploads, settings.max_event_streams, settings.max_body_memory_bytes
        ),
        queue_is_full=queue_is_full,
    )
    rate_limit = RateLimit(settings.rate_limit_per_s, settings.rate_limit_burst)
    app.add_middleware(AuthMiddleware, keys=keys, rate_limit=rate_limit)
    if settings.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=("GET", "POST", "PUT", "DELETE"),
            allow_headers=_CORS_SENT,
            expose_headers=_CORS_SHOWN,
        )
    app.add_middleware(EnvelopeMiddleware, metrics=metrics)
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
            await _end_of_no_domain(services)
            await run_sync(services.retention.prune)
        except DeepSimbadError:
            log.exception("expired sessions could not be ended")


async def _end_of_no_domain(services: Services) -> None:
    """A command beside the service may have deleted a domain."""
    domains = {record.name for record in await run_sync(services.catalog.domains)}
    await services.sessions.end_those(lambda session: session.domain not in domains)


def _start(settings: Settings, metrics: Metrics, keys: KeyRing, run_job: RunJob, parts: ExitStack) -> Services:
    """Open everything; `parts` closes it again, last opened first."""
    parts.enter_context(ServiceLock.take(settings.data_dir, f"{settings.host}:{settings.port}"))
    catalog = parts.enter_context(Catalog.open(settings.data_dir))
    keys.load(catalog.keys)
    settings.check_exposure(keys.n_created)
    try:
        for line in catalog.discard_unfinished():
            log.warning("discarded at start", extra={"what": line})
    except UnavailableError as error:
        if error.hints.get("reason") != "disk_full":
            raise
        log.warning("nothing was discarded at start", extra={"why": error.message})  # who only reads is answered
    if (told := fallback()) is not None:
        log.warning("the default network is not installed", extra={"why": told})
    evaluators = EvaluatorPool(settings.compute())
    evaluators.load_all({record.name: record.evaluator for record in catalog.domains()})
    maps = Maps(catalog)
    damaged = maps.load_all()
    worker = InferenceWorker(max_waiting=settings.max_queue, longest_wait_s=settings.encode_wait_ms / 1000)
    parts.callback(worker.close)
    worker.submit(warm_up).result()
    store = parts.enter_context(SessionStore.open(settings.data_dir, metrics.committed))
    live = Sessions(
        store,
        maps,
        evaluators,
        worker,
        ttl_s=settings.session_ttl_s,
        max_sessions=settings.max_sessions,
        snapshot_every=settings.snapshot_every,
        keep_ended_s=settings.keep_ended_sessions_s,
    )
    parts.callback(live.close)
    open_traverses = OpenTraverses(settings.data_dir)
    parts.callback(open_traverses.close)

    retention = Retention(catalog, store, maps, settings.keep_maps)
    retention.prune()

    def switched(domain: str) -> None:
        try:
            maps.refresh(domain)
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
    state = WatchedState(
        version=release(),
        data_dir=settings.data_dir,
        catalog=catalog,
        maps=maps,
        faults=readiness.faults,
        queue_length=lambda: worker.n_waiting,
        n_sessions=lambda: live.n_living,
    )
    metrics.watch(StateCollector(state))
    exposure = {"host": settings.host, "port": settings.port, "n_keys": keys.n_usable}
    if keys.n_created == 0:
        log.warning("runs open: no key was ever created, so whoever reaches this address may do all", extra=exposure)
    else:
        log.info("asks for keys", extra=exposure)
    log.info(
        "opened",
        extra={
            "n_domains": len(catalog.domains()),
            "n_maps": maps.n_loaded,
            "n_sessions": live.n_living,
            "damaged": list(damaged),
        },
    )
    return Services(
        settings=settings,
        metrics=metrics,
        catalog=catalog,
        maps=maps,
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
        readiness=readiness,
    )


def _body_limits(settings: Settings) -> Callable[[Scope], int]:
    """The most bytes a request may carry: a batch, an image, or JSON."""

    def limit(scope: Scope) -> int:
        if scope["method"] == "POST" and _BATCH_PATH.fullmatch(scope["path"]):
            return settings.max_batch_bytes
        content_type = next((value for name, value in scope["headers"] if name == b"content-type"), b"")
        return settings.max_image_bytes if content_type.lower().startswith(b"image/") else settings.max_json_bytes

    return limit
