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
_EVENING_OUT = 5.0  # of the mean variance: how far a projection's strong dimensions are held back
_BEAM = 8  # partial lists that are followed at once
_STILL, _MUTE = 1e-6, 1e6  # of the greatest deviation: what moves less tells nothing, and is divided by so much
_BARRED = np.float32(-1e9)
_ROWS_AT_ONCE = 1024
_SWEEPS, _INERTIA = 4, 0.5  # over which landmarks move to what lists them, and what where they stand counts beside that
_MOST_TAUGHT_BY = 4096  # places that landmarks are moved by
_MOST_FRAMES = 2048  # that principal directions are found from


@dataclass(frozen=True)
class Moments:
    """Running mean and mean square of every number of a row, over the views so far."""

    prior_weight: ClassVar[float] = PRIOR_WEIGHT_FRAMES
    weight: float  # how many views they are worth
    mean: NDArray[np.float64]  # [d]
    square: NDArray[np.float64]  # [d]

    @classmethod
    def of(cls, *drives: NDArray[np.float32]) -> Self:
        """Mean of the drives' means, mean of their variances: what is usual for a view of an unknown season.

        A number that stood still in one of the drives has so great a deviation that it says nothing.
        """
        means = [drive.mean(axis=0, dtype=np.float64) for drive in drives]
        variances = [_telling(drive.var(axis=0, dtype=np.float64)) for drive in drives]
        mean = np.mean(means, axis=0)
        return cls(cls.prior_weight, mean, np.mean(variances, axis=0) + np.square(mean))

    @classmethod
    def of_blocks(cls, blocks: Iterable[NDArray[np.float32]]) -> Self:
        """As `of` one drive, whose frames come in blocks [_, d]."""
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
        """As they are, to be pooled: what stood still in a few frames may move in others."""
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
        """With one view more; `worth` of one that saw little new is less than 1."""
        weight = self.weight + worth
        share, value = worth / weight, row.astype(np.float64)
        more, square = share * (value - self.mean), share * (np.square(value) - self.square)
        is_told = ~np.isnan(value)  # what was not told teaches nothing
        mean, square = self.mean + np.where(is_told, more, 0), self.square + np.where(is_told, square, 0)
        return replace(self, weight=weight, mean=mean, square=square)

    def pooled(self, n_frames: float, other: "Moments", n_others: float) -> Self:
        """Those of two drives together, each counted by its frames; the weight stays this one's."""
        share = n_others / (n_frames + n_others)
        mean, square = (
            mine + (theirs - mine) * share for mine, theirs in ((self.mean, other.mean), (self.square, other.square))
        )
        return replace(self, mean=mean, square=square)


def _telling(variance: NDArray[np.float64]) -> NDArray[np.float64]:
    """[d] with so great a variance in place of none that the number says nothing."""
    greatest = variance.max() or 1.0
    return np.where(variance <= _STILL**2 * greatest, _MUTE**2 * greatest, variance)


def unit(vectors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Each row at length 1; a row of zeros stays."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-12), np.float32)


def unit_encodings(
    encodings: NDArray[np.float32], usual: Moments, projection: NDArray[np.float32] | None
) -> NDArray[np.float32]:
    """u of encodings [..., d] by what is usual for them: [..., k], k = d without a projection [d, k]."""
    rows = standardised(encodings, usual)
    return unit(rows if projection is None else rows @ projection)


def standardised(encodings: NDArray[np.float32], usual: Moments) -> NDArray[np.float32]:
    """Encodings [..., d] in deviations from what is usual; a number that was not told, NaN, is as usual."""
    deviations = ((encodings - usual.mean) / usual.std).astype(np.float32)
    return np.where(np.isnan(deviations), np.float32(0), deviations)


def described(
    encodings: NDArray[np.float32], usual: Moments, projection: NDArray[np.float32] | None
) -> NDArray[np.float32]:
    """`unit_encodings` of a whole drive, [n, k], block by block."""
    blocks = range(0, len(encodings), _ROWS_AT_ONCE)
    return np.concatenate([unit_encodings(encodings[at : at + _ROWS_AT_ONCE], usual, projection) for at in blocks])


def principal_directions(
    *drives: NDArray[np.float32], halves: Sequence[int] = (), on_progress: Callable[[float], None] = lambda _: None
) -> NDArray[np.float32] | None:
    """[d, k] the directions in which frames differ most, the strongest held back a little.

    Numbers are standardised, and then weighed by how much they differ along the drives: of thousands many hardly do,
    and their noise would count as much as what shows places. k is 96 or the number of frames less 1, whichever is
    less. By the matrix of products between frames, at most 2,048 of them, so that no d x d matrix need exist.

    Args:
        drives: [n, d] encodings of each.
        halves: Lengths of encodings that lie side by side in one. Each has its own 96 directions, all halves of them
            the same mean square, so that none drowns another and each is compared alone as well as may be.

    Returns:
        None where d is no more than 96.
    """
    if halves:
        return _side_by_side(halves, drives, on_progress)
    if drives[0].shape[1] <= MOST_DIMENSIONS:
        return None
    most = _MOST_FRAMES // len(drives)
    some = [drive[np.linspace(0, len(drive) - 1, min(len(drive), most)).astype(np.intp)] for drive in drives]
    spread = np.mean([rows.std(axis=0, dtype=np.float64) for rows in some], axis=0)
    weight = (spread / max(spread.mean(), 1e-300)).astype(np.float32)
    frames = np.concatenate(
        [unit(unit_encodings(rows, Moments.of(drive), None) * weight) for rows, drive in zip(some, drives, strict=True)]
    )
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
    """[d, k] the directions of every half, which are nothing to the others."""
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
    """P = (C + s mean(eig C) I)^-1/2 [k, k]: what a season changes of a place counts less.

    C is the covariance of the difference between [m, k] unit encodings of the same places in two seasons, and
    s = 0.3 + 64 / m.
    """
    values, vectors = np.linalg.eigh(np.cov((first - second).T.astype(np.float64)).reshape(first.shape[1], -1))
    shrinkage = 0.3 + 64 / len(first)
    scale = 1 / np.sqrt(np.maximum(values, 0) + shrinkage * max(values.mean(), 1e-12))
    return np.asarray((vectors * scale) @ vectors.T, np.float32)


@cache
def list_weights(list_length: int) -> NDArray[np.float32]:
    """[h] float32, frozen."""
    weights = np.array([WEIGHTS[min(place, len(WEIGHTS) - 1)] for place in range(list_length)], np.float32)
    weights.setflags(write=False)
    return weights


def compose(
    places: NDArray[np.float32],
    landmarks: NDArray[np.float32],
    list_length: int,
    barred: NDArray[np.bool_] | None = None,
) -> NDArray[np.uint16]:
    """The lists of all map images, by a beam search.

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
        some = slice(start, start + _ROWS_AT_ONCE)
        products = np.ascontiguousarray(places[some] @ landmarks.T)
        if barred is not None:
            products[barred[some]] = _BARRED
        _search(products, gram, weights, lists[some])
    return np.ascontiguousarray(lists.T)


def learnt_landmarks(
    places: NDArray[np.float32],
    landmarks: NDArray[np.float32],
    list_length: int,
    barred: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """[r, k] unit landmarks whose weighted sums come nearer to the places than those of the frames they begin as.

    Lists are composed and landmarks moved in turns, to the least squares of what the sums leave over (dictionary
    learning by the method of optimal directions: Engan, Aase and Husoy 1999). Arguments as of `compose`.
    """
    some = np.linspace(0, len(places) - 1, min(len(places), _MOST_TAUGHT_BY)).astype(np.intp)
    places, barred = places[some], None if barred is None else barred[some]
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
    """Grow lists from the front, the best few of every length going on: those whose sum is nearest in direction."""
    n, r = products.shape
    h, width = weights.size, min(_BEAM, r)
    along, squares = np.empty(width, np.float32), np.empty(width, np.float32)  # of the sum: product with f, square
    cross = np.empty((width, r), np.float32)  # its products with all landmarks
    ids = np.empty((width, h), np.int64)
    best, best_of, best_id = np.empty(width, np.float32), np.empty(width, np.int64), np.empty(width, np.int64)
    scores = np.empty(r, np.float32)
    for i in range(n):
        n_partial = 1
        along[0], squares[0] = 0.0, 0.0
        cross[0] = 0.0
        for place in range(h):
            w, n_best = weights[place], 0
            for b in range(n_partial):
                for k in range(r):
                    square = squares[b] + w * (2 * cross[b, k] + w)
                    scores[k] = (along[b] + w * products[i, k]) / np.sqrt(max(square, np.float32(1e-9)))
                for j in range(place):
                    scores[ids[b, j]] = -np.inf
                for k in range(r):
                    if scores[k] > -np.inf and (n_best < width or scores[k] > best[width - 1]):
                        n_best = _insert(best, best_of, best_id, n_best, scores[k], b, k)
            _grow(along, squares, cross, ids, best_of[:n_best], best_id[:n_best], place, w, products[i], gram)
            n_partial = n_best
        for place in range(h):
            lists[i, place] = ids[0, place]


@njit(cache=True, nogil=True)
def _insert(best: Any, best_of: Any, best_id: Any, n_best: int, score: float, partial: int, landmark: int) -> int:
    """Into the best so far, in order; ties stay in the order in which they came."""
    at = min(n_best, best.size - 1)
    while at > 0 and score > best[at - 1]:
        best[at], best_of[at], best_id[at] = best[at - 1], best_of[at - 1], best_id[at - 1]
        at -= 1
    best[at], best_of[at], best_id[at] = score, partial, landmark
    longer: int = min(n_best + 1, best.size)
    return longer


@njit(cache=True, nogil=True)
def _grow(
    along: Any, squares: Any, cross: Any, ids: Any, of: Any, landmark: Any, place: int, w: Any, product: Any, gram: Any
) -> None:
    """Partial lists `of`, each one landmark longer, in place of all there were."""
    longer = of.size
    along[:longer], squares[:longer], cross[:longer], ids[:longer] = along[of], squares[of], cross[of], ids[of]
    for b in range(longer):
        k = landmark[b]
        along[b] += w * product[k]
        squares[b] += w * (2 * cross[b, k] + w)
        cross[b] += w * gram[k]
        ids[b, place] = k


def lengths_of_sums(lists: NDArray[np.uint16], landmarks: NDArray[np.float32]) -> NDArray[np.float32]:
    """[n] lengths of the weighted sums of lists [h, n], from the products between landmarks [r, k]."""
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
    """Whether a landmark model's prototypes are unit encodings, with what is usual of encodings beside them."""
    return "usual" in model
