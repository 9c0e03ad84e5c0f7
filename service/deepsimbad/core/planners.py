"""Which move would tell the robot most (II-D, and ours): what places are telling, and the planners."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

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
    """All a planner may look at.

    Attributes:
        map: The map.
        mass: [n] belief.
        relevance: [n] of the last view; None before any.
        seed: What random choices are drawn from, together with `step`.
        step: Number of the last observation.
    """

    map: Map
    mass: NDArray[np.float64]
    relevance: NDArray[np.float32] | None
    seed: int
    step: int


@dataclass(frozen=True)
class Plan:
    """A recommended move.

    Attributes:
        planner: Who recommends it.
        action_m: The move.
        values: [a] what the planner thought of every move, larger is better; None where it did not compare.
    """

    planner: str
    action_m: float
    values: NDArray[np.float64] | None = None


class Planner(Protocol):
    """Chooses the next move."""

    @property
    def name(self) -> str:
        """As it is asked for."""
        ...

    def plan(self, view: PlanningView) -> Plan | None:
        """Recommend a move; None where the planner has nothing to go by."""
        ...


@dataclass(frozen=True)
class ConstantPlanner:
    """The same move always (the paper's a[m])."""

    action_m: float

    @property
    def name(self) -> str:
        """`constant:<m>`."""
        return f"{CONSTANT}:{self.action_m:g}"

    def plan(self, view: PlanningView) -> Plan:  # noqa: ARG002 - that is the point of it
        """See `Planner.plan`."""
        return Plan(self.name, self.action_m)


@dataclass(frozen=True)
class RandomPlanner:
    """Any move alike (the paper's baseline)."""

    name: str = RANDOM

    def plan(self, view: PlanningView) -> Plan:
        """See `Planner.plan`."""
        drawn = np.random.default_rng([view.seed, view.step]).choice(view.map.actions_m)
        return Plan(self.name, float(drawn))


@dataclass(frozen=True)
class NnqlPlanner:
    """The paper's: Q-values of the k map images most relevant to the last view, averaged (II-D)."""

    n_neighbours: int = NNQL_NEIGHBOURS
    name: str = NNQL

    def plan(self, view: PlanningView) -> Plan | None:
        """See `Planner.plan`; needs a view and an experience database."""
        if view.map.q_values is None or view.relevance is None:
            return None
        nearest = shortlist(view.relevance, self.n_neighbours)
        values = _mean_rows(view.map.q_values, nearest)
        return Plan(self.name, float(view.map.actions_m[np.argmax(values)]), values)


@dataclass(frozen=True)
class TellingPlanner:
    """Ours: looks ahead over the map, under the whole belief.

    The value of a move is the number of bits that views from where it leads are known to be worth, averaged over the
    belief, less the less doubt there is left for them to remove, and a little for every metre. While the belief is
    flat that average is much the same everywhere, so the robot moves on as far as it can; once it has a few places in
    mind it seeks the telling ones before them; once it is sure it moves on, to views that are unlike the last.
    """

    bits_per_metre: float = _BITS_PER_METRE
    name: str = TELLING

    def plan(self, view: PlanningView) -> Plan:
        """See `Planner.plan`; where nobody knows what is telling, the longest move."""
        if view.map.bits_ahead is None:
            return Plan(self.name, float(view.map.actions_m[-1]))
        worth = np.sqrt(_doubt(view.mass)) * _averaged(view.mass, view.map.bits_ahead)
        values = self.bits_per_metre * view.map.actions_m + worth
        return Plan(self.name, float(view.map.actions_m[np.argmax(values)]), values)


def _doubt(mass: NDArray[np.float64]) -> float:
    """What is left of the greatest doubt there can be, 0..1: the entropy (of order 2) over that of no knowledge."""
    if mass.size == 1:
        return 0.0
    return float(-np.log2(np.square(mass).sum()) / np.log2(mass.size))


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
    named: dict[str, Planner] = {TELLING: TellingPlanner(), NNQL: NnqlPlanner(), RANDOM: RandomPlanner()}
    if text in named:
        return named[text]
    kind, _, metres = text.partition(":")
    allowed = [*named, *(ConstantPlanner(action_m).name for action_m in actions_m)]
    if kind == CONSTANT:
        for action_m in actions_m:
            if metres == f"{action_m:g}":
                return ConstantPlanner(action_m)
    raise InvalidInputError(f"{text!r} is no planner of this domain", allowed=allowed)


def telling_bits(map_: Map, second: SecondSeason) -> NDArray[np.float32]:
    """By how many bits a view from every map image's place narrows the map down: how telling it is (ours).

    The landmark traverse stands for a live drive of another season. Where it saw a place of the map, the rank of that
    place in its retrieval says how telling the place is.

    Args:
        map_: The map; its lists must not know the second season.
        second: Its `places` hold at least one pair.

    Returns:
        [n] float32.
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
