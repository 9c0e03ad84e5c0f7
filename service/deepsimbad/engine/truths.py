"""How well a session knew where its robot was, told once the truth is known: the alarm that a season has turned."""

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.route import Route
from deepsimbad.engine.pinned_maps import PinnedMaps
from deepsimbad.engine.replay import Replay
from deepsimbad.engine.session_registry import engine_of
from deepsimbad.engine.session_state import SessionEngine, SessionState
from deepsimbad.engine.worker import InferenceWorker
from deepsimbad.errors import InvalidInputError
from deepsimbad.store.session_records import JournalRow, ObservedRow, SessionRecord
from deepsimbad.store.sessions import SessionStore

_FARTHEST_M = 10.0  # a truth farther from every map image is of no place of the map: another road, another frame


@dataclass(frozen=True)
class RankedTruths:
    """Where a session's belief placed the truth.

    Attributes:
        domain, map_version: Of the session.
        position_m: [n_observations] the truth along the route; NaN where unknown.
        rank_share: [n_observations] share of the map images that the belief placed before the true one, 0..1; NaN where
            the truth is unknown, or farther than 10 m from the map.
    """

    domain: str
    map_version: int
    position_m: NDArray[np.float64]
    rank_share: NDArray[np.float64]

    @property
    def n_scored(self) -> int:
        """Observations whose truth is known."""
        return int(np.count_nonzero(~np.isnan(self.rank_share)))

    @property
    def n_left_out(self) -> int:
        """Observations whose truth is unknown, or is no place of the map."""
        return int(self.rank_share.size) - self.n_scored

    @property
    def anr(self) -> float | None:
        """Averaged normalised rank in percent, 0 is perfect, 50 chance; None where no truth is known."""
        return 100 * float(np.nanmean(self.rank_share)) if self.n_scored else None

    def new_since(self, before_m: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """The rank shares of those observations whose truth had not been told before.

        Args:
            before_m: What had been told: positions of the first so many observations, NaN where unknown; None: nothing.
        """
        known = ~np.isnan(self.rank_share)
        if before_m is not None:
            known[: before_m.size] &= np.isnan(before_m[: known.size])
        return self.rank_share[known]


def checked_truths(positions_m: Sequence[float | None], n_observations: int) -> NDArray[np.float64]:
    """[n_observations] true positions along the route, NaN where unknown.

    Raises:
        InvalidInputError: As many positions as observations there are not, or one is not finite.
    """
    if any(one is not None and not math.isfinite(one) for one in positions_m):
        raise InvalidInputError("a true position is NaN or infinite; give null where it is unknown")
    if len(positions_m) != n_observations:
        raise InvalidInputError(
            f"{len(positions_m)} true positions for {n_observations} observations: give one for each",
            n_observations=n_observations,
        )
    return np.array([math.nan if one is None else one for one in positions_m], np.float64)


class Truths:
    """Replays sessions, living ones and those that ended and are still known; used from an event loop.

    Args:
        store: The sessions.
        maps: What they are pinned to.
        worker: Where beliefs are computed.
        clock: Seconds since 1970.
    """

    def __init__(
        self, store: SessionStore, maps: PinnedMaps, worker: InferenceWorker, clock: Callable[[], float]
    ) -> None:
        self._store = store
        self._maps = maps
        self._replays = Replay(store, worker)
        self._clock = clock

    async def rank(self, session_id: str, positions_m: Sequence[float | None]) -> RankedTruths:
        """Rank the truth in the belief as it was after every observation.

        The true map image is the one nearest to the true position along the route; its rank follows ANR's rule.

        Args:
            session_id: The session.
            positions_m: One for every observation; None where it is unknown.

        Raises:
            UnknownSessionError: There is none such, or it ended long ago.
            RetiredMapError: Its map is no more.
            InvalidInputError: As many positions as observations there are not, or one is not finite.
            DamagedMapError, DamagedFileError: The map or the session cannot be read.
        """
        return (await self._ranked(session_id, positions_m))[1]

    async def keep(
        self, session_id: str, positions_m: Sequence[float | None]
    ) -> tuple[RankedTruths, NDArray[np.float64] | None]:
        """Rank the truths, then keep them for experience; raises as `rank` does, and then nothing was kept.

        Returns:
            The ranked truths, and the positions that had been kept before, if any.
        """
        record, ranked = await self._ranked(session_id, positions_m)
        kept = self._store.save_true_positions(record.number, ranked.position_m, self._clock())
        return ranked, await asyncio.wrap_future(kept)

    async def _ranked(self, session_id: str, positions_m: Sequence[float | None]) -> tuple[SessionRecord, RankedTruths]:
        record, engine, known = await asyncio.to_thread(self._prepared, session_id, positions_m)
        share = np.full(known.size, np.nan)
        n_needed = int(np.flatnonzero(~np.isnan(known)).max(initial=-1)) + 1  # what follows need not be replayed
        route = engine.snapshot.route
        truth = true_images(route, known)
        await self._replay(record, engine, truth[:n_needed], share[:n_needed])
        apart_m = np.abs(route.offset_m(route.position_m[truth], known))
        share[~(apart_m <= _FARTHEST_M)] = np.nan  # unknown ones too
        return record, RankedTruths(record.domain, record.map_version, known, share)

    def _prepared(
        self, session_id: str, positions_m: Sequence[float | None]
    ) -> tuple[SessionRecord, SessionEngine, NDArray[np.float64]]:
        record = self._store.find(session_id)
        known = checked_truths(positions_m, self._store.n_observations(record.number))
        return record, engine_of(record, self._maps), known

    async def _replay(
        self, record: SessionRecord, engine: SessionEngine, truth: NDArray[np.int64], share: NDArray[np.float64]
    ) -> None:
        """Fill `share` with the rank of every observation's true image."""
        n_seen = 0

        def rank(row: JournalRow, state: SessionState) -> bool:
            nonlocal n_seen
            if isinstance(row, ObservedRow):
                mass = state.belief.belief.mass
                share[n_seen] = rank_of_truth(mass, truth[n_seen : n_seen + 1]) / mass.size
                n_seen += 1
            return n_seen == truth.size

        if truth.size:
            await self._replays.until(record, engine, rank)


def true_images(route: Route, position_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """[n] the map image nearest to each position along the route; of an unknown position any.

    Args:
        route: Of the map.
        position_m: [n] NaN where unknown; on a closed route any number of rounds.
    """
    known = np.where(np.isnan(position_m), route.start_m, position_m)
    if route.closed and route.length_m > 0:
        known = route.start_m + (known - route.start_m) % route.length_m
    return route.nearest_image(known).astype(np.int64)
