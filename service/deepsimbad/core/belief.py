"""The belief over the route (II-C): predicted by moves, updated by views, on a grid or by particles.

The robot is somewhere on the route or lost: off it, or anywhere on it after having been carried. Being lost is entered
at a small rate a metre and left to anywhere, and how well the believed places explain a view, against the map on the
whole, decides between the two.

Views err alike where they are near each other, so a view counts by what it says beyond the one before, carried along by
the move; this is generalised least squares for errors that are autoregressive along the route. And how far this season
can be trusted nobody knows before: the belief is a mixture of three, which trust a view half, once and twice as much as
was learnt, weighed by how well each has predicted the views so far (`mixture`, ours). The paper's updates have one.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.relevance import UpdateRule, mean_ranks
from deepsimbad.core.route import Route
from deepsimbad.errors import PastTheEndError

TRUSTS = (0.5, 1.0, 2.0)
"""How much of the learnt log-likelihood each part of a mixture believes; each twice the one before."""

PRIOR_TRUST = (0.2, 0.4, 0.4)
"""How probable each is before anything was seen: few seasons are as bad as the least trust takes them for."""

TRUSTS_OF = {rule: TRUSTS if rule is UpdateRule.MIXTURE else (1.0,) for rule in UpdateRule}

LOST_AT_START, LOST_AT_FIX = 0.02, 0.005  # before anything was seen: anywhere, and where somebody said it is
LOST_A_METRE = 0.0005
FOUND_A_VIEW = 0.02  # of what is lost, spread over the route when the robot has moved
LEAST_SURVIVING_SHARE = 1e-9  # of a belief before a move; with less it leads past the end wherever the robot may be
_DOUBTING = 0.01  # a belief that takes the robot for lost by more refuses no move
SIGMAS = 4.0  # a move's error is cut off here
SLIPS = 0.3  # how often odometry is wrong by more than it says
_CELLS_A_SIGMA = 1024.0  # of the table that stands for the normal curve; exact to 1e-7
_NORMAL = np.exp(-0.5 * np.square(np.arange(int(SIGMAS * _CELLS_A_SIGMA) + 3) / _CELLS_A_SIGMA))
_NEGLIGIBLE = 1e-3  # of the mean mass: a place with less moves, but its error is not spread


class FilterKind(StrEnum):
    """The filters that exist."""

    GRID = "grid"
    PARTICLE = "particle"


def motion_std_m(action_m: float) -> float:
    """Standard deviation of a move whose odometry says nothing of its own error.

    Independent errors add their variances: 0.1 m per square root of a metre, and 0.05 m for standing.
    """
    return float(np.sqrt(0.05**2 + 0.01 * abs(action_m)))


def slipping_std_m(action_m: float, action_std_m: float, doubt: "Doubt") -> float:
    """Standard deviation of a move whose odometry is wrong by a tenth, which it is now and then."""
    return float(np.hypot(action_std_m, 0.1 * action_m)) if doubt.is_mixture else action_std_m


@dataclass(frozen=True)
class ViewEvidence:
    """What one view says of every map image."""

    rule: UpdateRule
    values: NDArray[np.float64]  # [n]; log-likelihoods but for a constant, mean 0, or what additive rules add
    shared: float = 0.0  # c', how much of its error is that of the view before; of a first view nothing

    @classmethod
    def of(cls, relevance: NDArray[np.float32], rule: UpdateRule, scale: float, shared: float = 0.0) -> Self:
        """Of a view's relevance [n], which counts `scale` times as a log-likelihood."""
        if rule is UpdateRule.ADDITIVE_RELEVANCE:
            return cls(rule, np.maximum(relevance, 0).astype(np.float64))
        if rule is UpdateRule.ADDITIVE_RECIPROCAL_RANK:
            return cls(rule, 1.0 / mean_ranks(relevance))
        values = relevance.astype(np.float64)
        return cls(rule, scale * (values - values.mean()), shared if rule is UpdateRule.MIXTURE else 0.0)

    def news(self, last: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """[n] what it says beyond the last view's values, carried along; None: there was none."""
        if last is None or self.shared == 0:
            return self.values
        return (self.values - self.shared * last) / (1 + self.shared)

    def likelihood(self, last: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """[n] of the least trust, the greatest 1: whatever the relevances are, none overflows."""
        news = self.news(last)
        return np.asarray(np.exp(TRUSTS_OF[self.rule][0] * (news - news.max())))

    def least_told(self, last: NDArray[np.float64] | None) -> float:
        """The mass that its news would at least have moved elsewhere where nothing was known, when it is small."""
        return 0.0 if self.is_added else 0.5 * TRUSTS_OF[self.rule][0] * float(np.abs(self.news(last)).mean())

    @property
    def is_added(self) -> bool:
        """Whether it is added to weights, as in the paper, and does not multiply them."""
        return self.rule in {UpdateRule.ADDITIVE_RELEVANCE, UpdateRule.ADDITIVE_RECIPROCAL_RANK}


@dataclass(frozen=True)
class Doubt:
    """What every filter knows besides places."""

    lost: NDArray[np.float64]  # [t] by trust, of what that trust believes
    log_trust: NDArray[np.float64]  # [t] how well each has predicted the views so far
    last: NDArray[np.float64] | None = None  # [n] values of the last view, where the robot would have seen them

    @classmethod
    def at_start(cls, rule: UpdateRule, lost: float) -> Self:
        """Before any view, lost with this probability."""
        n = len(TRUSTS_OF[rule])
        return cls(np.full(n, lost), np.log(PRIOR_TRUST) if n > 1 else np.zeros(n))

    @property
    def is_mixture(self) -> bool:
        """Whether being lost is entered and left; to the paper's updates it stays as likely as at the start."""
        return self.lost.size > 1

    @property
    def trust(self) -> NDArray[np.float64]:
        """[t] sums to 1."""
        weight = np.exp(self.log_trust - self.log_trust.max())
        return np.asarray(weight / weight.sum())

    @property
    def off_route(self) -> float:
        """Probability of being lost."""
        return float(self.trust @ self.lost)

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All state."""
        arrays = {"lost": self.lost, "log_trust": self.log_trust}
        return arrays if self.last is None else {**arrays, "last": self.last}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.float64]]) -> Self:
        """Restore what `arrays` gave."""
        return cls(arrays["lost"], arrays["log_trust"], arrays.get("last"))


def moved_along(route: Route, values: NDArray[np.float64], action_m: float) -> NDArray[np.float64]:
    """[n] values of map images, where a robot that moves sees them next; what lies before an open route is 0."""
    if action_m == 0:
        return values
    from_m = route.wrapped(route.position_m - action_m)
    if route.closed:
        return np.interp(from_m, route.position_m, values, period=route.length_m)
    return np.interp(from_m, route.position_m, values, left=0.0, right=0.0)


@dataclass(frozen=True)
class GridFilter:
    """Masses of the map images."""

    route: Route
    masses: NDArray[np.float64]  # [t, n] by trust; with `doubt.lost` each row sums to 1
    doubt: Doubt

    @classmethod
    def uniform(cls, route: Route, rule: UpdateRule = UpdateRule.MIXTURE) -> Self:
        """No knowledge: every metre of the route alike, so images of one long stop share one place's mass."""
        return cls._of(route, route.cell_m, rule, LOST_AT_START)

    @classmethod
    def around(cls, route: Route, position_m: float, std_m: float, rule: UpdateRule = UpdateRule.MIXTURE) -> Self:
        """A normal belief around a position, cut off at the ends of an open route."""
        offset = route.offset_m(route.position_m, position_m)
        nearest = np.abs(offset).min()  # a prior narrower than the spacing still has its nearest image
        log_mass = -0.5 * (np.square(offset) - nearest**2) / max(std_m, 1e-3) ** 2
        return cls._of(route, route.cell_m * np.exp(log_mass), rule, LOST_AT_FIX)

    @classmethod
    def _of(cls, route: Route, mass: NDArray[np.float64], rule: UpdateRule, lost: float) -> Self:
        doubt = Doubt.at_start(rule, lost)
        return cls(route, np.outer(1 - doubt.lost, mass / mass.sum()), doubt)

    @classmethod
    def from_arrays(cls, route: Route, arrays: dict[str, NDArray[np.float64]]) -> Self:
        """Restore what `arrays` gave."""
        return cls(route, arrays["masses"], Doubt.from_arrays(arrays))

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All state."""
        return {"masses": self.masses, **self.doubt.arrays()}

    @cached_property
    def mass(self) -> NDArray[np.float64]:
        """[n] of the map images, if the robot is on the route; sums to 1."""
        mass = self.doubt.trust @ self.masses
        return np.asarray(mass / max(mass.sum(), 1e-300))

    @property
    def off_route(self) -> float:
        """Probability that the robot is not where any of this could be right."""
        return self.doubt.off_route

    def predicted(self, action_m: float, action_std_m: float, step: int) -> Self:  # noqa: ARG002 - nothing is random
        """The belief after a move.

        It ends where an open route ends, within its error; what certainly leads past the end is lost.

        Args:
            action_m: Metres moved forward; backward where negative.
            action_std_m: Standard deviation of the move, at least 0.
            step: Number of this step in the session; seeds whatever is random in it.

        Raises:
            PastTheEndError: No place of the belief has that much open route before it.
        """
        route, places = self.route, self.route.places
        closed_m, reach_m = route.length_m if route.closed else 0.0, SIGMAS * action_std_m
        shared = places.position_m.size < route.n_images  # some images show one place
        moved = _summed(self.masses, places.of_image, places.position_m.size) if shared else self.masses
        before = moved
        if action_m != 0:
            within_m = reach_m if self.doubt.is_mixture else 0.0
            moved = _shift(before, places.position_m, action_m, closed_m, within_m)
            if not moved.any():  # it may still have stopped at the end
                moved = _shift(before, places.position_m, action_m, closed_m, reach_m)
        on_route, surviving = before.sum(axis=1), moved.sum(axis=1)
        check_ahead(route, self.doubt, on_route, surviving, action_m)
        slipping_m = slipping_std_m(action_m, action_std_m, self.doubt)
        spread = _spread(moved, places.position_m, action_std_m, slipping_m, closed_m)
        if not shared:
            masses = spread
        elif action_m != 0:  # which of a stop's images comes next is open again
            masses = spread[:, places.of_image] / places.n_images[places.of_image]
        else:
            stayed = np.where(before > 0, spread / np.where(before > 0, before, 1.0), 0.0)
            fresh = np.where(before > 0, 0.0, spread / places.n_images)
            masses = self.masses * stayed[:, places.of_image] + fresh[:, places.of_image]
        lost, staying, found = leaving_and_found(self.doubt, self.doubt.lost, on_route, surviving, action_m)
        masses = masses * staying[:, np.newaxis] + np.outer(found, route.cell_m / route.cell_m.sum())
        total = masses.sum(axis=1) + lost
        last = self.doubt.last
        last = last if last is None else moved_along(route, last, action_m)
        doubt = replace(self.doubt, lost=lost / total, last=last)
        return replace(self, masses=masses / total[:, np.newaxis], doubt=doubt)

    def updated(self, seen: ViewEvidence, step: int) -> Self:  # noqa: ARG002
        """The belief after a view."""
        if seen.is_added:
            mass = added(self.mass, seen.values)
            return replace(self, masses=np.outer(1 - self.doubt.lost, mass))
        likelihood = seen.likelihood(self.doubt.last)
        masses, lost, log_trust = _see(self.masses, self.doubt.lost, self.doubt.log_trust, likelihood)
        return replace(self, masses=masses, doubt=Doubt(lost, log_trust, seen.values))


def check_ahead(
    route: Route, doubt: Doubt, on_route: NDArray[np.float64], surviving: NDArray[np.float64], action_m: float
) -> None:
    """Raise PastTheEndError where a belief that does not take the robot for lost has nowhere to go."""
    if (surviving > LEAST_SURVIVING_SHARE * on_route).any() or (doubt.is_mixture and doubt.off_route > _DOUBTING):
        return
    end_m, side = (float(route.position_m[-1]), "ends") if action_m > 0 else (route.start_m, "begins")
    raise PastTheEndError(
        f"no place of the belief has {abs(action_m):g} m of route {'before' if action_m > 0 else 'behind'} it; "
        f"the route {side} at {end_m:g} m",
        route_end_m=end_m,
    )


def leaving_and_found(
    doubt: Doubt,
    lost: NDArray[np.float64],
    on_route: NDArray[np.float64],
    surviving: NDArray[np.float64],
    action_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """What is lost after a move, by what the masses that survived it are multiplied, and what is found anywhere; [t].

    To the paper's updates a move past the end is impossible, and nobody is lost on the way.
    """
    if not doubt.is_mixture:
        return lost, on_route / surviving, np.zeros_like(lost)
    lost = lost + on_route - surviving
    found = FOUND_A_VIEW * lost if action_m != 0 else np.zeros_like(lost)
    leaving = 1 - np.exp(-LOST_A_METRE * abs(action_m))
    return lost - found + leaving * surviving, np.full(lost.size, 1 - leaving), found


def added(mass: NDArray[np.float64], seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Masses [m], summing to 1, after evidence that is added, as the paper adds `v[u_k]` to its particles' weights.

    Weights are taken with mean 1 for that, so that the belief that knows nothing gives every hypothesis weight 1,
    however many there are.
    """
    weights = mass * mass.size + seen
    return np.asarray(weights / weights.sum(), np.float64)


@njit(cache=True, nogil=True)
def _summed(masses: NDArray[np.float64], group: NDArray[np.intp], n_groups: int) -> NDArray[np.float64]:
    sums = np.zeros((len(masses), n_groups))
    for t in range(len(masses)):
        for i in range(group.size):
            sums[t, group[i]] += masses[t, i]
    return sums


@njit(cache=True, nogil=True)
def _see(
    masses: NDArray[np.float64],
    lost: NDArray[np.float64],
    log_trust: NDArray[np.float64],
    likelihood: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Multiply by likelihoods, normalise, and weigh the trusts; `likelihood` [n], of the least trust, is used up.

    Where a view allows nothing that a trust still believes, that trust keeps what it knew.
    """
    n_trusts, n = masses.shape
    after = np.empty((n_trusts, n))
    believed, average = np.zeros(n_trusts), np.zeros(n_trusts)
    for t in range(n_trusts):  # the next trust is twice the one before
        for i in range(n):
            if t > 0:
                likelihood[i] *= likelihood[i]
            after[t, i] = masses[t, i] * likelihood[i]
            believed[t] += after[t, i]
            average[t] += likelihood[i]
    average /= n
    lost_after, log_trust_after = lost.copy(), log_trust.copy()
    for t in range(n_trusts):
        total = believed[t] + lost[t] * average[t]
        if total <= 0:
            after[t] = masses[t]
            continue
        for i in range(n):
            after[t, i] /= total
        lost_after[t] = lost[t] * average[t] / total
        log_trust_after[t] += np.log(total / average[t])
    return after, lost_after, log_trust_after


@njit(cache=True, nogil=True)
def _shift(
    masses: NDArray[np.float64], position_m: NDArray[np.float64], action_m: float, length_m: float, reach_m: float
) -> NDArray[np.float64]:
    """Move every place's masses; between two places they are shared by nearness. length_m > 0: a closed route.

    What would be up to `reach_m` beyond an end of an open route stops there, and what would be farther is dropped.
    """
    n_trusts, n = masses.shape
    moved = np.zeros((n_trusts, n))
    after = 0
    start, end = position_m[0], position_m[n - 1]
    last_target = -np.inf
    for i in range(n):
        target = position_m[i] + action_m
        if length_m > 0:
            target = start + (target - start) % length_m
        elif target > end + reach_m + 1e-9 or target < start - reach_m - 1e-9:
            continue
        else:
            target = min(max(target, start), end)
        if target < last_target:  # wrapped round
            after = 0
        last_target = target
        while after < n and position_m[after] < target:
            after += 1
        if after == n:  # closed: between the last place and the first
            gap = length_m - (end - start)
            share = (target - end) / gap if gap > 0 and length_m > 0 else 0.0
            one, other = n - 1, 0
        elif after == 0 or position_m[after] == target:
            share, one, other = 1.0, after, after
        else:
            share = (target - position_m[after - 1]) / (position_m[after] - position_m[after - 1])
            one, other = after - 1, after
        for t in range(n_trusts):
            moved[t, one] += masses[t, i] * (1 - share)
            moved[t, other] += masses[t, i] * share
    return moved


@njit(cache=True, nogil=True, inline="always")
def _normal(deviations: float) -> float:
    """`exp(-x^2 / 2)` for x in 0..4, from a table: exponentials would be most of a step's time."""
    place = deviations * _CELLS_A_SIGMA
    cell = int(place)
    share = place - cell
    weight: float = _NORMAL[cell] * (1 - share) + _NORMAL[cell + 1] * share
    return weight


@njit(cache=True, nogil=True, inline="always")
def _error(off_m: float, std_m: float, slipping_m: float) -> float:
    """Density of a move's error, but for a constant: mostly normal, now and then of a wheel that slips."""
    density = SLIPS * std_m / slipping_m * _normal(off_m / slipping_m)
    if off_m < SIGMAS * std_m:
        density += (1 - SLIPS) * _normal(off_m / std_m)
    return density


@njit(cache=True, nogil=True)
def _spread(  # noqa: PLR0912 - one pass over a band and its two wrapped ends
    masses: NDArray[np.float64], position_m: NDArray[np.float64], std_m: float, slipping_m: float, length_m: float
) -> NDArray[np.float64]:
    """Blur by a normal error; none is lost at the ends."""
    n_trusts, n = masses.shape
    if std_m <= 0 or n == 1:
        return masses
    reach = SIGMAS * slipping_m
    spread = np.zeros((n_trusts, n))
    least = _NEGLIGIBLE / n
    weights = np.empty(n)
    for i in range(n):
        held = 0.0
        for t in range(n_trusts):
            held += float(masses[t, i])
        if held < least:
            for t in range(n_trusts):
                spread[t, i] += masses[t, i]
            continue
        first = i
        while first > 0 and position_m[i] - position_m[first - 1] <= reach:
            first -= 1
        stop = i + 1
        while stop < n and position_m[stop] - position_m[i] <= reach:
            stop += 1
        total: float = 0.0
        for j in range(first, stop):
            weights[j] = _error(abs(position_m[j] - position_m[i]), std_m, slipping_m)
            total += float(weights[j])
        around_first, around_stop = n, 0
        if length_m > 0:  # beyond a closed route's ends
            while around_stop < first and position_m[around_stop] + length_m - position_m[i] <= reach:
                weights[around_stop] = _error(position_m[around_stop] + length_m - position_m[i], std_m, slipping_m)
                total += float(weights[around_stop])
                around_stop += 1
            while around_first > stop and position_m[i] + length_m - position_m[around_first - 1] <= reach:
                around_first -= 1
                weights[around_first] = _error(position_m[i] + length_m - position_m[around_first], std_m, slipping_m)
                total += float(weights[around_first])
        for t in range(n_trusts):
            share = masses[t, i] / total
            for j in range(first, stop):
                spread[t, j] += share * weights[j]
            for j in range(around_stop):
                spread[t, j] += share * weights[j]
            for j in range(around_first, n):
                spread[t, j] += share * weights[j]
    return spread
