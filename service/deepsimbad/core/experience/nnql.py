"""Nearest-neighbour Q-learning (II-D): the map's images are the states, and a view borrows those most relevant to it.

The experience database is `Q[map image, action]`. The value of a view is the mean over its k nearest map images,
nearest by relevance; what is learnt from a view moves the entries of the same images. A live session teaches as well,
once its true positions are known: `KnownWalk`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.index.retrieval import shortlist
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.relevance import Query, UpdateRule
from deepsimbad.errors import InvalidInputError, InvalidMapConfigError

FARTHEST_TRUTH_M = 10.0  # a truth farther from every map image is of no place of the map: another road, another frame


@dataclass(frozen=True)
class NnqlConfig:
    """The hyperparameters, with the paper's values where it gives one (III)."""

    n_episodes: int = 10_000  # training episodes
    n_actions_per_episode: int = 10  # moves of one episode, after its first view
    learning_rate: float = 0.1  # alpha, the share of the way an entry moves towards its target
    discount: float = 0.9  # gamma
    initial_q: float = 1e-4  # what an entry holds before anything is learnt
    reward: float = 100.0  # for a belief that places the truth well
    # Share of the map images; the true viewpoint's belief must rank among the best so many to earn the reward.
    top_share: float = 0.10
    n_neighbours: int = 4  # k, map images that stand for one view
    # Epsilon at the first episode: how often a move is drawn at random. Not given in the paper.
    exploration: float = 1.0
    final_exploration: float = 0.1  # epsilon at the last episode; between the two it falls in a straight line
    update: UpdateRule | None = None  # how a view changes the belief; None: as the map's relevance does by default
    motion_std_m: float | None = None  # standard deviation of a move; None: `motion_std_m` of it
    # Episodes that move in lockstep: each step acts on the same Q-values, then learns from all of them in their order.
    # More are faster, and hardly change the result.
    batch_episodes: int = 100
    seed: int = 0  # of every random draw

    def __post_init__(self) -> None:
        counts = (self.n_actions_per_episode, self.n_neighbours, self.batch_episodes)
        shares = (self.learning_rate, self.discount, self.top_share, self.exploration, self.final_exploration)
        if min(counts) < 1 or self.n_episodes < 0 or self.seed < 0:
            raise InvalidMapConfigError("NNQL needs at least one action, neighbour and episode, and a seed from 0")
        if not all(0 <= share <= 1 for share in shares):
            raise InvalidMapConfigError("NNQL's learning rate, discount, exploration and top share lie within 0 and 1")
        std_m = self.motion_std_m or 0.0
        if not all(np.isfinite([self.reward, self.initial_q, std_m])) or std_m < 0:
            raise InvalidMapConfigError("NNQL's reward, first value and motion deviation must be finite numbers")

    def exploration_at(self, episode: NDArray[np.int64]) -> NDArray[np.float64]:
        """[e] epsilon of episodes [e], counted from 0."""
        progress = episode / max(self.n_episodes - 1, 1)
        return self.exploration + (self.final_exploration - self.exploration) * progress


class Transitions(NamedTuple):
    """Moves whose outcome is known, in the order they are learnt."""

    nearest: NDArray[np.int64]  # [t, k] int64, map images most relevant to the view before the move
    action: NDArray[np.int64]  # [t] int64, index of the move among the domain's actions
    reward: NDArray[np.float64]  # [t] float64
    next_nearest: NDArray[np.int64]  # [t, k] int64, of the view after the move
    next_allowed: NDArray[np.bool_]  # [t, a] bool, the moves that the route allows from there; none where it ends


def initial_q_values(n_images: int, n_actions: int, config: NnqlConfig) -> NDArray[np.float32]:
    """[n, a] float32, an experience database that has learnt nothing."""
    return np.full((n_images, n_actions), config.initial_q, np.float32)


def q_of_nearest(q_values: NDArray[np.float32], nearest: NDArray[np.int64]) -> NDArray[np.float64]:
    """[t, a] the values of views, from their nearest map images [t, k]."""
    return np.asarray(q_values[nearest].mean(axis=1, dtype=np.float64))


def learn(q_values: NDArray[np.float32], moves: Transitions, config: NnqlConfig) -> None:
    """Q-learning, in place, one transition after the other.

    Each of the k entries of a transition moves by alpha towards `R + gamma max_a' Q(s', a')`.
    """
    _learn(q_values, *moves, config.learning_rate, config.discount)


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
            q_value = q_values[nearest[t, j], action[t]]
            q_values[nearest[t, j], action[t]] = q_value + learning_rate * (target - q_value)


@dataclass(frozen=True)
class KnownWalk:
    """A session's views and moves, and where they truly were."""

    queries: Sequence[Query]  # the t described views, in order of time
    action_m: NDArray[np.float64]  # [t] metres moved before every view; the first is ignored
    # [t] route positions, on a closed route any number of rounds on; NaN where unknown
    true_position_m: NDArray[np.float64]

    def __post_init__(self) -> None:
        if not len(self.queries) == self.action_m.size == self.true_position_m.size:
            raise InvalidInputError(
                f"{self.true_position_m.size} true positions for {len(self.queries)} views; give one for each, "
                "null where it is unknown",
                n_observations=len(self.queries),
            )


def transitions_of(map_: Map, walk: KnownWalk, config: NnqlConfig) -> Transitions:
    """Replay a walk as a session on the grid that starts anywhere, and reward its moves as training does.

    Where a move leads past the end the session begins anew, with the statistics that it has.

    A move counts for the domain's action nearest to it, if that is no farther than half the least step between two
    actions (of a single action, than half of it). Other moves, and those to an unknown place or to none of the map,
    teach nothing.
    """
    actions_m, route = map_.actions_m, map_.route
    reach_m = np.diff(actions_m).min() / 2 if actions_m.size > 1 else abs(actions_m[0]) / 2
    localizer = ActiveLocalizer(map_, LocalizerConfig(update=config.update))
    state = localizer.start()
    nearest: list[NDArray[np.int64]] = []
    outcomes: list[tuple[int, int, float]] = []  # view, action, reward
    for t, query in enumerate(walk.queries):
        step, _ = localizer.observe_or_restart(state, query, float(walk.action_m[t]), config.motion_std_m)
        state = step.state
        nearest.append(shortlist(step.relevance, config.n_neighbours))
        truth = route.nearest_image(route.wrapped(walk.true_position_m[[t]])).astype(np.int64)
        off_m = np.abs(route.offset_m(route.position_m[truth], walk.true_position_m[t]))
        if t == 0 or not off_m[0] <= FARTHEST_TRUTH_M:  # nor where it is unknown
            continue
        action = int(np.abs(actions_m - walk.action_m[t]).argmin())
        if abs(actions_m[action] - walk.action_m[t]) <= reach_m:
            is_earned = rank_of_truth(state.belief.mass, truth) < config.top_share * route.n_images
            outcomes.append((t, action, config.reward * is_earned))
    views = np.array([view for view, _, _ in outcomes], np.int64)
    k = min(config.n_neighbours, route.n_images)
    rows = np.array(nearest, np.int64).reshape(-1, k)
    ahead_m = walk.true_position_m[views][:, np.newaxis] + actions_m
    return Transitions(
        nearest=rows[views - 1],
        action=np.array([action for _, action, _ in outcomes], np.int64),
        reward=np.array([reward for _, _, reward in outcomes], np.float64),
        next_nearest=rows[views],
        next_allowed=route.reaches(ahead_m),
    )
