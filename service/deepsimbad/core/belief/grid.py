"""The exact belief: masses of equal cells along the route.

A move shifts them all, and its error is one short row of weights, the same everywhere; a view is heard of at cells,
between two map images as the way leads to the other.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.belief.cells import SUMS
from deepsimbad.core.belief.evidence import (
    LEAST_ALLOWED,
    LOST_AT_FIX,
    LOST_AT_START,
    Doubt,
    ViewEvidence,
    added,
)
from deepsimbad.core.belief.motion import (
    LEAST_SURVIVING_SHARE,
    SIGMAS,
    check_ahead,
    leaving_and_found,
    mixed_error,
    move_stds_m,
)
from deepsimbad.core.relevance import UpdateRule
from deepsimbad.core.route import Route

_BLOCK = 1024  # cells whose sums stay in the first-level cache
_ROUNDED = 1e-6  # 1 less what is lost or leaves is summed anew below this, where rounding would be felt
_NOTHING = 1e-300  # what a view leaves of a belief that it does not allow, or less


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

    def predicted(self, action_m: float, action_std_m: float, step: int) -> "GridFilter":  # noqa: ARG002 - nothing is random
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
        for beyond_m in (reach_m if doubt.is_mixture or action_m == 0 else 0.0, reach_m):
            some = cells.sources(shift, offset_m, beyond_m)
            leaving = self.masses[:, : some.start].sum(axis=1) + self.masses[:, some.stop :].sum(axis=1)
            surviving = 1 - doubt.lost - leaving
            if surviving.min() < _ROUNDED:
                surviving = self.masses[:, some].sum(axis=1)
            on_route = surviving + leaving
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
        return GridFilter(self.route, masses, offset_m, Doubt(lost / total, doubt.log_trust, last))

    def updated(self, seen: ViewEvidence, step: int) -> "GridFilter":  # noqa: ARG002
        """The belief after a view."""
        at_cells = self._at_cells(seen.values)
        if seen.is_added:
            mass, doubt = added(self._believed, at_cells), self.doubt
            masses, told = np.outer(1 - doubt.lost, mass), 0.5 * float(np.abs(mass - self._believed).sum())
        else:
            likelihood, least_told = seen.likelihood(at_cells, self.doubt.last)
            masses, lost, log_trust, moved = _see(self.masses, self.doubt.lost, self.doubt.log_trust, likelihood)
            doubt, told = Doubt(lost, log_trust, at_cells), max(moved, least_told)
        return GridFilter(self.route, masses, self.offset_m, doubt, told)

    def _at_cells(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """[c] what is known of map images [n]; the images of one stop say what they say on average."""
        places = self.route.places
        if places.position_m.size < values.size:
            values = np.bincount(places.of_image, values) / places.n_images
        return self.route.cells.of_places(values, self.offset_m)


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

    Where a view allows nothing that a trust still believes, that trust keeps what it knew of places: there is always
    something to go on from, however surely the robot is lost.

    Returns:
        Masses [t, c], lost [t], log trusts [t], and the share of what is believed that moved.
    """
    average, total = _likelihoods(masses, likelihood)
    gain, kept, lost_after, log_trust_after = np.zeros(lost.size), np.zeros(lost.size), lost.copy(), log_trust.copy()
    for t in range(lost.size):
        if total[t] <= _NOTHING:
            total[t] = LEAST_ALLOWED * average[t]
            kept[t] = total[t] / max(masses[t].sum(), _NOTHING)
        whole = total[t] + lost[t] * average[t]
        gain[t] = 1.0 / whole
        lost_after[t] = lost[t] * average[t] * gain[t]
        log_trust_after[t] += np.log(whole / average[t])
    weights = _trusted(log_trust, lost), _trusted(log_trust_after, lost_after)
    after, moved = _multiplied(masses, likelihood, kept, gain, weights[0], weights[1])
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
    kept: NDArray[np.float64],
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    weight_after: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Masses [t, c] times likelihoods and gains [t], and the sum of differences of what is believed.

    Args:
        kept: [t] in place of likelihoods, where that is not 0.
        weight, weight_after: [t] by which masses before and after are believed.
    """
    n_trusts, n = masses.shape
    after, moved = np.empty((n_trusts, n)), 0.0
    for begin in range(0, n, _BLOCK):
        powers = likelihood[begin : begin + _BLOCK].copy()
        change = np.zeros(powers.size)
        for t in range(n_trusts):
            before, row = masses[t, begin : begin + _BLOCK], after[t, begin : begin + _BLOCK]
            times, plus = 0.0 if kept[t] > 0 else gain[t], kept[t] * gain[t]
            share, share_after = weight[t], weight_after[t]
            for i in range(powers.size):
                row[i] = before[i] * (powers[i] * times + plus)
                change[i] += share_after * row[i] - share * before[i]
                powers[i] *= powers[i]
        for i in range(powers.size):
            moved += abs(change[i])
    return after, moved


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
        if closed:
            turn = shift % n
            on_route[turn:] = masses[t, : n - turn]
            on_route[:turn] = masses[t, n - turn :]
            source[:width] = source[n : n + width]
            source[width + n :] = source[width : 2 * width]
        else:
            least = max(first, -shift)  # cells from here on need not be held at an end,
            most = max(least, min(stop, n - shift))  # until here
            source[: width + least + shift] = 0.0
            on_route[least + shift : most + shift] = masses[t, least:most]
            source[width + most + shift :] = 0.0
            for i in range(first, min(least, stop)):
                on_route[0] += masses[t, i]
            for i in range(max(most, first), stop):
                on_route[n - 1] += masses[t, i]
            near = min(width, n)
            for end in range(near + min(width, n - near)):  # of what is near an end, what stays on the route is all
                i = end if end < near else n - 1 - (end - near)
                on_route[i] /= taps[max(width - i, 0) : width + n - i].sum()
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


@njit(cache=True, nogil=True)
def _carried(values: NDArray[np.float64], shift: int, closed: bool) -> NDArray[np.float64]:
    """[c] what was seen at cells, where a robot that moves has it next; what lies before an open route is 0."""
    carried, n = np.zeros_like(values), values.size
    turn = shift % n if closed else min(max(shift, -n), n)
    if turn >= 0:
        carried[turn:] = values[: n - turn]
    else:
        carried[:turn] = values[-turn:]
    if closed:
        carried[:turn] = values[n - turn :]
    return carried
