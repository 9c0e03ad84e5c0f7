"""One service of the fleet: the whole application in a process of Ray Serve's, asked by ASGI in place of a socket."""

import asyncio
import shutil
import tempfile
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import Any

import anyio
from ray import serve
from ray.exceptions import RayError
from ray.serve.exceptions import RayServeException
from ray.serve.handle import DeploymentHandle
from starlette.types import Message, Scope

from deepsimbad.api.app import Elsewhere, create_app, follow
from deepsimbad.api.requests import Services
from deepsimbad.api.server import configure_logging
from deepsimbad.errors import UnavailableError
from deepsimbad.jobs.runner import RunJob
from deepsimbad.settings import Settings
from deepsimbad.store.objects import Objects
from deepsimbad.store.records import KeyRecord, ListPage
from deepsimbad.store.sessions import ListedSession, SessionStore
from deepsimbad.store.shared_sessions import SharedSessionStore

_TIMEOUT_S = 5.0  # of what one asks of another
_MESSAGES = 8  # of an answer that may wait to be fetched


def replica_name(number: int) -> str:
    """Of the deployment: who answers for a domain is told by name, so that a restart moves nothing."""
    return f"domains-{number}"


class _AllSessions(SessionStore):
    """The sessions of one that has none of its own: what the replicas list."""

    replicas: "Sequence[DeploymentHandle[Replica]]" = ()

    def newest_living(
        self, domain: str | None, before: int | None, limit: int, at: float
    ) -> ListPage[ListedSession, int]:
        """As each of the replicas has them; of a session that two know, the one that knows more of it is believed."""
        asked = [replica.newest.remote(domain, before, limit, at) for replica in self.replicas]
        try:
            pages: list[ListPage[ListedSession, int]] = [page.result(timeout_s=_TIMEOUT_S) for page in asked]
        except (TimeoutError, RayError, RayServeException) as error:
            raise UnavailableError("a replica is away, so its sessions cannot be listed: try again") from error
        listed = sorted((entry for page in pages for entry in page.records), key=lambda entry: entry.n_observations)
        newest = sorted({entry.session.number: entry for entry in listed}.items(), reverse=True)
        has_more = len(newest) > limit or any(page.last_key is not None for page in pages)
        return ListPage(tuple(entry for _, entry in newest[:limit]), newest[:limit][-1][0] if has_more else None)


class Replica:
    """The service as it is anywhere else, but that its sessions and keys are shared.

    Args:
        settings: Of the whole fleet, which shares what is in its map store.
        admin: The one that has the data directory, and runs jobs; None: this is it.
        n_replicas: How many there are beside that one.
        run_job: As `create_app`.
    """

    async def __init__(  # type: ignore[misc]  # Serve awaits it
        self,
        settings: Settings,
        n_replicas: int,
        admin: "DeploymentHandle[Replica] | None" = None,
        run_job: RunJob | None = None,
    ) -> None:
        configure_logging(settings.log_level)
        self._parts = AsyncExitStack()
        if admin is None:
            elsewhere = Elsewhere(sessions=_AllSessions.open)
        else:
            folder = Path(tempfile.mkdtemp(prefix="deepsimbad-replica-"))
            self._parts.callback(shutil.rmtree, folder, ignore_errors=True)
            settings = settings.model_copy(update={"data_dir": folder})

            def keys() -> Sequence[KeyRecord]:
                records: Sequence[KeyRecord] = admin.keys.remote().result(timeout_s=_TIMEOUT_S)
                return records

            elsewhere = Elsewhere(keys, partial(SharedSessionStore.sharing, Objects.open(str(settings.map_store))))
        self._app = create_app(settings, run_job, elsewhere)
        await self._parts.enter_async_context(self._app.router.lifespan_context(self._app))
        self._services: Services = self._app.state.services
        if isinstance(store := self._services.session_store, _AllSessions):
            store.replicas = [serve.get_deployment_handle(replica_name(number)) for number in range(n_replicas)]

    async def __del__(self) -> None:
        await self._parts.aclose()

    def check_health(self) -> None:
        """Answered by the same event loop as everything else."""

    def keys(self) -> Sequence[KeyRecord]:
        """Every API key that was ever created."""
        return self._services.catalog.keys()

    async def newest(self, *page: Any) -> ListPage[ListedSession, int]:
        """As `SessionStore.newest_living`."""
        return await asyncio.to_thread(self._services.session_store.newest_living, *page)

    async def follow(self) -> None:
        """Take over now what the others have published."""
        await follow(self._services)

    async def lives(self, seconds: float) -> None:
        """Answer after a while, so that whoever waits for it learns at once of this process's end."""
        await asyncio.sleep(seconds)

    async def ask(self, scope: Scope, body: bytes) -> list[Message]:
        """A short answer whole."""
        return [message async for message in self.stream(scope, body)]

    async def stream(self, scope: Scope, body: bytes) -> AsyncIterator[Message]:
        """An answer as the application sends it."""
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
