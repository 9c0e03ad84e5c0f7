"""Which move would tell the robot most (II-D, and ours)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.belief.cells import SUMS
from deepsimbad.core.index.retrieval import shortlist
from deepsimbad.core.map import Map
from deepsimbad.core.route import Route
from deepsimbad.errors import InvalidInputError, nearest_of

NNQL, INFORMED, RANDOM, CONSTANT = "nnql", "informed", "random", "constant"
DEFAULT_PLANNER = INFORMED
NNQL_NEIGHBOURS = 4  # k of the paper
_DISCOUNT, _SWEEPS = 0.9, 60
_IMAGES_AT_ONCE = 256  # few enough for single precision
_NOTHING = 1e-6  # of a belief: so many images that hold less together move no average
_MOST_PRICES = 8  # whose tables are kept: of 26,000 images each takes 2 MB


@dataclass(frozen=True)
class PlanningView:
    """All a planner may look at: map, belief [n], relevance [n] of the last view, and what draws depend on."""

    map: Map
    mass: NDArray[np.float64]
    relevance: NDArray[np.float32] | None
    seed: int
    step: int
    price_bits_per_m: float = 0.0


@dataclass(frozen=True)
class Plan:
    """A recommended move."""

    planner: str  # who recommends it
    action_m: float  # the move
    # [a] what the planner thought of every move, larger is better; None where it did not compare
    values: NDArray[np.float64] | None = None
    bits: NDArray[np.float64] | None = (
        None  # [a] that the view after every move is expected to tell; None: nobody knows
    )


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


def plan_by_information(view: PlanningView) -> Plan:
    """Ours: acts on bits that views ahead are worth, under the whole belief; ties go to the longer move, and forward.

    Where nobody knows what views are worth it is the longest move.
    """
    actions_m = view.map.actions_m
    table = information_ahead(view.map, view.price_bits_per_m)
    both = np.zeros(2 * actions_m.size) if table is None else _averaged(view.mass, table.T)
    values, bits = both[: actions_m.size], both[actions_m.size :]
    *_, best_m = max(zip(values.tolist(), np.abs(actions_m).tolist(), actions_m.tolist(), strict=True))
    return Plan(INFORMED, best_m) if table is None else Plan(INFORMED, best_m, values, bits)


def information_ahead(map_: Map, price_bits_per_m: float) -> NDArray[np.float32] | None:
    """[n, 2a] discounted bits of a move from every image and of the best after it, then bits of its first view alone.

    A view is worth what its place is, but for what the view before explains of its error: `(1 - c(a)) I(x + a)`,
    less the price of the metres. Worked out once a map for each of the last few prices; None where nobody knows what
    views are worth.
    """
    if map_.view_bits is None:
        return None
    tables = map_.information_tables
    table = tables.get(price_bits_per_m)
    if table is None:
        actions_m = map_.actions_m
        news = np.array([1.0 - map_.alike_after(action_m) for action_m in actions_m.tolist()])
        leads_to, bits = _leads_to(map_.route, actions_m), map_.view_bits.astype(np.float64)
        values = _swept(leads_to, bits, news, price_bits_per_m * np.abs(actions_m))
        first = news * np.where(leads_to < 0, bits.mean(), bits[leads_to])
        table = np.asfortranarray(np.hstack([values, first.astype(np.float32)]))  # as it is summed
        if len(tables) >= _MOST_PRICES:
            tables.pop(next(iter(tables)), None)
        tables[price_bits_per_m] = table
    return table


def _leads_to(route: Route, actions_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """[n, a] the image where every move leads; -1 past an end of an open route."""
    target_m = route.wrapped(route.position_m[:, np.newaxis] + actions_m)
    image = route.nearest_image(target_m)
    return np.where(route.reaches(target_m), image, -1)


@njit(cache=True, nogil=True)
def _swept(
    leads_to: NDArray[np.int64], bits: NDArray[np.float64], news: NDArray[np.float64], price: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Value iteration; past an end of the route everything is as on average."""
    n, n_actions = leads_to.shape
    values = np.zeros((n, n_actions), np.float32)
    best = np.zeros(n)
    usual_bits = bits.mean()
    for _ in range(_SWEEPS):
        usual = best.mean()
        for i in range(n):
            for a in range(n_actions):
                image = leads_to[i, a]
                there = usual_bits if image < 0 else bits[image]
                then = usual if image < 0 else best[image]
                values[i, a] = news[a] * there - price[a] + _DISCOUNT * then
        for i in range(n):
            best[i] = values[i].max()
    return values


_PLANNERS: dict[str, Planner] = {INFORMED: plan_by_information, NNQL: plan_by_experience, RANDOM: plan_at_random}


@njit(cache=True, nogil=True, fastmath=SUMS)
def _averaged(mass: NDArray[np.float64], columns: NDArray[np.float32]) -> NDArray[np.float64]:
    """[a] columns [a, n] averaged by mass. A loop of our own: BLAS would wake its threads for this."""
    averages, total = np.zeros(len(columns)), 0.0
    for begin in range(0, mass.size, _IMAGES_AT_ONCE):
        shares = mass[begin : begin + _IMAGES_AT_ONCE].astype(np.float32)
        held = shares.sum()
        if held < _NOTHING:
            continue
        total += held
        for place in range(averages.size):
            column, some = columns[place, begin : begin + _IMAGES_AT_ONCE], np.float32(0)
            for image in range(shares.size):
                some += shares[image] * column[image]
            averages[place] += some
    return averages / max(total, _NOTHING)


@njit(cache=True, nogil=True)
def _mean_rows(table: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    means = np.zeros(table.shape[1])
    for row in rows:
        for place in range(means.size):
            means[place] += table[row, place] / rows.size
    return means


def parse_planner(text: str, actions_m: Sequence[float]) -> Planner:
    """A planner by name: `informed`, `nnql`, `random` or `constant:<m>`.

    Raises:
        InvalidInputError: No such planner, or a constant move the domain does not have.
    """
    planners = _PLANNERS | {f"{CONSTANT}:{action_m:g}": partial(plan_constantly, action_m) for action_m in actions_m}
    if text not in planners:
        raise InvalidInputError(
            f"{text!r} is no planner of this domain{nearest_of(text, planners)}", allowed=list(planners)
        )
    return planners[text]
