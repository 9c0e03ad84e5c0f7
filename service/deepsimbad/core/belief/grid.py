"""The exact belief: masses of equal cells along the route.

A move shifts all cells, and its error is one short row of weights, the same everywhere. What a view says of map images
is interpolated at the cells between them. Masses are in single precision, since those of many robots outgrow a
processor's caches; their sums are in double.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.belief.cells import SUMS, copy_into
from deepsimbad.core.belief.evidence import (
    LEAST_ALLOWED,
    LOST_AT_FIX,
    LOST_AT_START,
    Doubt,
    ViewEvidence,
    add_evidence,
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
_ROUNDED = 1e-6  # of a mass; a difference below it is summed anew, since rounding would be felt
_NOTHING = 1e-300  # the least that is divided by
_LEAST_MASS = np.float32(1e-30)  # a lesser one is 0, before it gets so small that processors take it slowly


@dataclass(frozen=True)
class GridFilter:
    """A belief of c cells, by each of t trusts. Nothing is random."""

    route: Route
    masses: NDArray[np.float32]  # [t, c] by trust; with `doubt.lost` each row sums to 1
    offset_m: float  # by which all cells are ahead of where they began, at most half a cell
    doubt: Doubt  # its last view at the cells
    mass_moved: float = 0.0  # share that the last view moved elsewhere, or would have of a belief that knew nothing

    @classmethod
    def uniform(cls, route: Route, rule: UpdateRule = UpdateRule.MIXTURE) -> Self:
        """The belief that knows nothing: every metre of the route is equally likely."""
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
        return cls(route, np.outer(1 - doubt.lost, mass / mass.sum()).astype(np.float32), offset_m, doubt)

    @classmethod
    def from_arrays(cls, route: Route, arrays: dict[str, NDArray[np.float64]]) -> Self:
        """The belief whose arrays `arrays` gave; raises KeyError for those of another release."""
        return cls(route, arrays["masses"].astype(np.float32), float(arrays["offset_m"][0]), Doubt.from_arrays(arrays))

    def arrays(self) -> dict[str, NDArray[np.floating]]:
        """The named arrays from which `from_arrays` restores it."""
        return {"masses": self.masses, "offset_m": np.array([self.offset_m]), **self.doubt.arrays()}

    @cached_property
    def mass(self) -> NDArray[np.float32]:
        """[n] belief of map images, if the robot is on the route; sums to 1. A stop's images share a mass."""
        places = self.route.places
        on_places = self.route.cells.to_places(self._believed(), self.offset_m)
        if places.position_m.size == self.route.n_images:
            return on_places
        return np.asarray(on_places[places.of_image] / places.n_images[places.of_image], np.float32)

    def predicted(self, action_m: float, action_std_m: float, step: int) -> "GridFilter":  # noqa: ARG002 - nothing is random
        """The belief after a move.

        A move ends where an open route ends, within its error; mass that it certainly leads past the end becomes lost.

        Args:
            action_m: Metres moved forward; backward where negative.
            action_std_m: Standard deviation of the move, at least 0.
            step: Number of this step in the session, which seeds the draws of particles.

        Raises:
            PastTheEndError: No place of the belief has that much open route before it.
        """
        cells, doubt, reach_m = self.route.cells, self.doubt, SIGMAS * action_std_m
        shift, offset_m = cells.shifted(self.offset_m + action_m)
        for beyond_m in (reach_m if doubt.is_mixture or action_m == 0 else 0.0, reach_m):
            on_route_cells = cells.sources(shift, offset_m, beyond_m)
            low_masses, high_masses = self.masses[:, : on_route_cells.start], self.masses[:, on_route_cells.stop :]
            leaving = low_masses.sum(axis=1, dtype=np.float64) + high_masses.sum(axis=1, dtype=np.float64)
            surviving = 1 - doubt.lost - leaving
            if surviving.min() < _ROUNDED:
                surviving = self.masses[:, on_route_cells].sum(axis=1, dtype=np.float64)
            on_route = surviving + leaving
            if (surviving > LEAST_SURVIVING_SHARE * on_route).any() or self.masses[:, on_route_cells].any():
                break  # else it may still have stopped at the end
        check_ahead(self.route, doubt, on_route, surviving, action_m)
        lost, staying, found_mass = leaving_and_found(doubt, doubt.lost, on_route, surviving, action_m)
        total = surviving * staying + found_mass + lost
        masses = _shift_and_spread(
            self.masses,
            (int(on_route_cells.start), int(on_route_cells.stop), shift),
            mixed_error(cells.step_m, cells.n_cells, *move_stds_m(action_m, action_std_m, doubt.is_mixture).items()),
            staying / total,
            found_mass / (total * cells.n_cells),
            cells.closed,
        )
        last = None if doubt.last is None else _shift(doubt.last, shift, cells.closed)
        doubt = Doubt(lost / total, doubt.log_trust, last, doubt.since_last_m + action_m)
        return GridFilter(self.route, masses, offset_m, doubt)

    def updated(self, evidence: ViewEvidence, step: int) -> "GridFilter":  # noqa: ARG002
        """The belief after a view; `step` as of `predicted`."""
        values = self._at_cells(evidence.values)
        if evidence.rule.is_additive:
            prior, doubt = self._believed(), self.doubt
            mass = add_evidence(prior, values)
            masses = np.outer(1 - doubt.lost, mass).astype(np.float32)
            mass_moved = 0.5 * float(np.abs(mass - prior).sum())
        else:
            likelihood, least_moved = evidence.likelihood(values, self.doubt.last)
            masses, lost, log_trust, mass_moved = _weigh(self.masses, self.doubt.lost, self.doubt.log_trust, likelihood)
            doubt, mass_moved = Doubt(lost, log_trust, values), max(mass_moved, least_moved)
        return GridFilter(self.route, masses, self.offset_m, doubt, mass_moved)

    def _believed(self) -> NDArray[np.float32]:
        """[c] belief of cells, provided that the robot is on the route; sums to 1."""
        return _mixed(self.masses, self.doubt.lost, self.doubt.log_trust)

    def _at_cells(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """[c] values at cells, interpolated from those of map images [n]; images of one stop count by their mean."""
        places = self.route.places
        if places.position_m.size < values.size:
            values = (np.bincount(places.of_image, values) / places.n_images).astype(np.float32)
        return self.route.cells.of_places(values, self.offset_m)


@njit(cache=True, nogil=True)
def _trusted(log_trust: NDArray[np.float64], lost: NDArray[np.float64]) -> NDArray[np.float64]:
    """[t] weights of the trusts, with which their masses together sum to 1."""
    weight = np.exp(log_trust - log_trust.max())
    return np.asarray(weight / max((weight * (1.0 - lost)).sum(), _NOTHING))


@njit(cache=True, nogil=True)
def _weigh(
    masses: NDArray[np.float32],
    lost: NDArray[np.float64],
    log_trust: NDArray[np.float64],
    likelihood: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64], float]:
    """Multiply by likelihoods [c] of the least trust, normalise, and weigh the trusts.

    Where a view excludes all that a trust still believes, that trust keeps its shares of places: there is always a
    belief to go on from, however surely the robot is lost.

    Returns:
        Masses [t, c], lost [t], log trusts [t], and the share of the belief that moved elsewhere.
    """
    average, total = _likelihoods(masses, likelihood)
    gain, kept_share, lost_after, log_trust_after = (
        np.zeros(lost.size),
        np.zeros(lost.size),
        lost.copy(),
        log_trust.copy(),
    )
    for t in range(lost.size):
        if total[t] <= LEAST_ALLOWED * average[t]:
            total[t] = LEAST_ALLOWED * average[t]
            kept_share[t] = total[t] / max(masses[t].sum(dtype=np.float64), _LEAST_MASS)
        explained = total[t] + lost[t] * average[t]
        gain[t] = 1.0 / explained
        lost_after[t] = lost[t] * average[t] * gain[t]
        log_trust_after[t] += np.log(explained / average[t])
    weights = _trusted(log_trust, lost), _trusted(log_trust_after, lost_after)
    posterior, change = _multiplied(masses, likelihood, kept_share, gain, weights[0], weights[1])
    return posterior, lost_after, log_trust_after, 0.5 * change


@njit(cache=True, nogil=True, fastmath=SUMS)
def _mixed(
    masses: NDArray[np.float32], lost: NDArray[np.float64], log_trust: NDArray[np.float64]
) -> NDArray[np.float32]:
    """[c] belief of cells over all trusts, provided that the robot is on the route; sums to 1."""
    weight = _trusted(log_trust, lost).astype(np.float32)
    mixed = weight[0] * masses[0]
    for t in range(1, weight.size):
        row, share = masses[t], weight[t]
        for i in range(mixed.size):
            mixed[i] += share * row[i]
    return np.asarray(mixed)


@njit(cache=True, nogil=True, fastmath=SUMS)
def _likelihoods(
    masses: NDArray[np.float32], likelihood: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[t], [t] mean of each trust's likelihoods [c], over all cells and weighed by its masses."""
    n_trusts, n = masses.shape
    mean, total = np.empty(n_trusts), np.empty(n_trusts)
    powers = likelihood.copy()
    for t in range(n_trusts):
        row, all_cells, weighed = masses[t], 0.0, 0.0
        for i in range(n):
            all_cells += powers[i]
            weighed += row[i] * powers[i]
        mean[t], total[t] = all_cells / n, weighed
        for i in range(n):
            powers[i] *= powers[i]  # the next trust is twice this one
    return mean, total


@njit(cache=True, nogil=True, fastmath=SUMS)
def _multiplied(
    masses: NDArray[np.float32],
    likelihood: NDArray[np.float32],
    kept_share: NDArray[np.float64],
    gain: NDArray[np.float64],
    weight: NDArray[np.float64],
    weight_after: NDArray[np.float64],
) -> tuple[NDArray[np.float32], float]:
    """Masses [t, c] times likelihoods and gains [t], and the sum over cells of how far the belief changes.

    Args:
        kept_share: [t] used in place of likelihoods where it is not 0.
        weight, weight_after: [t] weights of the trusts before and after.
    """
    n_trusts, n = masses.shape
    posterior, total_change = np.empty_like(masses), 0.0
    for begin in range(0, n, _BLOCK):
        powers = likelihood[begin : begin + _BLOCK].copy()
        change = np.zeros_like(powers)
        for t in range(n_trusts):
            prior, row = masses[t, begin : begin + _BLOCK], posterior[t, begin : begin + _BLOCK]
            factor, kept_factor = 0.0 if kept_share[t] > 0 else gain[t], kept_share[t] * gain[t]
            factor, kept_factor = np.float32(factor), np.float32(kept_factor)
            share, share_after = np.float32(weight[t]), np.float32(weight_after[t])
            for i in range(powers.size):
                mass = prior[i] * (powers[i] * factor + kept_factor)
                row[i] = mass if mass > _LEAST_MASS else np.float32(0)
                change[i] += share_after * row[i] - share * prior[i]
                powers[i] *= powers[i]
        for i in range(powers.size):
            total_change += abs(change[i])
    return posterior, total_change


@njit(cache=True, nogil=True, fastmath=SUMS)
def _shift_and_spread(
    masses: NDArray[np.float32],
    move: tuple[int, int, int],
    taps: NDArray[np.float64],
    gain: NDArray[np.float64],
    found_mass: NDArray[np.float64],
    closed: bool,
) -> NDArray[np.float32]:
    """Shift the masses [t, c] of a range of cells, spread them by a move's error, and add what is found everywhere.

    Args:
        move: The first cell that is shifted, the first that is not any more, and by how many cells.
        taps: [2 w + 1] weights of the error, symmetric. What it would carry past an end of an open route stays on it.
        gain: [t] factors of the masses.
        found_mass: [t] added to every cell.
    """
    n_trusts, n = masses.shape
    first, stop, shift = move
    width = taps.size // 2
    shifted = np.empty_like(masses)
    source = np.empty(n + 2 * width, np.float32)
    on_route = source[width : width + n]
    for t in range(n_trusts):
        if closed:
            turn = shift % n
            copy_into(on_route[turn:], masses[t, : n - turn])
            copy_into(on_route[:turn], masses[t, n - turn :])
            copy_into(source[:width], source[n : n + width])
            copy_into(source[width + n :], source[width : 2 * width])
        else:
            first_inside = max(first, -shift)  # cells from here on do not move past an end,
            stop_inside = max(first_inside, min(stop, n - shift))  # until here
            source[: width + first_inside + shift] = 0.0
            copy_into(on_route[first_inside + shift : stop_inside + shift], masses[t, first_inside:stop_inside])
            source[width + stop_inside + shift :] = 0.0
            for i in range(first, min(first_inside, stop)):
                on_route[0] += masses[t, i]
            for i in range(max(stop_inside, first), stop):
                on_route[n - 1] += masses[t, i]
            near = min(width, n)
            for edge in range(near + min(width, n - near)):  # mass near an end stays on the route
                i = edge if edge < near else n - 1 - (edge - near)
                on_route[i] /= taps[max(width - i, 0) : width + n - i].sum()
        for begin in range(0, n, _BLOCK):
            row = shifted[t, begin : begin + _BLOCK]
            middle = source[begin + width : n + 2 * width]
            weight, added_mass = np.float32(taps[width] * gain[t]), np.float32(found_mass[t])
            for i in range(row.size):
                row[i] = added_mass + weight * middle[i]
            for away in range(1, width + 1, 2):  # two cells to either side at once; one that is no more weighs nothing
                reach = min(away + 1, width)
                near = np.float32(taps[width + away] * gain[t])
                far = np.float32(taps[width + reach] * gain[t] if reach > away else 0.0)
                left, right = source[begin + width - away :], source[begin + width + away :]
                lefter, righter = source[begin + width - reach :], source[begin + width + reach :]
                for i in range(row.size):
                    row[i] += near * (left[i] + right[i]) + far * (lefter[i] + righter[i])
    return shifted


@njit(cache=True, nogil=True)
def _shift(values: NDArray[np.float32], shift: int, closed: bool) -> NDArray[np.float32]:
    """[c] values at cells, moved along with the robot by whole cells; what lies before an open route is 0."""
    carried, n = np.zeros_like(values), values.size
    by = shift % n if closed else min(max(shift, -n), n)
    if by >= 0:
        copy_into(carried[by:], values[: n - by])
    else:
        copy_into(carried[:by], values[-by:])
    if closed:
        copy_into(carried[:by], values[n - by :])
    return carried
