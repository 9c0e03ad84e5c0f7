"""The belief over the route (II-C): predicted by moves, updated by views, on a grid or by particles; summarised."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Self, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.relevance import UpdateRule, evidence, weigh
from deepsimbad.core.retrieval import shortlist
from deepsimbad.core.route import Route
from deepsimbad.errors import PastTheEndError

LEAST_SURVIVING_SHARE = 1e-9  # of a belief before a move; with less it leads past the end wherever the robot may be
_CREDIBLE_SHARE = 0.95
DEFAULT_N_PARTICLES = 1000
_START, _MOVE, _RESAMPLE = range(3)  # what a draw is for; part of its seed
_SIGMAS = 4.0  # a move's error is cut off here
_CELLS_A_SIGMA = 1024.0  # of the table that stands for the normal curve; exact to 1e-7
_NORMAL = np.exp(-0.5 * np.square(np.arange(int(_SIGMAS * _CELLS_A_SIGMA) + 3) / _CELLS_A_SIGMA))
_NEGLIGIBLE = 1e-12  # of the mean mass: a place with less is not spread any further


class FilterKind(StrEnum):
    """The filters that exist."""

    GRID = "grid"
    PARTICLE = "particle"


def motion_std_m(action_m: float) -> float:
    """Standard deviation of a move whose odometry says nothing of its own error.

    Independent errors add their variances: 0.1 m per square root of a metre, and 0.05 m for standing.
    """
    return float(np.sqrt(0.05**2 + 0.01 * action_m))


@dataclass(frozen=True)
class GridFilter:
    """Masses of the map images."""

    route: Route
    mass: NDArray[np.float64]  # [n] float64; sums to 1

    @classmethod
    def uniform(cls, route: Route) -> Self:
        """No knowledge: every metre of the route alike, so images of one long stop share one place's mass."""
        return cls(route, route.cell_m / route.cell_m.sum())

    @classmethod
    def around(cls, route: Route, position_m: float, std_m: float) -> Self:
        """A normal belief around a position, cut off at the ends of an open route."""
        offset = route.offset_m(route.position_m, position_m)
        nearest = np.abs(offset).min()  # a prior narrower than the spacing still has its nearest image
        log_mass = -0.5 * (np.square(offset) - nearest**2) / max(std_m, 1e-3) ** 2
        mass = route.cell_m * np.exp(log_mass)
        return cls(route, mass / mass.sum())

    @classmethod
    def from_arrays(cls, route: Route, arrays: dict[str, NDArray[np.float64]]) -> Self:
        """Restore what `arrays` gave."""
        return cls(route, arrays["mass"])

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All state."""
        return {"mass": self.mass}

    def predicted(self, action_m: float, action_std_m: float, step: int) -> Self:  # noqa: ARG002 - nothing is random
        """The belief after a move; what would be past the end of an open route is impossible and dropped.

        Args:
            action_m: Metres moved forward, at least 0.
            action_std_m: Standard deviation of the move, at least 0.
            step: Number of this step in the session; seeds whatever is random in it.

        Raises:
            PastTheEndError: No place of the belief has that much open route before it.
        """
        places = self.route.places
        at_places = np.asarray(np.bincount(places.of_image, self.mass, places.position_m.size), np.float64)
        length_m = self.route.length_m if self.route.closed else 0.0
        moved = at_places
        if action_m > 0:
            moved = _shift(at_places, places.position_m, action_m, length_m)
        total = moved.sum()
        if total <= LEAST_SURVIVING_SHARE:
            raise PastTheEndError(
                f"no place of the belief has {action_m:g} m of route before it; the route ends at "
                f"{self.route.position_m[-1]:g} m",
                route_end_m=float(self.route.position_m[-1]),
            )
        spread = _spread(moved / total, places.position_m, action_std_m, length_m)
        if action_m > 0:  # which of a stop's images comes next is open again
            mass = spread[places.of_image] / places.n_images[places.of_image]
        else:
            stayed = np.where(at_places > 0, spread / np.where(at_places > 0, at_places, 1.0), 0.0)
            fresh = np.where(at_places > 0, 0.0, spread / places.n_images)
            mass = self.mass * stayed[places.of_image] + fresh[places.of_image]
        return type(self)(self.route, mass / mass.sum())

    def updated(self, relevance: NDArray[np.float32], rule: UpdateRule, step: int) -> Self:  # noqa: ARG002
        """The belief after a view of relevance [n]."""
        return type(self)(self.route, weigh(self.mass, evidence(relevance.astype(np.float64), rule), rule))


@njit(cache=True, nogil=True)
def _shift(
    mass: NDArray[np.float64], position_m: NDArray[np.float64], action_m: float, length_m: float
) -> NDArray[np.float64]:
    """Move every place's mass forward; between two places it is shared by nearness. length_m > 0: a closed route."""
    n = mass.size
    moved = np.zeros(n)
    after = 0
    start = position_m[0]
    last_target = -np.inf
    for i in range(n):
        if mass[i] <= 0:
            continue
        target = position_m[i] + action_m
        if length_m > 0:
            target = start + (target - start) % length_m
        elif target > position_m[n - 1] + 1e-9:
            continue
        if target < last_target:  # wrapped round
            after = 0
        last_target = target
        while after < n and position_m[after] < target:
            after += 1
        if after == n:  # closed: between the last place and the first
            gap = length_m - (position_m[n - 1] - start)
            share = (target - position_m[n - 1]) / gap if gap > 0 and length_m > 0 else 0.0
            moved[n - 1] += mass[i] * (1 - share)
            moved[0] += mass[i] * share
        elif after == 0 or position_m[after] == target:
            moved[after] += mass[i]
        else:
            share = (target - position_m[after - 1]) / (position_m[after] - position_m[after - 1])
            moved[after - 1] += mass[i] * (1 - share)
            moved[after] += mass[i] * share
    return moved


@njit(cache=True, nogil=True, inline="always")
def _normal(deviations: float) -> float:
    """`exp(-x^2 / 2)` for x in 0..4, from a table: exponentials would be most of a step's time."""
    place = deviations * _CELLS_A_SIGMA
    cell = int(place)
    share = place - cell
    weight: float = _NORMAL[cell] * (1 - share) + _NORMAL[cell + 1] * share
    return weight


@njit(cache=True, nogil=True)
def _spread(  # noqa: PLR0912 - one pass over a band and its two wrapped ends
    mass: NDArray[np.float64], position_m: NDArray[np.float64], std_m: float, length_m: float
) -> NDArray[np.float64]:
    """Blur by a normal error; none is lost at the ends."""
    n = mass.size
    if std_m <= 0 or n == 1:
        return mass
    reach = _SIGMAS * std_m
    spread = np.zeros(n)
    least = _NEGLIGIBLE / n
    weights = np.empty(n)
    for i in range(n):
        if mass[i] < least:
            spread[i] += mass[i]
            continue
        first = i
        while first > 0 and position_m[i] - position_m[first - 1] <= reach:
            first -= 1
        stop = i + 1
        while stop < n and position_m[stop] - position_m[i] <= reach:
            stop += 1
        total = 0.0
        for j in range(first, stop):
            weights[j] = _normal(abs(position_m[j] - position_m[i]) / std_m)
            total += weights[j]
        around_first, around_stop = 0, 0
        if length_m > 0:  # beyond a closed route's ends
            while around_stop < first and position_m[around_stop] + length_m - position_m[i] <= reach:
                weights[around_stop] = _normal((position_m[around_stop] + length_m - position_m[i]) / std_m)
                total += weights[around_stop]
                around_stop += 1
            around_first = n
            while around_first > stop and position_m[i] + length_m - position_m[around_first - 1] <= reach:
                around_first -= 1
                weights[around_first] = _normal((position_m[i] + length_m - position_m[around_first]) / std_m)
                total += weights[around_first]
        share = mass[i] / total
        for j in range(first, stop):
            spread[j] += share * weights[j]
        if length_m > 0:
            for j in range(around_stop):
                spread[j] += share * weights[j]
            for j in range(around_first, n):
                spread[j] += share * weights[j]
    return spread


@dataclass(frozen=True)
class ParticleFilter:
    """Particles. Whatever is random is drawn from (seed, step), so that no generator's state need be kept."""

    route: Route
    position_m: NDArray[np.float64]  # [m] float64, hypotheses of the route position
    weight: NDArray[np.float64]  # [m] float64; sums to 1
    seed: int  # of all draws

    @classmethod
    def uniform(cls, route: Route, n_particles: int = DEFAULT_N_PARTICLES, seed: int = 0) -> Self:
        """No knowledge: one particle in each of m equal stretches of the route."""
        rng = np.random.default_rng([seed, 0, _START])
        stretch = (np.arange(n_particles) + rng.random(n_particles)) / n_particles
        return cls._equal(route, route.start_m + stretch * route.length_m, seed)

    @classmethod
    def around(
        cls, route: Route, position_m: float, std_m: float, n_particles: int = DEFAULT_N_PARTICLES, seed: int = 0
    ) -> Self:
        """Particles drawn around a position; beyond the ends of an open route they stand at the end."""
        rng = np.random.default_rng([seed, 0, _START])
        drawn = position_m + std_m * rng.standard_normal(n_particles)
        return cls._equal(route, _onto(route, drawn), seed)

    @classmethod
    def from_arrays(cls, route: Route, arrays: dict[str, NDArray[np.float64]], seed: int) -> Self:
        """Restore what `arrays` gave."""
        return cls(route, arrays["position_m"], arrays["weight"], seed)

    @classmethod
    def _equal(cls, route: Route, position_m: NDArray[np.float64], seed: int) -> Self:
        return cls(route, position_m, np.full(position_m.size, 1.0 / position_m.size), seed)

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All state."""
        return {"position_m": self.position_m, "weight": self.weight}

    @property
    def mass(self) -> NDArray[np.float64]:
        """[n] every particle counts for the map image nearest to it."""
        images = self.route.nearest_image(self.position_m)
        return np.asarray(np.bincount(images, self.weight, self.route.n_images), np.float64)

    def predicted(self, action_m: float, action_std_m: float, step: int) -> Self:
        """As `GridFilter.predicted`; a particle that would be past the end of an open route dies."""
        rng = np.random.default_rng([self.seed, step, _MOVE])
        alive = self if self.route.closed or action_m == 0 else self._with_route_ahead(action_m, step)
        moved = alive.position_m + action_m + action_std_m * rng.standard_normal(alive.position_m.size)
        return replace(alive, position_m=_onto(self.route, moved))

    def _with_route_ahead(self, action_m: float, step: int) -> Self:
        """Particles that would be past the end die, and the living take their places."""
        dead = self.position_m + action_m > self.route.position_m[-1] + 1e-9
        if not dead.any():
            return self
        weight = np.where(dead, 0.0, self.weight)
        if weight.sum() <= LEAST_SURVIVING_SHARE:
            end_m = float(self.route.position_m[-1])
            raise PastTheEndError(
                f"no particle has {action_m:g} m of route before it; the route ends at {end_m:g} m", route_end_m=end_m
            )
        return replace(self, weight=weight / weight.sum())._resampled(step)

    def updated(self, relevance: NDArray[np.float32], rule: UpdateRule, step: int) -> Self:
        """As `GridFilter.updated`; resamples when the effective sample size falls below half the particles."""
        seen = evidence(relevance.astype(np.float64), rule)[self.route.nearest_image(self.position_m)]
        weighed = replace(self, weight=weigh(self.weight, seen, rule))
        effective = 1.0 / np.square(weighed.weight).sum()
        return weighed if effective >= weighed.weight.size / 2 else weighed._resampled(step)

    def _resampled(self, step: int) -> Self:
        """Systematic resampling: one draw places an even comb over the cumulated weights."""
        n = self.weight.size
        offset = np.random.default_rng([self.seed, step, _RESAMPLE]).random()
        cumulated = np.cumsum(self.weight)
        chosen = np.searchsorted(cumulated / cumulated[-1], (np.arange(n) + offset) / n, side="right")
        return self._equal(self.route, self.position_m[np.minimum(chosen, n - 1)], self.seed)


def _onto(route: Route, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions on the route: round a closed one, to the ends of an open one."""
    if route.closed and route.length_m > 0:
        return route.wrapped(position_m)
    return np.clip(position_m, route.start_m, route.position_m[-1])


BeliefFilter: TypeAlias = GridFilter | ParticleFilter
"""A belief over the route. Immutable: every call returns a new one, so a failed step leaves nothing half done."""


@dataclass(frozen=True)
class BeliefSummary:
    """A belief in a few numbers."""

    # mean_m, std_m: Mean and standard deviation of the position; circular on a closed route
    mean_m: float
    mode_m: float  # position of the map image with the greatest mass
    std_m: float
    # The shortest stretch that holds 95 % of the mass; lo > hi crosses a closed route's start
    credible_95_m: tuple[float, float]
    entropy_bits: float  # entropy over map images
    off_route: float | None  # probability that the robot is nowhere on the route; None where it is not calibrated
    # histogram_edges_m, histogram_mass: Equal bins along the route, at most 200; [b + 1] and [b]
    histogram_edges_m: NDArray[np.float64]
    histogram_mass: NDArray[np.float64]
    top: NDArray[np.int64]  # ids of the map images with the greatest mass, best first
    top_mass: NDArray[np.float64]  # their masses


def summarise(route: Route, mass: NDArray[np.float64], n_top: int, off_route: float | None = None) -> BeliefSummary:
    """Summarise masses over map images, [n], which sum to 1; `n_top` of the likeliest are listed."""
    top = shortlist(mass, n_top)
    mean_m, std_m = _moments(route, mass)
    edges_m, bins = route.histogram
    held, position_m = mass[mass > 0], route.position_m
    twice, unrolled_m = mass, position_m
    if route.closed:
        twice, unrolled_m = np.r_[mass, mass], np.r_[position_m, position_m + route.length_m]
    first, last = _shortest_stretch(np.r_[0.0, np.cumsum(twice)], unrolled_m, mass.size)
    return BeliefSummary(
        mean_m=mean_m,
        mode_m=float(position_m[top[0]]),
        std_m=std_m,
        credible_95_m=(float(position_m[first]), float(position_m[last % mass.size])),
        entropy_bits=max(0.0, float(-(held * np.log2(held)).sum())),
        off_route=off_route,
        histogram_edges_m=edges_m,
        histogram_mass=np.asarray(np.bincount(bins, mass, edges_m.size - 1), np.float64),
        top=top,
        top_mass=mass[top],
    )


def _moments(route: Route, mass: NDArray[np.float64]) -> tuple[float, float]:
    # Sums, not dot products: BLAS would wake its threads for a vector this short.
    position = route.position_m
    if route.closed and route.length_m > 0:
        turn = 2 * np.pi / route.length_m
        resultant = (mass * np.exp(1j * turn * (position - route.start_m))).sum()
        mean = route.start_m + (np.angle(resultant) / turn) % route.length_m
        offset = route.offset_m(position, float(mean))
    else:
        mean = (mass * position).sum()
        offset = position - mean
    return float(mean), float(np.sqrt((mass * np.square(offset)).sum()))


@njit(cache=True, nogil=True)
def _shortest_stretch(before: NDArray[np.float64], position_m: NDArray[np.float64], n_starts: int) -> tuple[int, int]:
    """First and last image of the shortest stretch of images whose masses reach 95 %, its end slid for every start.

    `before` is the mass before every image, and after the last.
    """
    best_first, best_last, shortest_m = 0, position_m.size - 1, np.inf
    last = 0
    for first in range(n_starts):
        wanted = before[first] + _CREDIBLE_SHARE * (1 - 1e-12)
        while last < position_m.size and before[last + 1] < wanted:  # on to the image whose mass reaches the share
            last += 1
        if last == position_m.size:
            break
        length_m = position_m[last] - position_m[first]
        if length_m < shortest_m:
            best_first, best_last, shortest_m = first, last, length_m
    return best_first, best_last
