"""Where the service is, and the two loops, blocking and async, that send a call until it is answered."""

import asyncio
import os
import random
import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import httpx2

from deepsimbad_client.answers import REQUEST_ID, raise_for_problem
from deepsimbad_client.call import Call
from deepsimbad_client.errors import InvalidArgumentError, TransportError, TransportTimeoutError
from deepsimbad_client.map_download import BEYOND_THE_END, MapDownload
from deepsimbad_client.retry import Attempts, RetryPolicy

T = TypeVar("T")

_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")

URL_VARIABLE = "DEEPSIMBAD_URL"
KEY_VARIABLE = "DEEPSIMBAD_API_KEY"
DEFAULT_URL = "http://127.0.0.1:8000"
USER_AGENT = "deepsimbad-client"

THIN_LINK_TIMEOUT = httpx2.Timeout(connect=10.0, read=60.0, write=60.0, pool=120.0)
"""Generous where bytes move slowly, short where nobody is there: read and write count from the last byte moved."""
CONNECTIONS = httpx2.Limits(max_connections=64, max_keepalive_connections=32, keepalive_expiry=30.0)


@dataclass(frozen=True)
class Endpoint:
    """Where the service is and how to speak to it.

    Attributes:
        url: Its address; absent: `$DEEPSIMBAD_URL`, else the loopback default.
        api_key: Sent as a bearer token; absent: `$DEEPSIMBAD_API_KEY`, else none is sent. It is not shown in repr.
        timeout: httpx2's four timeouts.
        retry: How patient.
        request_id: Names every request that is sent; None: the service names them.
    """

    url: str | None = None
    api_key: str | None = field(default=None, repr=False)
    timeout: httpx2.Timeout = field(default_factory=lambda: THIN_LINK_TIMEOUT)
    retry: RetryPolicy = field(default_factory=RetryPolicy)
    request_id: Callable[[], str] | None = None

    def base_url(self) -> str:
        """The address in use.

        Raises:
            InvalidArgumentError: It is not an http(s) address.
        """
        url = (self.url or os.environ.get(URL_VARIABLE) or DEFAULT_URL).rstrip("/")
        try:
            parsed = httpx2.URL(url)
        except httpx2.InvalidURL as error:
            raise InvalidArgumentError(f"{url!r} is no address: {error}") from error
        if parsed.scheme not in {"http", "https"} or not parsed.host:
            raise InvalidArgumentError(f"{url!r} is no address: give something like {DEFAULT_URL}")
        return url

    def headers(self) -> dict[str, str]:
        """What every request carries."""
        headers = {"User-Agent": USER_AGENT, "Accept": "application/json"}
        key = self.api_key if self.api_key is not None else os.environ.get(KEY_VARIABLE)
        if key:
            if not (key.isascii() and key.isprintable()):
                raise InvalidArgumentError("the API key holds characters that no header can carry")
            headers["Authorization"] = f"Bearer {key}"
        return headers


def request_of(
    http: httpx2.Client | httpx2.AsyncClient, request_id: Callable[[], str] | None, call: Call[Any]
) -> httpx2.Request:
    """A call as an HTTP request, under an id of the caller's where he gives them.

    Raises:
        InvalidArgumentError: The service would not take that id.
    """
    headers = dict(call.headers)
    if request_id is not None:
        headers[REQUEST_ID] = request_id()
        if _REQUEST_ID.fullmatch(headers[REQUEST_ID]) is None:
            raise InvalidArgumentError(
                f"{headers[REQUEST_ID]!r} cannot name a request: use 1 to 64 letters, digits, '.', '_' and '-'"
            )
    return http.build_request(call.method, call.path, params=call.params or None, headers=headers, content=call.body)


def read(call: Call[T], response: httpx2.Response, attempts: Attempts) -> T:
    """The last word of a call: its parsed answer.

    Raises:
        ApiError: The service refused.
        UnexpectedAnswerError: Something else answers at this address.
    """
    if not (response.status_code in {404, 410} and call.gone_is_done and attempts.answer_lost):
        raise_for_problem(response)
    return call.parse(response)


class Transport:
    """Sends calls and blocks; safe to share between threads, connections are reused."""

    def __init__(
        self,
        endpoint: Endpoint,
        *,
        transport: httpx2.BaseTransport | None = None,
        sleep: Callable[[float], None] = time.sleep,
        jitter: Callable[[], float] = random.random,
    ) -> None:
        self.url = endpoint.base_url()
        self._retry = endpoint.retry
        self._sleep = sleep
        self._jitter = jitter
        self._http = httpx2.Client(
            base_url=self.url,
            headers=endpoint.headers(),
            timeout=endpoint.timeout,
            limits=CONNECTIONS,
            transport=transport,
        )
        self._request_of = partial(request_of, self._http, endpoint.request_id)

    def send(self, call: Call[T]) -> T:
        """Send a call until it is answered or hopeless.

        Raises:
            TransportError: No answer came.
            ApiError: The service refused.
            UnexpectedAnswerError: Something else answers at this address.
        """
        attempts = self._attempts(call)
        while True:
            try:
                response = self._http.send(self._request_of(call))
            except httpx2.TransportError as error:
                wait_s = attempts.after_failure(error)
            else:
                again_s = attempts.after_answer(response)
                if again_s is None:
                    return read(call, response, attempts)
                wait_s = again_s
            self._sleep(wait_s)

    @contextmanager
    def stream(self, call: Call[None]) -> Iterator[Iterator[httpx2.ServerSentEvent]]:
        """Listen to a stream of events, once.

        Raises:
            TransportError: The connection failed or broke off.
            ApiError: The service refused.
        """
        with _broken_streams(f"{call} at {self.url}"):
            response = self._http.send(self._request_of(call), stream=True)
            try:
                if not response.is_success:
                    response.read()
                    raise_for_problem(response)
                yield iter(httpx2.EventSource(response))
            finally:
                response.close()

    def fetch(self, download: MapDownload) -> None:
        """Receive a file until all of it is there; after a break it goes on where it stopped.

        As long as something comes every now and then it never gives up.

        Raises:
            TransportError: No answer came.
            ApiError: The service refused.
            UnexpectedAnswerError: Something else answers at this address.
            NotSavedError: The file cannot be written.
        """
        attempts = self._attempts(download.call)
        while True:
            n_received = download.n_received
            try:
                wait_s = self._received(download, attempts)
            except httpx2.TransportError as error:
                if download.n_received > n_received:
                    attempts = self._attempts(download.call)
                wait_s = attempts.after_failure(error)
            finally:
                download.pause()
            if wait_s is None:
                return
            self._sleep(wait_s)

    def _received(self, download: MapDownload, attempts: Attempts) -> float | None:
        """Receive what comes; answers how long to wait before asking for more, None where nothing is missing."""
        response = self._http.send(self._request_of(download.asking()), stream=True)
        try:
            if download.begin(response):
                for piece in response.iter_bytes():
                    download.write(piece)
                return None
            response.read()
            if response.status_code == BEYOND_THE_END and download.start_over():
                return 0.0
            wait_s = attempts.after_answer(response)
            if wait_s is None:
                raise_for_problem(response)
            return wait_s
        finally:
            response.close()

    def _attempts(self, call: Call[Any]) -> Attempts:
        return Attempts(self._retry, call.repeat, f"{call} at {self.url}", self._jitter)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()


class AsyncTransport:
    """Sends calls and awaits; connections are reused."""

    def __init__(
        self,
        endpoint: Endpoint,
        *,
        transport: httpx2.AsyncBaseTransport | None = None,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
        jitter: Callable[[], float] = random.random,
    ) -> None:
        self.url = endpoint.base_url()
        self._retry = endpoint.retry
        self._sleep = sleep
        self._jitter = jitter
        self._http = httpx2.AsyncClient(
            base_url=self.url,
            headers=endpoint.headers(),
            timeout=endpoint.timeout,
            limits=CONNECTIONS,
            transport=transport,
        )
        self._request_of = partial(request_of, self._http, endpoint.request_id)

    async def send(self, call: Call[T]) -> T:
        """See `Transport.send`."""
        attempts = self._attempts(call)
        while True:
            try:
                response = await self._http.send(self._request_of(call))
            except httpx2.TransportError as error:
                wait_s = attempts.after_failure(error)
            else:
                again_s = attempts.after_answer(response)
                if again_s is None:
                    return read(call, response, attempts)
                wait_s = again_s
            await self._sleep(wait_s)

    @asynccontextmanager
    async def stream(self, call: Call[None]) -> AsyncIterator[AsyncIterator[httpx2.ServerSentEvent]]:
        """See `Transport.stream`."""
        with _broken_streams(f"{call} at {self.url}"):
            response = await self._http.send(self._request_of(call), stream=True)
            try:
                if not response.is_success:
                    await response.aread()
                    raise_for_problem(response)
                yield aiter(httpx2.EventSource(response))
            finally:
                await response.aclose()

    async def fetch(self, download: MapDownload) -> None:
        """See `Transport.fetch`."""
        attempts = self._attempts(download.call)
        while True:
            n_received = download.n_received
            try:
                wait_s = await self._received(download, attempts)
            except httpx2.TransportError as error:
                if download.n_received > n_received:
                    attempts = self._attempts(download.call)
                wait_s = attempts.after_failure(error)
            finally:
                download.pause()
            if wait_s is None:
                return
            await self._sleep(wait_s)

    async def _received(self, download: MapDownload, attempts: Attempts) -> float | None:
        """Receive what comes; answers how long to wait before asking for more, None where nothing is missing."""
        response = await self._http.send(self._request_of(download.asking()), stream=True)
        try:
            if await asyncio.to_thread(download.begin, response):
                async for piece in response.aiter_bytes():
                    download.write(piece)
                return None
            await response.aread()
            if response.status_code == BEYOND_THE_END and download.start_over():
                return 0.0
            wait_s = attempts.after_answer(response)
            if wait_s is None:
                raise_for_problem(response)
            return wait_s
        finally:
            await response.aclose()

    def _attempts(self, call: Call[Any]) -> Attempts:
        return Attempts(self._retry, call.repeat, f"{call} at {self.url}", self._jitter)

    async def aclose(self) -> None:
        """Close the connections."""
        await self._http.aclose()


@contextmanager
def _broken_streams(what: str) -> Iterator[None]:
    try:
        yield
    except httpx2.TimeoutException as error:
        raise TransportTimeoutError(f"{what} fell silent: {error or type(error).__name__}") from error
    except httpx2.TransportError as error:
        raise TransportError(f"{what} broke off: {error or type(error).__name__}") from error
