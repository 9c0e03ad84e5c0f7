"""Many beliefs at once for training: the grid filter on cells of equal length, in a few passes (II-C, II-D).

On equal cells a move is a shift and its error one short row of weights, the same everywhere. There are about as many
cells as map images; where the images stand at equal distances the cells are the images, and the beliefs those of
`GridFilter`. Else a cell takes the evidence of the image nearest to it, as the paper's particles do.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.belief.motion import move_error
from deepsimbad.core.route import Route

_TAPS_AT_ONCE = 4
_WHOLE = 1e-4  # of a cell; a lesser part of one is a rounding of positions
_BLOCK = 2048  # cells whose sums stay in the first-level cache


NO_MOVE = np.iinfo(np.int64).min
"""The shift of a first view."""


class Moves(NamedTuple):
    """One move of every belief, in cells."""

    shift: NDArray[np.int64]  # [e] int64, whole cells, backward ones negative; NO_MOVE: this is a first view
    fraction: NDArray[np.float32]  # [e] float32, the part of a cell moved besides, 0..1
    taps: NDArray[np.float32]  # [e, 2w + 1] float32, weights of the move's error


@dataclass(frozen=True)
class Lattice:
    """Cells along a route."""

    step_m: float  # their length
    closed: bool  # the last joins the first
    image_of_cell: NDArray[np.int32]  # [c] int32, the map image nearest to every cell
    cell_of_image: NDArray[np.int64]  # [n] int64
    images_in_cell: NDArray[np.int32]  # [c] int32, how many map images have a cell as their nearest

    @classmethod
    def along(cls, route: Route, actions_m: NDArray[np.float64]) -> "Lattice":
        """Cells as long as map images are apart on average, and a whole part of the shortest move if that is longer."""
        shortest_action_m = float(np.abs(actions_m[actions_m != 0]).min(initial=np.inf))
        n = route.n_images
        n_steps = n if route.closed else n - 1
        step_m = route.length_m / n_steps if n_steps > 0 and route.length_m > 0 else 1.0
        if np.isfinite(shortest_action_m) and shortest_action_m > step_m and not route.closed:
            step_m = shortest_action_m / round(shortest_action_m / step_m)
        n_cells = max(1, round(route.length_m / step_m) + (0 if route.closed else 1))
        cells_m = np.asarray(route.start_m + step_m * np.arange(n_cells), np.float64)
        nearest = np.rint((route.position_m - route.start_m) / step_m).astype(np.int64)
        cell_of_image = nearest % n_cells if route.closed else np.minimum(nearest, n_cells - 1)
        return cls(
            step_m,
            route.closed,
            route.nearest_image(cells_m).astype(np.int32),
            cell_of_image,
            np.bincount(cell_of_image, minlength=n_cells).astype(np.int32),
        )

    @property
    def n_cells(self) -> int:
        """c."""
        return int(self.image_of_cell.size)

    def taps(self, std_m: float) -> NDArray[np.float32]:
        """[2w + 1] weights of a normal error, from w cells behind to w ahead; one tap of weight 1 for none."""
        return move_error(self.step_m, self.n_cells, std_m).astype(np.float32)


def moves_along(lattice: Lattice, actions_m: Sequence[float], stds_m: Sequence[float]) -> Moves:
    """The moves of a domain, [a], each with its deviation."""
    cells = np.array(actions_m, np.float64) / lattice.step_m
    shift = np.floor(cells + _WHOLE).astype(np.int64)
    fraction = cells - shift
    taps = [lattice.taps(std_m) for std_m in stds_m]
    widest = max(row.size for row in taps)
    return Moves(
        shift,
        np.where(fraction < _WHOLE, 0.0, fraction).astype(np.float32),
        np.stack([np.pad(row, (widest - row.size) // 2) for row in taps]),
    )


def uniform_beliefs(lattice: Lattice, n_beliefs: int) -> NDArray[np.float32]:
    """[e, c] beliefs that know nothing; a weight's mean is 1."""
    return np.ones((n_beliefs, lattice.n_cells), np.float32)


def step_beliefs(
    lattice: Lattice,
    beliefs: NDArray[np.float32],
    moves: Moves,
    evidence: NDArray[np.float32],
    true_image: NDArray[np.int64],
    additive: bool,
) -> NDArray[np.float64]:
    """Move, blur and update beliefs in place, and rank the truth's.

    Args:
        beliefs: [e, c] weights; come back with any total, which the next step takes into account.
        evidence: [e, n] of every map image.
        true_image: [e] map image nearest to the robot; below 0: unknown.
        additive: Evidence is added to weights of mean 1; else it multiplies them.

    Returns:
        [e] the truth's rank from 0: map images with a strictly greater belief, and half the others tied; -1 unknown.
    """
    ranks = np.empty(len(beliefs))
    true_cell = np.where(true_image >= 0, lattice.cell_of_image[true_image], -1)
    cells = lattice.image_of_cell, lattice.images_in_cell, true_cell
    _step(beliefs, *moves, evidence, *cells, lattice.closed, additive, ranks)
    return ranks


@njit(cache=True, nogil=True)
def _step(
    beliefs: NDArray[np.float32],
    shift: NDArray[np.int64],
    fraction: NDArray[np.float32],
    taps: NDArray[np.float32],
    evidence: NDArray[np.float32],
    image_of_cell: NDArray[np.int32],
    images_in_cell: NDArray[np.int32],
    true_cell: NDArray[np.int64],
    closed: bool,
    additive: bool,
    ranks: NDArray[np.float64],
) -> None:
    n_beliefs, n_cells = beliefs.shape
    reach = taps.shape[1] // 2
    # moved[reach + c] is cell c; beyond the ends zeros, or the other end of a closed route
    moved = np.zeros(n_cells + 2 * reach + 2 * _TAPS_AT_ONCE, np.float32)
    for e in range(n_beliefs):
        belief, at_cells = beliefs[e], moved[reach : reach + n_cells]
        total = np.float32(0.0)
        if shift[e] != NO_MOVE:
            total = _shift(belief, shift[e], fraction[e], closed, at_cells)
        if total > 0:  # else a first view; or no place has that much route ahead, and the belief stays
            _pad(moved, reach, n_cells, taps[e], closed)
            _blur(moved, taps[e], np.float32(n_cells) / total, belief)
        else:
            belief *= np.float32(n_cells) / belief.sum()
        at_cells[:] = belief
        if _see(belief, evidence[e], image_of_cell, additive) <= 0:  # what this view allows was already excluded
            belief[:] = at_cells
        ranks[e] = _rank(belief, images_in_cell, true_cell[e])


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _shift(
    belief: NDArray[np.float32], shift: int, fraction: np.float32, closed: bool, moved: NDArray[np.float32]
) -> np.float32:
    """Shift; what would be past an end of an open route is dropped. Returns the total that is left."""
    n = belief.size
    if closed:
        shift %= n
        moved[shift:] = belief[: n - shift]
        moved[:shift] = belief[n - shift :]
    elif shift >= 0:
        shift = min(shift, n)
        moved[:shift] = 0
        moved[shift:] = belief[: n - shift]
        if fraction > 0 and n > shift:  # the last cell's mass would be past the end
            moved[n - 1] = 0
    else:
        shift = max(shift, -n)
        moved[: n + shift] = belief[-shift:]
        moved[n + shift :] = 0
    if fraction > 0:
        last = moved[n - 1]
        for c in range(n - 1, 0, -1):
            moved[c] += fraction * (moved[c - 1] - moved[c])
        moved[0] += fraction * ((last if closed else np.float32(0.0)) - moved[0])
    total = np.float32(0.0)
    for c in range(n):
        total += moved[c]
    return total


@njit(cache=True, nogil=True)
def _pad(moved: NDArray[np.float32], reach: int, n: int, taps: NDArray[np.float32], closed: bool) -> None:
    """Make the ends ready for the blur: none of an open route's mass is blurred past its ends."""
    if reach == 0:
        return
    if closed:
        moved[:reach] = moved[n : n + reach]
        moved[reach + n : 2 * reach + n] = moved[reach : 2 * reach]
        return
    for c in range(min(reach, n)):
        moved[reach + c] /= _inside(taps, reach, c, n)
    for c in range(max(reach, n - reach), n):
        moved[reach + c] /= _inside(taps, reach, c, n)


@njit(cache=True, nogil=True)
def _inside(taps: NDArray[np.float32], reach: int, cell: int, n: int) -> np.float32:
    """The share of the blur of a cell that falls on the route."""
    share = np.float32(0.0)
    for k in range(taps.size):
        if 0 <= cell + k - reach < n:
            share += taps[k]
    return share


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _blur(
    moved: NDArray[np.float32], taps: NDArray[np.float32], scale: np.float32, belief: NDArray[np.float32]
) -> None:
    """Every cell's sum over its neighbours, a block of cells at a time."""
    n = belief.size
    weights = np.zeros(-(-taps.size // _TAPS_AT_ONCE) * _TAPS_AT_ONCE, np.float32)
    weights[: taps.size] = taps * scale
    for start in range(0, n, _BLOCK):
        stop = min(start + _BLOCK, n)
        block = belief[start:stop]
        block[:] = 0
        for k in range(0, weights.size, _TAPS_AT_ONCE):
            w0, w1, w2, w3 = weights[k], weights[k + 1], weights[k + 2], weights[k + 3]
            source = moved[start + k : stop + k + _TAPS_AT_ONCE - 1]
            for c in range(block.size):
                block[c] += w0 * source[c] + w1 * source[c + 1] + w2 * source[c + 2] + w3 * source[c + 3]


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _see(
    belief: NDArray[np.float32], evidence: NDArray[np.float32], image_of_cell: NDArray[np.int32], additive: bool
) -> np.float32:
    """Take the evidence of the cells' map images; returns the new total."""
    total = np.float32(0.0)
    for c in range(belief.size):
        seen = evidence[image_of_cell[c]]
        belief[c] = belief[c] + seen if additive else belief[c] * seen
        total += belief[c]
    return total


@njit(cache=True, nogil=True)
def _rank(belief: NDArray[np.float32], images_in_cell: NDArray[np.int32], true_cell: int) -> float:
    if true_cell < 0:
        return -1.0
    truth = belief[true_cell]
    n_better, n_tied = 0, 0
    for c in range(belief.size):
        n_better += images_in_cell[c] if belief[c] > truth else 0
        n_tied += images_in_cell[c] if belief[c] == truth else 0
    return n_better + 0.5 * (n_tied - 1)
