"""A belief in a few numbers."""

from dataclasses import dataclass
from math import erf

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.belief.cells import SUMS
from deepsimbad.core.index.retrieval import shortlist
from deepsimbad.core.route import Route

CONFIDENT_WITHIN_M = 5.0  # of the mode, to either side
DEFAULT_CONFIDENCE = 0.99
_NO_MOVES = np.empty((0, 1, 2))
_CREDIBLE_SHARE = 0.95
_ENOUGH = 1 - 1e-6  # of that share: masses are rounded
_SIZES = 1024  # classes of masses, sixteen an octave below the greatest; smaller ones count as the last
_TO_SIZE = 19  # bits of a single below its exponent and the four that cut an octave
_NOTHING = np.finfo(np.float32).tiny  # the least mass whose logarithm is taken


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
    top_mass: NDArray[np.float32]  # their masses

    @property
    def credible_95_m(self) -> tuple[float, float]:
        """The hull of that set, over its greatest gap on a closed route; lo > hi crosses the start."""
        return self.credible_95_sets_m[0][0], self.credible_95_sets_m[-1][1]


def summarise(route: Route, mass: NDArray[np.float32], n_top: int, off_route: float) -> BeliefSummary:
    """Summarise masses over map images, [n], which sum to 1; `n_top` of the likeliest are listed."""
    top, edges_m = shortlist(mass, n_top), route.histogram_edges_m
    bits = np.log2(np.maximum(mass, _NOTHING))
    mean_m, std_m, entropy_bits, ends = _figures(
        mass, bits, route.position_m, route.turn, route.length_m, edges_m[1] - edges_m[0]
    )
    return BeliefSummary(
        mean_m=mean_m,
        mode_m=float(route.position_m[top[0]]),
        std_m=std_m,
        credible_95_sets_m=_pieces(route, ends),
        entropy_bits=max(0.0, entropy_bits),
        off_route=off_route,
        near_mode=float(near_mode(route, mass, int(top[0]))[0]) * (1 - off_route),
        histogram_edges_m=edges_m,
        histogram_mass=route.histogram_of(mass),
        top=top,
        top_mass=mass[top],
    )


def near_mode(
    route: Route, mass: NDArray[np.float32], mode: int, errors: NDArray[np.float64] = _NO_MOVES
) -> NDArray[np.float64]:
    """[1 + a] the share of masses [n] no farther than 5 m from an image, and what of it still is after moves that err.

    Args:
        errors: [a, k, 2] share and standard deviation in metres of the k normal curves that each move's error is of.
    """
    return np.asarray(_near(mass, route.position_m, mode, route.length_m if route.closed else 0.0, errors))


@njit(cache=True, nogil=True, fastmath=SUMS)
def _near(
    mass: NDArray[np.float32], position_m: NDArray[np.float64], mode: int, turn_m: float, errors: NDArray[np.float64]
) -> NDArray[np.float64]:
    """See `near_mode`; `turn_m` is the length of a closed route, 0 of an open one."""
    near, total = np.zeros(1 + len(errors)), 0.0
    for image in range(mass.size):
        total += mass[image]
    if 0 < turn_m <= 2 * CONFIDENT_WITHIN_M:
        return near + 1.0
    for turns in range(-1, 2) if turn_m > 0 else range(1):
        at_m = position_m[mode] + turns * turn_m
        first = np.searchsorted(position_m, at_m - CONFIDENT_WITHIN_M)
        last = np.searchsorted(position_m, at_m + CONFIDENT_WITHIN_M, side="right")
        for image in range(first, last):
            near[0] += mass[image]
            room_m = CONFIDENT_WITHIN_M + at_m - position_m[image], CONFIDENT_WITHIN_M + position_m[image] - at_m
            for move in range(len(errors)):
                for share, std_m in errors[move]:
                    stays = erf(room_m[0] / (np.sqrt(2) * std_m)) + erf(room_m[1] / (np.sqrt(2) * std_m))
                    near[1 + move] += mass[image] * share * stays / 2
    return near / total  # in double: a planner asks how little is not near


@njit(cache=True, nogil=True)
def _figures(
    mass: NDArray[np.float32],
    bits: NDArray[np.float32],
    position_m: NDArray[np.float64],
    turn: NDArray[np.float64],
    length_m: float,
    bin_m: float,
) -> tuple[float, float, float, NDArray[np.int64]]:
    """All that is summed over the map, in one call, since between two calls a thread waits for the interpreter.

    Returns:
        Mean, standard deviation, entropy, and [2, s] ends of the stretches of the smallest set.
    """
    mean_m, std_m = _moments(mass, position_m, turn, length_m)
    entropy_bits, least_mass = _entropy_and_least(mass, bits, _CREDIBLE_SHARE)
    return mean_m, std_m, entropy_bits, _stretches(mass, least_mass, position_m, bin_m)


@njit(cache=True, nogil=True, fastmath=SUMS)
def _moments(
    mass: NDArray[np.float32], position_m: NDArray[np.float64], turn: NDArray[np.float64], length_m: float
) -> tuple[float, float]:
    """Mean and standard deviation of the position; circular where `turn` [2, n] has a direction for every image."""
    mean_m, x, y, square = 0.0, 0.0, 0.0, 0.0
    if turn.shape[1] == 0:
        for i in range(mass.size):
            mean_m += mass[i] * position_m[i]
        for i in range(mass.size):
            square += mass[i] * (position_m[i] - mean_m) ** 2
        return mean_m, np.sqrt(square)
    for i in range(mass.size):
        x += mass[i] * turn[0, i]
        y += mass[i] * turn[1, i]
    mean_m = position_m[0] + length_m * (np.arctan2(y, x) / (2 * np.pi) % 1.0)
    for i in range(mass.size):
        apart_m = abs(position_m[i] - mean_m)
        square += mass[i] * min(apart_m, length_m - apart_m) ** 2
    return mean_m, np.sqrt(square)


@njit(cache=True, nogil=True, fastmath=SUMS)
def _entropy_and_least(mass: NDArray[np.float32], bits: NDArray[np.float32], share: float) -> tuple[float, float]:
    """Entropy in bits, and the least mass in the smallest set of images that holds a share.

    Rather than sort all masses, sum them by classes of size, and sort the one class where the share is reached. The bit
    patterns of numbers that are not negative are in the numbers' order.
    """
    pattern, greatest, entropy = mass.view(np.int32), 0, 0.0
    for i in range(mass.size):
        entropy -= mass[i] * bits[i]
        greatest = max(greatest, pattern[i])
    size_class, top = np.empty(mass.size, np.int16), greatest >> _TO_SIZE
    for i in range(mass.size):
        size_class[i] = min(top - (pattern[i] >> _TO_SIZE), _SIZES - 1)
    by_turns = np.zeros((4, _SIZES))  # so that an addition need not wait for the one before it
    for i in range(mass.size):
        by_turns[i & 3, size_class[i]] += mass[i]
    class_mass = by_turns[0] + by_turns[1] + by_turns[2] + by_turns[3]
    total, last_class = 0.0, 0
    while last_class < class_mass.size - 1 and total + class_mass[last_class] < share * _ENOUGH:
        total += class_mass[last_class]
        last_class += 1
    class_members = np.empty_like(mass)
    count = 0
    for i in range(mass.size):
        if size_class[i] == last_class:
            class_members[count] = mass[i]
            count += 1
    ascending = np.sort(class_members[:count])
    for i in range(count - 1, -1, -1):
        total += ascending[i]
        if total >= share * _ENOUGH:
            return entropy, ascending[i]
    return entropy, ascending[0] if count else mass.max()


def _pieces(route: Route, ends: NDArray[np.int64]) -> list[tuple[float, float]]:
    """The pieces of the smallest set, each from and to, in route order; on a closed route after the greatest gap."""
    first_m, last_m = route.position_m[ends].tolist()
    pieces = list(zip(first_m, last_m, strict=True))
    if not route.closed or len(pieces) == 1:
        return pieces
    if ends[0, 0] == 0 and ends[1, -1] == route.n_images - 1:  # one piece crosses the start
        pieces = [*pieces[1:-1], (pieces[-1][0], pieces[0][1])]
    gaps_m = [(b[0] - a[1]) % route.length_m for a, b in zip([pieces[-1], *pieces[:-1]], pieces, strict=True)]
    first = int(np.argmax(gaps_m))
    return [*pieces[first:], *pieces[:first]]


@njit(cache=True, nogil=True)
def _stretches(
    mass: NDArray[np.float32], least_mass: float, position_m: NDArray[np.float64], gap_m: float
) -> NDArray[np.int64]:
    """[2, s] first and last of each run of images with `least_mass` or more; runs nearer than `gap_m` are one."""
    ends, n = np.empty((2, mass.size), np.int64), 0
    for image in range(mass.size):
        if mass[image] < least_mass:
            continue
        last = ends[1, n - 1]
        if n > 0 and (last == image - 1 or position_m[image] - position_m[last] <= gap_m):
            ends[1, n - 1] = image
        else:
            ends[:, n], n = image, n + 1
    return ends[:, :n]
