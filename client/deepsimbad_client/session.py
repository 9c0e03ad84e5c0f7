"""A live session of the blocking client."""

from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Self

from deepsimbad_client import session_calls
from deepsimbad_client.errors import DeepSimbadClientError, GoneError
from deepsimbad_client.models import NextBestView, SessionAnswer, SessionState, TruthScore
from deepsimbad_client.observation import Image, Numbers, Observation, observation
from deepsimbad_client.transport import Transport

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class Session:
    """One robot's belief, kept by the service and moved on by every observation.

    Made by `Client.session` or `Client.attach_session`. It is a context manager: the session ends with the block unless
    `keep` says otherwise. One session belongs to one robot: views sent by two threads at once count in the order of
    their arrival.

    Attributes:
        session_id: By which `Client.attach_session` finds it again, from this process or another.
        domain: Its domain.
        map_version: The map it began on and keeps, whatever is activated later.
        opened: What the service said when it was made or found.
        keep: Whether it outlives the block.
    """

    def __init__(self, transport: Transport, opened: SessionState, *, keep: bool) -> None:
        self._transport = transport
        self.opened = opened
        self.keep = keep
        self._deleted = False

    @property
    def session_id(self) -> str:
        """By which the session is found again."""
        return self.opened.session_id

    @property
    def domain(self) -> str:
        """The session's domain."""
        return self.opened.domain

    @property
    def map_version(self) -> int:
        """The map that the session began on."""
        return self.opened.map_version

    def observe(
        self,
        image: Image | None = None,
        *,
        action_m: float | None = None,
        action_std_m: float | None = None,
        content_type: str | None = None,
        ranked_landmarks: Numbers | None = None,
        dissimilarities: Numbers | None = None,
        encoding: Numbers | None = None,
        ranked: Observation | None = None,
        shortlist: int | None = None,
        idempotency_key: str | None = None,
    ) -> SessionAnswer:
        """Tell what the robot sees now, after the metres it has moved; give exactly one form of the view.

        A lost answer is asked for again and counts once. To repeat an observation yourself after a `TransportError`,
        choose its key, and send the same again under it.

        Args:
            image: An encoded image (JPEG, PNG, TIFF, WebP) or its path, sent as it is.
            action_m: Metres really moved since the last view; absent: stood still. Ignored for the first view.
            action_std_m: How well that is known; absent: the service's usual odometry.
            content_type: The image's media type; absent: read from its first bytes.
            ranked_landmarks: Landmark ids, nearest first, 1..r of them.
            dissimilarities: r finite numbers in landmark order, smaller is nearer.
            encoding: A ready encoding, where the domain takes them.
            ranked: What an `OnBoardEncoder` made of an image, a few bytes.
            shortlist: Length of `retrieval` and `belief.top`; absent: the service's default.
            idempotency_key: Names this observation; absent: a new one.

        Raises:
            InvalidMoveError: The move is negative or too long; `PastTheEndError`: past the end of the route.
            LandmarkModelDiffersError: `ranked` was made with other landmarks than those of the session's map.
            InvalidInputError: The service cannot use the view; its detail says why.
            GoneError: The session has ended, or its map was removed.
        """
        seen = observation(
            image,
            content_type=content_type,
            ranked_landmarks=ranked_landmarks,
            dissimilarities=dissimilarities,
            encoding=encoding,
            ranked=ranked,
        )
        call = session_calls.observe(
            self.session_id,
            seen,
            action_m=action_m,
            action_std_m=action_std_m,
            shortlist=shortlist,
            idempotency_key=idempotency_key,
        )
        return self._transport.send(call)

    def state(self) -> SessionState:
        """What it believes now, and how many views that rests on."""
        return self._transport.send(session_calls.state(self.session_id))

    def belief_masses(self) -> "NDArray[np.float32]":
        """The whole belief: [n] float32 over the map images, sums to 1 (needs numpy)."""
        return self._transport.send(session_calls.belief_masses(self.session_id))

    def next_best_view(self) -> NextBestView | None:
        """The move that would tell most, without another view; None where the map can name none."""
        return self._transport.send(session_calls.next_best_view(self.session_id))

    def set_prior(self, position_m: float, std_m: float) -> SessionState:
        """Forget the belief for one around a position: the robot was carried, or got a fix.

        Raises:
            InvalidPriorError: The position is far off the route, or the deviation cannot be one.
        """
        return self._transport.send(session_calls.set_prior(self.session_id, position_m, std_m))

    def truths(
        self,
        true_positions_m: Numbers,
        *,
        true_map_images: Sequence[Sequence[int]] | None = None,
        first_observation: int = 0,
    ) -> TruthScore:
        """Tell where the robot truly was at each of its observations, known only afterwards: how good were the answers?

        The service raises its alarm by this; the map learns nothing from it (`Admin.feed_experience`). The same truths
        again count once.

        Args:
            true_positions_m: A position along the map's route for each observation, in order; None where unknown.
            true_map_images: For each of the same observations the map images that show its place: the answer's
                `retrieval_ranks` then tell where each view by itself placed the best of them.
            first_observation: The observation that the first of them belongs to: truths may be told bit by bit.

        Raises:
            InvalidInputError: As many positions as observations there are not.
        """
        return self._transport.send(
            session_calls.truths(self.session_id, true_positions_m, true_map_images, first_observation)
        )

    def delete(self) -> None:
        """End the session; nothing more can be asked of it."""
        self._transport.send(session_calls.delete(self.session_id))
        self._deleted = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self.keep or self._deleted:
            return
        try:
            self.delete()
        except GoneError:
            pass  # it has expired, which is as good
        except DeepSimbadClientError:
            if error is None:  # else the block's own error matters more; the session expires by itself
                raise
