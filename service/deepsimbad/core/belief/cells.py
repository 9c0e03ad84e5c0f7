"""A route in cells of one length, which all move together: where a grid belief lives."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

SUMS = {"reassoc", "contract"}
"""For kernels that sum: in parts, which a processor adds at once. The same machine sums in the same order always."""

_MOST_PER_PLACE = 4  # cells, where a few places are far apart and the others near each other
_MOST_IN_GAPS, _LEAST_STEP_M = 32768, 0.25  # more than that, but no shorter ones: gaps must not make cells coarse
_ROUNDING = 1e-9  # of a cell, by which a sum of lengths may err
_NOTHING = 1e-300  # the least mass that is divided by
_SAME = 1e-6  # of a cell: places no farther from the middles of cells are taken for them


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
    def for_places(cls, place_m: NDArray[np.float64], length_m: float, closed: bool) -> Self:
        """Cells as long as the median distance of neighbouring places."""
        if place_m.size == 1 or length_m <= 0:
            return cls(float(place_m[0]), 1.0, 1, False, place_m)
        n_most = max(_MOST_PER_PLACE * place_m.size, min(_MOST_IN_GAPS, length_m / _LEAST_STEP_M))
        typical_m = max(float(np.median(np.diff(place_m))), length_m / n_most)
        n_steps = max(1, round(length_m / typical_m))
        return cls(float(place_m[0]), length_m / n_steps, n_steps if closed else n_steps + 1, closed, place_m)

    @cached_property
    def position_m(self) -> NDArray[np.float64]:
        """[c] positions of the middles of cells, at offset 0."""
        return np.asarray(self.start_m + self.step_m * np.arange(self.n_cells), np.float64)

    def shifted(self, metres: float) -> tuple[int, float]:
        """A distance as whole cells and the metres that remain, at most half a cell."""
        n_whole = round(metres / self.step_m)
        return n_whole, metres - n_whole * self.step_m

    def sources(self, shift: int, offset_m: float, reach_m: float) -> slice:
        """The cells that a move leaves on the route, or past an end by no more than half a cell and `reach_m`."""
        if self.closed:
            return slice(0, self.n_cells)
        n_ahead = 0.5 + (reach_m - offset_m) / self.step_m
        n_behind = 0.5 + (reach_m + offset_m) / self.step_m
        last = self.n_cells - 1 + int(np.floor(n_ahead + _ROUNDING)) - shift
        first = -int(np.floor(n_behind + _ROUNDING)) - shift
        first = min(max(first, 0), self.n_cells)
        return slice(first, min(max(last + 1, first), self.n_cells))

    @cached_property
    def are_places(self) -> bool:
        """Whether places are the middles of cells, so that nothing has to be searched."""
        return self.place_m.size == self.n_cells and bool(
            (np.abs(self.place_m - self.position_m) <= _SAME * self.step_m).all()
        )

    def of_places(self, values: NDArray[np.float32], offset_m: float) -> NDArray[np.float32]:
        """[c] values at cells, interpolated linearly from those at places [p]."""
        if self.are_places:
            return _shared(values, -offset_m / self.step_m, self.closed, False)
        length_m = self.step_m * self.n_cells if self.closed else 0.0
        return _interpolated(values, self.place_m, self.start_m + offset_m, self.step_m, self.n_cells, length_m)

    def to_places(self, mass: NDArray[np.float32], offset_m: float) -> NDArray[np.float32]:
        """[p] masses of places, summing to 1, from those of cells [c]: each has the stretch that is nearest to it."""
        if self.are_places:
            on_places = _shared(mass, offset_m / self.step_m, self.closed, True)
        else:
            on_places = _between(mass, self._bounds_m, self.start_m + offset_m, self.step_m, self.closed)
        return on_places / max(float(on_places.sum()), _NOTHING)

    @cached_property
    def _bounds_m(self) -> NDArray[np.float64]:
        """[p + 1] bounds of the places' stretches, half way between them; at the ends of an open route infinite."""
        middle_m = (self.place_m[1:] + self.place_m[:-1]) / 2
        if not self.closed:
            return np.concatenate([[-np.inf], middle_m, [np.inf]])
        length_m = self.step_m * self.n_cells
        last_m = (self.place_m[-1] + self.place_m[0] + length_m) / 2
        return np.concatenate([[last_m - length_m], middle_m, [last_m]])


@njit(cache=True, nogil=True)
def copy_into(target: NDArray[Any], source: NDArray[Any]) -> None:
    """`target[:] = source`, whose check of shapes numba compiles for seconds."""
    for i in range(target.size):
        target[i] = source[i]


@njit(cache=True, nogil=True)
def _shared(values: NDArray[np.float32], ahead: float, closed: bool, is_mass: bool) -> NDArray[np.float32]:
    """[n] values shifted by `ahead` of a step, from -1 to 1, each shared out between the steps on either side.

    Past an end of an open route values go on as they are at the end; a mass is 0 there, and none leaves the route.
    """
    n, share, no_mass = values.size, np.float32(abs(ahead)), np.float32(0)
    shared = np.empty_like(values)
    if ahead >= 0:
        first, last = 0, n - 1
        for i in range(1, n):
            shared[i] = values[i] + share * (values[i - 1] - values[i])
    else:
        first, last = n - 1, 0
        for i in range(n - 1):
            shared[i] = values[i] + share * (values[i + 1] - values[i])
    edge = values[last] if closed else no_mass if is_mass else values[first]
    shared[first] = values[first] + share * (edge - values[first])
    if is_mass and not closed:
        shared[last] += share * values[last]
    return shared


@njit(cache=True, nogil=True)
def _interpolated(
    values: NDArray[np.float32], at_m: NDArray[np.float64], from_m: float, step_m: float, n: int, length_m: float
) -> NDArray[np.float32]:
    """[n] values interpolated from those at ascending positions, constant past the ends; of a loop if length_m > 0."""
    interpolated = np.empty(n, np.float32)
    last = at_m.size - 1
    upper_place = 0
    for cell in range(n):
        metres = from_m + cell * step_m
        while upper_place <= last and at_m[upper_place] < metres:
            upper_place += 1
        upper = upper_place
        if upper_place == 0 and length_m > 0:  # one lap later, which may be before the last place
            metres += length_m
            upper = int(np.searchsorted(at_m, metres))
        if 0 < upper <= last:
            share = (metres - at_m[upper - 1]) / (at_m[upper] - at_m[upper - 1])
            interpolated[cell] = values[upper - 1] + (values[upper] - values[upper - 1]) * share
        elif length_m > 0:  # between the last place and the first
            gap_m = at_m[0] + length_m - at_m[last]
            interpolated[cell] = values[last] + (values[0] - values[last]) * ((metres - at_m[last]) / gap_m)
        else:
            interpolated[cell] = values[min(upper_place, last)]
    return interpolated


@njit(cache=True, nogil=True, fastmath=SUMS)
def _between(
    mass: NDArray[np.float32], bounds_m: NDArray[np.float64], from_m: float, step_m: float, closed: bool
) -> NDArray[np.float32]:
    """[p] mass between ascending bounds [p + 1] of cells, the first about `from_m`; a cell's mass is spread evenly."""
    n, a_metre = mass.size, 1.0 / step_m
    sums = np.empty(bounds_m.size - 1, np.float32)
    cell, used_mass = 0, 0.0  # of the cell: the mass that earlier places have
    if closed:
        first = (bounds_m[0] - from_m) * a_metre + 0.5
        cell = int(np.floor(first))
        used_mass = mass[cell % n] * (first - cell)
    index = cell % n
    for place in range(sums.size):
        last, total = (bounds_m[place + 1] - from_m) * a_metre + 0.5, -used_mass
        while cell + 1 <= last and (closed or cell < n):
            total += mass[index]
            cell += 1
            index = index + 1 if index + 1 < n else 0
        used_mass = mass[index] * max(last - cell, 0.0) if closed or cell < n else 0.0
        sums[place] = total + used_mass
    return sums
