"""What is usual for each landmark, so that a rank can be read as surprising or not (`standardised`, design's own).

A robot on a thin link sends its nearest landmarks alone. Of every other one it is known that it is farther than the
last that was sent, and landmarks go together: where one is unusually near, those that look like it are too. So the
standardised scores z of a view are taken as normal, with the correlations that the map's own drive showed, kept as a
few common factors: z = loadings @ f + a part of each landmark's own. The factors f are placed where all that is known
is most probable: the scores that were sent, and for each other landmark that it is beyond the last of them (a factor
model with censored observations). The expected z stands for one that was not sent; its variance says how little is
known of it, to whoever weighs evidence, and to the running statistics, which take the expected moments as an EM step
would.
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.descriptor import n_ranked, normal_scores

PRIOR_WEIGHT_FRAMES = 50.0  # how many live frames the map's statistics are worth at the start of a session
# A live season differs from those that a calibrated map knows: its own views soon say more than their statistics do.
CALIBRATED_PRIOR_WEIGHT_FRAMES = 20.0
_LEAST_STD = 1e-6
_ALL_KNOWN = np.ones(1)
_MAX_FACTORS = 64
_MAX_FACTOR_FRAMES = 1024  # neighbouring frames of a drive say the same
_LEAST_FACTOR_FRAMES = 30
_LEAST_OWN_VARIANCE = 0.02  # of a landmark, whatever the factors explain
_NEWTON_STEPS = 20  # at most; three or four are usual
_NEWTON_TOLERANCE = 1e-3  # in a score's standard deviations
_ASYMPTOTIC_FROM = 30.0


@dataclass(frozen=True)
class ViewScores:
    """What one view says of every landmark.

    Attributes:
        z: [r] float64, standardised scores, lowest is nearest; expected ones where a landmark was not sent.
        certainty: [r] float64, 1 less the variance of each, so 1 where it was sent; [1] where all were.
    """

    z: NDArray[np.float64]
    certainty: NDArray[np.float64]


@dataclass(frozen=True)
class LandmarkStatistics:
    """Running mean and spread of every landmark's normal score, as weighted moments.

    Attributes:
        weight: How many frames the moments are worth.
        mean: [r] float64, mean normal score.
        square: [r] float64, mean squared normal score.
        loadings: [r, q] float32 on common factors, from which landmarks' correlations follow; None: not known, each is
            taken for itself.
    """

    weight: float
    mean: NDArray[np.float64]
    square: NDArray[np.float64]
    loadings: NDArray[np.float32] | None = None

    @classmethod
    def of_map(cls, ranks: NDArray[np.float32]) -> Self:
        """The statistics of a traverse of ranks [n, r], weighed as the prior of a live session."""
        scores = normal_scores(ranks, ranks.shape[1])
        return cls(PRIOR_WEIGHT_FRAMES, scores.mean(axis=0), np.square(scores).mean(axis=0))

    @classmethod
    def from_mean_std(
        cls,
        mean: NDArray[np.float64],
        std: NDArray[np.float64],
        weight: float = PRIOR_WEIGHT_FRAMES,
        loadings: NDArray[np.float32] | None = None,
    ) -> Self:
        """From a map's stored mean and standard deviation, [r] each, and loadings."""
        return cls(weight, mean, np.square(std) + np.square(mean), loadings)

    @property
    def std(self) -> NDArray[np.float64]:
        """[r] float64. A landmark that never moved is given the spread that normal scores have, 1."""
        std = np.sqrt(np.maximum(self.square - np.square(self.mean), 0.0))
        return np.where(std > _LEAST_STD, std, 1.0)

    def observing(self, ranks: NDArray[np.float32]) -> Self:
        """The statistics after one more frame, [r] ranks, or one more of every drive, [e, r]; it counts in its own z.

        Of landmarks that were not sent the expected moments count.
        """
        scores = normal_scores(ranks, ranks.shape[-1])
        squares = np.square(scores)
        if ranks.ndim == 1 and n_ranked(ranks) < ranks.size:
            view = self.view(ranks)
            scores = self.mean + self.std * view.z
            squares = np.square(scores) + np.square(self.std) * (1.0 - view.certainty)
        weight = self.weight + 1.0
        mean = self.mean + (scores - self.mean) / weight
        square = self.square + (squares - self.square) / weight
        return replace(self, weight=weight, mean=mean, square=square)

    def pooled(self, n_frames: float, other: "LandmarkStatistics", n_others: float) -> Self:
        """The statistics of two drives together, each counted by its frames; weight and loadings stay this one's."""
        share = n_others / (n_frames + n_others)
        mean = self.mean + (other.mean - self.mean) * share
        square = self.square + (other.square - self.square) * share
        return replace(self, mean=mean, square=square)

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
