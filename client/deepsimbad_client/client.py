"""The blocking client."""

import random
import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

import httpx2

from deepsimbad_client import calls, session_calls
from deepsimbad_client.admin import Admin
from deepsimbad_client.models import Domain, Health, Localization, TruthScore
from deepsimbad_client.observation import Image, Numbers, Observation, observation
from deepsimbad_client.retry import RetryPolicy
from deepsimbad_client.session import Session
from deepsimbad_client.transport import THIN_LINK_TIMEOUT, Endpoint, Transport

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from deepsimbad_client.on_board import OnBoardEncoder


class Client:
    """Talks to one Deep SIMBAD service and blocks; safe to share between threads.

    Connection errors and the answers 408, 429, 502, 503 and 504 are retried with exponential backoff and jitter, or
    after the service's own `Retry-After`, where repeating is safe: every call here but those of `admin` that act once
    (`remap`, `feed_experience`, and `activate` with `expected`), which are sent again only when the service surely did
    not act on them. A refused key (401, 403) is never tried again.

    Args:
        url: The service's address; absent: `$DEEPSIMBAD_URL`, else http://127.0.0.1:8000.
        api_key: Absent: `$DEEPSIMBAD_API_KEY`, else none is sent.
        timeout: Connect, read, write and pool timeouts in seconds.
        retry: How often and how long to try.
        request_id: Names every request that is sent, each try anew, in the service's log too: 1 to 64 letters, digits,
            '.', '_' and '-'; absent: the service names them. Answers and errors tell it as their `request_id`.
        transport: Another httpx2 transport (tests, proxies, Unix sockets).
        sleep: Waits between tries.
        jitter: Draws in 0..1 that spread the waits.

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
        transport: httpx2.BaseTransport | None = None,
        sleep: Callable[[float], None] = time.sleep,
        jitter: Callable[[], float] = random.random,
    ) -> None:
        endpoint = Endpoint(url, api_key, timeout, retry or RetryPolicy(), request_id)
        self._transport = Transport(endpoint, transport=transport, sleep=sleep, jitter=jitter)
        self.admin = Admin(self._transport)

    @property
    def url(self) -> str:
        """The service's address."""
        return self._transport.url

    def health(self) -> Health:
        """Whether the process is alive."""
        return self._transport.send(calls.health())

    def ready(self) -> Health:
        """Whether it can answer now.

        Raises:
            UnavailableError: Not yet; its detail says why.
        """
        return self._transport.send(calls.ready())

    def metrics(self) -> str:
        """What the service counts, in Prometheus' text format."""
        return self._transport.send(calls.metrics())

    def domains(self) -> tuple[Domain, ...]:
        """Every domain."""
        return self._transport.send(calls.domains())

    def domain(self, name: str) -> Domain:
        """One domain and its active map.

        Raises:
            UnknownDomainError: There is none of that name.
        """
        return self._transport.send(calls.domain(name))

    def on_board(self, domain: str, *, map_version: int | None = None) -> "OnBoardEncoder":
        """Fetch a map's landmarks once, to rank them here and send a few bytes a view (needs `deep-simbad[edge]`).

        Args:
            domain: Where the robot is.
            map_version: A version that a session keeps; absent: the active map.

        Raises:
            UnknownDomainError, UnknownMapVersionError: There is none.
            NoActiveMapError: The domain has no map yet.
            RetiredMapError: That version was removed.
            MissingExtraError: The packages of `deep-simbad[edge]` are not installed.
        """
        return self._transport.send(calls.landmark_model(domain, map_version))

    def localize(
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
        """Where one view probably is; give exactly one form of it.

        Args:
            domain: Where to look.
            image: An encoded image (JPEG, PNG, TIFF, WebP) or its path, sent as it is.
            content_type: The image's media type; absent: read from its first bytes.
            ranked_landmarks: Landmark ids, nearest first, 1..r of them.
            dissimilarities: r finite numbers in landmark order, smaller is nearer.
            encoding: A ready encoding, where the domain takes them.
            ranked: What an `OnBoardEncoder` made of an image, a few bytes.
            shortlist: Length of `retrieval` and `belief.top`; absent: the service's default.

        Raises:
            UnknownDomainError: No such domain.
            NoActiveMapError: The domain has no map yet.
            LandmarkModelDiffersError: `ranked` was made with other landmarks than the map's; fetch them by `on_board`.
            InvalidInputError: The service cannot use the view; its detail says why.
        """
        seen = observation(
            image,
            content_type=content_type,
            ranked_landmarks=ranked_landmarks,
            dissimilarities=dissimilarities,
            encoding=encoding,
            ranked=ranked,
        )
        return self._transport.send(calls.localize(domain, seen, shortlist=shortlist))

    def relevances(
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
        """How well every map image answers one view: [n] float32, larger is better (needs numpy).

        Takes the same forms of a view, and raises the same errors, as `localize`.
        """
        seen = observation(
            image,
            content_type=content_type,
            ranked_landmarks=ranked_landmarks,
            dissimilarities=dissimilarities,
            encoding=encoding,
            ranked=ranked,
        )
        return self._transport.send(calls.relevances(domain, seen))

    def session(
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
    ) -> Session:
        """Begin a session: the service keeps this robot's belief from view to view.

        A lost answer is asked for again and begins no second session.

        Args:
            domain: Where the robot is.
            start_position_m: About where it starts along the route; absent: anywhere.
            start_std_m: How well that is known; absent: the service's default.
            seed: Of everything drawn at random; absent: the service's default.
            planner: Who chooses the next view (`nnql`, `random`, `constant:3`, ...); absent: the service's default.
            belief: `particle` or `grid`; absent: the service's default.
            update: How a view changes the belief; absent: the map's default.
            keep: Let it outlive its `with` block.
            idempotency_key: Names this beginning, so that it can be repeated after a `TransportError`; absent: a new
                one.

        Raises:
            UnknownDomainError: No such domain.
            NoActiveMapError: The domain has no map yet.
            InvalidPriorError: The start is far off the route.
            TooManySessionsError: The service holds as many as it may.
        """
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
        return Session(self._transport, self._transport.send(call), keep=keep)

    def attach_session(self, session_id: str, *, keep: bool = True) -> Session:
        """Find a session again that was kept.

        Raises:
            UnknownSessionError: No such session.
            EndedSessionError: It expired or was deleted.
            RetiredMapError: Its map was removed.
        """
        return Session(self._transport, self._transport.send(session_calls.state(session_id)), keep=keep)

    def truths(self, session_id: str, true_positions_m: Numbers) -> TruthScore:
        """Tell where a session's robot truly was, as `Session.truths` does; the session may have ended a while ago.

        Raises:
            UnknownSessionError: No such session, or it ended long ago.
            InvalidInputError: As many positions as observations there are not.
        """
        return self._transport.send(session_calls.truths(session_id, true_positions_m))

    def close(self) -> None:
        """Close the connections; the client cannot be used afterwards."""
        self._transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
