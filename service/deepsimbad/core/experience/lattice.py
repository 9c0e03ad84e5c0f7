"""Many beliefs at once for training: the grid filter on cells of equal length (II-C, II-D).

On equal cells a move is a shift, and its error a short row of weights that is the same everywhere. There are about as
many cells as map images; where the images stand at equal distances the cells are the images, and the beliefs those of
`GridFilter`. Else a cell takes the evidence of its nearest image, as the paper's particles do.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.belief.cells import copy_into
from deepsimbad.core.belief.motion import move_error
from deepsimbad.core.route import Route

_TAPS_AT_ONCE = 4
_WHOLE = 1e-4  # of a cell; a smaller fraction is taken for rounding of positions
_BLOCK = 2048  # cells whose sums stay in the first-level cache

NO_MOVE = np.iinfo(np.int64).min
"""The shift before a first view."""


class Moves(NamedTuple):
    """One move of every belief, in cells."""

    shift: NDArray[np.int64]  # [e] int64, whole cells, negative backward; NO_MOVE before a first view
    fraction: NDArray[np.float32]  # [e] float32, fraction of a cell moved besides, 0..1
    taps: NDArray[np.float32]  # [e, 2w + 1] float32, weights of the move's error


@dataclass(frozen=True)
class Lattice:
    """Cells of equal length along a route."""

    step_m: float  # length of a cell
    closed: bool  # whether the last cell joins the first
    image_of_cell: NDArray[np.int32]  # [c] int32, the map image nearest to every cell
    cell_of_image: NDArray[np.int64]  # [n] int64, the cell nearest to every map image
    images_in_cell: NDArray[np.int32]  # [c] int32, number of map images whose nearest cell it is

    @classmethod
    def of_route(cls, route: Route, actions_m: NDArray[np.float64]) -> "Lattice":
        """Cells as long as the mean step between map images; on an open route a longer shortest move is whole cells."""
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
    """The actions [a] of a domain as moves on the lattice, each with its standard deviation."""
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
    """[e, c] float32, beliefs that know nothing; the mean weight is 1."""
    return np.ones((n_beliefs, lattice.n_cells), np.float32)


def step_beliefs(
    lattice: Lattice,
    beliefs: NDArray[np.float32],
    moves: Moves,
    evidence: NDArray[np.float32],
    true_image: NDArray[np.int64],
    additive: bool,
) -> NDArray[np.float64]:
    """Move, blur and update beliefs in place, and rank the belief at the truth.

    Args:
        beliefs: [e, c] weights, of any total before and after.
        evidence: [e, n] of every map image.
        true_image: [e] map image nearest to the robot; below 0: unknown.
        additive: Whether evidence is added to weights of mean 1, or multiplies them.

    Returns:
        [e] rank of the truth from 0: map images with a strictly greater belief, and half the others tied; -1 unknown.
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
    # buffer[reach + c] is cell c after the shift; beyond the ends are zeros, or the other end of a closed route
    buffer = np.zeros(n_cells + 2 * reach + 2 * _TAPS_AT_ONCE, np.float32)
    for e in range(n_beliefs):
        belief, at_cells = beliefs[e], buffer[reach : reach + n_cells]
        total = np.float32(0.0)
        if shift[e] != NO_MOVE:
            total = _shift(belief, shift[e], fraction[e], closed, at_cells)
        if total > 0:  # else it is a first view, or no place has that much route ahead and the belief stays
            _pad(buffer, reach, n_cells, taps[e], closed)
            _blur(buffer, taps[e], np.float32(n_cells) / total, belief)
        else:
            belief *= np.float32(n_cells) / belief.sum()
        copy_into(at_cells, belief)
        if (
            _see(belief, evidence[e], image_of_cell, additive) <= 0
        ):  # the belief had excluded all that the view allows, and stays
            copy_into(belief, at_cells)
        ranks[e] = _rank(belief, images_in_cell, true_cell[e])


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _shift(
    belief: NDArray[np.float32], shift: int, fraction: np.float32, closed: bool, buffer: NDArray[np.float32]
) -> np.float32:
    """Write the shifted belief into the buffer, without what is past an end of an open route; returns its total."""
    n = belief.size
    if closed:
        shift %= n
        copy_into(buffer[shift:], belief[: n - shift])
        copy_into(buffer[:shift], belief[n - shift :])
    elif shift >= 0:
        shift = min(shift, n)
        buffer[:shift] = 0
        copy_into(buffer[shift:], belief[: n - shift])
        if fraction > 0 and n > shift:  # the last cell's part would be past the end
            buffer[n - 1] = 0
    else:
        shift = max(shift, -n)
        copy_into(buffer[: n + shift], belief[-shift:])
        buffer[n + shift :] = 0
    if fraction > 0:
        last = buffer[n - 1]
        for c in range(n - 1, 0, -1):
            buffer[c] += fraction * (buffer[c - 1] - buffer[c])
        buffer[0] += fraction * ((last if closed else np.float32(0.0)) - buffer[0])
    total = np.float32(0.0)
    for c in range(n):
        total += buffer[c]
    return total


@njit(cache=True, nogil=True)
def _pad(buffer: NDArray[np.float32], reach: int, n: int, taps: NDArray[np.float32], closed: bool) -> None:
    """Prepare the buffer's ends for the blur, which must lose no mass of an open route past its ends."""
    if reach == 0:
        return
    if closed:
        copy_into(buffer[:reach], buffer[n : n + reach])
        copy_into(buffer[reach + n : 2 * reach + n], buffer[reach : 2 * reach])
        return
    for c in range(min(reach, n)):
        buffer[reach + c] /= _inside(taps, reach, c, n)
    for c in range(max(reach, n - reach), n):
        buffer[reach + c] /= _inside(taps, reach, c, n)


@njit(cache=True, nogil=True)
def _inside(taps: NDArray[np.float32], reach: int, cell: int, n: int) -> np.float32:
    """Share of a cell's blur that falls on the route."""
    share = np.float32(0.0)
    for k in range(taps.size):
        if 0 <= cell + k - reach < n:
            share += taps[k]
    return share


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _blur(
    buffer: NDArray[np.float32], taps: NDArray[np.float32], scale: np.float32, belief: NDArray[np.float32]
) -> None:
    """Write the blurred buffer, times `scale`, into the belief, a block of cells at a time."""
    n = belief.size
    weights = np.zeros(-(-taps.size // _TAPS_AT_ONCE) * _TAPS_AT_ONCE, np.float32)
    for k in range(taps.size):
        weights[k] = taps[k] * scale
    for start in range(0, n, _BLOCK):
        stop = min(start + _BLOCK, n)
        block = belief[start:stop]
        block[:] = 0
        for k in range(0, weights.size, _TAPS_AT_ONCE):
            w0, w1, w2, w3 = weights[k], weights[k + 1], weights[k + 2], weights[k + 3]
            source = buffer[start + k : stop + k + _TAPS_AT_ONCE - 1]
            for c in range(block.size):
                block[c] += w0 * source[c] + w1 * source[c + 1] + w2 * source[c + 2] + w3 * source[c + 3]


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _see(
    belief: NDArray[np.float32], evidence: NDArray[np.float32], image_of_cell: NDArray[np.int32], additive: bool
) -> np.float32:
    """Update the belief in place by the evidence of the cells' map images; returns the new total."""
    total = np.float32(0.0)
    for c in range(belief.size):
        value = evidence[image_of_cell[c]]
        belief[c] = belief[c] + value if additive else belief[c] * value
        total += belief[c]
    return total


@njit(cache=True, nogil=True)
def _rank(belief: NDArray[np.float32], images_in_cell: NDArray[np.int32], true_cell: int) -> float:
    """`metrics.rank_of_truth` of the map images in cells, of one true image; -1 where its cell is below 0."""
    if true_cell < 0:
        return -1.0
    truth = belief[true_cell]
    n_better, n_tied = 0, 0
    for c in range(belief.size):
        n_better += images_in_cell[c] if belief[c] > truth else 0
        n_tied += images_in_cell[c] if belief[c] == truth else 0
    return n_better + 0.5 * (n_tied - 1)
