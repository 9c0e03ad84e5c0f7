"""Which move would tell the robot most (II-D, and ours)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.belief.cells import SUMS
from deepsimbad.core.belief.motion import usual_errors
from deepsimbad.core.belief.summary import near_mode
from deepsimbad.core.index.retrieval import shortlist
from deepsimbad.core.map import Map
from deepsimbad.core.route import Route
from deepsimbad.errors import InvalidInputError, nearest_of

NNQL, INFORMED, RANDOM, CONSTANT = "nnql", "informed", "random", "constant"
DEFAULT_PLANNER = INFORMED
NNQL_NEIGHBOURS = 4  # k of the paper
_DISCOUNT, _SWEEPS = 0.9, 60
_DOUBT_WEIGHT = 2.0  # bits of views, which are counted on a map that knows nothing, for a bit of doubt
_IMAGES_AT_ONCE = 256  # few enough for single precision
_LEAST_MASS = 1e-6  # of a belief; a block of images that holds less is left out of its averages
PROBABLY = 0.5  # of a move to end on the route: with less another one is taken
_MOST_PRICES = 8  # whose tables a map keeps: one of 26,000 images takes 2 MB


@dataclass(frozen=True)
class PlanningView:
    """All a planner may look at: map, belief [n], relevance [n] of the last view, seed and step of its draws."""

    map: Map
    mass: NDArray[np.float32]
    relevance: NDArray[np.float32] | None
    seed: int
    step: int
    price_bits_per_m: float = 0.0


@dataclass(frozen=True)
class Plan:
    """A recommended move."""

    planner: str  # name of the planner that recommends it
    action_m: float
    # [a] how good the planner takes every move to be, larger is better; None where it compared none
    values: NDArray[np.float64] | None = None
    # [a] bits that the view after every move is expected to tell; None where nobody knows
    bits: NDArray[np.float64] | None = None
    chance_on_route: float = 1.0  # of the move to end on an open route; 1 where the planner does not ask


Planner: TypeAlias = Callable[[PlanningView], Plan | None]
"""Recommends a move; None where it has nothing to go by."""


def plan_constantly(action_m: float, view: PlanningView) -> Plan:  # noqa: ARG001 - that is the point of it
    """The same move always (the paper's a[m])."""
    return Plan(f"{CONSTANT}:{action_m:g}", action_m)


def plan_at_random(view: PlanningView) -> Plan:
    """Every move with the same probability (the paper's baseline)."""
    return Plan(RANDOM, float(np.random.default_rng([view.seed, view.step]).choice(view.map.actions_m)))


def plan_by_experience(view: PlanningView) -> Plan | None:
    """The move of the greatest mean Q-value over the k map images most relevant to the last view (II-D)."""
    if view.map.q_values is None or view.relevance is None:
        return None
    values = _mean_rows(view.map.q_values, shortlist(view.relevance, NNQL_NEIGHBOURS))
    return Plan(NNQL, float(view.map.actions_m[np.argmax(values)]), values)


def plan_by_information(view: PlanningView) -> Plan:
    """The move whose views ahead tell most bits on average over the belief (ours); of equals the longer, forward one.

    What a move's error takes from a robot that knows its place is subtracted. Where nobody knows what views tell it is
    the longest move. A move that more probably leads past an end of the route than not is taken only where all do; then
    it is the one that most probably stays.
    """
    actions_m = view.map.actions_m
    table = information_ahead(view.map, view.price_bits_per_m)
    averages = np.zeros(2 * actions_m.size) if table is None else _averaged(view.mass, table.T)
    values, bits = averages[: actions_m.size], averages[actions_m.size :]
    if table is not None:  # the bits by which it gets more probable that the robot is not where it seems to be
        near = near_mode(view.map.route, view.mass, int(view.mass.argmax()), usual_errors(*actions_m.tolist()))
        doubt_bits = _DOUBT_WEIGHT * np.log2(np.maximum(1 - near, _LEAST_MASS))
        lost_bits = doubt_bits[1:] - doubt_bits[0]
        values -= np.where(bits > 0, lost_bits, lost_bits.max())  # who stays errs least, and would never get on
    moves = sorted(zip(values.tolist(), np.abs(actions_m).tolist(), actions_m.tolist(), strict=True), reverse=True)
    best_m, best_chance = 0.0, -1.0
    for *_, action_m in moves:
        stays = view.map.route.staying(action_m)
        chance = 1 - float(view.mass[: stays.start].sum() + view.mass[stays.stop :].sum())  # of few images mostly
        if chance > best_chance:
            best_m, best_chance = action_m, chance
        if best_chance >= PROBABLY:
            break
    if table is None:
        return Plan(INFORMED, best_m, chance_on_route=best_chance)
    return Plan(INFORMED, best_m, values, bits, best_chance)


def information_ahead(map_: Map, price_bits_per_m: float) -> NDArray[np.float32] | None:
    """[n, 2a] float32, bits of every move from every image; None where nobody knows what views tell.

    The first a columns hold the discounted bits of a move and of the best moves after it, less the price of the metres;
    the others those of its first view alone. A view tells what views of its place do, but for what the view before
    explains of its error: `(1 - c(a)) I(x + a)`. Computed once a map for each of the last few prices.
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
        first_bits = news * np.where(leads_to < 0, bits.mean(), bits[leads_to])
        table = np.asfortranarray(np.hstack([values, first_bits.astype(np.float32)]))  # `_averaged` reads columns
        if len(tables) >= _MOST_PRICES:
            tables.pop(next(iter(tables)), None)
        tables[price_bits_per_m] = table
    return table


def _leads_to(route: Route, actions_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """[n, a] the image to which every move leads from every image; -1 past an end of an open route."""
    target_m = route.wrapped(route.position_m[:, np.newaxis] + actions_m)
    image = route.nearest_image(target_m)
    return np.where(route.reaches(target_m), image, -1)


@njit(cache=True, nogil=True)
def _swept(
    leads_to: NDArray[np.int64], bits: NDArray[np.float64], news: NDArray[np.float64], price: NDArray[np.float64]
) -> NDArray[np.float32]:
    """[n, a] values by value iteration; past an end of the route bits and values are those of an average image."""
    n, n_actions = leads_to.shape
    values = np.zeros((n, n_actions), np.float32)
    best = np.zeros(n)
    mean_bits = bits.mean()
    for _ in range(_SWEEPS):
        mean_best = best.mean()
        for i in range(n):
            for a in range(n_actions):
                image = leads_to[i, a]
                next_bits = mean_bits if image < 0 else bits[image]
                next_best = mean_best if image < 0 else best[image]
                values[i, a] = news[a] * next_bits - price[a] + _DISCOUNT * next_best
        for i in range(n):
            best[i] = values[i].max()
    return values


_PLANNERS: dict[str, Planner] = {INFORMED: plan_by_information, NNQL: plan_by_experience, RANDOM: plan_at_random}


@njit(cache=True, nogil=True, fastmath=SUMS)
def _averaged(mass: NDArray[np.float32], columns: NDArray[np.float32]) -> NDArray[np.float64]:
    """[a] means of columns [a, n] weighted by mass [n]. A loop of our own: BLAS would wake its threads for this."""
    averages, total = np.zeros(len(columns)), 0.0
    for begin in range(0, mass.size, _IMAGES_AT_ONCE):
        shares = mass[begin : begin + _IMAGES_AT_ONCE]
        block_mass = shares.sum()
        if block_mass < _LEAST_MASS:
            continue
        total += block_mass
        for action in range(averages.size):
            column, block_sum = columns[action, begin : begin + _IMAGES_AT_ONCE], np.float32(0)
            for image in range(shares.size):
                block_sum += shares[image] * column[image]
            averages[action] += block_sum
    return averages / max(total, _LEAST_MASS)


@njit(cache=True, nogil=True)
def _mean_rows(table: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    means = np.zeros(table.shape[1])
    for row in rows:
        for column in range(means.size):
            means[column] += table[row, column] / rows.size
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
