"""How well a session knew where its robot was, ranked once the truth is known: the alarm that a season has turned."""

import asyncio
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.experience.nnql import FARTHEST_TRUTH_M
from deepsimbad.core.localizer import LocalizerState
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.route import Route
from deepsimbad.engine.session import SessionEngine, SessionState, replayed_until
from deepsimbad.engine.sessions import Sessions, check_owner
from deepsimbad.engine.worker import InferenceWorker
from deepsimbad.errors import InvalidInputError
from deepsimbad.store.sessions import JournalRow, ObservedRow, SessionRecord, SessionStore, StateSnapshot

_MOST_RESUMABLE = 16  # sessions, 0.5 MB each at 26,000 map images


@dataclass(frozen=True)
class RankedTruths:
    """Where a session's belief placed the truth."""

    session: SessionRecord
    position_m: NDArray[np.float64]  # [n_observations] the truth along the route; NaN where unknown
    # [n_observations] share of the map images that the belief placed before the true one, 0..1; NaN where the truth is
    # unknown, or farther than 10 m from the map
    rank_share: NDArray[np.float64]
    # [n_observations] rank from 0 of the best-placed true image by each view's own relevance; NaN where an observation
    # has no true image; None where none has
    retrieval_rank: NDArray[np.float64] | None = None
    first: int = 0  # observation whose truth was posted

    @property
    def n_scored(self) -> int:
        """Observations whose truth is known."""
        return int(np.count_nonzero(~np.isnan(self.rank_share)))

    @property
    def n_left_out(self) -> int:
        """Observations from `first` on whose truth is unknown, or is no place of the map."""
        return int(self.rank_share.size) - self.first - self.n_scored

    @property
    def anr(self) -> float | None:
        """Averaged normalised rank in percent, 0 is perfect, 50 chance; None where no truth is known."""
        return 100 * float(np.nanmean(self.rank_share)) if self.n_scored else None

    def new_since(self, before_m: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """[m] the rank shares of the observations whose truth was not known before.

        Args:
            before_m: Truths known before, of the first observations: [k] positions, NaN where unknown; None: none.
        """
        is_new = ~np.isnan(self.rank_share)
        if before_m is not None:
            is_new[: before_m.size] &= np.isnan(before_m[: is_new.size])
        return self.rank_share[is_new]


def checked_truths(positions_m: Sequence[float | None], n_observations: int, first: int = 0) -> NDArray[np.float64]:
    """[n_observations] true positions along the route, NaN where unknown and for the observations before `first`.

    Raises:
        InvalidInputError: There are not as many positions as observations from `first` on, or one is not finite.
    """
    if any(position_m is not None and not math.isfinite(position_m) for position_m in positions_m):
        raise InvalidInputError("a true position is NaN or infinite; give null where it is unknown")
    if first + len(positions_m) != n_observations:
        from_the_first = f" from observation {first} on" if first else ""
        raise InvalidInputError(
            f"{len(positions_m)} true positions{from_the_first} for {n_observations} observations: give one for each",
            n_observations=n_observations,
        )
    return np.array([math.nan] * first + list(positions_m), np.float64)  # None becomes NaN


class Truths:
    """Replays sessions, living ones and those that ended and are still known; used from an event loop."""

    def __init__(
        self, store: SessionStore, worker: InferenceWorker, sessions: Sessions, clock: Callable[[], float] = time.time
    ) -> None:
        self._store = store
        self._worker = worker
        self._sessions = sessions
        self._clock = clock
        # By session's id (a number may be another's later), the number of observations ranked last and the state after
        # them: truths come bit by bit
        self._resume_points: dict[str, tuple[int, StateSnapshot]] = {}

    async def rank(
        self,
        session_id: str,
        positions_m: Sequence[float | None],
        true_map_images: Sequence[Sequence[int]] | None = None,
        first: int = 0,
        key_id: str | None = None,
    ) -> RankedTruths:
        """Rank the truth in the belief, and with `true_map_images` in the retrieval, as it was after every observation.

        In the belief the true map image is the one nearest to the true position along the route; ranks follow ANR's
        rule. Truths that come in pieces, in order, cost no more than all at once.

        Args:
            session_id: The session.
            positions_m: One for every observation from `first` on; None where it is unknown.
            true_map_images: For each of these observations the map images that show its place.
            first: The observation that the first of the positions belongs to.
            key_id: The API key whose sessions alone are known to the asker; None: all are.

        Raises:
            UnknownSessionError: There is none such, or it ended long ago.
            RetiredMapError: Its map is no more.
            InvalidInputError: There are not as many positions or lists as observations from `first` on, a position is
                not finite, or a list holds what is no map image.
            DamagedMapError, DamagedFileError: The map or the session cannot be read.
        """

        def prepare() -> tuple[SessionRecord, SessionEngine, NDArray[np.float64]]:
            record = self._store.find(session_id)
            check_owner(record, key_id)
            truth_m = checked_truths(positions_m, self._store.n_observations(record.number), first)
            return record, self._sessions.engine_of(record), truth_m

        record, engine, truth_m = await asyncio.to_thread(prepare)
        route = engine.snapshot.route
        images = _checked_images(true_map_images, truth_m.size, first, route.n_images)
        nearest_images = true_images(route, truth_m)
        share, retrieval = np.full((2, truth_m.size), np.nan)

        def rank(number: int, state: LocalizerState) -> None:
            if not math.isnan(truth_m[number]):
                mass = state.belief.mass
                share[number] = rank_of_truth(mass, nearest_images[number : number + 1]) / mass.size
            if number in images and state.relevance is not None:
                retrieval[number] = rank_of_truth(state.relevance, images[number])

        numbers = np.union1d(np.flatnonzero(~np.isnan(truth_m)), list(images)).astype(int)
        if numbers.size:
            await self._follow(record, engine, numbers[0], numbers[-1], rank)
        apart_m = np.abs(route.offset_m(route.position_m[nearest_images], truth_m))
        share[~(apart_m <= FARTHEST_TRUTH_M)] = np.nan  # unknown ones too
        return RankedTruths(record, truth_m, share, None if true_map_images is None else retrieval, first)

    async def keep(
        self,
        session_id: str,
        positions_m: Sequence[float | None],
        true_map_images: Sequence[Sequence[int]] | None = None,
        first: int = 0,
        key_id: str | None = None,
    ) -> tuple[RankedTruths, NDArray[np.float64] | None]:
        """Rank the truths, then keep the positions for experience; raises as `rank` does, and then nothing was kept.

        Returns:
            The ranked truths, and the positions that had been kept before, if any.
        """
        ranking = await self.rank(session_id, positions_m, true_map_images, first, key_id)
        previous = self._store.save_true_positions(ranking.session.number, ranking.position_m, self._clock())
        return ranking, await asyncio.wrap_future(previous)

    async def _follow(
        self,
        record: SessionRecord,
        engine: SessionEngine,
        first: int,
        last: int,
        rank: Callable[[int, LocalizerState], None],
    ) -> None:
        """Call `rank` with the number and the state of every observation from `first` to `last`."""

        def is_last(row: JournalRow, state: SessionState) -> bool:
            number = state.belief.n_observations - 1
            if isinstance(row, ObservedRow) and number >= first:
                rank(number, state.belief)
            return number == last

        n_before, snapshot = self._resume_points.pop(record.session_id, (0, None))
        state = await replayed_until(
            self._store, self._worker, record, engine, is_last, snapshot if n_before <= first else None
        )
        self._resume_points[record.session_id] = state.belief.n_observations, state.snapshot()
        while len(self._resume_points) > _MOST_RESUMABLE:
            del self._resume_points[next(iter(self._resume_points))]


def _checked_images(
    true_map_images: Sequence[Sequence[int]] | None, n_observations: int, first: int, n_images: int
) -> dict[int, NDArray[np.int64]]:
    """The map images that show the place of each observation, by its number; without those that have none.

    Raises:
        InvalidInputError: There are not as many lists as observations, or a list holds what is no map image.
    """
    if true_map_images is not None and first + len(true_map_images) != n_observations:
        raise InvalidInputError(f"{len(true_map_images)} lists of true map images: give one for each true position")
    if any(not 0 <= image < n_images for images in true_map_images or () for image in images):
        raise InvalidInputError(f"map images are 0 to {n_images - 1}", minimum=0, maximum=n_images - 1)
    return {number: np.array(images, np.int64) for number, images in enumerate(true_map_images or (), first) if images}


def true_images(route: Route, position_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """[n] int64: the map image nearest to each position [n], NaN where unknown, which gives any image.

    On a closed route a position may be any number of rounds on.
    """
    somewhere_m = np.where(np.isnan(position_m), route.start_m, position_m)
    return route.nearest_image(route.wrapped(somewhere_m)).astype(np.int64)
