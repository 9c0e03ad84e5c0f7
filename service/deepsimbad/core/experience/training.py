"""Training of the experience database: episodes of many robots at once on a drive through the map (II-D, III)."""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief.evidence import batch_evidence
from deepsimbad.core.belief.motion import motion_std_m
from deepsimbad.core.experience.lattice import NO_MOVE, Lattice, Moves, moves_along, step_beliefs, uniform_beliefs
from deepsimbad.core.experience.nnql import NnqlConfig, Transitions, initial_q_values, learn, q_of_nearest
from deepsimbad.core.index.retrieval import relevances, shortlist
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import LiveStatistics, Query, UpdateRule
from deepsimbad.core.route import Route

EPISODES_A_POINT = 100  # a point of the learning curve
_EVALUATION = 0xE7A1  # part of the evaluation's seed, larger than any batch number of training
_CELLS_AT_ONCE = 300_000  # of one thread, so that its episodes' beliefs and evidence stay in the second-level cache


@dataclass(frozen=True)
class TrainingWorld:
    """A drive along the map's route, on which a robot can be moved."""

    map: Map  # with which its frames are compared; none of them is an image of it
    views: Query  # the m described frames, as a batch
    rule: UpdateRule  # how a view's relevance becomes evidence
    n_neighbours: int  # k, map images that stand for one view
    lattice: Lattice  # of the map's route
    true_image: NDArray[np.int64]  # [m] int64, the map image nearest to every frame; -1 where there is none
    # [m, a] int64, the frame nearest to where a move leads; -1 where the drive ends before that
    next_frame: NDArray[np.int64]
    start_frames: NDArray[np.int64]  # [s] int64, frames where episodes may start
    moves: Moves  # the domain's actions [a] on the lattice

    @classmethod
    def on(
        cls, map_: Map, views: Query, live_route: Route, true_image: NDArray[np.int64], config: NnqlConfig
    ) -> "TrainingWorld":
        """The world of a drive, from its views [m], its own route, and the map image nearest to every frame, or -1."""
        actions_m = map_.actions_m
        lattice = Lattice.of_route(map_.route, actions_m)
        stds_m = [motion_std_m(m) if config.motion_std_m is None else config.motion_std_m for m in actions_m.tolist()]
        if map_.relevance.traits.compares_dissimilarities:  # which were measured once for all episodes
            views = replace(views, encoding=None)
        return cls(
            map_,
            views,
            config.update or map_.update_rule,
            config.n_neighbours,
            lattice,
            true_image,
            _next_frames(live_route, actions_m),
            _start_frames(live_route, true_image, config.n_actions_per_episode * actions_m),
            moves_along(lattice, actions_m.tolist(), stds_m),
        )

    @property
    def n_images(self) -> int:
        """n."""
        return self.map.n_images

    @property
    def n_actions(self) -> int:
        """a."""
        return int(self.next_frame.shape[1])

    def observing(self, live: LiveStatistics | None, frames: NDArray[np.int64]) -> LiveStatistics | None:
        """The episodes' own statistics, [e, r], after one more frame [e] each; None where the relevance needs none."""
        start = live or self.map.live_statistics
        if start is None or start.encodings is not None:
            return None
        return replace(start, ranks=start.ranks.observing(self.views.ranks[frames]))

    def look(
        self, frames: NDArray[np.int64], live: LiveStatistics | None
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Evidence [e, n] and the nearest map images [e, k], best first, of frames [e] by statistics [e, r]."""
        relevance = relevances(self.map, self.views.at(frames), live)
        evidence = batch_evidence(relevance, self.rule, self.map.log_likelihood_scale)
        return evidence, shortlist(relevance, self.n_neighbours)


def _next_frames(route: Route, actions_m: NDArray[np.float64]) -> NDArray[np.int64]:
    target = route.position_m[:, np.newaxis] + actions_m
    return np.where(route.reaches(target), route.nearest_image(route.wrapped(target)), -1)


def _start_frames(route: Route, true_image: NDArray[np.int64], episodes_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """[s] frames of known place from which an episode of any one move fits; where none does, all of known place."""
    is_placed = true_image >= 0
    fits = is_placed & route.reaches(route.position_m[:, np.newaxis] + episodes_m).all(axis=1)
    return np.flatnonzero(fits if fits.any() else is_placed)


class Walk:
    """Episodes that move in lockstep, each with its own belief and statistics.

    Attributes:
        world: The drive on which they move.
        frames: [e] the frame at which each robot is.
        nearest: [e, k] map images nearest to their views.
        ranks: [e] rank of the truth's belief from 0; below 0 where it is unknown.
    """

    def __init__(self, world: TrainingWorld, starts: NDArray[np.int64], pool: Executor | None = None) -> None:
        self.world = world
        self._pool = pool
        self._beliefs = uniform_beliefs(world.lattice, starts.size)
        self._live = world.observing(None, starts)
        self.frames = starts
        self._see(np.full(starts.size, -1, np.int64))

    @property
    def allowed(self) -> NDArray[np.bool_]:
        """[e, a] whether the drive has a frame where a move leads."""
        return self.world.next_frame[self.frames] >= 0

    def step(self, action: NDArray[np.int64]) -> None:
        """Move every robot by its action [e], an index among the domain's; one of -1, whose episode is over, stays."""
        is_moving = action >= 0
        self.frames = np.where(is_moving, self.world.next_frame[self.frames, action], self.frames)
        self._live = self.world.observing(self._live, self.frames)
        self._see(action)

    def _see(self, action: NDArray[np.int64]) -> None:
        e = self.frames.size
        self.nearest = np.empty((e, min(self.world.n_neighbours, self.world.n_images)), np.int64)
        self.ranks = np.empty(e)
        size = max(1, min(-(-e // 2), _CELLS_AT_ONCE // self.world.lattice.n_cells))
        parts = [slice(first, first + size) for first in range(0, e, size)]
        see = map if self._pool is None else self._pool.map
        for _ in see(partial(self._see_part, action), parts):
            pass

    def _see_part(self, action: NDArray[np.int64], part: slice) -> None:
        world, part_action, frames = self.world, action[part], self.frames[part]
        live = self._live
        if live is not None:
            live = replace(live, ranks=replace(live.ranks, mean=live.ranks.mean[part], square=live.ranks.square[part]))
        evidence, self.nearest[part] = world.look(frames, live)
        moves = Moves(
            np.where(part_action >= 0, world.moves.shift[part_action], NO_MOVE),
            world.moves.fraction[part_action],
            world.moves.taps[part_action],
        )
        self.ranks[part] = step_beliefs(
            world.lattice,
            self._beliefs[part],
            moves,
            evidence,
            world.true_image[frames],
            additive=world.rule.is_additive,
        )


@dataclass(frozen=True)
class LearningCurve:
    """How the share of rewarded moves grew in training, and what was reached."""

    reward_share: tuple[float, ...]  # share of rewarded moves of every hundred episodes
    greedy_reward_share: float  # the same by the learnt values, without exploration
    random_reward_share: float  # the same of random moves from the same starts

    def as_dict(self) -> dict[str, Any]:
        """The JSON form."""
        return {
            "reward_share": [round(share, 4) for share in self.reward_share],
            "greedy_reward_share": self.greedy_reward_share,
            "random_reward_share": self.random_reward_share,
        }


def train(
    world: TrainingWorld, config: NnqlConfig, on_progress: Callable[[float], None], pool: Executor | None = None
) -> tuple[NDArray[np.float32], LearningCurve]:
    """Learn the experience database, [n, a] float32, from nothing; returns it and the learning curve.

    They depend on the seed alone, not on how many threads the pool has.
    """
    q_values = initial_q_values(world.n_images, world.n_actions, config)
    successes = np.full((config.n_episodes, config.n_actions_per_episode), np.nan)
    for batch, first in enumerate(range(0, config.n_episodes, config.batch_episodes)):
        episodes = np.arange(first, min(first + config.batch_episodes, config.n_episodes))
        rng = np.random.default_rng([config.seed, batch])
        exploration = config.exploration_at(episodes)
        walk = Walk(world, rng.choice(world.start_frames, episodes.size), pool)
        for step in range(config.n_actions_per_episode):
            successes[episodes, step] = _learning_step(walk, q_values, exploration, rng, config)
        on_progress((first + episodes.size) / config.n_episodes)
    points = range(0, config.n_episodes, EPISODES_A_POINT)
    curve = tuple(_share(successes[first : first + EPISODES_A_POINT]) for first in points)
    n_starts = max(EPISODES_A_POINT, config.n_episodes // 50)
    starts = np.random.default_rng([config.seed, _EVALUATION]).choice(world.start_frames, n_starts)
    greedy, random = (
        _share(_successes(walk_greedily(world, starts, values, config, pool), world, config))
        for values in (q_values, initial_q_values(world.n_images, world.n_actions, config))
    )
    return q_values, LearningCurve(curve, greedy, random)


def walk_greedily(
    world: TrainingWorld,
    starts: NDArray[np.int64],
    q_values: NDArray[np.float32],
    config: NnqlConfig,
    pool: Executor | None = None,
) -> NDArray[np.float64]:
    """Rank of the truth's belief after every move of episodes that follow the Q-values without exploration.

    Args:
        starts: [e] frames.
        q_values: [n, a]; where all are equal the moves are random.

    Returns:
        [e, t] ranks from 0; below 0 where the place is unknown or the episode is over.
    """
    rng = np.random.default_rng([config.seed, _EVALUATION, 1])
    walk = Walk(world, starts, pool)
    ranks = np.empty((starts.size, config.n_actions_per_episode))
    for step in range(config.n_actions_per_episode):
        action = choose_actions(q_of_nearest(q_values, walk.nearest), walk.allowed, np.zeros(starts.size), rng)
        walk.step(action)
        ranks[:, step] = np.where(action >= 0, walk.ranks, -1.0)
    return ranks


def choose_actions(
    values: NDArray[np.float64], allowed: NDArray[np.bool_], exploration: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.int64]:
    """Epsilon-greedy moves, ties broken at random.

    Args:
        values, allowed: [e, a].
        exploration: [e] probability of drawing among all moves that are allowed.
        rng: Yields as many draws whatever the values are.

    Returns:
        [e] index of the move; -1 where none is allowed.
    """
    lots = rng.random(values.shape)
    is_exploring = rng.random(len(values)) < exploration
    best = np.where(allowed, values, -np.inf).max(axis=1, keepdims=True)
    candidates = allowed & ((values == best) | is_exploring[:, np.newaxis])
    action = np.where(candidates, lots, -1.0).argmax(axis=1)
    return np.where(allowed.any(axis=1), action, -1)


def _learning_step(
    walk: Walk,
    q_values: NDArray[np.float32],
    exploration: NDArray[np.float64],
    rng: np.random.Generator,
    config: NnqlConfig,
) -> NDArray[np.float64]:
    """Move every episode once and learn from it; returns [e] 1 where it earned the reward, 0 where not, NaN unknown."""
    nearest = walk.nearest
    action = choose_actions(q_of_nearest(q_values, nearest), walk.allowed, exploration, rng)
    walk.step(action)
    successes = _successes(np.where(action >= 0, walk.ranks, -1.0), walk.world, config)
    rows = np.flatnonzero(~np.isnan(successes))
    moves = Transitions(
        nearest[rows], action[rows], config.reward * successes[rows], walk.nearest[rows], walk.allowed[rows]
    )
    learn(q_values, moves, config)
    return successes


def _successes(ranks: NDArray[np.float64], world: TrainingWorld, config: NnqlConfig) -> NDArray[np.float64]:
    """1 where a rank, of any shape, earns the reward, 0 where not, NaN where it is below 0."""
    return np.where(ranks < 0, np.nan, ranks < config.top_share * world.n_images)


def _share(successes: NDArray[np.float64]) -> float:
    """Mean of the successes that are known, 0 where none is."""
    successes = successes[~np.isnan(successes)]
    return float(successes.mean()) if successes.size else 0.0
