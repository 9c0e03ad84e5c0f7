"""One service of the fleet: the whole application in a process of Ray Serve's, called by ASGI in place of a socket."""

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
from deepsimbad.fleet.encoder import AskedEncoder, Encoder, answer_or_error
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

_START_S = 60.0  # longest wait of a replica for the administrator whose keys it reads
_THREADS = 64
_MESSAGES = 8  # parts of an answer that may wait to be fetched
_FOLDER_PREFIX = "deepsimbad-replica-"  # before the process's number

MakeRunJob: TypeAlias = Callable[[Path], RunJob]


def replica_name(number: int) -> str:
    """Name of a replica's deployment; a domain belongs to names, so that a restart moves nothing."""
    return f"domains-{number}"


def administrator_name(number: int) -> str:
    """Name of an administrator's deployment; the first is called as when there was only one."""
    return f"admin-{number}" if number else "admin"


def administrator_folder(data_dir: Path, number: int) -> Path:
    """An administrator's data directory: the first has the fleet's own, the others theirs in it."""
    return data_dir / "administrators" / str(number) if number else data_dir


def keys_of(admin: "DeploymentHandle[Replica]") -> Callable[[], Sequence[KeyRecord]]:
    """A function that reads the keys of the administrator that has them; it blocks, so call it in a thread."""

    def read() -> Sequence[KeyRecord]:
        records: Sequence[KeyRecord] = admin.keys.remote().result(timeout_s=BRIEFLY_S)
        return records

    return read


class AllSessions(SharedSessionStore):
    """The sessions as an administrator sees them: it looks after none, and lists them all."""

    replicas: Sequence[DeploymentHandle[Any]] = ()

    def living_sessions(self) -> list[SessionRecord]:
        """None, though there may be local copies of some."""
        return []

    def newest_living(
        self, domain: str | None, last_key: int | None, limit: int, time_s: float
    ) -> ListPage[ListedSession, int]:
        """As `SharedSessionStore.newest_living`, each session as the replica that looks after it has it."""
        marks = [mark for mark in self.marks() if domain in {None, mark.domain}]
        newest = sorted((mark.number, mark.session_id) for mark in marks if last_key is None or mark.number < last_key)[
            ::-1
        ]
        by_owner = defaultdict[int, list[str]](list)
        for _, session_id in newest[:limit]:
            by_owner[session_owners(session_id, len(self.replicas))[0]].append(session_id)
        responses = [
            self.replicas[owner].listed_sessions.remote(session_ids) for owner, session_ids in by_owner.items()
        ]
        sessions = _answers(responses, "a replica is away, so its sessions cannot be listed: try again")
        living = {
            entry.session.number: entry
            for entry in sessions
            if entry.session.ending is None and entry.session.expires_at > time_s
        }
        last_number = newest[limit - 1][0] if len(newest) > limit else None
        return ListPage(tuple(living[number] for number in sorted(living, reverse=True)), last_number)


class AllJobs:
    """The jobs as one of several administrators sees them: its own, and those of `other_administrators`."""

    def __init__(self) -> None:
        self.other_administrators: Sequence[DeploymentHandle[Any]] = ()

    def newest(
        self, catalog: Catalog, domain: str | None, last_key: int | None, limit: int
    ) -> ListPage[JobRecord, int]:
        """As `Catalog.newest_jobs`, over all administrators; a domain's jobs are all in its administrator's catalog."""
        if domain is not None:
            return catalog.newest_jobs(domain, last_key, limit)
        responses = [administrator.jobs.remote(last_key, limit + 1) for administrator in self.other_administrators]
        numbered = catalog.numbered_jobs(None, last_key, limit + 1)
        numbered += _answers(
            responses,
            "one of those that administer is away, so its jobs cannot be listed: try again, or ask for those of one "
            "domain",
        )
        return ListPage.of(sorted(numbered, key=lambda entry: entry[0], reverse=True), limit)


def _answers(responses: Sequence[DeploymentResponse[Any]], message: str) -> list[Any]:
    """The entries of all lists that were asked for; raises UnavailableError with `message` where one does not come."""
    try:
        return [entry for response in responses for entry in response.result(timeout_s=BRIEFLY_S)]
    except (TimeoutError, RayError, RayServeException) as error:
        for response in responses:  # nobody waits for them any more
            with suppress(RayError, RayServeException):  # its own failure
                response.cancel()
        raise UnavailableError(message, retry_after_s=AWAY_S) from error


class Replica:
    """The service as it is anywhere else, with shared sessions and keys.

    Args:
        settings: Of the whole fleet, which shares what is in its map store.
        n_replicas: How many there are beside the administrators.
        n_administrators: How many administrators there are.
        encoder: Has the networks; None: each process has its own.
        admin: The first administrator, which has the keys; None: this is it.
        number: Of this one among the administrators, which have data directories and run jobs; None: it is none.
        make_run_job: Makes the runner of a data directory's jobs that `create_app` takes; None: its own.
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
        # Taking a session over waits for many objects, which should keep no other request waiting.
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(_THREADS))
        self._parts = AsyncExitStack()
        self._watching = list[asyncio.Task[None]]()
        objects = Objects.open(str(settings.map_store))
        substitutes, jobs = Substitutes(), AllJobs()
        if admin is not None:
            with suppress(TimeoutError):
                await asyncio.wait_for(admin.lives.remote(0), _START_S)
            substitutes = replace(substitutes, keys=keys_of(admin))
        if number is not None:
            settings = settings.model_copy(update={"data_dir": administrator_folder(settings.data_dir, number)})
            substitutes = replace(
                substitutes,
                sessions=partial(AllSessions.open_shared, objects),
                administrator=number,
                newest_jobs=jobs.newest,
            )
        else:
            folder = _new_folder()
            self._parts.callback(shutil.rmtree, folder, ignore_errors=True)
            settings = settings.model_copy(update={"data_dir": folder})
            name = serve.get_replica_context().deployment
            replicas = [Backend(serve.get_deployment_handle(replica_name(other))) for other in range(n_replicas)]
            self._watching += [asyncio.create_task(backend.watch()) for backend in replicas]
            sessions = partial(
                SharedSessionStore.open_shared,
                objects,
                is_own=lambda session_id: replica_name(session_owners(session_id, n_replicas)[0]) == name,
            )
            substitutes = replace(substitutes, sessions=sessions, owners=AskedOwners(replicas))
        if encoder is not None:
            backend = Backend(encoder)
            self._watching.append(asyncio.create_task(backend.watch()))
            await backend.wait_for_process(BRIEFLY_S)
            asked_encoder = AskedEncoder(backend, asyncio.get_running_loop())
            substitutes = replace(substitutes, make_evaluator=by_encoder(asked_encoder))
        self._app = create_app(settings, make_run_job and make_run_job(settings.data_dir), substitutes)
        await self._parts.enter_async_context(self._app.router.lifespan_context(self._app))
        self._services: Services = self._app.state.services
        if isinstance(store := self._services.session_store, AllSessions):
            store.replicas = [serve.get_deployment_handle(replica_name(replica)) for replica in range(n_replicas)]
            other_numbers = [other for other in range(n_administrators) if other != number]
            jobs.other_administrators = [
                serve.get_deployment_handle(administrator_name(other)) for other in other_numbers
            ]
            key_readers = (*store.replicas, *jobs.other_administrators, serve.get_deployment_handle("front"))

            async def announce() -> None:
                calls = (reader.reread_keys.remote() for reader in key_readers)
                rereading = asyncio.gather(*calls, return_exceptions=True)
                with suppress(TimeoutError):  # one that is away reads them at its start
                    await asyncio.wait_for(rereading, BRIEFLY_S)

            if admin is None:
                self._services.keys.announce = announce

    async def __del__(self) -> None:
        await self._parts.aclose()

    def check_health(self) -> None:
        """Answer from the event loop of all requests, so that one that hangs is seen."""

    async def keys(self) -> Sequence[KeyRecord]:
        """Every API key that was ever created."""
        return await asyncio.to_thread(self._services.catalog.keys)

    async def reread_keys(self) -> None:
        """Read the keys anew."""
        await self._services.keys.reread()

    async def administrator_of(self, domain: str) -> int | None:
        """Number of the administrator that made a domain; None: there is no such domain."""
        catalog = cast("SharedCatalog", self._services.catalog)
        try:
            return await asyncio.to_thread(catalog.administrator_of, domain)
        except UnknownDomainError:
            return None

    async def has_job(self, job_id: str) -> bool:
        """Whether a job is in this administrator's catalog."""
        try:
            await asyncio.to_thread(self._services.catalog.job, job_id)
        except UnknownJobError:
            return False
        return True

    async def jobs(self, last_key: int | None, limit: int) -> list[tuple[int, JobRecord]]:
        """As `Catalog.numbered_jobs`, of all domains."""
        return await asyncio.to_thread(self._services.catalog.numbered_jobs, None, last_key, limit)

    async def listed_sessions(self, session_ids: Sequence[str]) -> list[ListedSession]:
        """As `SharedSessionStore.listed_sessions`."""
        store = cast("SharedSessionStore", self._services.session_store)
        return await asyncio.to_thread(store.listed_sessions, session_ids)

    async def answer(self, method: str, *arguments: Any) -> Any:
        """The answer of `gather_heads` or `part`, or the error of ours that it raises."""
        return await answer_or_error(getattr(self, method)(*arguments))

    async def gather_heads(
        self, names: Sequence[str], is_all: bool
    ) -> tuple[list[MappedDomain], dict[str, DeepSimbadError]]:
        """As `Atlas.gather`, with each map's head in place of the map."""

        def heads() -> tuple[list[MappedDomain], dict[str, DeepSimbadError]]:
            mapped_domains, left_out = self._services.atlas.gather(names, is_all)
            return [
                replace(domain, snapshot=cast("Map", MapHead.of(domain.snapshot))) for domain in mapped_domains
            ], left_out

        return await asyncio.to_thread(heads)

    async def part(self, domains: Sequence[MappedDomain], view: View, n_in_full: int, n_shortlist: int | None) -> Part:
        """As `Atlas.ask`, by the maps whose heads were gathered, with localizations rendered as answers hold them."""
        services, versions = self._services, {domain.record.name: domain.snapshot.version for domain in domains}
        mapped_domains, left_out = await asyncio.to_thread(services.atlas.gather, list(versions), True)
        unchanged = [domain for domain in mapped_domains if domain.snapshot.version == versions[domain.record.name]]
        for name in versions.keys() - {domain.record.name for domain in unchanged} - left_out.keys():
            left_out[name] = NotLoadedError("its map was switched this moment: ask again")
        evaluator = services.evaluators.evaluator(domains[0].record.evaluator)
        part = await services.worker.computed(
            lambda: services.atlas.ask(unchanged, evaluator, view, n_in_full, n_shortlist)
        )
        likeliest = {
            name: cast("Mapping[str, Any]", render_localization(cast("Localization", localization), Stopwatch()))
            for name, localization in part.likeliest.items()
        }
        return Part(part.log_evidences, likeliest, {**left_out, **part.left_out})

    async def follow(self) -> None:
        """Take over now what other processes have published."""
        await follow(self._services)

    async def lives(self, seconds: float) -> None:
        """Answer after some seconds, so that who waits for it learns at once of this process's end."""
        if seconds == 0:  # it may have missed what was published while it started
            with suppress(DeepSimbadError):
                await self.follow()
        await asyncio.sleep(seconds)

    async def ask(self, scope: Scope, body: bytes) -> list[Message]:
        """A short answer of the application, all its messages at once."""
        return [message async for message in self.stream(scope, body)]

    async def stream(self, scope: Scope, body: bytes) -> AsyncGenerator[Message]:
        """An answer of the application, message by message; it is called without a socket."""
        parts = [{"type": "http.request", "body": body, "more_body": False}]
        send, messages = anyio.create_memory_object_stream[Message](_MESSAGES)

        async def receive() -> Message:
            if not parts:
                await asyncio.Event().wait()  # a client that leaves is told by cancelling, not by a message
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
    """An empty folder for this process; those of processes that were killed are removed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_FOLDER_PREFIX}*"):
        with suppress(OSError):  # another user's, or one in use
            process = Path("/proc", folder.name.removeprefix(_FOLDER_PREFIX).partition("-")[0], "exe")
            if process.exists():  # of one that ended and is not yet reaped it does not
                continue
            descriptor = lock_folder(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
            os.close(descriptor)
    return Path(tempfile.mkdtemp(prefix=f"{_FOLDER_PREFIX}{os.getpid()}-"))
