"""The belief over the route (II-C): predicted by moves, updated by views, on a grid or by particles.

The robot is somewhere on the route or lost: off it, or anywhere on it after having been carried. Being lost is entered
at a small rate a metre and left to anywhere, and how well the believed places explain a view, against the map on the
whole, decides between the two.

The grid has equal cells along the route (`core.cells`). A move shifts them all, and its error is one short row of
weights, the same everywhere; a view is heard of at cells, between two map images as the way leads to the other.

Views err alike where they are near each other, so a view counts by what it says beyond the one before, carried along by
the move; this is generalised least squares for errors that are autoregressive along the route. And how far this season
can be trusted nobody knows before: the belief is a mixture of three, which trust a view half, once and twice as much as
was learnt, weighed by how well each has predicted the views so far (`mixture`, ours). The paper's updates have one.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property, lru_cache
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.cells import SUMS
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
_AS_TOLD = 0.6  # of moves: how many err by no more than odometry says of itself
_SLIPPING = 0.2  # of a move: how far off the others are, for a wheel slips or its size is not what it was
_BLOCK = 1024  # cells whose sums stay in the first-level cache
_NOTHING = 1e-300  # what a view leaves of a belief that it does not allow, or less
_NARROW = 0.6  # cells; a narrower normal curve is not sampled, but has its variance all the same


class FilterKind(StrEnum):
    """The filters that exist."""

    GRID = "grid"
    PARTICLE = "particle"


def motion_std_m(action_m: float) -> float:
    """Standard deviation of a move whose odometry says nothing of its own error.

    Independent errors add their variances: 0.1 m per square root of a metre, and 0.05 m for standing.
    """
    return float(np.sqrt(0.05**2 + 0.01 * abs(action_m)))


def move_stds_m(action_m: float, action_std_m: float, doubt: "Doubt") -> dict[float, float]:
    """Deviations of a move by how probable each is: a mixture takes some to be farther off than told.

    Where odometry says of itself that it is more exact than usual, its moves slip less by as much.
    """
    if not doubt.is_mixture:
        return {1.0: action_std_m}
    slip_m = _SLIPPING * action_m * min(1.0, action_std_m / motion_std_m(action_m))
    return {_AS_TOLD: action_std_m, 1 - _AS_TOLD: float(np.hypot(action_std_m, slip_m))}


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

    def likelihood(self, news: NDArray[np.float64]) -> NDArray[np.float64]:
        """[n] of the least trust, the greatest 1: whatever the relevances are, none overflows."""
        return np.asarray(np.exp(TRUSTS_OF[self.rule][0] * (news - news.max())))

    def least_told(self, news: NDArray[np.float64]) -> float:
        """The mass that its news would at least have moved elsewhere where nothing was known, when it is small."""
        return 0.0 if self.is_added else 0.5 * TRUSTS_OF[self.rule][0] * float(np.abs(news).mean())

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
    if action_m == 0 or route.length_m == 0:
        return values
    from_m = route.wrapped(route.position_m - action_m)
    if route.closed:
        return np.interp(from_m, route.position_m, values, period=route.length_m)
    return np.interp(from_m, route.position_m, values, left=0.0, right=0.0)


@dataclass(frozen=True)
class GridFilter:
    """Masses of cells."""

    route: Route
    masses: NDArray[np.float64]  # [t, c] by trust; with `doubt.lost` each row sums to 1
    offset_m: float  # by which all cells are ahead of where they began, at most half a cell
    doubt: Doubt  # its last view at the cells
    told: float = 0.0  # share of the mass that the last view moved elsewhere, or would have where nothing was known

    @classmethod
    def uniform(cls, route: Route, rule: UpdateRule = UpdateRule.MIXTURE) -> Self:
        """No knowledge: every metre of the route alike."""
        return cls._of(route, np.ones(route.cells.n_cells), 0.0, rule, LOST_AT_START)

    @classmethod
    def around(cls, route: Route, position_m: float, std_m: float, rule: UpdateRule = UpdateRule.MIXTURE) -> Self:
        """A normal belief around a position, cut off at the ends of an open route."""
        cells = route.cells
        _, offset_m = cells.shifted(position_m - cells.start_m)  # one cell is where the robot is said to be
        apart_m = route.offset_m(cells.position_m + offset_m, position_m)
        nearest = np.abs(apart_m).min()  # a prior narrower than a cell still has its nearest one
        log_mass = -0.5 * (np.square(apart_m) - nearest**2) / max(std_m, 1e-3) ** 2
        return cls._of(route, np.exp(log_mass), offset_m, rule, LOST_AT_FIX)

    @classmethod
    def _of(cls, route: Route, mass: NDArray[np.float64], offset_m: float, rule: UpdateRule, lost: float) -> Self:
        doubt = Doubt.at_start(rule, lost)
        return cls(route, np.outer(1 - doubt.lost, mass / mass.sum()), offset_m, doubt)

    @classmethod
    def from_arrays(cls, route: Route, arrays: dict[str, NDArray[np.float64]]) -> Self:
        """Restore what `arrays` gave; raises KeyError where an earlier release did."""
        return cls(route, arrays["masses"], float(arrays["offset_m"][0]), Doubt.from_arrays(arrays))

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All state."""
        return {"masses": self.masses, "offset_m": np.array([self.offset_m]), **self.doubt.arrays()}

    @cached_property
    def _believed(self) -> NDArray[np.float64]:
        """[c] of the cells, if the robot is on the route; sums to 1."""
        return _mixed(self.masses, self.doubt.lost, self.doubt.log_trust)

    @cached_property
    def mass(self) -> NDArray[np.float64]:
        """[n] of the map images, if the robot is on the route; sums to 1. Images of one stop share its mass."""
        places = self.route.places
        on_places = self.route.cells.to_places(self._believed, self.offset_m)
        if places.position_m.size == self.route.n_images:
            return on_places
        return np.asarray(on_places[places.of_image] / places.n_images[places.of_image])

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
        cells, doubt, reach_m = self.route.cells, self.doubt, SIGMAS * action_std_m
        shift, offset_m = cells.shifted(self.offset_m + action_m)
        on_route = 1 - doubt.lost
        for beyond_m in (reach_m if doubt.is_mixture or action_m == 0 else 0.0, reach_m):
            some = cells.sources(shift, offset_m, beyond_m)
            without = self.masses[:, : some.start].sum(axis=1) + self.masses[:, some.stop :].sum(axis=1)
            surviving = on_route - without
            if (surviving > LEAST_SURVIVING_SHARE * on_route).any() or self.masses[:, some].any():
                break  # else it may still have stopped at the end
        check_ahead(self.route, doubt, on_route, surviving, action_m)
        lost, staying, found = leaving_and_found(doubt, doubt.lost, on_route, surviving, action_m)
        total = surviving * staying + found + lost
        masses = _moved(
            self.masses,
            (int(some.start), int(some.stop), shift),
            mixed_error(cells.step_m, cells.n_cells, *move_stds_m(action_m, action_std_m, doubt).items()),
            staying / total,
            found / (total * cells.n_cells),
            cells.closed,
        )
        last = None if doubt.last is None else _carried(doubt.last, shift, cells.closed)
        return replace(self, masses=masses, offset_m=offset_m, doubt=replace(doubt, lost=lost / total, last=last))

    def updated(self, seen: ViewEvidence, step: int) -> Self:  # noqa: ARG002
        """The belief after a view."""
        at_cells = replace(seen, values=self._at_cells(seen.values))
        news = at_cells.news(self.doubt.last)
        if seen.is_added:
            mass = added(self._believed, at_cells.values)
            masses, doubt = np.outer(1 - self.doubt.lost, mass), self.doubt
            moved = 0.5 * float(np.abs(mass - self._believed).sum())
        else:
            likelihood = at_cells.likelihood(news)
            masses, lost, log_trust, moved = _see(self.masses, self.doubt.lost, self.doubt.log_trust, likelihood)
            doubt = Doubt(lost, log_trust, at_cells.values)
        return replace(self, masses=masses, doubt=doubt, told=max(moved, at_cells.least_told(news)))

    def _at_cells(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """[c] what is known of map images [n]; the images of one stop say what they say on average."""
        places = self.route.places
        if places.position_m.size < values.size:
            values = np.bincount(places.of_image, values) / places.n_images
        return self.route.cells.of_places(values, self.offset_m)


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
def _trusted(log_trust: NDArray[np.float64], lost: NDArray[np.float64]) -> NDArray[np.float64]:
    """[t] by which masses of cells are believed, so that they sum to 1."""
    weight = np.exp(log_trust - log_trust.max())
    return np.asarray(weight / max((weight * (1.0 - lost)).sum(), _NOTHING))


@njit(cache=True, nogil=True)
def _see(
    masses: NDArray[np.float64],
    lost: NDArray[np.float64],
    log_trust: NDArray[np.float64],
    likelihood: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
    """Multiply by likelihoods [c] of the least trust, normalise, and weigh the trusts.

    Where a view allows nothing that a trust still believes, that trust keeps what it knew.

    Returns:
        Masses [t, c], lost [t], log trusts [t], and the share of what is believed that moved.
    """
    average, total = _likelihoods(masses, likelihood)
    gain, lost_after, log_trust_after = np.zeros(lost.size), lost.copy(), log_trust.copy()
    for t in range(lost.size):
        total[t] += lost[t] * average[t]
        if total[t] > _NOTHING:
            gain[t] = 1.0 / total[t]
            lost_after[t] = lost[t] * average[t] * gain[t]
            log_trust_after[t] += np.log(total[t] / average[t])
    weights = _trusted(log_trust, lost), _trusted(log_trust_after, lost_after)
    after, moved = _multiplied(masses, likelihood, gain, weights[0], weights[1])
    return after, lost_after, log_trust_after, 0.5 * moved


@njit(cache=True, nogil=True, fastmath=SUMS)
def _mixed(
    masses: NDArray[np.float64], lost: NDArray[np.float64], log_trust: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[c] what the trusts believe together, if the robot is on the route; sums to 1."""
    weight = _trusted(log_trust, lost)
    mixed = weight[0] * masses[0]
    for t in range(1, weight.size):
        row, share = masses[t], weight[t]
        for i in range(mixed.size):
            mixed[i] += share * row[i]
    return np.asarray(mixed)


@njit(cache=True, nogil=True, fastmath=SUMS)
def _likelihoods(
    masses: NDArray[np.float64], likelihood: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[t], [t] means of likelihoods [c], over all cells and over what each trust believes."""
    n_trusts, n = masses.shape
    mean, total = np.empty(n_trusts), np.empty(n_trusts)
    powers = likelihood.copy()
    for t in range(n_trusts):
        row, everywhere, believed = masses[t], 0.0, 0.0
        for i in range(n):
            everywhere += powers[i]
            believed += row[i] * powers[i]
        mean[t], total[t] = everywhere / n, believed
        for i in range(n):
            powers[i] *= powers[i]  # the next trust is twice this one
    return mean, total


@njit(cache=True, nogil=True, fastmath=SUMS)
def _multiplied(
    masses: NDArray[np.float64],
    likelihood: NDArray[np.float64],
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    weight_after: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Masses [t, c] times likelihoods and gains [t], and the sum of differences of what is believed.

    Args:
        gain: 0 where a trust stays as it was.
        weight, weight_after: [t] by which masses before and after are believed.
    """
    n_trusts, n = masses.shape
    after, moved = np.empty((n_trusts, n)), 0.0
    for begin in range(0, n, _BLOCK):
        powers = likelihood[begin : begin + _BLOCK].copy()
        change = np.zeros(powers.size)
        for t in range(n_trusts):
            before, row = masses[t, begin : begin + _BLOCK], after[t, begin : begin + _BLOCK]
            times, plus = gain[t], 1.0 if gain[t] == 0 else 0.0
            share, share_after = weight[t], weight_after[t]
            for i in range(powers.size):
                row[i] = before[i] * (powers[i] * times + plus)
                change[i] += share_after * row[i] - share * before[i]
                powers[i] *= powers[i]
        for i in range(powers.size):
            moved += abs(change[i])
    return after, moved


def move_error(step_m: float, n_cells: int, std_m: float) -> NDArray[np.float64]:
    """[2 w + 1] a move's normal error, from w cells of `step_m` behind to w ahead."""
    deviation = std_m / step_m
    if deviation < _NARROW:
        half = deviation**2 / 2 if n_cells > 1 else 0.0
        return np.array([half, 1 - 2 * half, half]) if half > 0 else np.ones(1)
    reach = min(int(SIGMAS * deviation), n_cells - 1)
    weights = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) / deviation))
    return np.asarray(weights / weights.sum())


@lru_cache(maxsize=64)  # robots make the same moves again and again
def mixed_error(step_m: float, n_cells: int, *stds_m: tuple[float, float]) -> NDArray[np.float64]:
    """[2 w + 1] as `move_error`, of deviations after how probable each is; not to be written to."""
    errors = [share * move_error(step_m, n_cells, std_m) for share, std_m in stds_m]
    widest = max(error.size for error in errors)
    return np.asarray(np.sum([np.pad(error, (widest - error.size) // 2) for error in errors], axis=0), np.float64)


@njit(cache=True, nogil=True, fastmath=SUMS)
def _moved(
    masses: NDArray[np.float64],
    move: tuple[int, int, int],
    taps: NDArray[np.float64],
    gain: NDArray[np.float64],
    found: NDArray[np.float64],
    closed: bool,
) -> NDArray[np.float64]:
    """Shift the masses [t, c] of some cells, spread them by a move's error, and add what was found everywhere.

    Args:
        move: The first cell that is shifted, the first that is not any more, and by how many cells.
        taps: [2 w + 1] the error, the same to either side. Of what it would carry past an end of an open route nothing
            is lost.
        gain: [t] that masses are multiplied by.
        found: [t] added to every cell.
    """
    n_trusts, n = masses.shape
    first, stop, shift = move
    width = taps.size // 2
    moved = np.empty((n_trusts, n))
    source = np.empty(n + 2 * width)
    on_route = source[width : width + n]
    for t in range(n_trusts):
        source[:] = 0.0
        if closed:
            turn = shift % n
            on_route[turn:] = masses[t, : n - turn]
            on_route[:turn] = masses[t, n - turn :]
            source[:width] = source[n : n + width]
            source[width + n :] = source[width : 2 * width]
        else:
            least, most = max(first, -shift), min(stop, n - shift)  # cells that need not be held at an end
            if most > least:
                on_route[least + shift : most + shift] = masses[t, least:most]
            for i in range(first, min(least, stop)):
                on_route[0] += masses[t, i]
            for i in range(max(most, first), stop):
                on_route[n - 1] += masses[t, i]
            for i in range(min(width, n)):  # of what is near an end, the part that stays on the route is all
                on_route[i] /= 1.0 - taps[: width - i].sum()
            for i in range(min(width, n)):
                on_route[n - 1 - i] /= 1.0 - taps[width + i + 1 :].sum()
        for begin in range(0, n, _BLOCK):
            row = moved[t, begin : begin + _BLOCK]
            middle = source[begin + width : n + 2 * width]
            weight = taps[width] * gain[t]
            for i in range(row.size):
                row[i] = found[t] + weight * middle[i]
            for away in range(1, width + 1, 2):  # two cells to either side at once; one that is no more weighs nothing
                reach = min(away + 1, width)
                near, far = taps[width + away] * gain[t], taps[width + reach] * gain[t] if reach > away else 0.0
                left, right = source[begin + width - away :], source[begin + width + away :]
                lefter, righter = source[begin + width - reach :], source[begin + width + reach :]
                for i in range(row.size):
                    row[i] += near * (left[i] + right[i]) + far * (lefter[i] + righter[i])
    return moved


def _carried(values: NDArray[np.float64], shift: int, closed: bool) -> NDArray[np.float64]:
    """[c] what was seen at cells, where a robot that moves has it next; what lies before an open route is 0."""
    if closed:
        return np.roll(values, shift)
    carried = np.zeros_like(values)
    if 0 <= shift < values.size:
        carried[shift:] = values[: values.size - shift]
    elif -values.size < shift < 0:
        carried[:shift] = values[-shift:]
    return carried
