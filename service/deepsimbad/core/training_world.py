"""Where training episodes run: a live drive along the map's route, many robots on it at once (II-D, III)."""

from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief_lattice import Lattice, Moves, moves_along, step_beliefs, uniform_beliefs
from deepsimbad.core.filters import motion_std_m
from deepsimbad.core.live_views import LiveViews, of_episodes
from deepsimbad.core.nnql import NnqlConfig
from deepsimbad.core.route import Route
from deepsimbad.core.update_rules import UpdateRule

_CELLS_AT_ONCE = 300_000  # of one thread: its episodes' beliefs and evidence stay in the second-level cache


@dataclass(frozen=True)
class TrainingWorld:
    """A drive along the map's route, on which a robot can be moved.

    Attributes:
        views: Its frames; none of them is an image of the map they look at.
        lattice: Of the map's route.
        true_image: [m] int64, the map image nearest to every frame; -1 where there is none.
        next_frame: [m, a] int64, the frame nearest to where a move leads; -1 where the drive ends before.
        start_frames: Where episodes may start.
        moves: [a] the moves on the lattice.
    """

    views: LiveViews
    lattice: Lattice
    true_image: NDArray[np.int64]
    next_frame: NDArray[np.int64]
    start_frames: NDArray[np.int64]
    moves: Moves

    @classmethod
    def on(
        cls,
        map_route: Route,
        views: LiveViews,
        live_route: Route,
        true_image: NDArray[np.int64],
        actions_m: tuple[float, ...],
        config: NnqlConfig,
    ) -> "TrainingWorld":
        """A world of one drive.

        Args:
            map_route: Where the map images are.
            views: The drive's frames.
            live_route: Where they are, along the drive itself.
            true_image: As the attribute.
            actions_m: The moves.
            config: For the length of an episode and the moves' error.
        """
        lattice = Lattice.along(map_route, min(actions_m))
        stds_m = [motion_std_m(m) if config.motion_std_m is None else config.motion_std_m for m in actions_m]
        return cls(
            views,
            lattice,
            true_image,
            _next_frames(live_route, actions_m),
            _start_frames(live_route, true_image, max(actions_m) * config.n_actions_per_episode),
            moves_along(lattice, actions_m, stds_m),
        )

    @property
    def n_images(self) -> int:
        """n."""
        return self.views.built.index.n_images

    @property
    def n_actions(self) -> int:
        """a."""
        return int(self.next_frame.shape[1])


def _next_frames(route: Route, actions_m: tuple[float, ...]) -> NDArray[np.int64]:
    target = route.position_m[:, np.newaxis] + np.array(actions_m)
    if route.closed and route.length_m > 0:
        wrapped = route.start_m + (target - route.start_m) % route.length_m
        return np.asarray(route.nearest_image(wrapped), np.int64)
    return np.where(target <= route.position_m[-1] + 1e-9, route.nearest_image(target), -1)


def _start_frames(route: Route, true_image: NDArray[np.int64], episode_m: float) -> NDArray[np.int64]:
    """Frames of known place from which a whole episode fits; where there is none, all of known place."""
    known = true_image >= 0
    fits = known & (route.closed | (route.position_m + episode_m <= route.position_m[-1] + 1e-9))
    return np.flatnonzero(fits if fits.any() else known)


class Walk:
    """Episodes that move in lockstep, each with its own belief and statistics.

    Attributes:
        world: Where they move.
        frames: [e] where the robots are.
        nearest: [e, k] map images nearest to their views.
        ranks: [e] rank of the truth's belief from 0; below 0 where it is unknown.
    """

    def __init__(self, world: TrainingWorld, starts: NDArray[np.int64], pool: Executor | None = None) -> None:
        self.world = world
        self._pool = pool
        self._beliefs = uniform_beliefs(world.lattice, starts.size)
        self._live = world.views.observing(None, starts)
        self.frames = starts
        self._see(np.full(starts.size, -1, np.int64))

    @property
    def allowed(self) -> NDArray[np.bool_]:
        """[e, a] the moves that are possible."""
        return self.world.next_frame[self.frames] >= 0

    def step(self, action: NDArray[np.int64]) -> None:
        """Move every robot, [e] places of the moves; -1: its episode is over and it stays."""
        moving = action >= 0
        self.frames = np.where(moving, self.world.next_frame[self.frames, action], self.frames)
        self._live = self.world.views.observing(self._live, self.frames)
        self._see(action)

    def _see(self, action: NDArray[np.int64]) -> None:
        e = self.frames.size
        self.nearest = np.empty((e, min(self.world.views.n_neighbours, self.world.n_images)), np.int64)
        self.ranks = np.empty(e)
        size = max(1, min(-(-e // 2), _CELLS_AT_ONCE // self.world.lattice.n_cells))
        parts = [slice(first, first + size) for first in range(0, e, size)]
        see = map if self._pool is None else self._pool.map
        for _ in see(partial(self._see_some, action), parts):
            pass

    def _see_some(self, action: NDArray[np.int64], some: slice) -> None:
        world, moved, frames = self.world, action[some], self.frames[some]
        evidence, nearest = world.views.look(frames, of_episodes(self._live, some))
        self.nearest[some] = nearest
        moves = Moves(
            np.where(moved >= 0, world.moves.shift[moved], -1), world.moves.fraction[moved], world.moves.taps[moved]
        )
        self.ranks[some] = step_beliefs(
            world.lattice,
            self._beliefs[some],
            moves,
            evidence,
            world.true_image[frames],
            additive=world.views.rule is not UpdateRule.LOG_LIKELIHOOD,
        )
