"""A live session of the async client."""

from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Self

from deepsimbad_client import session_calls
from deepsimbad_client.errors import DeepSimbadClientError, GoneError
from deepsimbad_client.models import NextBestView, SessionAnswer, SessionState, TruthScore
from deepsimbad_client.observation import Image, Numbers, Observation, observation
from deepsimbad_client.transport import AsyncTransport

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class AsyncSession:
    """The awaiting twin of `deepsimbad_client.session.Session`, which describes every call."""

    def __init__(self, transport: AsyncTransport, opened: SessionState, *, keep: bool) -> None:
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

    async def observe(
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
        """Tell what the robot sees now, after the metres it has moved; give exactly one form of the view."""
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
        return await self._transport.send(call)

    async def state(self) -> SessionState:
        """What it believes now, and how many views that rests on."""
        return await self._transport.send(session_calls.state(self.session_id))

    async def belief_masses(self) -> "NDArray[np.float32]":
        """The whole belief: [n] float32 over the map images, sums to 1 (needs numpy)."""
        return await self._transport.send(session_calls.belief_masses(self.session_id))

    async def next_best_view(self) -> NextBestView | None:
        """The move that would tell most, without another view; None where the map can name none."""
        return await self._transport.send(session_calls.next_best_view(self.session_id))

    async def set_prior(self, position_m: float, std_m: float) -> SessionState:
        """Forget the belief for one around a position: the robot was carried, or got a fix.

        Raises:
            InvalidPriorError: The position is far off the route, or the deviation cannot be one.
        """
        return await self._transport.send(session_calls.set_prior(self.session_id, position_m, std_m))

    async def truths(
        self,
        true_positions_m: Numbers,
        *,
        true_map_images: Sequence[Sequence[int]] | None = None,
        first_observation: int = 0,
    ) -> TruthScore:
        """Tell where the robot truly was at each of its observations, known only afterwards."""
        return await self._transport.send(
            session_calls.truths(self.session_id, true_positions_m, true_map_images, first_observation)
        )

    async def delete(self) -> None:
        """End the session; nothing more can be asked of it."""
        await self._transport.send(session_calls.delete(self.session_id))
        self._deleted = True

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self.keep or self._deleted:
            return
        try:
            await self.delete()
        except GoneError:
            pass  # it has expired, which is as good
        except DeepSimbadClientError:
            if error is None:  # else the block's own error matters more; the session expires by itself
                raise
