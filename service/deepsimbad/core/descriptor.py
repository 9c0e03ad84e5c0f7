"""The scene descriptor: landmarks ranked by dissimilarity (II-C), and what is usual for each of them (ours).

What is usual tells whether a rank is surprising. A robot on a thin link sends its nearest landmarks alone. Of every
other one it is known that it is farther than the last that was sent, and landmarks go together: where one is unusually
near, those that look like it are too. So the standardised scores z of a view are taken as normal, with the correlations
of the map's own drive, as a few common factors: z = loadings @ f + a part of each landmark's own. The factors f are the
most probable ones, given the scores that were sent and that each other landmark is beyond the last of them (a factor
model with censored observations). The expected z stands in for one that was not sent; its variance says how little is
known of it, both to relevances and to the running statistics, which take the expected moments as an EM step would.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from statistics import NormalDist
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from deepsimbad.core.composed import Moments
from deepsimbad.errors import InvalidDissimilaritiesError, InvalidRankedLandmarksError

MAX_LANDMARKS = 0xFFFF  # landmark ids are uint16 and the last value means "none"
PRIOR_WEIGHT_FRAMES = 50.0  # how many live frames the map's statistics are worth at the start of a session
_LEAST_STD = 1e-6
_ALL_KNOWN = np.ones(1)
_MAX_FACTORS = 64
_MAX_FACTOR_FRAMES = 1024  # neighbouring frames of a drive say the same
_LEAST_FACTOR_FRAMES = 30
_LEAST_OWN_VARIANCE = 0.02  # of a landmark's variance, 1, that the factors leave to itself
_NEWTON_STEPS = 20  # at most; three or four are usual
_NEWTON_TOLERANCE = 1e-3  # in a score's standard deviations
_ASYMPTOTIC_FROM = 30.0


def rank_landmarks(dissimilarities: ArrayLike) -> NDArray[np.float32]:
    """Ranks 1..r by ascending dissimilarity, [r] or [n, r] as given, float32; ties by landmark id.

    Raises:
        InvalidDissimilaritiesError: Not one or two dimensions, no landmarks, or NaN or infinity somewhere.
    """
    values = np.asarray(dissimilarities)
    if values.ndim not in {1, 2} or values.shape[-1] == 0:
        raise InvalidDissimilaritiesError(f"dissimilarities have shape {values.shape}; give [r] or [n, r]")
    if not np.isfinite(values).all():
        raise InvalidDissimilaritiesError("dissimilarities hold NaN or infinity; every one must be finite")
    order = np.argsort(values, axis=-1, kind="stable")
    ranks = np.empty(values.shape, np.float32)
    ascending = np.arange(1, values.shape[-1] + 1, dtype=np.float32)
    if values.ndim == 1:
        ranks[order] = ascending
    else:
        np.put_along_axis(ranks, order, np.broadcast_to(ascending, values.shape), axis=-1)
    return ranks


def ranks_from_ranked_landmarks(landmark_ids: Sequence[int], n_landmarks: int) -> NDArray[np.float32]:
    """[r] ranks of all landmarks from the ids that a robot sent, nearest first, 1..r of them.

    Landmarks that were not sent share the mean of the ranks left, from which `n_ranked` counts those that were.

    Raises:
        InvalidRankedLandmarksError: None, too many, out of range or listed twice.
    """
    ids = checked_ranking(landmark_ids, n_landmarks)
    n_sent = ids.size
    ranks = np.full(n_landmarks, (n_sent + 1 + n_landmarks) / 2, np.float32)
    ranks[ids] = np.arange(1, n_sent + 1, dtype=np.float32)
    return ranks


def n_ranked(ranks: NDArray[np.float32]) -> int:
    """How many landmarks of ranks [r] have one of their own, the nearest m; the others share the mean rank left.

    r where all ranks are known, 0 of a view that shows nothing.
    """
    last = float(ranks.max())
    return ranks.size if last == ranks.size else round(2 * last) - 1 - ranks.size


def checked_ranking(landmark_ids: Sequence[int], n_landmarks: int) -> NDArray[np.int64]:
    """[m] int64, the ids given, nearest first; raises InvalidRankedLandmarksError where they are no ranking."""
    n_sent = len(landmark_ids)
    if not 1 <= n_sent <= n_landmarks:
        raise wrong_number(n_sent, n_landmarks)
    try:
        ids = np.asarray(landmark_ids, dtype=np.int64)
    except (OverflowError, TypeError, ValueError) as error:
        raise InvalidRankedLandmarksError("ranked landmarks must be whole numbers") from error
    if ids.min() < 0 or ids.max() >= n_landmarks:
        raise InvalidRankedLandmarksError(
            f"a landmark id is out of range; ids run from 0 to {n_landmarks - 1}", n_landmarks=n_landmarks
        )
    if np.bincount(ids).max() > 1:
        raise InvalidRankedLandmarksError("a landmark id is listed twice; ids must be distinct")
    return ids


def wrong_number(n_sent: int, n_landmarks: int) -> InvalidRankedLandmarksError:
    """The error for a ranking of no landmark, or of more than there are."""
    return InvalidRankedLandmarksError(
        f"{n_sent} ranked landmarks sent; send 1 to {n_landmarks}, nearest first", n_landmarks=n_landmarks
    )


def nearest_landmarks(values: ArrayLike, list_length: int) -> NDArray[np.uint16]:
    """[h, n] the landmarks of lowest value (rank, dissimilarity or z, [n, r]) of every image, ties by landmark id."""
    order = np.argsort(np.asarray(values), axis=1, kind="stable")[:, :list_length]
    return np.ascontiguousarray(order.T, dtype=np.uint16)


def normal_scores(ranks: NDArray[np.float32], n_landmarks: int) -> NDArray[np.float64]:
    """Normal scores of whole or half ranks of any shape, `Phi^-1((v - 1/2) / r)`: the nearest landmark's is lowest."""
    half_ranks = np.rint(2 * ranks).astype(np.intp)
    return _scores_of_half_ranks(n_landmarks)[half_ranks]


@lru_cache(maxsize=16)
def _scores_of_half_ranks(n_landmarks: int) -> NDArray[np.float64]:
    """[2r + 1]; entry 2v is the score of rank v. Entries 0 and 1 are no ranks."""
    quantile = NormalDist().inv_cdf
    scores = [np.nan, np.nan]
    scores += [quantile((half_rank / 2 - 0.5) / n_landmarks) for half_rank in range(2, 2 * n_landmarks + 1)]
    table = np.array(scores)
    table.setflags(write=False)
    return table


@dataclass(frozen=True)
class ViewScores:
    """What one view says of every landmark."""

    # [r] float64, standardised scores, lowest is nearest; expected ones where a landmark was not sent
    z: NDArray[np.float64]
    # [r] float64, 1 less the variance of each, so 1 where it was sent; [1] where all were
    certainty: NDArray[np.float64]


@dataclass(frozen=True)
class LandmarkStatistics(Moments):
    """Running mean and spread of every landmark's normal score, [r]."""

    prior_weight = PRIOR_WEIGHT_FRAMES
    # [r, q] float32 on common factors, which give the landmarks' correlations; None: unknown, they count as none
    loadings: NDArray[np.float32] | None = None

    @classmethod
    def of_map(cls, ranks: NDArray[np.float32]) -> Self:
        """The statistics of a traverse of ranks [n, r], weighted as the prior of a live session."""
        scores = normal_scores(ranks, ranks.shape[1])
        return cls(cls.prior_weight, scores.mean(axis=0), np.square(scores).mean(axis=0))

    @cached_property
    def std(self) -> NDArray[np.float64]:
        """[r] float64; 1, the spread of normal scores, of a landmark whose score never changed."""
        std = np.sqrt(np.maximum(self.square - np.square(self.mean), 0.0))
        return np.where(std > _LEAST_STD, std, 1.0)

    def observing(self, ranks: NDArray[np.float32], worth: float = 1.0) -> Self:
        """The statistics after one more frame of ranks [r], or of each of e sessions, [e, r].

        Of landmarks that were not sent the expected moments count; `worth` is less than 1 of a frame that saw little
        new.
        """
        scores = normal_scores(ranks, ranks.shape[-1])
        squares = np.square(scores)
        if ranks.ndim == 1 and n_ranked(ranks) < ranks.size:
            view = self.view(ranks)
            scores = self.mean + self.std * view.z
            squares = np.square(scores) + np.square(self.std) * (1.0 - view.certainty)
        weight = self.weight + worth
        share = worth / weight
        mean = self.mean + (scores - self.mean) * share
        square = self.square + (squares - self.square) * share
        return replace(self, weight=weight, mean=mean, square=square)

    def standardise(self, ranks: NDArray[np.float32]) -> NDArray[np.float64]:
        """z of ranks [r] or [n, r], all of them sent: normal scores less their mean, over their spread.

        Lowest is nearest.
        """
        return (normal_scores(ranks, ranks.shape[-1]) - self.mean) / self.std

    def view(self, ranks: NDArray[np.float32]) -> ViewScores:
        """What a view says of every landmark, also of those that a robot did not send.

        Args:
            ranks: [r]; or of a batch, all of them sent, [e, r].
        """
        n_landmarks = ranks.shape[-1]
        n_sent = n_landmarks if ranks.ndim > 1 else n_ranked(ranks)
        if n_sent == n_landmarks:
            return ViewScores(self.standardise(ranks), _ALL_KNOWN)
        if n_sent == 0:
            return ViewScores(np.zeros(n_landmarks), np.zeros(n_landmarks))
        z, certainty = self.standardise(ranks), np.ones(n_landmarks)
        is_sent = ranks <= n_sent
        border_rank = np.full(1, n_sent + 0.5, np.float32)  # between the last that was sent and the first that was not
        loadings = np.zeros((n_landmarks, 0)) if self.loadings is None else self.loadings.astype(np.float64)
        bounds = ((normal_scores(border_rank, n_landmarks) - self.mean) / self.std)[~is_sent]
        z[~is_sent], variance = _expected_beyond(bounds, loadings[~is_sent], z[is_sent], loadings[is_sent])
        certainty[~is_sent] = 1.0 - np.minimum(variance, 1.0)
        return ViewScores(z, certainty)


def common_factors(scores: NDArray[np.float64]) -> NDArray[np.float32] | None:
    """The correlations of landmarks over a drive, as their loadings on its principal components.

    Correlations over few frames are too large, so they are shrunk by as much as chance explains (Schäfer and Strimmer).
    A landmark keeps a variance of its own.

    Args:
        scores: [n, r], standardised over the drive.

    Returns:
        [r, q] float32, of numbers that float16 holds too; None where the frames are too few.
    """
    n, n_landmarks = scores.shape
    if n < _LEAST_FACTOR_FRAMES or n_landmarks == 1:
        return None
    if n > _MAX_FACTOR_FRAMES:
        scores = scores[np.linspace(0, n - 1, _MAX_FACTOR_FRAMES).round().astype(np.intp)]
    _, strength, components = np.linalg.svd(scores / math.sqrt(len(scores)), full_matrices=False)
    mean_square = max((np.sum(strength**4) - n_landmarks) / (n_landmarks * (n_landmarks - 1)), 1e-12)  # of correlations
    by_chance = (1.0 - min(mean_square, 1.0)) ** 2 / (len(scores) - 1)
    real_share = max(1.0 - by_chance / mean_square, 0.0)
    loadings = math.sqrt(real_share) * (strength[:_MAX_FACTORS, np.newaxis] * components[:_MAX_FACTORS]).T
    common_variance, limit = np.square(loadings).sum(axis=1), 1.0 - _LEAST_OWN_VARIANCE
    loadings *= np.sqrt(limit / np.maximum(common_variance, limit))[:, np.newaxis]
    return np.asarray(loadings, np.float16).astype(np.float32)


def _expected_beyond(
    bounds: NDArray[np.float64],
    loadings: NDArray[np.float64],
    sent_scores: NDArray[np.float64],
    sent_loadings: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance, [u] each, of scores that were not sent, given those sent and that they exceed bounds.

    Args:
        bounds: [u] which the scores exceed.
        loadings: [u, q] of their landmarks.
        sent_scores: [m] that were sent.
        sent_loadings: [m, q] of their landmarks.
    """
    own_variance, sent_variance = _own_variance(loadings), _own_variance(sent_loadings)
    std = np.sqrt(own_variance)
    # The log-probability of the factors f has gradient pull - curvature @ f, but for what the bounds add.
    pull = sent_loadings.T @ (sent_scores / sent_variance)
    curvature = np.eye(sent_loadings.shape[1]) + sent_loadings.T @ (sent_loadings / sent_variance[:, np.newaxis])
    factors, precision = np.linalg.solve(curvature, pull), curvature
    for _ in range(_NEWTON_STEPS):
        hazard, narrowing = _hazards((bounds - loadings @ factors) / std)
        precision = curvature + loadings.T @ (loadings * (narrowing / own_variance)[:, np.newaxis])
        step = np.linalg.solve(precision, pull - curvature @ factors + loadings.T @ (hazard / std))
        factors = factors + step
        if np.abs(step).max(initial=0.0) < _NEWTON_TOLERANCE:
            break
    hazard, narrowing = _hazards((bounds - loadings @ factors) / std)
    of_factors = np.einsum("uq,qu->u", loadings, np.linalg.solve(precision, loadings.T))
    mean = loadings @ factors + std * hazard
    return mean, own_variance * (1.0 - narrowing) + np.square(1.0 - narrowing) * of_factors


def _own_variance(loadings: NDArray[np.float64]) -> NDArray[np.float64]:
    """[r] the part of each landmark's variance, 1, that the common factors leave."""
    return np.asarray(np.maximum(1.0 - np.square(loadings).sum(axis=1), _LEAST_OWN_VARIANCE / 2))


@njit(cache=True, nogil=True)
def _hazards(bounds: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean of the standard normal beyond each bound [u], and 1 less its variance there; [u] each."""
    mean, narrowing = np.empty(bounds.size), np.empty(bounds.size)
    for i, bound in enumerate(bounds):
        if bound > _ASYMPTOTIC_FROM:  # the upper tail would underflow
            hazard = bound + 1.0 / (bound + 2.0 / bound)
        else:
            density = math.exp(-0.5 * bound * bound) * math.sqrt(2.0 / math.pi)
            hazard = density / math.erfc(bound / math.sqrt(2.0))
        mean[i] = hazard
        narrowing[i] = min(max(hazard * (hazard - bound), 0.0), 1.0)
    return mean, narrowing
