"""The front of the fleet: an HTTP server that gives every request to a process that has its domain."""

import asyncio
import json
import re
import secrets
import socket
import tempfile
from collections.abc import AsyncGenerator, AsyncIterator, Iterable, Sequence
from contextlib import AsyncExitStack, aclosing, asynccontextmanager
from http import HTTPStatus
from pathlib import Path

import uvicorn
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from ray.serve.handle import DeploymentHandle
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.types import Message, Receive, Scope, Send

from deepsimbad.api.door import FREE_BYTES, max_body_bytes
from deepsimbad.api.keys import KeyRing, check_reach, presented_key
from deepsimbad.api.problems import error_response
from deepsimbad.api.requests import Slots
from deepsimbad.api.server import cannot_listen, configure_logging, http_config
from deepsimbad.errors import DeepSimbadError, ForbiddenError, UnauthorizedError, UnavailableError
from deepsimbad.fleet.backend import AWAY_S, Backend, Gone
from deepsimbad.fleet.owners import Administrators
from deepsimbad.fleet.placement import place
from deepsimbad.fleet.replica import Replica, keys_of
from deepsimbad.settings import Settings
from deepsimbad.store.catalog import ApiKey
from deepsimbad.store.durable import storage_faults

_PASSED = (  # of a request's scope
    "type",
    "asgi",
    "http_version",
    "method",
    "path",
    "raw_path",
    "query_string",
    "headers",
    "scheme",
    "client",
    "server",
    "root_path",
)

_PATIENCE_S = 10.0  # longest wait of a request whose owners are both away; one that ended is back in half of it
_SUMMED_GAUGES = {
    "requests_in_flight",
    "inference_queue",
    "loaded_maps",
    "loaded_map_bytes",
    "sessions",
    "map_store_failing",
    "jobs",
}
_HEALTH_GAUGES = re.compile(
    r"^deepsimbad_(?:ready (?P<ready>\S+)|data_dir_free_bytes (?P<free>\S+)|data_dir_size_bytes (?P<size>\S+))$",
    re.MULTILINE,
)


class Front:
    """The deployment; listens where the settings say.

    A request whose replica ends under it is given to the domain's other owner, or to either once it is back:
    observations and sessions carry a key by which they count once, and the rest may be asked twice.
    """

    async def __init__(  # type: ignore[misc]  # Serve awaits it
        self,
        settings: Settings,
        administrators: Sequence[DeploymentHandle[Replica]],
        replicas: Sequence[DeploymentHandle[Replica]],
    ) -> None:
        configure_logging(settings.log_level)
        self._settings = settings
        self._administrators = Administrators([Backend(handle) for handle in administrators])
        self._replicas = [Backend(handle) for handle in replicas]
        backends = [*self._administrators.backends, *self._replicas]
        self._watching = [asyncio.create_task(backend.watch()) for backend in backends]
        required = [backends[0], *self._replicas]  # the keys, and who serves robots; another may be away for long
        while any(backend.process_end is None for backend in required):
            await asyncio.sleep(0.05)
        self._keys = KeyRing()
        await asyncio.to_thread(self._keys.load, keys_of(administrators[0]))
        self._bodies = Bodies(settings, self._keys)
        self._watching.append(asyncio.create_task(self._keys.follow()))
        try:
            listening = socket.create_server((settings.host, settings.port), backlog=2048)
        except OSError as error:
            raise cannot_listen(settings, error) from error
        self._address: tuple[str, int] = listening.getsockname()[:2]
        server = uvicorn.Server(http_config(self, settings))
        self._serving = asyncio.create_task(server.serve([listening]))

    async def address(self) -> tuple[str, int]:
        """The host and port where it listens."""
        return self._address

    async def reread_keys(self) -> None:
        """Read the keys anew."""
        await self._keys.reread()

    def check_health(self) -> None:
        """Raise RuntimeError where nothing listens any more."""
        if self._serving.done():
            raise RuntimeError("the HTTP server has ended")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request of ASGI's."""
        if scope["type"] != "http":
            return
        root = self._settings.root_path
        if root and scope["path"].startswith(f"{root}/"):  # as the door does
            scope["path"] = scope["path"].removeprefix(root)
        try:
            async with self._bodies.of(scope, receive) as body:
                await self._pass_on(scope, body, receive, send)
        except DeepSimbadError as error:
            await _refuse(scope, error, receive, send)
        except ClientDisconnect:  # nobody is left to be answered
            pass

    async def _pass_on(self, scope: Scope, body: bytes, receive: Receive, send: Send) -> None:
        passed_scope = {name: scope[name] for name in _PASSED if name in scope}
        headers = dict(scope["headers"])
        if scope["method"] == "POST" and b"idempotency-key" not in headers:
            passed_scope["headers"] = [*scope["headers"], (b"idempotency-key", secrets.token_hex(16).encode())]
        answering = asyncio.create_task(self._answer(passed_scope, body, receive, send))
        leaving = asyncio.create_task(_sender_gone(receive))
        await asyncio.wait({answering, leaving}, return_when=asyncio.FIRST_COMPLETED)
        leaving.cancel()
        if not answering.done() and scope["method"] in {"GET", "HEAD"}:  # what changes something is finished
            answering.cancel()
        await asyncio.gather(answering, return_exceptions=True)

    async def _answer(self, scope: Scope, body: bytes, receive: Receive, send: Send) -> None:
        if scope["path"] == "/metrics":
            await self._metrics(scope, receive, send)
            return
        if scope["path"] == "/readyz" and len(self._administrators.backends) > 1:
            await self._readiness(scope, receive, send)
            return
        try:
            candidates, patience_s = await self._candidates(scope)
        except UnavailableError as error:
            await _refuse(scope, error, receive, send)
            return
        deadline_s = asyncio.get_running_loop().time() + patience_s
        while not await self._is_answered(candidates, scope, body, send):
            if asyncio.get_running_loop().time() >= deadline_s:
                message = "those that know the domain are away this moment: try again"
                await _refuse(scope, UnavailableError(message, retry_after_s=AWAY_S), receive, send)
                return
            await asyncio.sleep(0.05)

    async def _is_answered(self, candidates: Sequence[Backend], scope: Scope, body: bytes, send: Send) -> bool:
        """Let the first candidate that is there answer; False: all are away, or ended during the request."""
        has_begun = False
        for backend in candidates:
            backend.n_calls += 1
            try:
                if scope["method"] not in {"GET", "HEAD"}:  # these alone may be long
                    for message in await backend.ask("ask", scope, body):
                        await self._before_last(message, backend)
                        await send(message)
                    return True
                async with aclosing(backend.stream("stream", scope, body)) as messages:
                    async for message in messages:
                        await self._before_last(message, backend)
                        await send(message)
                        has_begun = True
                return True
            except Gone:
                if has_begun:
                    raise
            finally:
                backend.n_calls -= 1
        return False

    async def _metrics(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer with the summed metrics of all processes that are there."""
        administrator_answers = await self._answers_of(self._administrators.backends, scope)
        answers = administrator_answers + await self._answers_of(self._replicas, scope)
        if (refusal := _refusal(answers)) is not None:
            for message in refusal:
                await send(message)
            return
        texts = [_body(answer).decode() for answer in answers]
        n_administrators = len(administrator_answers)
        texts[:n_administrators] = sorted(texts[:n_administrators], key=_health)  # the worst first, which is believed
        await Response(summed_metrics(texts), media_type=CONTENT_TYPE_LATEST)(scope, receive, send)

    async def _readiness(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer whether all administrators are ready, and with the damaged maps that any of them has met."""
        answers = await self._answers_of(self._administrators.backends, scope)
        if len(answers) < len(self._administrators.backends):
            problem = "one of those that administer is away this moment"
            await _refuse(scope, UnavailableError(problem, retry_after_s=AWAY_S, faults=[problem]), receive, send)
            return
        if scope["method"] == "GET" and _refusal(answers) is None:
            documents = [json.loads(_body(answer)) for answer in answers]
            damaged = sorted({domain for document in documents for domain in document["damaged_maps"]})
            body = json.dumps({**documents[0], "damaged_maps": damaged}).encode()
            headers = [(name, value) for name, value in answers[0][0]["headers"] if name != b"content-length"]
            headers.append((b"content-length", str(len(body)).encode()))
            await send({**answers[0][0], "headers": headers})
            await send({"type": "http.response.body", "body": body})
            return
        for message in _refusal(answers) or answers[0]:
            await send(message)

    async def _answers_of(self, backends: Sequence[Backend], scope: Scope) -> list[list[Message]]:
        """The answers of the processes that are there."""
        calls = (backend.ask_briefly("ask", scope, b"") for backend in backends)
        return [answer for answer in await asyncio.gather(*calls, return_exceptions=True) if isinstance(answer, list)]

    async def _before_last(self, message: Message, backend: Backend) -> None:
        """Before an administrator's answer is complete, let all other processes see what it may have changed."""
        administrators = self._administrators.backends
        is_last = message["type"] == "http.response.body" and not message.get("more_body", False)
        if is_last and backend in administrators:
            calls = [other.ask_briefly("follow") for other in administrators if other is not backend]
            calls += [replica.ask("follow") for replica in self._replicas]  # which may have a large map to load
            await asyncio.gather(*calls, return_exceptions=True)

    async def _candidates(self, scope: Scope) -> tuple[Sequence[Backend], float]:
        """Who may answer, the preferred one first, and how many seconds to wait for one; raises UnavailableError."""
        word = dict(scope["headers"]).get(b"idempotency-key")
        placement = place(scope["path"], len(self._replicas), _key_id(scope), word and word.decode("latin-1"))
        if placement is None:  # health checks, too, are answered without waiting
            if not self._opens(scope):  # and learns nothing of domains
                return self._administrators.backends, 0.0
            return await self._administrators.of(scope["path"], scope["query_string"]), 0.0
        backends = [self._replicas[number] for number in placement[0]]
        return backends if placement[1] else sorted(backends, key=lambda backend: backend.n_calls), _PATIENCE_S

    def _opens(self, scope: Scope) -> bool:
        """Whether the path needs no key, or the key that is presented reaches it."""
        try:
            required_scope = self._keys.scope_for(scope["path"])
            if required_scope is not None:
                check_reach(self._keys.holder(presented_key(scope)), scope["path"], required_scope)
        except (UnauthorizedError, ForbiddenError, UnavailableError):  # the administrator answers so
            return False
        return True


class Bodies:
    """Request bodies, read whole before a replica is asked, within the memory that the service's setting allows.

    A slow sender takes memory for what has come alone, and all senders together no more than the setting. A batch lies
    on the disk until all of it has come, as in the service; then one at a time is in memory. Bodies sent with a key
    that `keys` does not know are not read.
    """

    def __init__(self, settings: Settings, keys: KeyRing) -> None:
        self._settings = settings
        self._keys = keys
        self._room = Slots(settings.max_body_memory_bytes, "bytes of bodies are held", "max_body_memory_bytes")
        self._uploads = Slots(settings.max_uploads, "batches of frames are on their way", "max_uploads")
        self._batch = asyncio.Lock()  # of the one that is in memory

    @asynccontextmanager
    async def of(self, scope: Scope, receive: Receive) -> AsyncGenerator[bytes]:
        """The body of a request; empty where its head is refused, and cut behind its limit where it is too long.

        Raises:
            OverloadedError: There is no room for it in memory.
            UnavailableError: There is no room for it on the disk.
            ClientDisconnect: Its sender has gone before all of it had come.
        """
        headers = dict(scope["headers"])
        max_bytes, is_batch = max_body_bytes(scope, headers, self._settings)
        content_length = headers.get(b"content-length", b"0")
        n_declared = int(content_length[:20]) if content_length.isdigit() else 0
        parts = _parts(scope, receive, max_bytes)
        if n_declared > max_bytes or not self._is_let_in(scope):
            yield b""
        elif is_batch:
            folder = Path(tempfile.gettempdir())
            async with AsyncExitStack() as turn:
                turn.enter_context(self._uploads.slot())
                with storage_faults(folder), tempfile.TemporaryFile(dir=folder) as spool:
                    async for part in parts:
                        await asyncio.to_thread(spool.write, part)
                    await turn.enter_async_context(self._batch)
                    spool.seek(0)
                    body = await asyncio.to_thread(spool.read)
                yield body
        else:
            self._room.check(max(0, n_declared - FREE_BYTES))
            received, n_held = bytearray(), 0
            try:
                async for part in parts:
                    received += part
                    if (n_more := len(received) - FREE_BYTES - n_held) > 0:
                        self._room.take(n_more)
                        n_held += n_more
                body = bytes(received)
                del received
                yield body
            finally:
                self._room.give_back(n_held)

    def _is_let_in(self, scope: Scope) -> bool:
        """Whether a replica would read a body sent with this key; the replica judges what the key may do."""
        try:
            if self._keys.scope_for(scope["path"]) is not None:
                self._keys.holder(presented_key(scope))
        except UnauthorizedError:
            return False
        except UnavailableError:  # the replica says so
            return True
        return True


async def _parts(scope: Scope, receive: Receive, max_bytes: int) -> AsyncIterator[bytes]:
    """A body in parts as they come, until it is longer than `max_bytes`; raises ClientDisconnect."""
    n_bytes = 0
    async for part in Request(scope, receive).stream():
        n_bytes += len(part)
        yield part
        if n_bytes > max_bytes:
            return


async def _refuse(scope: Scope, error: DeepSimbadError, receive: Receive, send: Send) -> None:
    """Answer with an error in place of a replica."""
    scope["state"] = {"request_id": secrets.token_hex(8)}
    headers = [(b"x-request-id", scope["state"]["request_id"].encode()), (b"cache-control", b"no-store")]

    async def send_marked(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message["headers"], *headers]
        await send(message)

    await error_response(scope, error)(scope, receive, send_marked)


def _refusal(answers: Iterable[list[Message]]) -> list[Message] | None:
    """The first answer whose status is not 200; None: there is none."""
    return next((answer for answer in answers if answer[0]["status"] != HTTPStatus.OK), None)


def _body(answer: Iterable[Message]) -> bytes:
    return b"".join(message.get("body", b"") for message in answer)


def _health(text: str) -> tuple[float, float]:
    """Whether an administrator is ready (1 or 0), and the share of its disk that is free, from its metrics."""
    gauges = {
        name: float(value)
        for match in _HEALTH_GAUGES.finditer(text)
        for name, value in match.groupdict().items()
        if value
    }
    return gauges.get("ready", 0.0), gauges.get("free", 0.0) / gauges.get("size", 1.0)


def _key_id(scope: Scope) -> str | None:
    """The id of the key that is presented, which is not checked here; None: there is none, or no such form."""
    try:
        key = ApiKey.parse(presented_key(scope))
    except UnauthorizedError:
        return None
    return key.key_id if key else None


async def _sender_gone(receive: Receive) -> None:
    """Return once the sender has gone."""
    while (await receive())["type"] != "http.disconnect":
        pass


def summed_metrics(texts: Iterable[str]) -> str:
    """The metrics of several processes as if they were one.

    Counts and the gauges that each process has of its own are added; of gauges that all see alike the first is taken.
    """
    families: dict[str, dict[str, float]] = {}
    for text in texts:
        heading, samples, adds = "", dict[str, float](), True
        for line in text.splitlines():
            if line.startswith("# TYPE"):
                _, _, family, kind = line.split()
                adds = kind != "gauge" or family.removeprefix("deepsimbad_") in _SUMMED_GAUGES
                samples = families.setdefault(f"{heading}{line}\n", {})
            elif line.startswith("#"):
                heading = f"{line}\n"
            else:
                name, _, value = line.rpartition(" ")
                samples[name] = samples.get(name, 0.0) + float(value) if adds else samples.get(name, float(value))
    return "".join(
        heading + "".join(f"{name} {value}\n" for name, value in samples.items())
        for heading, samples in families.items()
    )
