"""A robot's calls for domains, places and sessions, on the blocking and the async client."""

import asyncio
import math
import random
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from contextlib import aclosing
from typing import TYPE_CHECKING, Any, Generic, TypedDict, TypeVar, Unpack

import httpx2

from deepsimbad_client.errors import DeepSimbadClientError, GoneError, InvalidArgumentError
from deepsimbad_client.http import (
    BINARY,
    Call,
    Image,
    Numbers,
    Repeat,
    ViewForm,
    domain_path,
    float_array,
    idempotency_header,
    known_positions,
    model_of,
    observation,
    session_path,
)
from deepsimbad_client.http.admin import Admin, AsyncAdmin
from deepsimbad_client.http.models import (
    Coverage,
    Domain,
    Health,
    Landmarks,
    Localization,
    NextBestView,
    SessionAnswer,
    SessionState,
    TruthScore,
    Whereabouts,
)
from deepsimbad_client.http.wire import (
    THIN_LINK_TIMEOUT,
    Awaiting,
    AwaitingLink,
    Blocking,
    BlockingLink,
    Face,
    RetryPolicy,
    Wire,
    http_settings,
    run_to_end,
    shared,
    shared_stream,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from deepsimbad_client.http.on_board import OnBoardEncoder

AnySession = TypeVar("AnySession", bound="SessionCalls")


class SessionOptions(TypedDict, total=False):
    """The options of a session; one that is absent or None is left to the service's default."""

    seed: int | None  # of all that is drawn at random
    planner: str | None  # who chooses the next view: informed, nnql, random, constant:3, ...
    belief: str | None  # particle or grid
    update: str | None  # how a view changes the belief
    confidence: float | None  # mass within 5 m of the likeliest place from which on the robot may stop
    price_bits_per_m: float | None  # what a metre costs `informed`; other planners refuse it


class SessionCalls(Face):
    """The calls of a session: `opened` is its state when it was opened, `keep` whether it outlives its `with` block."""

    def __init__(self, wire: Wire, state: SessionState, *, keep: bool) -> None:
        super().__init__(wire)
        self.opened = state
        self.keep = keep
        self._path = session_path(state.session_id)
        self._is_deleted = False

    @property
    def session_id(self) -> str:
        """The id by which `Client.attach_session` finds the session again, from this process or another."""
        return self.opened.session_id

    @property
    def domain(self) -> str:
        """The session's domain."""
        return self.opened.domain

    @property
    def map_version(self) -> int:
        """The version of the map that the session began on and keeps, whatever is activated later."""
        return self.opened.map_version

    @shared
    async def observe(
        self,
        image: Image | None = None,
        *,
        action_m: float | None = None,
        action_std_m: float | None = None,
        shortlist: int | None = None,
        brief: bool = False,
        idempotency_key: str | None = None,
        **view: Unpack[ViewForm],
    ) -> SessionAnswer:
        """Send what the robot sees now, after the metres it has moved; give exactly one form of the view.

        The forms of a view, `shortlist` and `brief` are those of `Client.localize`. `action_m` are the metres
        really moved since the last view (absent: stood still; ignored for the first view), `action_std_m` how well
        they are known (absent: the service's usual odometry). A lost answer is asked for again and counts once.
        To repeat an observation yourself after a `TransportError`, choose its `idempotency_key`, and send the
        same again under it. Raises InvalidMoveError, LandmarkModelDiffersError, InvalidInputError, GoneError.
        """
        body = observation(image, **view)
        move = {"action_m": action_m, "action_std_m": action_std_m}
        for name, value in move.items():
            if value is not None and not math.isfinite(value):
                raise InvalidArgumentError(f"{name} is {value}: give metres, or nothing when the robot stood still")
        call = Call(
            "POST",
            f"{self._path}/observations",
            params={name: None if value is None else float(value) for name, value in move.items()}
            | {"shortlist": shortlist, "brief": "true" if brief else None},
            headers=body.headers | idempotency_header(idempotency_key),
            body=body.body,
        )
        return await self._wire.model(SessionAnswer, call)

    @shared
    async def state(self) -> SessionState:
        """The session's present belief, and how many views it rests on."""
        return await self._wire.model(SessionState, Call("GET", self._path))

    @shared
    async def belief_masses(self) -> "NDArray[np.float32]":
        """The whole belief: [n] float32 over the map images, sums to 1 (needs numpy)."""
        return float_array(await self._wire.send(Call("GET", f"{self._path}/belief", headers=BINARY)))

    @shared
    async def next_best_view(self) -> NextBestView | None:
        """The most informative next move, without sending another view; None where the map can name none."""
        response = await self._wire.send(Call("GET", f"{self._path}/next-best-view"))
        return None if response.content.strip() == b"null" else model_of(NextBestView, response)

    @shared_stream
    async def events(self, after: int | None = None) -> AsyncGenerator[SessionAnswer, None]:
        """Yield the answer to every observation until the session ends, over one connection that is not renewed.

        Begins with the latest answer, or behind event `after`; 0: with the first. Raises TransportError (the
        connection failed or broke off).
        """
        call = Call(
            "GET", f"{self._path}/events", {"after": after}, {"Accept": "text/event-stream"}, repeat=Repeat.NEVER
        )
        async with aclosing(self._wire.events(call)) as events:
            async for event in events:
                if event.event == "observation":
                    yield SessionAnswer.model_validate_json(event.data)
                elif event.event == "done":
                    return

    @shared
    async def view(self) -> bytes | None:
        """The robot's last view as a small JPEG; None where the service no longer holds it."""
        return (await self._wire.send(Call("GET", f"{self._path}/view"))).content or None

    @shared
    async def set_prior(self, position_m: float, std_m: float) -> SessionState:
        """Replace the belief by one around a position: the robot was carried, or got a fix.

        Raises InvalidPriorError (the position is far off the route, or the deviation cannot be one).
        """
        prior = {"position_m": float(position_m), "std_m": float(std_m)}
        return await self._wire.model(SessionState, Call.with_json("PUT", f"{self._path}/prior", prior))

    @shared
    async def truths(
        self,
        true_positions_m: Numbers,
        *,
        true_map_images: Sequence[Sequence[int]] | None = None,
        first_observation: int = 0,
    ) -> TruthScore:
        """Tell where the robot truly was at each of its observations, known only afterwards: how good were the answers?

        The service raises its alarm by this; the map learns nothing from it (`Admin.feed_experience`). The same truths
        again count once.

        `true_positions_m` are positions along the map's route, one for each observation in order, None where unknown.
        `true_map_images` are, for each of the same observations, the map images that show its place: the
        answer's `retrieval_ranks` then tell where each view by itself placed the best of them. Truths may be
        sent bit by bit, from `first_observation` on. Raises InvalidInputError (not one position per observation).
        """
        images = None if true_map_images is None else [[int(image) for image in images] for images in true_map_images]
        fields = {"true_map_images": images, "first_observation": first_observation or None}
        return await _truths(self._wire, self._path, true_positions_m, **fields)

    @shared
    async def delete(self) -> None:
        """End the session; nothing more can be asked of it."""
        await self._wire.send(Call.delete(self._path))
        self._is_deleted = True

    async def _leave(self, error: BaseException | None, /) -> None:
        if self.keep or self._is_deleted:
            return
        try:
            await SessionCalls.delete(self)
        except GoneError:
            pass  # it has expired, which is as good
        except DeepSimbadClientError:
            if error is None:  # else the block's own error matters more; the session expires by itself
                raise


class Session(SessionCalls, Blocking):
    """One robot's belief, kept by the service and moved on by every observation.

    A context manager: the session ends with the block unless `keep` says otherwise. Views sent by two threads at once
    count in the order of their arrival.
    """


class AsyncSession(SessionCalls, Awaiting):
    """A `Session` whose calls are awaited."""


class ClientCalls(Face, Generic[AnySession]):
    """The calls that need no key of scope `admin`."""

    _session: type[AnySession]

    @property
    def url(self) -> str:
        """The service's address."""
        return self._wire.url

    @shared
    async def health(self) -> Health:
        """Whether the process is alive."""
        return await self._wire.model(Health, Call("GET", "/healthz"))

    @shared
    async def ready(self) -> Health:
        """Whether the service can answer now; asked once. Raises UnavailableError (not yet; its detail says why)."""
        return await self._wire.model(Health, Call("GET", "/readyz", repeat=Repeat.NEVER))

    @shared
    async def metrics(self) -> str:
        """The service's metrics in Prometheus' text format."""
        return (await self._wire.send(Call("GET", "/metrics"))).text

    @shared
    async def domains(self) -> tuple[Domain, ...]:
        """Every domain."""
        return await self._wire.model_list(Domain, "domains", "/v1/domains")

    @shared
    async def domain(self, name: str) -> Domain:
        """One domain and its active map. Raises UnknownDomainError (there is none of that name)."""
        return await self._wire.model(Domain, Call("GET", domain_path(name)))

    @shared
    async def on_board(self, domain: str, *, map_version: int | None = None) -> "OnBoardEncoder":
        """Fetch a map's landmarks once, to rank them here and send a few bytes a view (needs `deep-simbad[edge]`).

        `map_version` is one that a session keeps; absent: the active map. Raises UnknownDomainError,
        NotFoundError, NoActiveMapError, RetiredMapError, MissingExtraError.
        """
        from deepsimbad_client.http.on_board import OnBoardEncoder  # noqa: PLC0415 - needs further packages

        call = Call("GET", f"{domain_path(domain)}/landmark-model", {"map_version": map_version}, BINARY)
        return OnBoardEncoder((await self._wire.send(call)).content)

    @shared
    async def coverage(self, domain: str, *, map_version: int | None = None) -> Coverage:
        """Where on its route a map can be trusted. Raises UnknownDomainError, NoActiveMapError, RetiredMapError."""
        call = Call("GET", f"{domain_path(domain)}/coverage", {"map_version": map_version})
        return await self._wire.model(Coverage, call)

    @shared
    async def landmarks(self, domain: str, *, map_version: int | None = None) -> Landmarks:
        """The frames that a map's landmarks began as. Raises UnknownDomainError, NoActiveMapError, RetiredMapError."""
        call = Call("GET", f"{domain_path(domain)}/landmarks", {"map_version": map_version})
        return await self._wire.model(Landmarks, call)

    @shared
    async def landmark_thumbnail(self, domain: str, landmark: int, *, map_version: int | None = None) -> bytes:
        """A small JPEG of the frame that a landmark began as. Raises NotFoundError (the domain keeps none)."""
        path = f"{domain_path(domain)}/landmarks/{landmark}/thumbnail"
        return (await self._wire.send(Call("GET", path, {"map_version": map_version}))).content

    @shared
    async def thumbnail(self, domain: str, map_image: int, *, map_version: int | None = None) -> bytes:
        """A small JPEG of a map image. Raises NotFoundError (the domain keeps none)."""
        path = f"{domain_path(domain)}/map-images/{map_image}/thumbnail"
        return (await self._wire.send(Call("GET", path, {"map_version": map_version}))).content

    @shared
    async def localize(
        self,
        domain: str,
        image: Image | None = None,
        *,
        shortlist: int | None = None,
        brief: bool = False,
        **view: Unpack[ViewForm],
    ) -> Localization:
        """Where one view probably is; give exactly one form of it.

        `image` is an encoded one (JPEG, PNG, TIFF, WebP), its path or open file, sent as it is, or an array of pixels,
        [height, width, 3] BGR or [height, width] grey, sent as PNG; the other forms are those of
        `ViewForm`. `shortlist` is the length of `retrieval` and `belief.top`; in `brief` these, the histogram and the
        list of moves are empty, for a thin link. Raises UnknownDomainError, NoActiveMapError,
        LandmarkModelDiffersError (`on_board` was made with other landmarks than the map's), InvalidInputError.
        """
        body = observation(image, **view)
        path = f"{domain_path(domain)}/localizations"
        call = Call("POST", path, {"shortlist": shortlist, "brief": "true" if brief else None}, body.headers, body.body)
        return await self._wire.model(Localization, call)

    @shared
    async def localize_anywhere(
        self,
        image: Image | None = None,
        *,
        domains: Sequence[str] | None = None,
        shortlist: int | None = None,
        brief: bool = False,
        in_full: int | None = None,
        **view: Unpack[ViewForm],
    ) -> Whereabouts:
        """On which of many domains one view is, and where on them; its forms and `brief` are those of `localize`.

        `domains` are asked (absent: all that the key opens), all equally probable beforehand; `in_full` is how many of
        the likeliest are answered with their beliefs. Raises UnknownDomainError, ForbiddenError, InvalidInputError,
        LandmarkModelDiffersError (ranks and dissimilarities are of one landmark model), ConflictError (none answers).
        """
        body = observation(image, **view)
        wishes = {"shortlist": shortlist, "brief": "true" if brief else None, "in_full": in_full}
        return await self._wire.model(
            Whereabouts, Call("POST", "/v1/localizations", {"domains": domains, **wishes}, body.headers, body.body)
        )

    @shared
    async def relevances(
        self, domain: str, image: Image | None = None, **view: Unpack[ViewForm]
    ) -> "NDArray[np.float32]":
        """How well every map image answers one view: [n] float32, larger is better (needs numpy).

        Takes the same forms of a view, and raises the same errors, as `localize`.
        """
        body = observation(image, **view)
        path = f"{domain_path(domain)}/localizations"
        return float_array(await self._wire.send(Call("POST", path, headers=body.headers | BINARY, body=body.body)))

    @shared
    async def session(
        self,
        domain: str,
        start_position_m: float | None = None,
        start_std_m: float | None = None,
        *,
        keep: bool = False,
        idempotency_key: str | None = None,
        **options: Unpack[SessionOptions],
    ) -> AnySession:
        """Begin a session: the service keeps this robot's belief from view to view.

        Use it as `with client.session(...) as session`, or `async with await client.session(...) as session`. A lost
        answer is asked for again and begins no second session.

        `start_position_m` is about where it starts along the route (absent: anywhere), `start_std_m` how well
        that is known; `options` are the `SessionOptions`. With `keep` it outlives its `with` block. The
        `idempotency_key` names this beginning, so that it can be repeated after a `TransportError`. Raises
        UnknownDomainError, NoActiveMapError, InvalidPriorError, TooManySessionsError.
        """
        document = {"start_position_m": start_position_m, "start_std_m": start_std_m, **options}
        call = Call.with_json(
            "POST", f"{domain_path(domain)}/sessions", document, headers=idempotency_header(idempotency_key)
        )
        return self._session(self._wire, await self._wire.model(SessionState, call), keep=keep)

    @shared
    async def attach_session(self, session_id: str, *, keep: bool = True) -> AnySession:
        """Go on with a session that was kept. Raises UnknownSessionError, EndedSessionError, RetiredMapError."""
        response = await self._wire.send(Call("GET", session_path(session_id)))
        return self._session(self._wire, model_of(SessionState, response), keep=keep)

    @shared
    async def truths(self, session_id: str, true_positions_m: Numbers) -> TruthScore:
        """Tell where a session's robot truly was, as `Session.truths` does; the session may have ended a while ago.

        Raises UnknownSessionError, InvalidInputError.
        """
        return await _truths(self._wire, session_path(session_id), true_positions_m)

    async def _leave(self, _error: BaseException | None, /) -> None:
        await self._wire.link.close()


class Client(ClientCalls[Session], Blocking):
    """Talks to one Deep SIMBAD service and blocks; safe to share between threads.

    Connection errors and the answers 408, 429, 502, 503 and 504 are retried with exponential backoff and jitter, not
    before the service's own `Retry-After`, for some 30 s in all, where repeating is safe: every call here but
    `admin.activate` with `expected`, which is sent again only when the service surely did not act on it.

    Args:
        url: The service's address; absent: `$DEEPSIMBAD_URL`, else http://127.0.0.1:8000.
        api_key: Absent: `$DEEPSIMBAD_API_KEY`, else none is sent.
        timeout: Connect, read, write and pool timeouts in seconds.
        retry: How often and how long to try.
        request_id: Names every request that is sent, each try anew, in the service's log too: 1 to 64 letters, digits,
            '.', '_' and '-'; absent: the service names them. Answers and errors hold it as their `request_id`.
        transport: Another httpx2 transport (tests, proxies, Unix sockets).
        sleep: Waits between tries.
        jitter: Draws in 0..1 that spread the waits.
    """

    _session = Session

    def __init__(
        self,
        url: str | None = None,
        api_key: str | None = None,
        *,
        timeout: httpx2.Timeout = THIN_LINK_TIMEOUT,
        retry: RetryPolicy | None = None,
        request_id: Callable[[], str] | None = None,
        transport: httpx2.BaseTransport | None = None,
        sleep: Callable[[float], None] = time.sleep,
        jitter: Callable[[], float] = random.random,
    ) -> None:
        http = httpx2.Client(**http_settings(url, api_key, timeout), transport=transport)
        super().__init__(Wire(BlockingLink(http, sleep), retry, request_id, jitter))
        self.admin = Admin(self._wire)

    def close(self) -> None:
        """Close the connections; the client cannot be used afterwards."""
        run_to_end(self._leave(None))


class AsyncClient(ClientCalls[AsyncSession], Awaiting):
    """A `Client` whose calls are awaited, `transport` and `sleep` too."""

    _session = AsyncSession

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
        http = httpx2.AsyncClient(**http_settings(url, api_key, timeout), transport=transport)
        super().__init__(Wire(AwaitingLink(http, sleep), retry, request_id, jitter))
        self.admin = AsyncAdmin(self._wire)

    async def aclose(self) -> None:
        """Close the connections; the client cannot be used afterwards."""
        await self._leave(None)


async def _truths(wire: Wire, path: str, true_positions_m: Numbers, **fields: Any) -> TruthScore:
    document = {"true_positions_m": known_positions(true_positions_m), **fields}
    return await wire.model(TruthScore, Call.with_json("POST", f"{path}/truths", document))
