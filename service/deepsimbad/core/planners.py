"""Next-best-view planners: which move would tell the robot most (II-D, and ours)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.retrieval import shortlist
from deepsimbad.core.route import Route
from deepsimbad.errors import InvalidInputError

NNQL, TELLING, RANDOM, CONSTANT = "nnql", "telling", "random", "constant"
DEFAULT_PLANNER = TELLING
NNQL_NEIGHBOURS = 4  # k of the paper
_BITS_PER_METRE = 0.12  # what a longer move is worth for being less like the view before


@dataclass(frozen=True)
class PlanningView:
    """All a planner may look at.

    Attributes:
        route: Where the map images are.
        actions_m: [a] the moves there are, ascending.
        mass: [n] belief.
        relevance: [n] of the last view; None before any.
        q_values: [n, a] the experience database; None where the map has none.
        bits_ahead: [n, a] float32, by how much a view from where each move leads narrows the map down
            (`telling.bits_ahead`); None where nobody knows.
        seed: What random choices are drawn from, together with `step`.
        step: Number of the last observation.
    """

    route: Route
    actions_m: NDArray[np.float64]
    mass: NDArray[np.float64]
    relevance: NDArray[np.float32] | None
    q_values: NDArray[np.float32] | None
    bits_ahead: NDArray[np.float32] | None
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
        drawn = np.random.default_rng([view.seed, view.step]).choice(view.actions_m)
        return Plan(self.name, float(drawn))


@dataclass(frozen=True)
class NnqlPlanner:
    """The paper's: Q-values of the k map images most relevant to the last view, averaged (II-D)."""

    n_neighbours: int = NNQL_NEIGHBOURS
    name: str = NNQL

    def plan(self, view: PlanningView) -> Plan | None:
        """See `Planner.plan`; needs a view and an experience database."""
        if view.q_values is None or view.relevance is None:
            return None
        nearest = shortlist(view.relevance, self.n_neighbours)
        values = _mean_rows(view.q_values, nearest)
        return Plan(self.name, float(view.actions_m[np.argmax(values)]), values)


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
        if view.bits_ahead is None:
            return Plan(self.name, float(view.actions_m[-1]))
        worth = np.sqrt(_doubt(view.mass)) * _averaged(view.mass, view.bits_ahead)
        values = self.bits_per_metre * view.actions_m + worth
        return Plan(self.name, float(view.actions_m[np.argmax(values)]), values)


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
