"""One service of the fleet: the whole application in a process of Ray Serve's, asked by ASGI in place of a socket."""

import asyncio
import fcntl
import os
import shutil
import tempfile
from collections import defaultdict
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias, cast

import anyio
from ray import serve
from ray.exceptions import RayError
from ray.serve.exceptions import RayServeException
from ray.serve.handle import DeploymentHandle, DeploymentResponse
from starlette.types import Message, Scope

from deepsimbad.api.app import Substitutes, create_app, follow
from deepsimbad.api.localizations import render_localization
from deepsimbad.api.requests import Services
from deepsimbad.api.server import configure_logging
from deepsimbad.core.map import Map
from deepsimbad.engine.atlas import MapHead, Part
from deepsimbad.engine.distant import by_encoder
from deepsimbad.engine.localizer import Localization, View
from deepsimbad.engine.maps import MappedDomain
from deepsimbad.engine.worker import Stopwatch
from deepsimbad.errors import DeepSimbadError, NotLoadedError, UnavailableError, UnknownDomainError, UnknownJobError
from deepsimbad.fleet.backend import AWAY_S, BRIEFLY_S, Backend
from deepsimbad.fleet.encoder import AskedEncoder, Encoder
from deepsimbad.fleet.owners import AskedOwners
from deepsimbad.fleet.placement import session_owners
from deepsimbad.jobs.runner import RunJob
from deepsimbad.settings import Settings
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.durable import lock_folder
from deepsimbad.store.objects import Objects
from deepsimbad.store.records import JobRecord, KeyRecord, ListPage
from deepsimbad.store.sessions import ListedSession, SessionRecord
from deepsimbad.store.shared_catalog import SharedCatalog
from deepsimbad.store.shared_sessions import SharedSessionStore

_START_S = 60.0  # that a replica waits for the one that administers, whose keys it reads
_THREADS = 64
_MESSAGES = 8  # of an answer that may wait to be fetched
_FOLDER_PREFIX = "deepsimbad-replica-"  # before the process's number

MakeRunJob: TypeAlias = Callable[[Path], RunJob]


def replica_name(number: int) -> str:
    """Of the deployment: who answers for a domain is told by name, so that a restart moves nothing."""
    return f"domains-{number}"


def administrator_name(number: int) -> str:
    """Of the deployment of one that administers; of one alone as when there could be no other."""
    return f"admin-{number}" if number else "admin"


def administrator_folder(data_dir: Path, number: int) -> Path:
    """The data directory of one that administers: the first has the fleet's own, the others theirs in it."""
    return data_dir / "administrators" / str(number) if number else data_dir


def keys_of(admin: "DeploymentHandle[Replica]") -> Callable[[], Sequence[KeyRecord]]:
    """What reads the keys of the one that has them, in a thread of its own."""

    def read() -> Sequence[KeyRecord]:
        records: Sequence[KeyRecord] = admin.keys.remote().result(timeout_s=BRIEFLY_S)
        return records

    return read


class AllSessions(SharedSessionStore):
    """The sessions as one that administers sees them: it looks after none, and lists them all."""

    replicas: Sequence[DeploymentHandle[Any]] = ()

    def living_sessions(self) -> list[SessionRecord]:
        """None, though copies of some be here."""
        return []

    def newest_living(
        self, domain: str | None, before: int | None, limit: int, at: float
    ) -> ListPage[ListedSession, int]:
        """Those that live, each as the replica has it that looks after it."""
        marks = [mark for mark in self.marks() if domain in {None, mark.domain}]
        newest = sorted((mark.number, mark.session_id) for mark in marks if before is None or mark.number < before)[
            ::-1
        ]
        by_owner = defaultdict[int, list[str]](list)
        for _, session_id in newest[:limit]:
            by_owner[session_owners(session_id, len(self.replicas))[0]].append(session_id)
        asked = [self.replicas[owner].listed.remote(session_ids) for owner, session_ids in by_owner.items()]
        listed = _answers(asked, "a replica is away, so its sessions cannot be listed: try again")
        living = {
            entry.session.number: entry
            for entry in listed
            if entry.session.ending is None and entry.session.expires_at > at
        }
        last = newest[limit - 1][0] if len(newest) > limit else None
        return ListPage(tuple(living[number] for number in sorted(living, reverse=True)), last)


class AllJobs:
    """The jobs as one of several that administer sees them: its own, and those that the `others` are asked for."""

    def __init__(self) -> None:
        self.others: Sequence[DeploymentHandle[Any]] = ()

    def newest(self, catalog: Catalog, domain: str | None, before: int | None, limit: int) -> ListPage[JobRecord, int]:
        """As `Catalog.newest_jobs`, of all of them; those of one domain are its administrator's, which is asked."""
        if domain is not None:
            return catalog.newest_jobs(domain, before, limit)
        asked = [other.jobs.remote(before, limit + 1) for other in self.others]
        numbered = catalog.numbered_jobs(None, before, limit + 1)
        numbered += _answers(
            asked,
            "one of those that administer is away, so its jobs cannot be listed: try again, or ask for those of one "
            "domain",
        )
        return ListPage.of(sorted(numbered, key=lambda entry: entry[0], reverse=True), limit)


def _answers(asked: Sequence[DeploymentResponse[Any]], away: str) -> list[Any]:
    """All that those who were asked have, whose lists follow one another; raises UnavailableError, saying `away`."""
    try:
        return [entry for answer in asked for entry in answer.result(timeout_s=BRIEFLY_S)]
    except (TimeoutError, RayError, RayServeException) as error:
        for answer in asked:  # nobody waits for them any more
            with suppress(RayError, RayServeException):  # which is what it would have answered
                answer.cancel()
        raise UnavailableError(away, retry_after_s=AWAY_S) from error


class Replica:
    """The service as it is anywhere else, but that its sessions and keys are shared.

    Args:
        settings: Of the whole fleet, which shares what is in its map store.
        n_replicas: How many there are beside those that administer.
        n_administrators: How many of these.
        encoder: Has the networks; None: each has its own.
        admin: The first that administers, which has the keys; None: this is it.
        number: Of this one among those that administer, that have data directories and run jobs; None: it is none.
        make_run_job: Makes what does jobs of a data directory, as `create_app` takes it; None: as there.
    """

    async def __init__(  # type: ignore[misc]  # Serve awaits it
        self,
        settings: Settings,
        n_replicas: int,
        n_administrators: int,
        encoder: DeploymentHandle[Encoder] | None = None,
        admin: "DeploymentHandle[Replica] | None" = None,
        number: int | None = None,
        make_run_job: MakeRunJob | None = None,
    ) -> None:
        configure_logging(settings.log_level)
        # Whoever takes a session over waits for many objects, which should keep nobody else waiting.
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(_THREADS))
        self._parts = AsyncExitStack()
        self._watching = list[asyncio.Task[None]]()
        objects = Objects.open(str(settings.map_store))
        elsewhere, jobs = Substitutes(), AllJobs()
        if admin is not None:
            with suppress(TimeoutError):
                await asyncio.wait_for(admin.lives.remote(0), _START_S)
            elsewhere = replace(elsewhere, keys=keys_of(admin))
        if number is not None:
            settings = settings.model_copy(update={"data_dir": administrator_folder(settings.data_dir, number)})
            elsewhere = replace(
                elsewhere,
                sessions=partial(AllSessions.open_shared, objects),
                administrator=number,
                newest_jobs=jobs.newest,
            )
        else:
            folder = _new_folder()
            self._parts.callback(shutil.rmtree, folder, ignore_errors=True)
            settings = settings.model_copy(update={"data_dir": folder})
            name = serve.get_replica_context().deployment
            others = [Backend(serve.get_deployment_handle(replica_name(other))) for other in range(n_replicas)]
            self._watching += [asyncio.create_task(backend.watch()) for backend in others]
            sessions = partial(
                SharedSessionStore.open_shared,
                objects,
                is_own=lambda session_id: replica_name(session_owners(session_id, n_replicas)[0]) == name,
            )
            elsewhere = replace(elsewhere, sessions=sessions, owners=AskedOwners(others))
        if encoder is not None:
            backend = Backend(encoder)
            self._watching.append(asyncio.create_task(backend.watch()))
            await backend.there(BRIEFLY_S)
            asking = AskedEncoder(backend, asyncio.get_running_loop())
            elsewhere = replace(elsewhere, make_evaluator=by_encoder(asking))
        self._app = create_app(settings, make_run_job and make_run_job(settings.data_dir), elsewhere)
        await self._parts.enter_async_context(self._app.router.lifespan_context(self._app))
        self._services: Services = self._app.state.services
        if isinstance(store := self._services.session_store, AllSessions):
            store.replicas = [serve.get_deployment_handle(replica_name(replica)) for replica in range(n_replicas)]
            beside = [each for each in range(n_administrators) if each != number]
            jobs.others = [serve.get_deployment_handle(administrator_name(each)) for each in beside]
            hear = (*store.replicas, *jobs.others, serve.get_deployment_handle("front"))

            async def announce() -> None:
                asked = (each.reread_keys.remote() for each in hear)
                told = asyncio.gather(*asked, return_exceptions=True)
                with suppress(TimeoutError):  # who is away reads them at its start
                    await asyncio.wait_for(told, BRIEFLY_S)

            if admin is None:
                self._services.keys.announce = announce

    async def __del__(self) -> None:
        await self._parts.aclose()

    def check_health(self) -> None:
        """Answered by the same event loop as everything else."""

    async def keys(self) -> Sequence[KeyRecord]:
        """Every API key that was ever created."""
        return await asyncio.to_thread(self._services.catalog.keys)

    async def reread_keys(self) -> None:
        """Let the keys count as they are by now."""
        await self._services.keys.reread()

    async def administrator_of(self, domain: str) -> int | None:
        """Which of those that administer has made a domain; None: there is none."""

        def told() -> int | None:
            try:
                return cast("SharedCatalog", self._services.catalog).administrator_of(domain)
            except UnknownDomainError:
                return None

        return await asyncio.to_thread(told)

    async def has_job(self, job_id: str) -> bool:
        """Whether a job is one of this one's."""

        def told() -> bool:
            try:
                self._services.catalog.job(job_id)
            except UnknownJobError:
                return False
            return True

        return await asyncio.to_thread(told)

    async def jobs(self, before: int | None, limit: int) -> list[tuple[int, JobRecord]]:
        """As `Catalog.numbered_jobs`, of all domains."""
        return await asyncio.to_thread(self._services.catalog.numbered_jobs, None, before, limit)

    async def listed(self, session_ids: Sequence[str]) -> list[ListedSession]:
        """As `SharedSessionStore.listed_sessions`."""
        store = cast("SharedSessionStore", self._services.session_store)
        return await asyncio.to_thread(store.listed_sessions, session_ids)

    async def answer(self, method: str, *arguments: Any) -> Any:
        """What `gathered` or `part` answers, or the error of ours that it raises."""
        try:
            return await getattr(self, method)(*arguments)
        except DeepSimbadError as error:
            return error.with_traceback(None)

    async def gathered(
        self, names: Sequence[str], is_all: bool
    ) -> tuple[list[MappedDomain], dict[str, DeepSimbadError]]:
        """As `Atlas.gather`, of each map its head."""

        def heads() -> tuple[list[MappedDomain], dict[str, DeepSimbadError]]:
            there, left_out = self._services.atlas.gather(names, is_all)
            return [replace(mapped, snapshot=cast("Map", MapHead.of(mapped.snapshot))) for mapped in there], left_out

        return await asyncio.to_thread(heads)

    async def part(self, domains: Sequence[MappedDomain], view: View, n_in_full: int, n_shortlist: int | None) -> Part:
        """What a view is to domains of one evaluator whose heads were gathered; where on them as it is answered."""
        services, versions = self._services, {mapped.record.name: mapped.snapshot.version for mapped in domains}
        there, left_out = await asyncio.to_thread(services.atlas.gather, list(versions), True)
        same = [mapped for mapped in there if mapped.snapshot.version == versions[mapped.record.name]]
        for name in versions.keys() - {mapped.record.name for mapped in same} - left_out.keys():
            left_out[name] = NotLoadedError("its map was switched this moment: ask again")
        evaluator = services.evaluators.evaluator(domains[0].record.evaluator)
        part = await services.worker.computed(lambda: services.atlas.ask(same, evaluator, view, n_in_full, n_shortlist))
        likeliest = {
            name: cast("Mapping[str, Any]", render_localization(cast("Localization", each), Stopwatch()))
            for name, each in part.likeliest.items()
        }
        return Part(part.log_evidences, likeliest, {**left_out, **part.left_out})

    async def follow(self) -> None:
        """Take over now what the others have published."""
        await follow(self._services)

    async def lives(self, seconds: float) -> None:
        """Answer after a while, so that whoever waits for it learns at once of this process's end."""
        if seconds == 0:  # nobody told it what was published while it started
            with suppress(DeepSimbadError):
                await self.follow()
        await asyncio.sleep(seconds)

    async def ask(self, scope: Scope, body: bytes) -> list[Message]:
        """A short answer whole."""
        return [message async for message in self.stream(scope, body)]

    async def stream(self, scope: Scope, body: bytes) -> AsyncGenerator[Message]:
        """An answer as the application sends it, which is asked without a socket."""
        parts = [{"type": "http.request", "body": body, "more_body": False}]
        send, messages = anyio.create_memory_object_stream[Message](_MESSAGES)

        async def receive() -> Message:
            if not parts:
                await asyncio.Event().wait()  # nobody leaves; who does is heard of by cancelling
            return parts.pop()

        async def answer() -> None:
            async with send:
                await self._app(scope, receive, send.send)

        answering = asyncio.create_task(answer())
        try:
            async for message in messages:
                yield message
        finally:
            messages.close()
            answering.cancel()


def _new_folder() -> Path:
    """An empty folder of this process's, once those of processes that were killed were removed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_FOLDER_PREFIX}*"):
        with suppress(OSError):  # another user's
            process = Path("/proc", folder.name.removeprefix(_FOLDER_PREFIX).partition("-")[0], "exe")
            if process.exists():  # of one that ended and is not yet reaped it does not
                continue
            if (descriptor := lock_folder(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)) is not None:
                shutil.rmtree(folder, ignore_errors=True)
                os.close(descriptor)
    return Path(tempfile.mkdtemp(prefix=f"{_FOLDER_PREFIX}{os.getpid()}-"))
