"""A place is the weighted sum of its landmarks: `composed`, ours.

A season is mostly a shift and a scale of every dimension of an encoding, so encodings are standardised by their own
drive's statistics and brought to unit length: u. Where two seasons of a route are known a place is the mean direction
of both, and what a season changes counts less (within-place whitening). The h landmarks of a place are those whose sum,
weighted by list position, comes nearest to it in direction; a view answers a place by its cosine with that sum.
Landmarks begin as frames and are moved to where the sums come nearer still.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

WEIGHTS = (1.0, 0.8, 0.65, 0.5)
"""Of the landmarks of a list, by position; a longer list goes on with the last."""

PRIOR_WEIGHT_FRAMES = 20.0  # how many live views the map's statistics are worth
MOST_DIMENSIONS = 96  # of u; longer encodings are projected
SECOND_SEASON_WEIGHT = 0.8  # of the landmark drive's view of a place beside the training drive's
LEAST_SHARED_PLACES = 100  # that within-place scatter is learnt from
_EVENING_OUT = 5.0  # times the mean variance, by which a projection's strong dimensions are held back
_BEAM = 8  # partial lists that are followed at once
_STILL = 1e-6  # of the greatest standard deviation: a number whose own is less tells nothing
_MUTE = 1e6  # of the greatest standard deviation: what such a number gets in place of its own
_RIDGE = 1e-3  # of the mean square along a direction of landmarks
_BARRED = np.float32(-1e9)
_ROWS_AT_ONCE = 1024
_SWEEPS = 4  # rounds in which landmarks are moved towards the places that list them
_INERTIA = 0.5  # what a landmark's own position counts in a round
_MOST_TAUGHT_BY = 4096  # places from which landmarks learn
_MOST_FRAMES = 2048  # from which principal directions are computed


@dataclass(frozen=True)
class Moments:
    """Running mean and mean square of every number of a row, over the views so far."""

    prior_weight: ClassVar[float] = PRIOR_WEIGHT_FRAMES
    weight: float  # how many views they are worth
    mean: NDArray[np.float64]  # [d]
    square: NDArray[np.float64]  # [d]

    @classmethod
    def of(cls, *drives: NDArray[np.float32]) -> Self:
        """Mean of the drives' means, mean of their variances: those to expect of a view of an unknown season.

        A number that stood still in one of the drives gets so great a deviation that it tells nothing.
        """
        means = [drive.mean(axis=0, dtype=np.float64) for drive in drives]
        variances = [_telling(drive.var(axis=0, dtype=np.float64)) for drive in drives]
        mean = np.mean(means, axis=0)
        return cls(cls.prior_weight, mean, np.mean(variances, axis=0) + np.square(mean))

    @classmethod
    def of_blocks(cls, blocks: Iterable[NDArray[np.float32]]) -> Self:
        """`of` one drive, whose frames come in blocks [_, d]."""
        n_frames, total, squares = 0, np.zeros(1), np.zeros(1)
        for block in blocks:
            n_frames += len(block)
            total = total + block.sum(axis=0, dtype=np.float64)
            squares = squares + np.einsum("nd,nd->d", block, block, dtype=np.float64)
        mean = total / max(n_frames, 1)
        variance = np.maximum(squares / max(n_frames, 1) - np.square(mean), 0.0)
        return cls(cls.prior_weight, mean, _telling(variance) + np.square(mean))

    @classmethod
    def counted(cls, frames: NDArray[np.float32]) -> Self:
        """Of a few frames [n, d], to be `pooled`: a number that stands still in them may move in others."""
        mean = frames.mean(axis=0, dtype=np.float64)
        return cls(cls.prior_weight, mean, frames.var(axis=0, dtype=np.float64) + np.square(mean))

    @classmethod
    def from_mean_std(cls, statistics: NDArray[np.floating]) -> Self:
        """From a map's stored mean and standard deviation, [2, d]."""
        mean, std = statistics.astype(np.float64)
        return cls(cls.prior_weight, mean, np.square(std) + np.square(mean))

    @cached_property
    def std(self) -> NDArray[np.float64]:
        """[d] float64."""
        return np.sqrt(np.maximum(self.square - np.square(self.mean), 1e-300))

    def mean_std(self) -> NDArray[np.float32]:
        """[2, d], as a map stores it."""
        return np.stack([self.mean, self.std]).astype(np.float32)

    def observing(self, row: NDArray[np.float32], worth: float = 1.0) -> Self:
        """With one view [d] more, NaN where a number is unknown; `worth` is less than 1 of one that saw little new."""
        weight = self.weight + worth
        share, value = worth / weight, row.astype(np.float64)
        mean_step, square_step = share * (value - self.mean), share * (np.square(value) - self.square)
        is_known = ~np.isnan(value)
        mean = self.mean + np.where(is_known, mean_step, 0)
        square = self.square + np.where(is_known, square_step, 0)
        return replace(self, weight=weight, mean=mean, square=square)

    def pooled(self, n_frames: float, other: "Moments", n_others: float) -> Self:
        """The moments of two drives together, each weighted by its number of frames; the weight stays this one's."""
        share = n_others / (n_frames + n_others)
        mean = self.mean + (other.mean - self.mean) * share
        return replace(self, mean=mean, square=self.square + (other.square - self.square) * share)


def _telling(variance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Variances [d], where a number that stands still has so great a one that it tells nothing."""
    greatest = variance.max() or 1.0
    return np.where(variance <= _STILL**2 * greatest, _MUTE**2 * greatest, variance)


def unit(vectors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Each row at length 1; a row of zeros stays."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-12), np.float32)


def unit_encodings(
    encodings: NDArray[np.float32], moments: Moments, projection: NDArray[np.float32] | None
) -> NDArray[np.float32]:
    """u [..., k] float32 of encodings [..., d] by their moments; k = d without a projection [d, k]."""
    rows = standardised(encodings, moments)
    return unit(rows if projection is None else rows @ projection)


def standardised(encodings: NDArray[np.float32], moments: Moments) -> NDArray[np.float32]:
    """Encodings [..., d] in standard deviations from their mean, float32; an unknown number, NaN, becomes 0."""
    deviations = ((encodings - moments.mean) / moments.std).astype(np.float32)
    return np.where(np.isnan(deviations), np.float32(0), deviations)


def season_seen(u: NDArray[np.float32], places: NDArray[np.int64], n_images: int) -> NDArray[np.float32]:
    """[n, k] what a second season adds to every map image: the weighted mean of its frames [m, k] there.

    Args:
        places: [p, 2] pairs (map image, frame) of the same place.
    """
    sums, n_frames = np.zeros((n_images, u.shape[1]), np.float32), np.bincount(places[:, 0], minlength=n_images)
    np.add.at(sums, places[:, 0], u[places[:, 1]])
    return np.asarray(SECOND_SEASON_WEIGHT * (sums / np.maximum(n_frames, 1)[:, np.newaxis]), np.float32)


def described(
    encodings: NDArray[np.float32], moments: Moments, projection: NDArray[np.float32] | None
) -> NDArray[np.float32]:
    """`unit_encodings` of a whole drive, [n, k], block by block."""
    blocks = range(0, len(encodings), _ROWS_AT_ONCE)
    return np.concatenate([unit_encodings(encodings[i : i + _ROWS_AT_ONCE], moments, projection) for i in blocks])


def principal_directions(
    *drives: NDArray[np.float32], halves: Sequence[int] = (), on_progress: Callable[[float], None] = lambda _: None
) -> NDArray[np.float32] | None:
    """[d, k] float32, the directions in which frames differ most, the strongest held back a little.

    Numbers are standardised, and then weighted by how much they differ along the drives: of thousands many hardly do,
    and their noise would count as much as what shows places. k is 96 or the number of frames less 1, whichever is
    less. They come from the matrix of products between at most 2,048 frames, so that no d x d matrix need exist.

    Args:
        drives: [n, d] encodings of each.
        halves: Lengths of the encodings that lie side by side in each row. Each half has 96 directions of its own, and
            all have the same mean square, so that none drowns another and each can be compared alone.

    Returns:
        None where d is no more than 96.
    """
    if halves:
        return _side_by_side(halves, drives, on_progress)
    if drives[0].shape[1] <= MOST_DIMENSIONS:
        return None
    n_per_drive = _MOST_FRAMES // len(drives)
    samples = [drive[np.linspace(0, len(drive) - 1, min(len(drive), n_per_drive)).astype(np.intp)] for drive in drives]
    spread = np.mean([rows.std(axis=0, dtype=np.float64) for rows in samples], axis=0)
    weight = (spread / max(spread.mean(), 1e-300)).astype(np.float32)
    pairs = zip(samples, drives, strict=True)
    frames = np.concatenate([unit(unit_encodings(rows, Moments.of(drive), None) * weight) for rows, drive in pairs])
    on_progress(0.4)
    k = max(1, min(MOST_DIMENSIONS, len(frames) - 1))
    products = (frames @ frames.T).astype(np.float64) / len(frames)
    on_progress(0.5)
    variance, vectors = np.linalg.eigh(products)
    on_progress(0.8)
    variance, vectors = np.maximum(variance[-k:], 1e-12), vectors[:, -k:]
    scale = 1 / np.sqrt(variance * len(frames) * (variance + _EVENING_OUT * variance.mean()))
    return np.asarray(weight[:, np.newaxis] * (frames.T.astype(np.float64) @ (vectors * scale)), np.float32)


def _side_by_side(
    halves: Sequence[int], drives: Sequence[NDArray[np.float32]], on_progress: Callable[[float], None]
) -> NDArray[np.float32]:
    """[d, k] float32, the directions of every half, 0 for the numbers of the others."""
    blocks, first = [], 0
    for width in halves:
        parts = [np.ascontiguousarray(drive[:, first : first + width]) for drive in drives]
        block = principal_directions(*parts)
        block = np.eye(width, dtype=np.float32) if block is None else block
        squares = [np.square(standardised(part, Moments.of(part)) @ block).sum(axis=1).mean() for part in parts]
        blocks.append(block / np.float32(np.sqrt(max(np.mean(squares), 1e-12))))
        first += width
        on_progress(first / sum(halves))
    directions = np.zeros((sum(halves), sum(block.shape[1] for block in blocks)), np.float32)
    row = column = 0
    for block in blocks:
        directions[row : row + len(block), column : column + block.shape[1]] = block
        row, column = row + len(block), column + block.shape[1]
    return directions


def within_place_whitening(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """P = (C + s mean(eig C) I)^-1/2 [k, k]: the more seasons change a direction, the less it counts.

    C is the covariance of the difference between [m, k] unit encodings of the same places in two seasons, and
    s = 0.3 + 64 / m.
    """
    values, vectors = np.linalg.eigh(np.cov((first - second).T.astype(np.float64)).reshape(first.shape[1], -1))
    shrinkage = 0.3 + 64 / len(first)
    scale = 1 / np.sqrt(np.maximum(values, 0) + shrinkage * max(values.mean(), 1e-12))
    return np.asarray((vectors * scale) @ vectors.T, np.float32)


@cache
def list_weights(list_length: int) -> NDArray[np.float32]:
    """[h] float32 weights of the landmarks of a list, by position; frozen."""
    weights = np.array([WEIGHTS[min(position, len(WEIGHTS) - 1)] for position in range(list_length)], np.float32)
    weights.setflags(write=False)
    return weights


def compose(
    places: NDArray[np.float32],
    landmarks: NDArray[np.float32],
    list_length: int,
    barred: NDArray[np.bool_] | None = None,
) -> NDArray[np.uint16]:
    """The lists of all map images, each found by a beam search.

    Args:
        places: [n, k] unit.
        landmarks: [r, k] unit.
        list_length: h.
        barred: [n, r] landmarks that a place may not list, as long as there are others; None: it may list any.

    Returns:
        [h, n] landmark ids by list position, none twice in a list.
    """
    weights = list_weights(list_length)
    gram = np.ascontiguousarray(landmarks @ landmarks.T)
    lists = np.empty((len(places), list_length), np.uint16)
    for start in range(0, len(places), _ROWS_AT_ONCE):
        block = slice(start, start + _ROWS_AT_ONCE)
        products = np.ascontiguousarray(places[block] @ landmarks.T)
        if barred is not None:
            products[barred[block]] = _BARRED
        _search(products, gram, weights, lists[block])
    return np.ascontiguousarray(lists.T)


def learnt_landmarks(
    places: NDArray[np.float32],
    landmarks: NDArray[np.float32],
    list_length: int,
    barred: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """[r, k] unit landmarks whose weighted sums come nearer to the places than those of the landmarks given.

    Lists are composed and landmarks moved in turns, to the least squares of places less their sums (dictionary learning
    by the method of optimal directions: Engan, Aase and Husoy 1999). Arguments as of `compose`.
    """
    sample = np.linspace(0, len(places) - 1, min(len(places), _MOST_TAUGHT_BY)).astype(np.intp)
    places, barred = places[sample], None if barred is None else barred[sample]
    weights, rows = list_weights(list_length), np.arange(len(places))
    for _ in range(_SWEEPS):
        lists = compose(places, landmarks, list_length, barred)
        sums = np.tensordot(weights, landmarks[lists], axes=1)
        amplitudes = np.einsum("nk,nk->n", places, sums) / np.maximum(np.einsum("nk,nk->n", sums, sums), 1e-9)
        shares = np.zeros((len(places), len(landmarks)), np.float32)
        for weight, ids in zip(weights, lists, strict=True):
            shares[rows, ids] = weight * amplitudes  # no landmark is twice in a list
        squares = (shares.T @ shares).astype(np.float64)
        squares[np.diag_indices_from(squares)] += _INERTIA
        landmarks = unit(np.linalg.solve(squares, shares.T @ places + _INERTIA * landmarks))
    return landmarks


@njit(cache=True, nogil=True)
def _search(
    products: NDArray[np.float32], gram: NDArray[np.float32], weights: NDArray[np.float32], lists: NDArray[np.uint16]
) -> None:
    """Fill `lists` [n, h] from the front: of every length go on the few whose sum is nearest to the place."""
    n, r = products.shape
    h, width = weights.size, min(_BEAM, r)
    # Of the sum of every partial list: its product with the place, its square, its products with all landmarks.
    # Each twice, since the lists of one length are made from those one landmark shorter.
    dots, squares = np.empty((2, width), np.float32), np.empty((2, width), np.float32)
    cross = np.empty((2, width, r), np.float32)
    ids = np.empty((2, width, h), np.int64)
    best, best_of, best_id = np.empty(width, np.float32), np.empty(width, np.int64), np.empty(width, np.int64)
    scores = np.empty(r, np.float32)
    for i in range(n):
        n_partial = 1
        dots[0, 0], squares[0, 0] = 0.0, 0.0
        cross[0, 0] = 0.0
        for depth in range(h):
            w, n_best, old = weights[depth], 0, depth % 2
            for b in range(n_partial):
                for k in range(r):
                    square = squares[old, b] + w * (2 * cross[old, b, k] + w)
                    scores[k] = (dots[old, b] + w * products[i, k]) / np.sqrt(max(square, np.float32(1e-9)))
                for j in range(depth):
                    scores[ids[old, b, j]] = -np.inf
                for k in range(r):
                    if scores[k] > -np.inf and (n_best < width or scores[k] > best[width - 1]):
                        n_best = _insert(best, best_of, best_id, n_best, scores[k], b, k)
            for b in range(n_best):
                base, k = best_of[b], best_id[b]
                dots[1 - old, b] = dots[old, base] + w * products[i, k]
                squares[1 - old, b] = squares[old, base] + w * (2 * cross[old, base, k] + w)
                for j in range(r):
                    cross[1 - old, b, j] = cross[old, base, j] + w * gram[k, j]
                for j in range(depth):
                    ids[1 - old, b, j] = ids[old, base, j]
                ids[1 - old, b, depth] = k
            n_partial = n_best
        for depth in range(h):
            lists[i, depth] = ids[h % 2, 0, depth]


@njit(cache=True, nogil=True)
def _insert(best: Any, best_of: Any, best_id: Any, n_best: int, score: float, partial: int, landmark: int) -> int:
    """Insert a score into the best so far, in order, ties by arrival; returns how many there are then."""
    rank = min(n_best, best.size - 1)
    while rank > 0 and score > best[rank - 1]:
        best[rank], best_of[rank], best_id[rank] = best[rank - 1], best_of[rank - 1], best_id[rank - 1]
        rank -= 1
    best[rank], best_of[rank], best_id[rank] = score, partial, landmark
    n_longer: int = min(n_best + 1, best.size)
    return n_longer


def fit_to(landmarks: NDArray[np.float32]) -> NDArray[np.float32]:
    """[r, k] float32: estimates [r] of a vector's products with landmarks [r, k], times it, are that vector.

    By least squares, held back where landmarks tell next to nothing of a direction.
    """
    gram = landmarks.T.astype(np.float64) @ landmarks
    gram[np.diag_indices_from(gram)] += _RIDGE * gram.trace() / len(gram)
    return np.asarray(np.linalg.solve(gram, landmarks.T).T, np.float32)


def lengths_of_sums(lists: NDArray[np.uint16], landmarks: NDArray[np.float32]) -> NDArray[np.float32]:
    """[n] float32 lengths of the weighted sums of lists [h, n] of landmarks [r, k]."""
    return _lengths(lists, np.ascontiguousarray(landmarks @ landmarks.T), list_weights(len(lists)))


@njit(cache=True, nogil=True)
def _lengths(lists: NDArray[np.uint16], gram: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    h, n = lists.shape
    lengths = np.empty(n, np.float32)
    for i in range(n):
        square = 0.0
        for a in range(h):
            square += weights[a] * weights[a]
            for b in range(a):
                square += 2 * weights[a] * weights[b] * gram[lists[a, i], lists[b, i]]
        lengths[i] = np.sqrt(max(square, 1e-9))
    return lengths


def is_composed(model: Mapping[str, Any]) -> bool:
    """Whether a landmark model is of `composed` maps: it holds moments of encodings, and prototypes by them."""
    return "usual" in model
