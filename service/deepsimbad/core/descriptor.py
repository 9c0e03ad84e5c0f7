"""The scene descriptor: landmarks ranked by dissimilarity (II-C), and what is usual for each of them (ours).

With that a rank can be read as surprising or not. A robot on a thin link sends its nearest landmarks alone. Of every
other one it is known that it is farther than the last that was sent, and landmarks go together: where one is unusually
near, those that look like it are too. So the standardised scores z of a view are taken as normal, with the correlations
that the map's own drive showed, kept as a few common factors: z = loadings @ f + a part of each landmark's own. The
factors f are placed where all that is known is most probable: the scores that were sent, and for each other landmark
that it is beyond the last of them (a factor model with censored observations). The expected z stands for one that was
not sent; its variance says how little is known of it, to whoever weighs evidence, and to the running statistics, which
take the expected moments as an EM step would.
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
_LEAST_OWN_VARIANCE = 0.02  # of a landmark, whatever the factors explain
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

    Landmarks that were not sent share the mean of the ranks left; `n_ranked` tells them.

    Raises:
        InvalidRankedLandmarksError: None, too many, out of range or listed twice.
    """
    ids = checked_ranking(landmark_ids, n_landmarks)
    n_sent = ids.size
    ranks = np.full(n_landmarks, (n_sent + 1 + n_landmarks) / 2, np.float32)
    ranks[ids] = np.arange(1, n_sent + 1, dtype=np.float32)
    return ranks


def n_ranked(ranks: NDArray[np.float32]) -> int:
    """How many landmarks a view [r] has a rank of its own for: the nearest m, the others share the mean rank left.

    r where all ranks are known, 0 for a view that shows nothing.
    """
    last = float(ranks.max())
    return ranks.size if last == ranks.size else round(2 * last) - 1 - ranks.size


def checked_ranking(landmark_ids: Sequence[int], n_landmarks: int) -> NDArray[np.int64]:
    """[m] ids that a ranking may begin with; raises InvalidRankedLandmarksError."""
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
    """None or more than there are."""
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
    # [r, q] float32 on common factors, from which landmarks' correlations follow; None: not known, each is taken for
    # itself
    loadings: NDArray[np.float32] | None = None

    @classmethod
    def of_map(cls, ranks: NDArray[np.float32]) -> Self:
        """The statistics of a traverse of ranks [n, r], weighed as the prior of a live session."""
        scores = normal_scores(ranks, ranks.shape[1])
        return cls(cls.prior_weight, scores.mean(axis=0), np.square(scores).mean(axis=0))

    @cached_property
    def std(self) -> NDArray[np.float64]:
        """[r] float64. A landmark that never moved is given the spread that normal scores have, 1."""
        std = np.sqrt(np.maximum(self.square - np.square(self.mean), 0.0))
        return np.where(std > _LEAST_STD, std, 1.0)

    def observing(self, ranks: NDArray[np.float32], worth: float = 1.0) -> Self:
        """The statistics after one more frame, [r] ranks, or one more of every drive, [e, r]; it counts in its own z.

        Of landmarks that were not sent the expected moments count; `worth` of a frame that saw little new is below 1.
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
        """z of ranks that are all known, [r] or [n, r]: normal scores less their mean, over their spread.

        Lowest is nearest.
        """
        return (normal_scores(ranks, ranks.shape[-1]) - self.mean) / self.std

    def view(self, ranks: NDArray[np.float32]) -> ViewScores:
        """What a view says of every landmark, of those too that a robot did not send.

        Args:
            ranks: [r]; of a batch [e, r], all of them sent.
        """
        n_landmarks = ranks.shape[-1]
        n_sent = n_landmarks if ranks.ndim > 1 else n_ranked(ranks)
        if n_sent == n_landmarks:
            return ViewScores(self.standardise(ranks), _ALL_KNOWN)
        if n_sent == 0:
            return ViewScores(np.zeros(n_landmarks), np.zeros(n_landmarks))
        z, certainty = self.standardise(ranks), np.ones(n_landmarks)
        sent = ranks <= n_sent
        between = np.full(1, n_sent + 0.5, np.float32)  # the last that was sent and the first that was not
        loadings = np.zeros((n_landmarks, 0), np.float32) if self.loadings is None else self.loadings
        least = ((normal_scores(between, n_landmarks) - self.mean) / self.std)[~sent]
        z[~sent], variance = _expected_beyond(least, loadings[~sent], z[sent], loadings[sent])
        certainty[~sent] = 1.0 - np.minimum(variance, 1.0)
        return ViewScores(z, certainty)


def common_factors(scores: NDArray[np.float64]) -> NDArray[np.float32] | None:
    """How landmarks go together over a drive, as loadings on its principal components.

    Correlations of few frames show more than there is, so they are shrunk as far as chance alone would explain them
    (Schäfer and Strimmer). A landmark keeps a variance of its own.

    Returns:
        [r, q] of scores [n, r] standardised over the drive, each number one that float16 holds too; None where the
        frames are too few to tell.
    """
    n, n_landmarks = scores.shape
    if n < _LEAST_FACTOR_FRAMES or n_landmarks == 1:
        return None
    if n > _MAX_FACTOR_FRAMES:
        scores = scores[np.linspace(0, n - 1, _MAX_FACTOR_FRAMES).round().astype(np.intp)]
    _, strength, components = np.linalg.svd(scores / math.sqrt(len(scores)), full_matrices=False)
    mean_square = max((np.sum(strength**4) - n_landmarks) / (n_landmarks * (n_landmarks - 1)), 1e-12)  # correlation's
    by_chance = (1.0 - min(mean_square, 1.0)) ** 2 / (len(scores) - 1)
    shrunk = max(1.0 - by_chance / mean_square, 0.0)
    loadings = math.sqrt(shrunk) * (strength[:_MAX_FACTORS, np.newaxis] * components[:_MAX_FACTORS]).T
    shared = np.square(loadings).sum(axis=1)
    loadings *= np.sqrt((1.0 - _LEAST_OWN_VARIANCE) / np.maximum(shared, 1.0 - _LEAST_OWN_VARIANCE))[:, np.newaxis]
    return np.asarray(loadings, np.float16).astype(np.float32)


def _expected_beyond(
    least: NDArray[np.float64],
    loadings: NDArray[np.float32],
    sent: NDArray[np.float64],
    loadings_sent: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance, [u] each, of scores of which it is known only that they exceed some value.

    Args:
        least: [u], that value.
        loadings: [u, q].
        sent: [m] the other scores, which are known.
        loadings_sent: [m, q].
    """
    unsent, others = loadings.astype(np.float64), loadings_sent.astype(np.float64)
    own, own_others = _own_variance(unsent), _own_variance(others)
    std = np.sqrt(own)
    # Gradient and curvature of the log-probability of the factors f, but for what the bounds add: pull - curved @ f.
    pull = others.T @ (sent / own_others)
    curved = np.eye(others.shape[1]) + others.T @ (others / own_others[:, np.newaxis])
    factors, precision = np.linalg.solve(curved, pull), curved
    for _ in range(_NEWTON_STEPS):
        hazard, narrowed = _hazards((least - unsent @ factors) / std)
        precision = curved + unsent.T @ (unsent * (narrowed / own)[:, np.newaxis])
        step = np.linalg.solve(precision, pull - curved @ factors + unsent.T @ (hazard / std))
        factors = factors + step
        if np.abs(step).max(initial=0.0) < _NEWTON_TOLERANCE:
            break
    hazard, narrowed = _hazards((least - unsent @ factors) / std)
    of_factors = np.einsum("uq,qu->u", unsent, np.linalg.solve(precision, unsent.T))
    mean = unsent @ factors + std * hazard
    return mean, own * (1.0 - narrowed) + np.square(1.0 - narrowed) * of_factors


def _own_variance(loadings: NDArray[np.float64]) -> NDArray[np.float64]:
    """What of each landmark's variance, 1, the common factors leave, [r]."""
    return np.asarray(np.maximum(1.0 - np.square(loadings).sum(axis=1), _LEAST_OWN_VARIANCE / 2))


@njit(cache=True, nogil=True)
def _hazards(bounds: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean of what of the standard normal lies beyond each bound, and 1 less its variance; [u] each."""
    mean, narrowed = np.empty(bounds.size), np.empty(bounds.size)
    for place, bound in enumerate(bounds):
        if bound > _ASYMPTOTIC_FROM:  # the upper tail would underflow
            hazard = bound + 1.0 / (bound + 2.0 / bound)
        else:
            density = math.exp(-0.5 * bound * bound) * math.sqrt(2.0 / math.pi)
            hazard = density / math.erfc(bound / math.sqrt(2.0))
        mean[place] = hazard
        narrowed[place] = min(max(hazard * (hazard - bound), 0.0), 1.0)
    return mean, narrowed
