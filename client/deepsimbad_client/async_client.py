"""The async client."""

import asyncio
import random
from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

import httpx2

from deepsimbad_client import calls, session_calls
from deepsimbad_client.async_admin import AsyncAdmin
from deepsimbad_client.async_session import AsyncSession
from deepsimbad_client.models import Domain, Health, Localization, TruthScore
from deepsimbad_client.observation import Image, Numbers, Observation, observation
from deepsimbad_client.retry import RetryPolicy
from deepsimbad_client.transport import THIN_LINK_TIMEOUT, AsyncTransport, Endpoint

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from deepsimbad_client.on_board import OnBoardEncoder


class AsyncClient:
    """The awaiting twin of `deepsimbad_client.Client`, which describes every argument and call.

    Attributes:
        admin: The calls that need a key of scope `admin`.
    """

    def __init__(
        self,
        url: str | None = None,
        api_key: str | None = None,
        *,
        timeout: httpx2.Timeout = THIN_LINK_TIMEOUT,
        retry: RetryPolicy | None = None,
        request_id: Callable[[], str] | None = None,
        transport: httpx2.AsyncBaseTransport | None = None,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
        jitter: Callable[[], float] = random.random,
    ) -> None:
        endpoint = Endpoint(url, api_key, timeout, retry or RetryPolicy(), request_id)
        self._transport = AsyncTransport(endpoint, transport=transport, sleep=sleep, jitter=jitter)
        self.admin = AsyncAdmin(self._transport)

    @property
    def url(self) -> str:
        """The service's address."""
        return self._transport.url

    async def health(self) -> Health:
        """Whether the process is alive."""
        return await self._transport.send(calls.health())

    async def ready(self) -> Health:
        """Whether it can answer now."""
        return await self._transport.send(calls.ready())

    async def metrics(self) -> str:
        """What the service counts, in Prometheus' text format."""
        return await self._transport.send(calls.metrics())

    async def domains(self) -> tuple[Domain, ...]:
        """Every domain."""
        return await self._transport.send(calls.domains())

    async def domain(self, name: str) -> Domain:
        """One domain and its active map."""
        return await self._transport.send(calls.domain(name))

    async def on_board(self, domain: str, *, map_version: int | None = None) -> "OnBoardEncoder":
        """Fetch a map's landmarks once, to rank them here and send a few bytes a view (needs `deep-simbad[edge]`)."""
        return await self._transport.send(calls.landmark_model(domain, map_version))

    async def localize(
        self,
        domain: str,
        image: Image | None = None,
        *,
        content_type: str | None = None,
        ranked_landmarks: Numbers | None = None,
        dissimilarities: Numbers | None = None,
        encoding: Numbers | None = None,
        ranked: Observation | None = None,
        shortlist: int | None = None,
    ) -> Localization:
        """Where one view probably is; give exactly one form of it."""
        seen = observation(
            image,
            content_type=content_type,
            ranked_landmarks=ranked_landmarks,
            dissimilarities=dissimilarities,
            encoding=encoding,
            ranked=ranked,
        )
        return await self._transport.send(calls.localize(domain, seen, shortlist=shortlist))

    async def relevances(
        self,
        domain: str,
        image: Image | None = None,
        *,
        content_type: str | None = None,
        ranked_landmarks: Numbers | None = None,
        dissimilarities: Numbers | None = None,
        encoding: Numbers | None = None,
        ranked: Observation | None = None,
    ) -> "NDArray[np.float32]":
        """How well every map image answers one view: [n] float32, larger is better (needs numpy)."""
        seen = observation(
            image,
            content_type=content_type,
            ranked_landmarks=ranked_landmarks,
            dissimilarities=dissimilarities,
            encoding=encoding,
            ranked=ranked,
        )
        return await self._transport.send(calls.relevances(domain, seen))

    async def session(
        self,
        domain: str,
        start_position_m: float | None = None,
        start_std_m: float | None = None,
        *,
        seed: int | None = None,
        planner: str | None = None,
        belief: str | None = None,
        update: str | None = None,
        keep: bool = False,
        idempotency_key: str | None = None,
    ) -> AsyncSession:
        """Begin a session; use it as `async with await client.session(...) as session`."""
        call = session_calls.start(
            domain,
            start_position_m=start_position_m,
            start_std_m=start_std_m,
            seed=seed,
            planner=planner,
            belief=belief,
            update=update,
            idempotency_key=idempotency_key,
        )
        return AsyncSession(self._transport, await self._transport.send(call), keep=keep)

    async def attach_session(self, session_id: str, *, keep: bool = True) -> AsyncSession:
        """Find a session again that was kept."""
        return AsyncSession(self._transport, await self._transport.send(session_calls.state(session_id)), keep=keep)

    async def truths(self, session_id: str, true_positions_m: Numbers) -> TruthScore:
        """Tell where a session's robot truly was; the session may have ended a while ago."""
        return await self._transport.send(session_calls.truths(session_id, true_positions_m))

    async def aclose(self) -> None:
        """Close the connections; the client cannot be used afterwards."""
        await self._transport.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.aclose()
