"""What a person or a planner reads of a belief (design section 6)."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.retrieval import shortlist
from deepsimbad.core.route import Route

HISTOGRAM_BINS = 200
_CREDIBLE_SHARE = 0.95


@dataclass(frozen=True)
class BeliefSummary:
    """A belief in a few numbers.

    Attributes:
        mean_m, std_m: Mean and standard deviation of the position; circular on a closed route.
        mode_m: Position of the map image with the greatest mass.
        credible_95_m: The shortest stretch that holds 95 % of the mass; lo > hi crosses a closed route's start.
        entropy_bits: Entropy over map images.
        off_route: Probability that the robot is nowhere on the route; None where it is not calibrated.
        histogram_edges_m, histogram_mass: Equal bins along the route, at most 200; [b + 1] and [b].
        top: Ids of the map images with the greatest mass, best first.
        top_mass: Their masses.
    """

    mean_m: float
    mode_m: float
    std_m: float
    credible_95_m: tuple[float, float]
    entropy_bits: float
    off_route: float | None
    histogram_edges_m: NDArray[np.float64]
    histogram_mass: NDArray[np.float64]
    top: NDArray[np.int64]
    top_mass: NDArray[np.float64]


def summarise(route: Route, mass: NDArray[np.float64], n_top: int, off_route: float | None = None) -> BeliefSummary:
    """Summarise masses over map images, [n], which sum to 1; `n_top` of the likeliest are listed."""
    top = shortlist(mass, n_top)
    mean_m, std_m = _moments(route, mass)
    edges_m, bins = route.histogram(HISTOGRAM_BINS)
    return BeliefSummary(
        mean_m=mean_m,
        mode_m=float(route.position_m[top[0]]),
        std_m=std_m,
        credible_95_m=_credible_stretch(route, mass),
        entropy_bits=entropy_bits(mass),
        off_route=off_route,
        histogram_edges_m=edges_m,
        histogram_mass=np.asarray(np.bincount(bins, mass, edges_m.size - 1), np.float64),
        top=top,
        top_mass=mass[top],
    )


def entropy_bits(mass: NDArray[np.float64]) -> float:
    """Entropy over map images, in bits."""
    held = mass[mass > 0]
    return max(0.0, float(-(held * np.log2(held)).sum()))


def _moments(route: Route, mass: NDArray[np.float64]) -> tuple[float, float]:
    # Sums, not dot products: BLAS would wake its threads for a vector this short.
    position = route.position_m
    if route.closed and route.length_m > 0:
        turn = 2 * np.pi / route.length_m
        resultant = (mass * np.exp(1j * turn * (position - route.start_m))).sum()
        mean = route.start_m + (np.angle(resultant) / turn) % route.length_m
    else:
        mean = (mass * position).sum()
    offset = route.offset_m(position, float(mean))
    return float(mean), float(np.sqrt((mass * np.square(offset)).sum()))


def _credible_stretch(route: Route, mass: NDArray[np.float64]) -> tuple[float, float]:
    """Shortest stretch of images whose masses reach 95 %, by sliding its end for every start."""
    position, n = route.position_m, mass.size
    twice = np.r_[mass, mass] if route.closed else mass
    unrolled = np.r_[position, position + route.length_m] if route.closed else position
    first, last = _shortest_stretch(np.r_[0.0, np.cumsum(twice)], unrolled, n)
    return float(position[first]), float(position[last % n])


@njit(cache=True, nogil=True)
def _shortest_stretch(before: NDArray[np.float64], position_m: NDArray[np.float64], n_starts: int) -> tuple[int, int]:
    """First and last image of the stretch; `before` is the mass before every image, and after the last."""
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
