"""A route in cells of one length, which all move together: where a grid belief lives."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

SUMS = {"reassoc", "contract"}
"""For kernels that sum: in parts, which a processor adds at once. The same machine sums in the same order always."""

_MOST_PER_PLACE = 4  # cells, where a few places are far apart and the others near each other
_MOST_IN_GAPS, _LEAST_STEP_M = 32768, 0.25  # more than that, but no shorter ones: gaps must not make cells coarse
_ROUNDING = 1e-9  # of a cell
_NOTHING = 1e-300  # of a mass that is almost wholly lost
_SAME = 1e-6  # of a cell: how far places may be from its middles that are taken for them


@dataclass(frozen=True)
class Cells:
    """Equal cells along a route, whose places stand for the metres nearest to them.

    Where places stand at equal distances, cells are places. All cells may be ahead of where they began by one offset
    of at most half a cell: a move is a shift by whole cells and an offset, and blurs nothing.
    """

    start_m: float  # where the first begins, at offset 0
    step_m: float  # their length
    n_cells: int  # c
    closed: bool  # the last joins the first
    place_m: NDArray[np.float64]  # [p] distinct positions of map images, ascending

    @classmethod
    def along(cls, place_m: NDArray[np.float64], length_m: float, closed: bool) -> Self:
        """As long as neighbouring places are usually apart."""
        if place_m.size == 1 or length_m <= 0:
            return cls(float(place_m[0]), 1.0, 1, False, place_m)
        most = max(_MOST_PER_PLACE * place_m.size, min(_MOST_IN_GAPS, length_m / _LEAST_STEP_M))
        usual_m = max(float(np.median(np.diff(place_m))), length_m / most)
        n_steps = max(1, round(length_m / usual_m))
        return cls(float(place_m[0]), length_m / n_steps, n_steps if closed else n_steps + 1, closed, place_m)

    @cached_property
    def position_m(self) -> NDArray[np.float64]:
        """[c] of their middles, at offset 0."""
        return np.asarray(self.start_m + self.step_m * np.arange(self.n_cells), np.float64)

    def shifted(self, metres: float) -> tuple[int, float]:
        """A way in whole cells, and the rest."""
        whole = round(metres / self.step_m)
        return whole, metres - whole * self.step_m

    def sources(self, shift: int, offset_m: float, reach_m: float) -> slice:
        """The cells that a move leaves on the route, or beyond an end by no more than half a cell and a reach."""
        if self.closed:
            return slice(0, self.n_cells)
        beyond = 0.5 + (reach_m - offset_m) / self.step_m
        before = 0.5 + (reach_m + offset_m) / self.step_m
        last = self.n_cells - 1 + int(np.floor(beyond + _ROUNDING)) - shift
        first = -int(np.floor(before + _ROUNDING)) - shift
        first = min(max(first, 0), self.n_cells)
        return slice(first, min(max(last + 1, first), self.n_cells))

    @cached_property
    def are_places(self) -> bool:
        """Whether the places stand at equal distances, so that nothing must be looked for."""
        same = self.place_m.size == self.n_cells
        return same and bool((np.abs(self.place_m - self.position_m) <= _SAME * self.step_m).all())

    def of_places(self, values: NDArray[np.float64], offset_m: float) -> NDArray[np.float64]:
        """[c] values at cells from those at places [p]: between two places the way leads from one to the other."""
        if self.are_places:
            return _shared(values, -offset_m / self.step_m, self.closed, False)
        length_m = self.step_m * self.n_cells if self.closed else 0.0
        return _interpolated(values, self.place_m, self.start_m + offset_m, self.step_m, self.n_cells, length_m)

    def to_places(self, mass: NDArray[np.float64], offset_m: float) -> NDArray[np.float64]:
        """[p] masses of places, summing to 1, from those of cells [c]: of the stretch that is nearest to each."""
        if self.are_places:
            within = _shared(mass, offset_m / self.step_m, self.closed, True)
        else:
            within = _within(mass, self._bounds_m, self.start_m + offset_m, self.step_m, self.closed)
        return within / max(float(within.sum()), _NOTHING)

    @cached_property
    def _bounds_m(self) -> NDArray[np.float64]:
        """[p + 1] half the way between neighbouring places; an open route's ends have all that is beyond them."""
        between_m = (self.place_m[1:] + self.place_m[:-1]) / 2
        if not self.closed:
            return np.concatenate([[-np.inf], between_m, [np.inf]])
        length_m = self.step_m * self.n_cells
        last_m = (self.place_m[-1] + self.place_m[0] + length_m) / 2
        return np.concatenate([[last_m - length_m], between_m, [last_m]])


@njit(cache=True, nogil=True)
def _shared(values: NDArray[np.float64], ahead: float, closed: bool, is_mass: bool) -> NDArray[np.float64]:
    """[n] values so much of a step ahead, or behind where negative, shared out between the steps on either side.

    Beyond an end of an open route a value is as it is there; of a mass nothing comes from there, and nothing is lost.
    """
    n, share = values.size, abs(ahead)
    shared = np.empty(n)
    if ahead >= 0:
        first, last = 0, n - 1
        for i in range(1, n):
            shared[i] = values[i] + share * (values[i - 1] - values[i])
    else:
        first, last = n - 1, 0
        for i in range(n - 1):
            shared[i] = values[i] + share * (values[i + 1] - values[i])
    before = values[last] if closed else 0.0 if is_mass else values[first]
    shared[first] = values[first] + share * (before - values[first])
    if is_mass and not closed:
        shared[last] += share * values[last]
    return shared


@njit(cache=True, nogil=True)
def _interpolated(
    values: NDArray[np.float64], at_m: NDArray[np.float64], from_m: float, step_m: float, n: int, length_m: float
) -> NDArray[np.float64]:
    """[n] linear between values at ascending positions, constant beyond the ends; round a loop of length_m > 0."""
    into = np.empty(n)
    last = at_m.size - 1
    after = 0
    for cell in range(n):
        metres = from_m + cell * step_m
        while after <= last and at_m[after] < metres:
            after += 1
        upper = after
        if after == 0 and length_m > 0:  # a turn later, which may be before the last place
            metres += length_m
            upper = int(np.searchsorted(at_m, metres))
        if 0 < upper <= last:
            share = (metres - at_m[upper - 1]) / (at_m[upper] - at_m[upper - 1])
            into[cell] = values[upper - 1] + (values[upper] - values[upper - 1]) * share
        elif length_m > 0:  # between the last place and the first
            gap_m = at_m[0] + length_m - at_m[last]
            into[cell] = values[last] + (values[0] - values[last]) * ((metres - at_m[last]) / gap_m)
        else:
            into[cell] = values[min(after, last)]
    return into


@njit(cache=True, nogil=True, fastmath=SUMS)
def _within(
    mass: NDArray[np.float64], bounds_m: NDArray[np.float64], from_m: float, step_m: float, closed: bool
) -> NDArray[np.float64]:
    """[p] shares of masses between ascending bounds [p + 1], of cells about `from_m` and on; cells are evenly full."""
    n, a_metre = mass.size, 1.0 / step_m
    within = np.empty(bounds_m.size - 1)
    cell, held = 0, 0.0  # of the cell, what earlier places have
    if closed:
        first = (bounds_m[0] - from_m) * a_metre + 0.5
        cell = int(np.floor(first))
        held = mass[cell % n] * (first - cell)
    at = cell % n
    for place in range(within.size):
        last, total = (bounds_m[place + 1] - from_m) * a_metre + 0.5, -held
        while cell + 1 <= last and (closed or cell < n):
            total += mass[at]
            cell += 1
            at = at + 1 if at + 1 < n else 0
        held = mass[at] * max(last - cell, 0.0) if closed or cell < n else 0.0
        within[place] = total + held
    return within
