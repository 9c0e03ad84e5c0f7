"""Which move would tell the robot most (II-D, and ours): what places are telling, and the planners."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import SecondSeason
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.relevance import Query
from deepsimbad.core.retrieval import relevances, shortlist
from deepsimbad.core.route import Route
from deepsimbad.errors import InvalidInputError

NNQL, TELLING, RANDOM, CONSTANT = "nnql", "telling", "random", "constant"
DEFAULT_PLANNER = TELLING
NNQL_NEIGHBOURS = 4  # k of the paper
_SMOOTHED_OVER_M = 1.0  # one view is a noisy measurement of its place; neighbours show much the same
_MAX_VIEWS = 20_000  # more would only take longer
_BITS_PER_METRE = 0.12  # what a longer move is worth for being less like the view before


@dataclass(frozen=True)
class PlanningView:
    """All a planner may look at: map, belief [n], relevance [n] of the last view, and what draws depend on."""

    map: Map
    mass: NDArray[np.float64]
    relevance: NDArray[np.float32] | None
    seed: int
    step: int


@dataclass(frozen=True)
class Plan:
    """A recommended move."""

    planner: str  # who recommends it
    action_m: float  # the move
    # [a] what the planner thought of every move, larger is better; None where it did not compare
    values: NDArray[np.float64] | None = None


Planner: TypeAlias = Callable[[PlanningView], Plan | None]
"""Recommends a move; None where it has nothing to go by."""


def plan_constantly(action_m: float, view: PlanningView) -> Plan:  # noqa: ARG001 - that is the point of it
    """The same move always (the paper's a[m])."""
    return Plan(f"{CONSTANT}:{action_m:g}", action_m)


def plan_at_random(view: PlanningView) -> Plan:
    """Any move alike (the paper's baseline)."""
    return Plan(RANDOM, float(np.random.default_rng([view.seed, view.step]).choice(view.map.actions_m)))


def plan_by_experience(view: PlanningView) -> Plan | None:
    """The paper's: Q-values of the k map images most relevant to the last view, averaged (II-D)."""
    if view.map.q_values is None or view.relevance is None:
        return None
    values = _mean_rows(view.map.q_values, shortlist(view.relevance, NNQL_NEIGHBOURS))
    return Plan(NNQL, float(view.map.actions_m[np.argmax(values)]), values)


def plan_for_telling_places(view: PlanningView) -> Plan:
    """Ours: looks ahead over the map, under the whole belief; where nobody knows what is telling, the longest move.

    The value of a move is the number of bits that views from where it leads are known to be worth, averaged over the
    belief, less the less doubt there is left for them to remove, and a little for every metre. While the belief is
    flat that average is much the same everywhere, so the robot moves on as far as it can; once it has a few places in
    mind it seeks the telling ones before them; once it is sure it moves on, to views that are unlike the last.
    """
    actions_m, bits_ahead = view.map.actions_m, view.map.bits_ahead
    if bits_ahead is None:
        return Plan(TELLING, float(actions_m[-1]))
    doubt = 0.0  # what is left of the greatest there can be, 0..1: entropy (of order 2) over that of no knowledge
    if view.mass.size > 1:
        doubt = float(-np.log2(np.square(view.mass).sum()) / np.log2(view.mass.size))
    values = _BITS_PER_METRE * actions_m + np.sqrt(doubt) * _averaged(view.mass, bits_ahead)
    return Plan(TELLING, float(actions_m[np.argmax(values)]), values)


_PLANNERS: dict[str, Planner] = {TELLING: plan_for_telling_places, NNQL: plan_by_experience, RANDOM: plan_at_random}


@njit(cache=True, nogil=True)
def _averaged(mass: NDArray[np.float64], rows: NDArray[np.float32]) -> NDArray[np.float64]:
    """[a] rows averaged by mass. A loop of our own: BLAS would wake its threads for this."""
    averages = np.zeros(rows.shape[1])
    for image in range(mass.size):
        for place in range(averages.size):
            averages[place] += mass[image] * rows[image, place]
    return averages


@njit(cache=True, nogil=True)
def _mean_rows(table: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    means = np.zeros(table.shape[1])
    for row in rows:
        for place in range(means.size):
            means[place] += table[row, place] / rows.size
    return means


def parse_planner(text: str, actions_m: Sequence[float]) -> Planner:
    """A planner by name: `telling`, `nnql`, `random` or `constant:<m>`.

    Raises:
        InvalidInputError: No such planner, or a constant move the domain does not have.
    """
    planners = _PLANNERS | {f"{CONSTANT}:{action_m:g}": partial(plan_constantly, action_m) for action_m in actions_m}
    if text not in planners:
        raise InvalidInputError(f"{text!r} is no planner of this domain", allowed=list(planners))
    return planners[text]


def telling_bits(map_: Map, second: SecondSeason) -> NDArray[np.float32]:
    """[n] by how many bits a view from every map image's place narrows the map down: how telling it is (ours).

    The landmark traverse stands for a live drive of another season. Where it saw a place of the map, the rank of that
    place in its retrieval says how telling the place is.

    Args:
        map_: Its lists must not know the second season.
        second: Its `places` hold at least one pair.
    """
    step = -(-len(second.places) // _MAX_VIEWS)
    places = second.places[::step]
    bits = np.empty(len(places))
    for row, (image, frame) in enumerate(places):
        relevance = relevances(map_, Query(rank_landmarks(second.dissimilarities[frame])))
        bits[row] = np.log2(relevance.size / (1 + rank_of_truth(relevance, np.array([image]))))
    return _smooth(map_.route, map_.position_m[places[:, 0]], bits).astype(np.float32)


def _smooth(route: Route, at_m: NDArray[np.float64], bits: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n] local mean of measurements along the route; far from all of them their overall mean."""
    order = np.argsort(at_m, kind="stable")
    at_m, bits = at_m[order], bits[order]
    reach = 3 * _SMOOTHED_OVER_M
    first = np.searchsorted(at_m, route.position_m - reach)
    stop = np.searchsorted(at_m, route.position_m + reach, side="right")
    smoothed = np.full(route.n_images, bits.mean())
    for image, (low, high) in enumerate(zip(first, stop, strict=True)):
        if high > low:
            near = np.exp(-0.5 * np.square((at_m[low:high] - route.position_m[image]) / _SMOOTHED_OVER_M))
            smoothed[image] = (near * bits[low:high]).sum() / near.sum()
    return smoothed
