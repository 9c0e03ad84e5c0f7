"""The sending of calls until they are answered: written once, for the blocking and the async client alike.

The clients and this module are written as coroutines over a link, which holds the few things that differ between
blocking and awaiting. A `BlockingLink` never suspends, so `run_to_end` runs such a coroutine in place; `shared` and
`shared_stream` do that to the calls of a `Blocking` client and leave them to be awaited on an `Awaiting` one.
"""
# ruff: noqa: D102 - a link's methods do what httpx2's methods of these names do

import asyncio
import logging
import os
import re
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Coroutine, Iterator
from contextlib import aclosing, asynccontextmanager, closing
from dataclasses import dataclass, replace
from functools import wraps
from ipaddress import ip_address
from types import TracebackType
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar, overload
from urllib.request import getproxies, proxy_bypass

import httpx2

from deepsimbad_client.errors import InvalidArgumentError, TransportError, TransportTimeoutError
from deepsimbad_client.http import (
    REFUSED_STATUSES,
    REQUEST_ID,
    Call,
    Model,
    Repeat,
    model_of,
    of_python,
    page_of,
    problem_of,
    raise_for_problem,
    retry_after_s,
)

P = ParamSpec("P")
T = TypeVar("T")
Blocked = TypeVar("Blocked")
Awaited = TypeVar("Awaited")

URL_VARIABLE = "DEEPSIMBAD_URL"
KEY_VARIABLE = "DEEPSIMBAD_API_KEY"
DEFAULT_URL = "http://127.0.0.1:8000"
# Generous where bytes move slowly, short where nobody is there: read and write count from the last byte moved.
THIN_LINK_TIMEOUT = httpx2.Timeout(connect=10.0, read=60.0, write=60.0, pool=120.0)
PAGE_LENGTH = 200
UNTOUCHED_FAILURES = (httpx2.ConnectError, httpx2.ConnectTimeout, httpx2.PoolTimeout)  # no service saw the request
LASTING_CODES = frozenset({"damaged_map", "damaged_file"})  # behind a 503 that waiting cannot cure
_CONNECTIONS = httpx2.Limits(max_connections=64, max_keepalive_connections=32, keepalive_expiry=30.0)
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")

logger = logging.getLogger(__name__)


def http_settings(url: str | None, api_key: str | None, timeout: httpx2.Timeout) -> dict[str, Any]:
    """The keyword arguments of an httpx2 client; absent address and key are those of the environment.

    Raises InvalidArgumentError (no http(s) address, or a key that no header can carry).
    """
    url = (url or os.environ.get(URL_VARIABLE) or DEFAULT_URL).rstrip("/").removesuffix("/v1")  # which calls begin with
    try:
        parsed_url = httpx2.URL(url)
    except httpx2.InvalidURL as error:
        raise InvalidArgumentError(f"{url!r} is no address: {error}") from error
    if parsed_url.scheme not in {"http", "https"} or not parsed_url.host:
        raise InvalidArgumentError(f"{url!r} is no address: give something like {DEFAULT_URL}")
    headers = {"User-Agent": "deepsimbad-client", "Accept": "application/json"}
    if key := os.environ.get(KEY_VARIABLE) if api_key is None else api_key:
        if not (key.isascii() and key.isprintable()):
            raise InvalidArgumentError("the API key holds characters that no header can carry")
        headers["Authorization"] = f"Bearer {key}"
    settings = {"base_url": url, "headers": headers, "timeout": timeout, "limits": _CONNECTIONS}
    if not _is_loopback(parsed_url.host):
        return settings
    # A proxy of the environment does not lead to this machine. Plain http needs no certificates, and to read those of
    # all authorities takes 24 ms.
    return settings | {"mounts": {f"all://{parsed_url.netloc.decode()}": None}, "verify": parsed_url.scheme == "https"}


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def _by_proxy(url: str) -> str:
    """Words for the proxy of the environment that requests go through; "" where there is none."""
    parsed_url = httpx2.URL(url)
    if _is_loopback(parsed_url.host) or proxy_bypass(parsed_url.host):
        return ""
    proxies = getproxies()
    proxy = proxies.get(parsed_url.scheme) or proxies.get("all")
    return f" by the proxy {httpx2.URL(proxy).copy_with(userinfo=b'')} of the environment" if proxy else ""


@dataclass(frozen=True)
class RetryPolicy:
    """How patient a client is: waits double from `base_s` on, the upper half of each drawn at random.

    As it stands the waits come to 30 s, which a service takes to be replaced, and to 3 s until it answered anything:
    an address where nobody ever did is likelier a wrong one.
    """

    attempts: int = 10  # times a request is sent in all; 1 never repeats
    first_attempts: int = 5  # the same, at most, while the service has never answered
    base_s: float = 0.25
    max_backoff_s: float = 8.0
    max_retry_after_s: float = 60.0  # a service that asks for more is not asked again: its error is raised at once

    def backoff_s(self, n_sent: int, jitter: float) -> float:
        """Wait after the `n_sent`-th try; `jitter` in 0..1."""
        return min(self.base_s * 2.0 ** (n_sent - 1), self.max_backoff_s) * (0.5 + 0.5 * jitter)


@dataclass
class Attempts:
    """The tries of one request: after each it says how long to wait for the next; nothing here waits or sends."""

    policy: RetryPolicy
    repeat: Repeat
    request_text: str  # the request in words, for errors
    jitter: Callable[[], float]  # draws in 0..1
    n_sent: int = 0
    answer_lost: bool = False  # an earlier try may have been acted on without our hearing of it

    def after_failure(self, error: httpx2.RequestError) -> float:
        """Seconds to wait before the next try; raises TransportError when there is none."""
        self.n_sent += 1
        is_untouched = isinstance(error, UNTOUCHED_FAILURES)
        is_safe = self.repeat is Repeat.ALWAYS or (self.repeat is Repeat.IF_UNTOUCHED and is_untouched)
        is_hopeless = isinstance(error, httpx2.UnsupportedProtocol | httpx2.LocalProtocolError)
        reason = str(error) or type(error).__name__
        if is_safe and not is_hopeless and self.n_sent < self.policy.attempts:
            self.answer_lost |= not is_untouched
            return self._announce(self.policy.backoff_s(self.n_sent, self.jitter()), reason)
        kind = TransportTimeoutError if isinstance(error, httpx2.TimeoutException) else TransportError
        tries = f"{self.n_sent} tries" if self.n_sent > 1 else "one try"
        advice = "; is the service running there?" if is_untouched else ""
        raise kind(f"no answer to {self.request_text} after {tries}: {reason}{advice}") from error

    def after_answer(self, response: httpx2.Response) -> float | None:
        """Seconds to wait before the next try; None when this answer is final."""
        self.n_sent += 1
        status, code = response.status_code, problem_of(response).get("code")
        if status not in self.repeat.value or self.n_sent >= self.policy.attempts or code in LASTING_CODES:
            return None
        asked_s = retry_after_s(response.headers.get("retry-after"))
        if asked_s is None:
            self.answer_lost |= status not in REFUSED_STATUSES
        elif asked_s > self.policy.max_retry_after_s:
            return None
        wait_s = max(asked_s or 0.0, self.policy.backoff_s(self.n_sent, self.jitter()))
        return self._announce(wait_s, f"{status} {code or ''}".rstrip())

    def _announce(self, wait_s: float, reason: str) -> float:
        """Log the wait, since a client that only waits looks dead, and return it."""
        next_try = f"try {self.n_sent + 1} of {self.policy.attempts}"
        logger.info("%s: %s; trying again in %.1f s (%s)", self.request_text, reason, wait_s, next_try)
        return wait_s


class BlockingLink:
    """A link that blocks; safe to share between threads."""

    def __init__(self, http: httpx2.Client, sleep: Callable[[float], None]) -> None:
        self.http = http
        self._sleep = sleep

    async def send(self, request: httpx2.Request) -> httpx2.Response:
        return self.http.send(request)

    @asynccontextmanager
    async def stream(self, request: httpx2.Request) -> AsyncIterator[httpx2.Response]:
        with closing(self.http.send(request, stream=True)) as response:
            if not response.is_success:
                response.read()
            yield response

    async def pieces(self, response: httpx2.Response) -> AsyncIterator[bytes]:
        for piece in response.iter_bytes():
            yield piece

    async def events(self, response: httpx2.Response) -> AsyncIterator[httpx2.ServerSentEvent]:
        for event in httpx2.EventSource(response):
            yield event

    async def aside(self, work: Callable[[], T]) -> T:
        return work()

    async def sleep(self, seconds: float) -> None:
        self._sleep(seconds)

    async def close(self) -> None:
        self.http.close()


class AwaitingLink:
    """A link that awaits; work that blocks on the disk runs in a thread."""

    def __init__(self, http: httpx2.AsyncClient, sleep: Callable[[float], Awaitable[None]]) -> None:
        self.http = http
        self.sleep = sleep

    async def send(self, request: httpx2.Request) -> httpx2.Response:
        return await self.http.send(request)

    @asynccontextmanager
    async def stream(self, request: httpx2.Request) -> AsyncIterator[httpx2.Response]:
        async with aclosing(await self.http.send(request, stream=True)) as response:
            if not response.is_success:
                await response.aread()
            yield response

    def pieces(self, response: httpx2.Response) -> AsyncIterator[bytes]:
        return response.aiter_bytes()

    def events(self, response: httpx2.Response) -> AsyncIterator[httpx2.ServerSentEvent]:
        return aiter(httpx2.EventSource(response))

    async def aside(self, work: Callable[[], T]) -> T:
        return await asyncio.to_thread(work)

    async def close(self) -> None:
        await self.http.aclose()


class Wire:
    """Sends calls over a link; `request_id` names every request that is sent (None: the service names them)."""

    def __init__(
        self,
        link: BlockingLink | AwaitingLink,
        retry: RetryPolicy | None,
        request_id: Callable[[], str] | None,
        jitter: Callable[[], float],
    ) -> None:
        self.link = link
        self.url = str(link.http.base_url).rstrip("/")
        self._retry = retry or RetryPolicy()
        self._request_id = request_id
        self._jitter = jitter
        self._has_answered = False

    def attempts(self, call: Call) -> Attempts:
        """The tries of a call, none of them made yet."""
        n_tries = self._retry.attempts if self._has_answered else min(self._retry.attempts, self._retry.first_attempts)
        return Attempts(
            replace(self._retry, attempts=n_tries),
            call.repeat,
            f"{call} at {self.url}{_by_proxy(self.url)}",
            self._jitter,
        )

    def request(self, call: Call) -> httpx2.Request:
        """A call as an HTTP request; raises InvalidArgumentError (the caller's id cannot name it)."""
        headers = dict(call.headers)
        if self._request_id is not None:
            headers[REQUEST_ID] = self._request_id()
            if _REQUEST_ID.fullmatch(headers[REQUEST_ID]) is None:
                raise InvalidArgumentError(
                    f"{headers[REQUEST_ID]!r} cannot name a request: use 1 to 64 letters, digits, '.', '_' and '-'"
                )
        values = {name: of_python(value) for name, value in call.params.items() if value is not None}
        params = {
            name: str(value) if isinstance(value, str | float | int) else list(value) for name, value in values.items()
        }
        return self.link.http.build_request(
            call.method, call.path, params=params or None, headers=headers, content=call.body
        )

    async def send(self, call: Call) -> httpx2.Response:
        """Send a call until it is answered or hopeless; raises TransportError, ApiError, UnexpectedAnswerError."""
        attempts = self.attempts(call)
        while True:
            try:
                response = await self.link.send(self.request(call))
            except httpx2.RequestError as error:
                wait_s: float | None = attempts.after_failure(error)
            else:
                self._has_answered = True
                wait_s = attempts.after_answer(response)
            if wait_s is None:
                if not (response.status_code in {404, 410} and call.gone_is_done and attempts.answer_lost):
                    raise_for_problem(response)
                return response
            await self.link.sleep(wait_s)

    async def model(self, kind: type[Model], call: Call) -> Model:
        """Send a call and return its answer as a model; raises as `send`."""
        return model_of(kind, await self.send(call))

    async def model_list(self, kind: type[Model], key: str, path: str, **params: str | None) -> tuple[Model, ...]:
        """Every entry of a list, fetched page after page; raises as `send`."""
        entries: list[Model] = []
        cursor = None
        while True:
            call = Call("GET", path, {**params, "limit": PAGE_LENGTH, "after": cursor})
            models, cursor = page_of(kind, key, await self.send(call))
            entries += models
            if cursor is None:
                return tuple(entries)

    async def events(self, call: Call) -> AsyncGenerator[httpx2.ServerSentEvent, None]:
        """Yield the events of a stream over one connection; raises TransportError (it broke off or ended), ApiError."""
        request_text = f"{call} at {self.url}"
        try:
            async with self.link.stream(self.request(call)) as response:
                raise_for_problem(response)
                async for event in self.link.events(response):
                    yield event
                raise TransportError(
                    f"{request_text} ended before all was told: the service stops, or the key was revoked"
                )
        except httpx2.TimeoutException as error:
            raise TransportTimeoutError(f"{request_text} fell silent: {error or type(error).__name__}") from error
        except httpx2.RequestError as error:
            raise TransportError(f"{request_text} broke off: {error or type(error).__name__}") from error


def run_to_end(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine that never suspends to its end."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        value: T = end.value
        return value
    raise RuntimeError(f"{coroutine} waits for something on a blocking link")


class Face:
    """A class of calls over one wire.

    Its blocking and its awaiting class have the same calls, which are written once in their common base.
    """

    def __init__(self, wire: Wire) -> None:
        self._wire = wire

    async def _leave(self, _error: BaseException | None, /) -> None:
        """Leave the `with` block, which `_error` ended if it is not None."""


class Blocking(Face):
    """A face whose calls block until they are answered."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        run_to_end(self._leave(error))


class Awaiting(Face):
    """A face whose calls are awaited."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self._leave(error)


class Shared(Generic[P, Blocked, Awaited]):
    """A call as two functions: a `Blocking` class shows the blocking one, every other class the awaiting one.

    So a call of the common base, such as `AdminCalls.maps(self, domain)`, can be awaited whatever the face.
    """

    def __init__(self, blocking: Any, awaiting: Any) -> None:
        self._blocking: Any = wraps(awaiting)(blocking)
        self._awaiting = awaiting

    @overload
    def __get__(self, face: Blocking, owner: type[Face]) -> Callable[P, Blocked]: ...
    @overload
    def __get__(self, face: Awaiting, owner: type[Face]) -> Callable[P, Awaited]: ...
    @overload
    def __get__(self, face: None, owner: type[Face]) -> Callable[..., Any]: ...
    def __get__(self, face: Face | None, owner: type[Face]) -> Any:
        function = self._blocking if issubclass(owner, Blocking) else self._awaiting
        return function if face is None else function.__get__(face, owner)


def shared(awaiting: Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]) -> Shared[P, T, Coroutine[Any, Any, T]]:
    """Make a plain method of a `Blocking` class and a coroutine method of an `Awaiting` one."""
    return Shared(lambda *args, **kwargs: run_to_end(awaiting(*args, **kwargs)), awaiting)


def shared_stream(
    awaiting: Callable[Concatenate[Any, P], AsyncGenerator[T, None]],
) -> Shared[P, Iterator[T], AsyncIterator[T]]:
    """Make a method that gives an iterator in a `Blocking` class and an async iterator in an `Awaiting` one."""

    def blocking(*args: Any, **kwargs: Any) -> Iterator[T]:
        items = awaiting(*args, **kwargs)
        try:
            while True:
                yield run_to_end(items.__anext__())
        except StopAsyncIteration:
            return
        finally:
            run_to_end(items.aclose())

    return Shared(blocking, awaiting)
