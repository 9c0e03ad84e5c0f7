"""What a live session teaches once its true positions are known (II-D): the rewards it would have earned."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.filters import motion_std_m
from deepsimbad.core.grid_filter import GridFilter
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.nnql import NnqlConfig, Transitions
from deepsimbad.core.relevance import Query, RetrievalMap, relevances
from deepsimbad.core.retrieval import shortlist
from deepsimbad.core.route import Route
from deepsimbad.core.update_rules import DEFAULT_UPDATE
from deepsimbad.errors import InvalidInputError, PastTheEndError


@dataclass(frozen=True)
class KnownWalk:
    """A session's views and moves, and where they truly were.

    Attributes:
        queries: The t described views, in order.
        action_m: [t] metres moved before every view; the first is not read.
        true_position_m: [t] route positions; NaN where unknown.
    """

    queries: Sequence[Query]
    action_m: NDArray[np.float64]
    true_position_m: NDArray[np.float64]

    def __post_init__(self) -> None:
        if not len(self.queries) == self.action_m.size == self.true_position_m.size:
            raise InvalidInputError(
                f"{self.true_position_m.size} true positions for {len(self.queries)} views; give one for each, "
                "null where it is unknown",
                n_observations=len(self.queries),
            )


def transitions_of(
    built: RetrievalMap, route: Route, actions_m: Sequence[float], walk: KnownWalk, config: NnqlConfig
) -> Transitions:
    """Replay a walk from a uniform belief, and reward its moves as training does.

    A move counts for the domain's action nearest to it, if that is nearer than half the step between two actions (of
    one action alone, than half of it). Other moves, and those to an unknown place, teach nothing.

    Args:
        built: The map.
        route: Where its images are.
        actions_m: The domain's moves, ascending.
        walk: What happened.
        config: The hyperparameters.
    """
    moves = np.asarray(actions_m, np.float64)
    reach_m = np.diff(moves).min() / 2 if moves.size > 1 else moves[0] / 2
    rule = config.update or DEFAULT_UPDATE[built.relevance]
    belief, live = GridFilter.uniform(route), built.statistics
    nearest: list[NDArray[np.int64]] = []
    rewarded: list[tuple[int, int, float]] = []  # view, action, reward
    for t, query in enumerate(walk.queries):
        if t > 0:
            action_m = float(walk.action_m[t])
            std_m = motion_std_m(action_m) if config.motion_std_m is None else config.motion_std_m
            try:
                belief = belief.predicted(action_m, std_m, t)
            except PastTheEndError:
                belief = GridFilter.uniform(route)
        live = None if live is None else live.observing(query.ranks)
        relevance = relevances(built, query, live)
        belief = belief.updated(relevance, rule, t)
        nearest.append(shortlist(relevance, config.n_neighbours))
        if t == 0 or np.isnan(walk.true_position_m[t]):
            continue
        action = int(np.abs(moves - walk.action_m[t]).argmin())
        if abs(moves[action] - walk.action_m[t]) <= reach_m:
            truth = route.nearest_image(walk.true_position_m[[t]]).astype(np.int64)
            earned = rank_of_truth(belief.mass, truth) < config.top_share * route.n_images
            rewarded.append((t, action, config.reward * earned))
    views = np.array([view for view, _, _ in rewarded], np.int64)
    k = min(config.n_neighbours, route.n_images)
    rows = np.array(nearest, np.int64).reshape(-1, k)
    ahead_m = walk.true_position_m[views][:, np.newaxis] + moves
    return Transitions(
        nearest=rows[views - 1],
        action=np.array([action for _, action, _ in rewarded], np.int64),
        reward=np.array([reward for _, _, reward in rewarded], np.float64),
        next_nearest=rows[views],
        next_allowed=route.closed | (ahead_m <= route.position_m[-1] + 1e-9),
    )
