"""The application: its parts, in the order in which they start and stop, and whether it is ready."""

import asyncio
import logging
import math
import os
import shutil
import threading
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from concurrent.futures import TimeoutError as TookTooLong
from contextlib import ExitStack, asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from anyio.to_thread import run_sync
from fastapi import APIRouter, FastAPI, Response
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from pydantic import Field
from starlette.responses import PlainTextResponse

from deepsimbad import release
from deepsimbad.api import (
    coverage,
    domains,
    events,
    frames,
    jobs,
    localizations,
    maps,
    pages,
    sessions,
    traverses,
    whereabouts,
)
from deepsimbad.api.door import SHUTTING_DOWN, Door
from deepsimbad.api.keys import KeyRing
from deepsimbad.api.metrics import Metrics, StateCollector
from deepsimbad.api.problems import install_openapi, install_problem_handlers, problems
from deepsimbad.api.requests import Answer, RunningServices, Services, Slots, StrictRoute
from deepsimbad.engine.atlas import Atlas, Owners
from deepsimbad.engine.decoders import Decoders
from deepsimbad.engine.events import SessionEvents
from deepsimbad.engine.localizer import warm_up
from deepsimbad.engine.maps import Maps, Retention
from deepsimbad.engine.pictures import Pictures
from deepsimbad.engine.sessions import Sessions
from deepsimbad.engine.traverses import OpenTraverses, SpoolRoom
from deepsimbad.engine.truths import Truths
from deepsimbad.engine.worker import EvaluatorPool, InferenceWorker
from deepsimbad.errors import DeepSimbadError, NoActiveMapError, NotFoundError, UnavailableError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.registry import EvaluatorConfig, fallback, make_evaluator
from deepsimbad.jobs.runner import InAnotherProcess, JobRunner, RunJob, job_threads
from deepsimbad.settings import MEBIBYTE, Settings
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.durable import service_lock
from deepsimbad.store.records import JobRecord, KeyRecord, ListPage
from deepsimbad.store.sessions import SessionRecord, SessionStore
from deepsimbad.store.shared_catalog import open_catalog

router = APIRouter(tags=["health"], route_class=StrictRoute)
log = logging.getLogger(__name__)

LEAST_FREE_BYTES = 16 * MEBIBYTE  # with less, the next map or the write-ahead log may not fit
TRUSTED_S = 1.0  # anybody may ask whether it is ready, and every look writes to the disk
_WRITE_TIMEOUT_S = 2.0
_LOADING_S = 1.0  # that a start spends on maps; what is left is loaded when it is asked for
_FOLLOW_S = 1.0  # between two looks into a map store's log, of one small request each
_ROUTERS = (  # routes are tried in this order: those that robots ask come first
    sessions.router,
    localizations.router,
    router,
    domains.router,
    domains.admin,
    traverses.router,
    frames.router,
    jobs.making,
    jobs.router,
    maps.router,
    sessions.listing,
    whereabouts.router,
    events.router,
    coverage.router,
    pages.router,
)
_DESCRIPTION = (
    "Where on a prelearned route a robot is, from what it sees; every error is an RFC 9457 problem document. "
    "Ids count from 0, ranks from 1, units stand in the names."
)


@dataclass(frozen=True)
class Substitutes:
    """Parts that a service which is one of several has from others, in the place of its own."""

    keys: Callable[[], Sequence[KeyRecord]] | None = None  # reads the keys; None: the catalog does
    # Opens the sessions' file of a data directory; the function it takes is called with every transaction's writes
    sessions: Callable[[Path, Callable[[int], None]], SessionStore] = SessionStore.open
    owners: Owners | None = None  # of domains, where one view is asked of many
    administrator: int | None = None  # number of this one among those that administer; None: the data directory's
    # Reads a page of the jobs of this catalog and of others, as `Catalog.newest_jobs` does of one
    newest_jobs: Callable[[Catalog, str | None, int | None, int], ListPage[JobRecord, int]] = Catalog.newest_jobs
    make_evaluator: Callable[[EvaluatorConfig, Compute | None], Evaluator] = make_evaluator


def create_app(settings: Settings, run_job: RunJob | None = None, substitutes: Substitutes | None = None) -> FastAPI:
    """The service as an ASGI application; its files are opened when it starts.

    Args:
        settings: All that it is configured by; it reads no environment.
        run_job: Does jobs; None: each in a process of its own (decision 0011).
        substitutes: Parts that others have; None: all parts are its own.
    """
    if run_job is None:
        n_threads = job_threads(settings.job_threads)
        compute = replace(settings.compute(), n_threads=n_threads)
        run_job = InAnotherProcess(settings.data_dir, n_threads, settings.job_priority, compute=compute)
    metrics = Metrics()
    keys = KeyRing()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        with ExitStack() as parts:
            try:
                services = await run_sync(_start, settings, metrics, keys, run_job, substitutes or Substitutes(), parts)
            except DeepSimbadError as error:
                app.state.startup_error = error  # the server only reports that there was one
                raise
            app.state.services = services
            tasks = [asyncio.create_task(task) for task in (keys.follow(), _sweep(services), _keep_following(services))]
            yield
            for task in tasks:
                task.cancel()
            services.stopping.set()
            # Jobs and the worker are waited for, which must not hold up the loop that their answers go through.
            await run_sync(parts.close)

    app = FastAPI(
        title="Deep SIMBAD",
        version=release(),
        description=_DESCRIPTION,
        lifespan=lifespan,
        routes=[route for part in _ROUTERS for route in part.routes],
        redirect_slashes=False,
        openapi_url=None,  # `install_openapi` answers it
        docs_url=None,  # the framework's page loads its script from another host
        redoc_url=None,
    )
    app.router.route_class = StrictRoute
    install_problem_handlers(app)
    install_openapi(app, settings.root_path)
    app.add_middleware(Door, settings=settings, keys=keys, metrics=metrics)
    return app


async def follow(services: Services) -> None:
    """Take over what other machines have published; raises as `SharedCatalog.follow`."""

    def take_over(domain: str) -> bool:
        """Serve what was published for a domain; whether it still exists."""
        try:
            services.catalog.domain(domain)
            if services.maps.serves(domain):  # else its map is fetched when it is asked for
                services.maps.refresh(domain)
            services.retention.prune(domain)
        except NotFoundError:
            services.maps.forget(domain)
            services.metrics.forget_domain(domain)
            return False
        except NoActiveMapError:  # it was made anew
            pass
        except DeepSimbadError:
            log.exception("a new map cannot be served", extra={"domain": domain})
        return True

    def catch_up() -> set[str]:
        """Take over all domains that changed; the names of those that were deleted."""
        with services.catalog.follow_lock:  # who asks meanwhile waits until what has been read is served
            return {domain for domain in services.catalog.follow() if not take_over(domain)}

    deleted_domains = await run_sync(catch_up)
    await services.sessions.end_those(lambda session: session.domain in deleted_domains)


async def _keep_following(services: Services) -> None:
    """Follow the map store again and again. A failure is logged once; what is in memory goes on to serve."""
    is_failing = False
    while services.catalog.is_shared:
        await asyncio.sleep(_FOLLOW_S)
        try:
            await follow(services)
        except Exception as error:  # whatever it is, the next try may succeed
            if not is_failing:
                log.warning("the map store cannot be followed", exc_info=error)
            is_failing = True
        else:
            if is_failing:
                log.info("the map store is followed again")
            is_failing = False
        services.metrics.map_store_failing(is_failing)


async def _sweep(services: Services) -> None:
    """End sessions as they expire or lose their key or domain, so that their memory is free though nobody asks."""
    while True:
        await asyncio.sleep(services.settings.session_sweep_s)
        try:
            await services.sessions.sweep()
            # A command beside the service may have deleted domains.
            domain_names = await run_sync(services.catalog.domain_names)

            def is_over(session: SessionRecord, domain_names: set[str] = domain_names) -> bool:
                has_no_key = session.key_id is not None and not services.keys.still_opens(session.key_id)
                return has_no_key or session.domain not in domain_names

            await services.sessions.end_those(is_over)
            await run_sync(services.retention.prune)
        except Exception:  # as above
            log.exception("expired sessions could not be ended")


def _current_catalog(settings: Settings, administrator: int | None) -> Catalog:
    """The catalog; one that is shared knows what others published, as far as the store can be reached."""
    catalog = open_catalog(settings.data_dir, settings.map_store, settings.map_cache_disk_bytes, administrator)
    try:
        catalog.catch_up()
    except UnavailableError as error:  # what is here can be served
        log.warning("the map store cannot be followed", extra={"why": error.message})
    except BaseException:
        catalog.close()
        raise
    return catalog


def _start(
    settings: Settings, metrics: Metrics, keys: KeyRing, run_job: RunJob, substitutes: Substitutes, parts: ExitStack
) -> Services:
    """Open everything; `parts` closes it again, last opened first."""
    parts.enter_context(service_lock(settings.data_dir, f"{settings.host}:{settings.port}"))
    catalog = parts.enter_context(_current_catalog(settings, substitutes.administrator))
    keys.load(substitutes.keys or catalog.keys)
    settings.check_exposure(len(keys.by_id))
    try:
        for line in catalog.discard_unfinished():
            log.warning("discarded at start", extra={"what": line})
    except UnavailableError as error:
        if error.hints.get("reason") != "disk_full":
            raise
        log.warning("nothing was discarded at start", extra={"why": error.message})  # who only reads is answered
    if (missing_package := fallback()) is not None:
        log.warning("the default network is not installed", extra={"why": missing_package})
    evaluators = EvaluatorPool(settings.compute(), substitutes.make_evaluator)
    evaluators.load_all(catalog.evaluators())
    maps_ = Maps(catalog, cache_bytes=settings.map_cache_bytes)
    damaged_domains = maps_.load_all(_LOADING_S)
    worker = InferenceWorker(max_waiting=settings.max_queue, longest_wait_s=settings.encode_wait_ms / 1000)
    parts.callback(worker.close)
    worker.submit(warm_up).result()
    store = parts.enter_context(substitutes.sessions(settings.data_dir, metrics.record_commit))
    live_sessions = Sessions(
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
    parts.callback(live_sessions.close)
    catalog.is_in_use = lambda domain, version, digest: (
        maps_.holds(domain, version, digest) or (domain, version) in SessionStore.pins(store)  # of those read here
    )
    open_traverses = OpenTraverses(settings.data_dir)
    parts.callback(open_traverses.close)

    retention = Retention(catalog, store, maps_, settings.keep_maps)
    retention.prune()

    def serve_new_map(domain: str) -> None:
        try:
            maps_.refresh(domain)
            retention.prune(domain)
        except DeepSimbadError:
            log.exception("a new map cannot be served", extra={"domain": domain})

    runner = JobRunner(catalog, run_job, serve_new_map, settings.max_jobs, metrics.record_job)
    parts.callback(runner.close)
    threads = {
        "the inference worker": lambda: worker.is_alive,
        "the thread that writes sessions": lambda: store.is_committing,
        "the thread that runs jobs": lambda: runner.is_alive,
    }
    readiness = ReadinessCheck(catalog, store, threads)
    metrics.watch(StateCollector(catalog, maps_, readiness.faults, worker, live_sessions, keys))
    exposure = {"host": settings.host, "port": settings.port, "n_keys": sum(map(keys.still_opens, keys.by_id))}
    if not keys.by_id:
        log.warning("runs open: no key was ever created, so whoever reaches this address may do all", extra=exposure)
    else:
        log.info("asks for keys", extra=exposure)
    counts = {"n_domains": catalog.n_domains, "n_maps": maps_.n_loaded, "n_sessions": live_sessions.n_living}
    log.info("opened", extra={**counts, "damaged": damaged_domains})
    return Services(
        settings=settings,
        metrics=metrics,
        catalog=catalog,
        maps=maps_,
        atlas=Atlas(maps_),
        evaluators=evaluators,
        open_traverses=open_traverses,
        spools=SpoolRoom(settings.data_dir, settings.max_spool_bytes),
        sessions=live_sessions,
        session_store=store,
        retention=retention,
        truths=Truths(store, worker, live_sessions),
        pictures=Pictures(settings.data_dir, settings.max_pixels),
        session_events=SessionEvents(store, worker, live_sessions, settings.event_poll_s),
        worker=worker,
        decoders=Decoders(settings.max_pixels),
        runner=runner,
        keys=keys,
        faults=readiness.faults,
        uploads=Slots(settings.max_uploads, "batches of frames are on their way", "max_uploads"),
        event_streams=Slots(settings.max_event_streams, "event streams are open", "max_event_streams"),
        owners=substitutes.owners,
        newest_jobs=partial(substitutes.newest_jobs, catalog),
    )


# Whether it is ready


class Health(Answer):
    """The process lives."""

    status: Literal["alive"]


class Readiness(Answer):
    """The service answers queries."""

    status: Literal["ready"]
    damaged_maps: Annotated[list[str], Field(description="Domains whose active map cannot be loaded.")]


@dataclass(eq=False)
class ReadinessCheck:
    """Finds what keeps the service from working by trying it, once a second at most; usable from any thread."""

    catalog: Catalog
    sessions: SessionStore
    threads: Mapping[str, Callable[[], bool]]  # what must be alive, by a name that a person understands
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _looked_at: float = -math.inf
    _faults: tuple[str, ...] = ()

    def faults(self) -> tuple[str, ...]:
        """One sentence for each fault; empty where the service is ready. May wait for the disk."""
        with self._lock:
            if time.monotonic() - self._looked_at > TRUSTED_S:
                self._faults = tuple(dict.fromkeys(self._look()))
                self._looked_at = time.monotonic()
            return self._faults

    def _look(self) -> list[str]:
        faults = [f"{name} has ended: restart the service" for name, is_alive in self.threads.items() if not is_alive()]

        def write() -> None:
            self.sessions.try_writing().result(_WRITE_TIMEOUT_S)

        for look in (self.catalog.check, self.sessions.check, write):
            try:
                look()
            except DeepSimbadError as error:
                faults.append(error.message)
            except TookTooLong:
                faults.append(f"sessions.sqlite: a write takes longer than {_WRITE_TIMEOUT_S:g} s")
        return [*faults, *_disk_faults(self.catalog.data_dir)]


def _disk_faults(data_dir: Path) -> list[str]:
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


@router.get("/healthz", responses=problems(403))
async def healthz() -> Health:
    """The process lives; a supervisor restarts it where this stays unanswered."""
    return Health(status="alive")


@router.get("/readyz", responses=problems(403))
async def readyz(services: RunningServices) -> Readiness:
    """What serves is there: threads that work, a catalog and sessions that can be read and written, room on the disk.

    Else 503, and `faults` says what is wrong; while shutting down too. A damaged map keeps its own domain alone from
    being served, and is told here.
    """
    if services.stopping.is_set():
        raise UnavailableError(SHUTTING_DOWN.message, faults=[SHUTTING_DOWN.message])
    faults = await run_sync(services.faults, limiter=services.health)
    if faults:
        raise UnavailableError("; ".join(faults), faults=list(faults))
    damaged_versions = await run_sync(services.maps.damaged, limiter=services.health)
    return Readiness(status="ready", damaged_maps=list(damaged_versions))


@router.get("/metrics", response_class=PlainTextResponse, responses=problems(403))
async def metrics(services: RunningServices) -> Response:
    """What Prometheus scrapes."""
    content = await run_sync(services.metrics.render, limiter=services.health)
    return Response(content, media_type=CONTENT_TYPE_LATEST)
