"""Nearest-neighbour Q-learning (II-D): the map's images are the states, and a view borrows those most relevant to it.

The experience database is `Q[map image, action]`. The value of a view is the mean over its k nearest map images,
nearest by relevance; what is learnt from a view moves the entries of the same images.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.retrieval import shortlist
from deepsimbad.core.update_rules import UpdateRule
from deepsimbad.errors import InvalidMapConfigError


@dataclass(frozen=True)
class NnqlConfig:
    """The hyperparameters, with the paper's values where it gives one (III).

    Attributes:
        n_episodes: Training episodes.
        n_actions_per_episode: Moves of one episode, after its first view.
        learning_rate: Alpha, the share of the way an entry moves towards its target.
        discount: Gamma.
        initial_q: What an entry holds before anything is learnt.
        reward: For a belief that places the truth well.
        top_share: Share of the map images among which the true viewpoint's belief must rank to earn the reward.
        n_neighbours: k, map images that stand for one view.
        exploration: Epsilon at the first episode: how often a move is drawn at random. Not given in the paper.
        final_exploration: Epsilon at the last episode; between the two it falls in a straight line.
        update: How a view changes the belief; None: as the map's relevance does by default.
        motion_std_m: Standard deviation of a move; None: `filters.motion_std_m`.
        batch_episodes: Episodes that move in lockstep: each step acts on the same Q-values, then learns from all of
            them in their order. It decides speed, and hardly the result.
        seed: Of every draw.
    """

    n_episodes: int = 10_000
    n_actions_per_episode: int = 10
    learning_rate: float = 0.1
    discount: float = 0.9
    initial_q: float = 1e-4
    reward: float = 100.0
    top_share: float = 0.10
    n_neighbours: int = 4
    exploration: float = 1.0
    final_exploration: float = 0.1
    update: UpdateRule | None = None
    motion_std_m: float | None = None
    batch_episodes: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        counts = (self.n_actions_per_episode, self.n_neighbours, self.batch_episodes)
        shares = (self.learning_rate, self.discount, self.top_share, self.exploration, self.final_exploration)
        if min(counts) < 1 or self.n_episodes < 0 or self.seed < 0:
            raise InvalidMapConfigError("NNQL needs at least one action, neighbour and episode, and a seed from 0")
        if not all(0 <= share <= 1 for share in shares):
            raise InvalidMapConfigError("NNQL's learning rate, discount, exploration and top share lie within 0 and 1")
        if (
            not all(np.isfinite([self.reward, self.initial_q, self.motion_std_m or 0.0]))
            or (self.motion_std_m or 0) < 0
        ):
            raise InvalidMapConfigError("NNQL's reward, first value and motion deviation must be finite numbers")

    def exploration_at(self, episode: NDArray[np.int64]) -> NDArray[np.float64]:
        """Epsilon of episodes, counted from 0."""
        done = episode / max(self.n_episodes - 1, 1)
        return self.exploration + (self.final_exploration - self.exploration) * done


@dataclass(frozen=True)
class Transitions:
    """Moves whose outcome is known, in the order they are learnt.

    Attributes:
        nearest: [t, k] int64, map images most relevant to the view before the move.
        action: [t] int64, place of the move among the domain's actions.
        reward: [t] float64.
        next_nearest: [t, k] int64, of the view after the move.
        next_allowed: [t, a] bool, the moves that are possible from there; none: the route ends.
    """

    nearest: NDArray[np.int64]
    action: NDArray[np.int64]
    reward: NDArray[np.float64]
    next_nearest: NDArray[np.int64]
    next_allowed: NDArray[np.bool_]


def initial_q_values(n_images: int, n_actions: int, config: NnqlConfig) -> NDArray[np.float32]:
    """An experience database [n, a] that knows nothing."""
    return np.full((n_images, n_actions), config.initial_q, np.float32)


def append_images(
    q_values: NDArray[np.float32], n_images: int, config: NnqlConfig | None = None
) -> NDArray[np.float32]:
    """The experience database with further map images [m, a] behind the present ones; this one is unchanged."""
    fresh = initial_q_values(n_images, q_values.shape[1], config or NnqlConfig())
    return np.concatenate([q_values, fresh])


def q_of_view(q_values: NDArray[np.float32], relevance: NDArray[np.float32], k: int) -> NDArray[np.float32]:
    """`Q(s, a) = |N(s)|^-1 sum over s' in N(s) of Q(s', a)`: the value of every action in a view.

    Args:
        q_values: [n, a].
        relevance: [n] of every map image to the view, larger is better.
        k: Nearest map images that are asked; ties by id.

    Returns:
        [a] float32.
    """
    return np.asarray(q_values[shortlist(relevance, k)].mean(axis=0, dtype=np.float64), np.float32)


def q_of_nearest(q_values: NDArray[np.float32], nearest: NDArray[np.int64]) -> NDArray[np.float64]:
    """The values [t, a] of views whose nearest map images [t, k] are known."""
    return np.asarray(q_values[nearest].mean(axis=1, dtype=np.float64))


def learn(q_values: NDArray[np.float32], moves: Transitions, config: NnqlConfig) -> None:
    """Q-learning, in place, one transition after the other.

    Each of the k entries moves by alpha towards `R + gamma max_a' Q(s', a')`.
    """
    _learn(
        q_values,
        moves.nearest,
        moves.action,
        moves.reward,
        moves.next_nearest,
        moves.next_allowed,
        config.learning_rate,
        config.discount,
    )


def learn_online(
    q_values: NDArray[np.float32], transitions: Transitions, config: NnqlConfig | None = None
) -> NDArray[np.float32]:
    """The experience database after moves of a live session, once its true positions are known; a new one."""
    learnt = q_values.astype(np.float32, copy=True)
    learn(learnt, transitions, config or NnqlConfig())
    return learnt


@njit(cache=True, nogil=True)
def _learn(
    q_values: NDArray[np.float32],
    nearest: NDArray[np.int64],
    action: NDArray[np.int64],
    reward: NDArray[np.float64],
    next_nearest: NDArray[np.int64],
    next_allowed: NDArray[np.bool_],
    learning_rate: float,
    discount: float,
) -> None:
    k = nearest.shape[1]
    for t in range(action.size):
        best = -np.inf
        for a in range(q_values.shape[1]):
            if not next_allowed[t, a]:
                continue
            total = 0.0
            for j in range(k):
                total += q_values[next_nearest[t, j], a]
            best = max(best, total / k)
        target = reward[t] + (discount * best if best > -np.inf else 0.0)
        for j in range(k):
            old = q_values[nearest[t, j], action[t]]
            q_values[nearest[t, j], action[t]] = old + learning_rate * (target - old)
