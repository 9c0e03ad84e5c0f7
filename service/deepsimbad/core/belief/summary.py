"""A belief in a few numbers."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.belief.cells import SUMS
from deepsimbad.core.index.retrieval import shortlist
from deepsimbad.core.route import Route

CONFIDENT_WITHIN_M = 5.0  # of the mode, to either side
DEFAULT_CONFIDENCE = 0.99
_CREDIBLE_SHARE = 0.95
_OCTAVES = 64  # of masses below the greatest; what is smaller is nothing
_NOTHING = 1e-300
_PARTS = 16  # that each octave is cut into


@dataclass(frozen=True)
class BeliefSummary:
    """Where the robot is, if it is on the route, and how sure that is."""

    # mean_m, std_m: Mean and standard deviation of the position; circular on a closed route
    mean_m: float
    mode_m: float  # position of the map image with the greatest mass
    std_m: float
    # [s, 2] the pieces of the smallest set of map images that holds 95 % of the mass; lo > hi crosses a closed start
    credible_95_sets_m: list[tuple[float, float]]
    entropy_bits: float  # entropy over map images
    off_route: float  # probability that the robot is lost: off the route, or carried along it
    near_mode: float  # probability that it is on the route and no farther than 5 m from the mode
    # histogram_edges_m, histogram_mass: Equal bins along the route, at most 200; [b + 1] and [b]
    histogram_edges_m: NDArray[np.float64]
    histogram_mass: NDArray[np.float64]
    top: NDArray[np.int64]  # ids of the map images with the greatest mass, best first
    top_mass: NDArray[np.float64]  # their masses

    @property
    def credible_95_m(self) -> tuple[float, float]:
        """The hull of that set, over its greatest gap on a closed route; lo > hi crosses the start."""
        return self.credible_95_sets_m[0][0], self.credible_95_sets_m[-1][1]


def summarise(route: Route, mass: NDArray[np.float64], n_top: int, off_route: float) -> BeliefSummary:
    """Summarise masses over map images, [n], which sum to 1; `n_top` of the likeliest are listed."""
    top = shortlist(mass, n_top)
    mean_m, std_m = _moments(route, mass)
    entropy_bits, least = _entropy_and_least(mass, np.log2(np.maximum(mass, _NOTHING)), _CREDIBLE_SHARE)
    return BeliefSummary(
        mean_m=mean_m,
        mode_m=float(route.position_m[top[0]]),
        std_m=std_m,
        credible_95_sets_m=_pieces(route, mass >= least),
        entropy_bits=max(0.0, entropy_bits),
        off_route=off_route,
        near_mode=near_mode(route, mass, int(top[0])) * (1 - off_route),
        histogram_edges_m=route.histogram_edges_m,
        histogram_mass=route.histogram_of(mass),
        top=top,
        top_mass=mass[top],
    )


def near_mode(route: Route, mass: NDArray[np.float64], mode: int) -> float:
    """The share of masses [n] no farther than 5 m from an image."""
    if route.closed and route.length_m <= 2 * CONFIDENT_WITHIN_M:
        return float(mass.sum())
    turns_m = (-route.length_m, 0.0, route.length_m) if route.closed else (0.0,)
    at_m, near = route.position_m[mode], 0.0
    for turn_m in turns_m:
        window_m = (at_m + turn_m - CONFIDENT_WITHIN_M, at_m + turn_m + CONFIDENT_WITHIN_M)
        first, last = (
            np.searchsorted(route.position_m, window_m[0]),
            np.searchsorted(route.position_m, window_m[1], "right"),
        )
        near += float(mass[first:last].sum())
    return near


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


@njit(cache=True, nogil=True, fastmath=SUMS)
def _entropy_and_least(mass: NDArray[np.float64], bits: NDArray[np.float64], share: float) -> tuple[float, float]:
    """Entropy in bits, and the least mass in the smallest set of images that holds a share.

    Not all are sorted: they are summed by size, 16 classes an octave, and the class where the share is reached is.
    """
    n_classes = _OCTAVES * _PARTS
    size_class, greatest, entropy = np.empty(mass.size, np.int16), bits.max(), 0.0
    for i in range(mass.size):
        entropy -= mass[i] * bits[i]
        size_class[i] = min(int((greatest - bits[i]) * _PARTS), n_classes - 1)
    by_turns = np.zeros((4, n_classes))  # so that an addition need not wait for the one before it
    for i in range(mass.size):
        by_turns[i & 3, size_class[i]] += mass[i]
    held = by_turns[0] + by_turns[1] + by_turns[2] + by_turns[3]
    total, last = 0.0, 0
    while last < held.size - 1 and total + held[last] < share * (1 - 1e-12):
        total += held[last]
        last += 1
    within = np.empty(mass.size)
    count = 0
    for i in range(mass.size):
        if size_class[i] == last:
            within[count] = mass[i]
            count += 1
    ascending = np.sort(within[:count])
    for at in range(count - 1, -1, -1):
        total += ascending[at]
        if total >= share * (1 - 1e-12):
            return entropy, ascending[at]
    return entropy, ascending[0] if count else mass.max()


def _pieces(route: Route, member: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Stretches of neighbouring members; those nearer together than a bin of the histogram are one."""
    images = np.flatnonzero(member)
    position_m = route.position_m[images]
    bin_m = float(route.histogram_edges_m[1] - route.histogram_edges_m[0])
    adjacent = (np.diff(images) == 1) | (np.diff(position_m) <= bin_m)
    starts = np.r_[0, np.flatnonzero(~adjacent) + 1]
    stops = np.r_[starts[1:], images.size]
    pieces = [(float(position_m[a]), float(position_m[b - 1])) for a, b in zip(starts, stops, strict=True)]
    if not route.closed or len(pieces) == 1:
        return pieces
    if images[0] == 0 and images[-1] == member.size - 1:  # one piece crosses the start
        pieces = [*pieces[1:-1], (pieces[-1][0], pieces[0][1])]
    gaps_m = [(b[0] - a[1]) % route.length_m for a, b in zip([pieces[-1], *pieces[:-1]], pieces, strict=True)]
    first = int(np.argmax(gaps_m))
    return [*pieces[first:], *pieces[:first]]
