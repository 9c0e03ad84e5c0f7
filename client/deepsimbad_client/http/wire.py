"""How calls are sent until they are answered: written once, for the blocking and the async client alike.

The clients and all that is here are written as coroutines over a `Link`, the few things that differ between blocking
and awaiting. A `BlockingLink` never suspends, so `finished` runs such a coroutine to its end in place; `shared` and
`shared_stream` do that to the calls of a `Blocking` client and leave them to be awaited on an `Awaiting` one.
"""
# ruff: noqa: D102 - the methods of both links are described by `Link`

import asyncio
import os
import re
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Coroutine, Iterator
from contextlib import AbstractAsyncContextManager, aclosing, asynccontextmanager, closing
from functools import wraps
from types import TracebackType
from typing import Any, Concatenate, Generic, ParamSpec, Protocol, Self, TypeVar, overload

import httpx2

from deepsimbad_client.errors import InvalidArgumentError, TransportError, TransportTimeoutError
from deepsimbad_client.http.call import REQUEST_ID, Call, Model, page_of, raise_for_problem
from deepsimbad_client.http.retry import Attempts, RetryPolicy

P = ParamSpec("P")
T = TypeVar("T")
Blocked = TypeVar("Blocked")
Awaited = TypeVar("Awaited")

URL_VARIABLE = "DEEPSIMBAD_URL"
KEY_VARIABLE = "DEEPSIMBAD_API_KEY"
DEFAULT_URL = "http://127.0.0.1:8000"
THIN_LINK_TIMEOUT = httpx2.Timeout(connect=10.0, read=60.0, write=60.0, pool=120.0)
"""Generous where bytes move slowly, short where nobody is there: read and write count from the last byte moved."""
PAGE_LENGTH = 200  # Worth its round trip, and soon there on a thin link
_CONNECTIONS = httpx2.Limits(max_connections=64, max_keepalive_connections=32, keepalive_expiry=30.0)
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")


def speaking_to(url: str | None, api_key: str | None, timeout: httpx2.Timeout) -> dict[str, Any]:
    """What an httpx2 client is made with; absent address and key are those of the environment.

    Raises InvalidArgumentError: it is no http(s) address, or no header can carry the key.
    """
    url = (url or os.environ.get(URL_VARIABLE) or DEFAULT_URL).rstrip("/")
    try:
        parsed = httpx2.URL(url)
    except httpx2.InvalidURL as error:
        raise InvalidArgumentError(f"{url!r} is no address: {error}") from error
    if parsed.scheme not in {"http", "https"} or not parsed.host:
        raise InvalidArgumentError(f"{url!r} is no address: give something like {DEFAULT_URL}")
    headers = {"User-Agent": "deepsimbad-client", "Accept": "application/json"}
    if key := os.environ.get(KEY_VARIABLE) if api_key is None else api_key:
        if not (key.isascii() and key.isprintable()):
            raise InvalidArgumentError("the API key holds characters that no header can carry")
        headers["Authorization"] = f"Bearer {key}"
    return {"base_url": url, "headers": headers, "timeout": timeout, "limits": _CONNECTIONS}


class Link(Protocol):
    """What differs between blocking and awaiting."""

    @property
    def http(self) -> httpx2.Client | httpx2.AsyncClient:
        """What sends."""

    async def send(self, request: httpx2.Request) -> httpx2.Response:
        """Send once and read the answer."""

    def stream(self, request: httpx2.Request) -> AbstractAsyncContextManager[httpx2.Response]:
        """Send once; of a refusal the whole answer is read, of another the content is still to come."""

    def pieces(self, response: httpx2.Response) -> AsyncIterator[bytes]:
        """The content of a streamed answer, as it comes."""

    def events(self, response: httpx2.Response) -> AsyncIterator[httpx2.ServerSentEvent]:
        """The events of a streamed answer, as they come."""

    async def aside(self, work: Callable[[], T]) -> T:
        """Do what takes the processor or the disk a while, where nothing else waits for it."""

    async def sleep(self, seconds: float) -> None:
        """Wait."""

    async def close(self) -> None:
        """Close the connections."""


class BlockingLink:
    """Blocks; safe to share between threads."""

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
    """Awaits."""

    def __init__(self, http: httpx2.AsyncClient, sleep: Callable[[float], Awaitable[None]]) -> None:
        self.http = http
        self._sleep = sleep

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

    async def sleep(self, seconds: float) -> None:
        await self._sleep(seconds)

    async def close(self) -> None:
        await self.http.aclose()


class Wire:
    """Sends calls over a link; connections are reused.

    Args:
        link: Blocking or awaiting.
        retry: How patient.
        request_id: Names every request that is sent; None: the service names them.
        jitter: Draws in 0..1.
    """

    def __init__(
        self, link: Link, retry: RetryPolicy, request_id: Callable[[], str] | None, jitter: Callable[[], float]
    ) -> None:
        self.link = link
        self.url = str(link.http.base_url).rstrip("/")
        self._retry = retry
        self._request_id = request_id
        self._jitter = jitter

    def attempts(self, call: Call) -> Attempts:
        """The tries of a call, none of them made yet."""
        return Attempts(self._retry, call.repeat, f"{call} at {self.url}", self._jitter)

    def request(self, call: Call) -> httpx2.Request:
        """A call as an HTTP request, under an id of the caller's where he gives them; raises InvalidArgumentError."""
        headers = dict(call.headers)
        if self._request_id is not None:
            headers[REQUEST_ID] = self._request_id()
            if _REQUEST_ID.fullmatch(headers[REQUEST_ID]) is None:
                raise InvalidArgumentError(
                    f"{headers[REQUEST_ID]!r} cannot name a request: use 1 to 64 letters, digits, '.', '_' and '-'"
                )
        params = {name: str(value) for name, value in call.params.items() if value is not None}
        return self.link.http.build_request(
            call.method, call.path, params=params or None, headers=headers, content=call.body
        )

    async def send(self, call: Call) -> httpx2.Response:
        """Send a call until it is answered or hopeless. Raises TransportError, ApiError, UnexpectedAnswerError."""
        attempts = self.attempts(call)
        while True:
            try:
                response = await self.link.send(self.request(call))
            except httpx2.TransportError as error:
                wait_s: float | None = attempts.after_failure(error)
            else:
                wait_s = attempts.after_answer(response)
            if wait_s is None:
                if not (response.status_code in {404, 410} and call.gone_is_done and attempts.answer_lost):
                    raise_for_problem(response)
                return response
            await self.link.sleep(wait_s)

    async def pages(self, kind: type[Model], key: str, path: str, **params: str | None) -> AsyncGenerator[Model, None]:
        """Yield every entry of a list; a page is fetched when its first entry is wanted."""
        after = None
        while True:
            call = Call("GET", path, {**params, "limit": PAGE_LENGTH, "after": after})
            models, after = page_of(kind, key, await self.send(call))
            for model in models:
                yield model
            if after is None:
                return

    async def events(self, call: Call) -> AsyncGenerator[httpx2.ServerSentEvent, None]:
        """Yield the events of a stream, listened to once. Raises TransportError, ApiError."""
        what = f"{call} at {self.url}"
        try:
            async with self.link.stream(self.request(call)) as response:
                raise_for_problem(response)
                async for event in self.link.events(response):
                    yield event
        except httpx2.TimeoutException as error:
            raise TransportTimeoutError(f"{what} fell silent: {error or type(error).__name__}") from error
        except httpx2.TransportError as error:
            raise TransportError(f"{what} broke off: {error or type(error).__name__}") from error


def finished(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine that never suspends to its end."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        result: T = end.value
        return result
    raise RuntimeError(f"{coroutine} waits for something on a blocking link")


class Face:
    """What calls are sent through.

    Blocking and awaiting classes have the same calls, which are written once in a class beside them.
    """

    def __init__(self, wire: Wire) -> None:
        self._wire = wire

    async def _leave(self, _error: BaseException | None, /) -> None:
        """What the end of a `with` block does."""


class Blocking(Face):
    """Its calls block until they are answered."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        finished(self._leave(error))


class Awaiting(Face):
    """Its calls are awaited."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self._leave(error)


class Shared(Generic[P, Blocked, Awaited]):
    """A call as two functions, of which a `Blocking` class shows the one and every other class the other.

    So `AdminCalls.maps(self, domain)`, in the class that holds a call, can be awaited whatever the face.
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


def shared(
    awaiting: Callable[Concatenate[Any, P], Coroutine[Any, Any, T]],
) -> Shared[P, T, Coroutine[Any, Any, T]]:
    """Make a plain method of a `Blocking` class and a coroutine method of an `Awaiting` one."""
    return Shared(lambda *args, **kwargs: finished(awaiting(*args, **kwargs)), awaiting)


def shared_stream(
    awaiting: Callable[Concatenate[Any, P], AsyncGenerator[T, None]],
) -> Shared[P, Iterator[T], AsyncIterator[T]]:
    """Make a method that gives an iterator in a `Blocking` class and an async iterator in an `Awaiting` one."""

    def blocking(*args: Any, **kwargs: Any) -> Iterator[T]:
        items = awaiting(*args, **kwargs)
        try:
            while True:
                yield finished(items.__anext__())
        except StopAsyncIteration:
            return
        finally:
            finished(items.aclose())

    return Shared(blocking, awaiting)
