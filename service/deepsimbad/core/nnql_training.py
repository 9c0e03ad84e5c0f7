"""Training of the experience database: episodes of a live drive through the map (II-D, III)."""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.nnql import NnqlConfig, Transitions, initial_q_values, learn, q_of_nearest
from deepsimbad.core.training_world import TrainingWorld, Walk

EPISODES_A_POINT = 100  # of the learning curve
_EVALUATION = 0xE7A1  # part of the evaluation's seed, which no batch of training has


@dataclass(frozen=True)
class LearningCurve:
    """How training went.

    Attributes:
        reward_share: Share of the moves that earned the reward, by hundred episodes.
        greedy_reward_share: The same of the learnt values without exploration.
        random_reward_share: Of random moves from the same starts.
    """

    reward_share: tuple[float, ...]
    greedy_reward_share: float
    random_reward_share: float

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "reward_share": [round(share, 4) for share in self.reward_share],
            "greedy_reward_share": self.greedy_reward_share,
            "random_reward_share": self.random_reward_share,
        }


def train(
    world: TrainingWorld, config: NnqlConfig, on_progress: Callable[[float], None], pool: Executor | None = None
) -> tuple[NDArray[np.float32], LearningCurve]:
    """Learn the experience database from nothing.

    The result depends on the seed alone, not on how many threads the pool has.

    Args:
        world: Where the episodes run.
        config: The hyperparameters.
        on_progress: Called with the share done; may raise to cancel.
        pool: Takes half of every batch in a thread of its own.

    Returns:
        Q-values [n, a] float32, and the learning curve.
    """
    q_values = initial_q_values(world.n_images, world.n_actions, config)
    earned = np.full((config.n_episodes, config.n_actions_per_episode), np.nan)
    for batch, first in enumerate(range(0, config.n_episodes, config.batch_episodes)):
        episodes = np.arange(first, min(first + config.batch_episodes, config.n_episodes))
        rng = np.random.default_rng([config.seed, batch])
        exploration = config.exploration_at(episodes)
        walk = Walk(world, rng.choice(world.start_frames, episodes.size), pool)
        for step in range(config.n_actions_per_episode):
            earned[episodes, step] = _learning_step(walk, q_values, exploration, rng, config)
        on_progress((first + episodes.size) / config.n_episodes)
    curve = [_share(earned[first : first + EPISODES_A_POINT]) for first in range(0, len(earned), EPISODES_A_POINT)]
    n_starts = max(EPISODES_A_POINT, config.n_episodes // 50)
    starts = np.random.default_rng([config.seed, _EVALUATION]).choice(world.start_frames, n_starts)
    greedy, random = (
        _share(_earned(walk_greedily(world, starts, values, config, pool), world, config))
        for values in (q_values, initial_q_values(world.n_images, world.n_actions, config))
    )
    return q_values, LearningCurve(tuple(curve), greedy, random)


def walk_greedily(
    world: TrainingWorld,
    starts: NDArray[np.int64],
    q_values: NDArray[np.float32],
    config: NnqlConfig,
    pool: Executor | None = None,
) -> NDArray[np.float64]:
    """Rank of the truth's belief after every move of episodes that follow the Q-values without exploration.

    Args:
        world: Where the episodes run.
        starts: [e] frames.
        q_values: [n, a]; where all are alike the moves are random.
        config: For the length of an episode, and the seed by which ties are broken.
        pool: As for `train`.

    Returns:
        [e, t], from 0; below 0 where the place is unknown or the episode is over.
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
    values: NDArray[np.float64],
    allowed: NDArray[np.bool_],
    exploration: NDArray[np.float64],
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Epsilon-greedy moves, ties broken at random.

    Args:
        values: [e, a].
        allowed: [e, a].
        exploration: [e], how often to draw from all that are allowed.
        rng: Of the draws; as many whatever the values are.

    Returns:
        [e], -1 where nothing is allowed.
    """
    lots = rng.random(values.shape)
    explores = rng.random(len(values)) < exploration
    best = np.where(allowed, values, -np.inf).max(axis=1, keepdims=True)
    candidates = allowed & ((values == best) | explores[:, np.newaxis])
    chosen = np.where(candidates, lots, -1.0).argmax(axis=1)
    return np.where(allowed.any(axis=1), chosen, -1)


def _learning_step(
    walk: Walk,
    q_values: NDArray[np.float32],
    exploration: NDArray[np.float64],
    rng: np.random.Generator,
    config: NnqlConfig,
) -> NDArray[np.float64]:
    """One move of every episode, and what it teaches; 1 where it earned the reward, 0 where not, NaN unknown."""
    nearest = walk.nearest
    action = choose_actions(q_of_nearest(q_values, nearest), walk.allowed, exploration, rng)
    walk.step(action)
    earned = _earned(np.where(action >= 0, walk.ranks, -1.0), walk.world, config)
    known = np.flatnonzero(~np.isnan(earned))
    moves = Transitions(
        nearest[known], action[known], config.reward * earned[known], walk.nearest[known], walk.allowed[known]
    )
    learn(q_values, moves, config)
    return earned


def _earned(ranks: NDArray[np.float64], world: TrainingWorld, config: NnqlConfig) -> NDArray[np.float64]:
    return np.where(ranks < 0, np.nan, ranks < config.top_share * world.n_images)


def _share(earned: NDArray[np.float64]) -> float:
    known = earned[~np.isnan(earned)]
    return float(known.mean()) if known.size else 0.0
