"""How far each landmark can be trusted across seasons, learnt where two seasons of one route are known (ours).

A map knows the route in two domains: the training traverse that became the map, and the landmark traverse. Wherever
both saw the same place, their standardised scores of a landmark are a sample of what a live view of a third season
will score against the map. Their correlation `rho` says how much of a landmark's score belongs to the place. Between
two standard normal scores of that correlation, the log-likelihood ratio of "seen from the place that lists it" against
"seen from anywhere" is, for equal spread,

    rho * z_q * z_m - rho^2 * z_m^2 / 2

with z_q the score in the query and z_m the map image's. The map stores no z_m; its mean over the images that list the
landmark at that rank stands for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.statistics import LandmarkStatistics

# A live season differs from both that the map knows: its own views soon say more than their statistics do.
CALIBRATED_PRIOR_WEIGHT_FRAMES = 20.0
# Without two seasons of one place nothing can be learnt; this is what the development recordings show on average.
DEFAULT_CORRELATION = 0.6
_LEAST_MEAN_CORRELATION = 0.15  # below, the two traverses did not see the same places, whatever their positions say
_LEAST_PAIRS = 30
_BOUNDS = (0.05, 0.95)
_PSEUDO_IMAGES = 3.0  # weight of the rank's mean in a landmark's mean score at that rank


@dataclass(frozen=True)
class Calibration:
    """The model of every landmark.

    Attributes:
        correlation: [r] float64, rho.
        listed_score: [h, r] float64, mean standardised score of landmark i where a map image lists it at rank j + 1.
        is_learnt: Whether the correlations were learnt from two seasons, or are the default.
    """

    correlation: NDArray[np.float64]
    listed_score: NDArray[np.float64]
    is_learnt: bool

    @classmethod
    def learn(
        cls,
        map_scores: NDArray[np.float64],
        lists: NDArray[np.uint16],
        pairs: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
    ) -> Self:
        """Learn from the map, and from places seen in two seasons where there are any.

        Args:
            map_scores: [n, r] standardised scores of the map images, by the map's own statistics.
            lists: [h, n], their lists.
            pairs: Standardised scores of the same places in the map and in the landmark traverse, [m, r] each, each by
                its own traverse's statistics; None where the traverses share no place.
        """
        correlation = np.full(map_scores.shape[1], DEFAULT_CORRELATION)
        is_learnt = False
        if pairs is not None and len(pairs[0]) >= _LEAST_PAIRS:
            in_map, in_landmarks = pairs
            learnt = np.einsum("mr,mr->r", in_map, in_landmarks) / len(in_map)
            if learnt.mean() >= _LEAST_MEAN_CORRELATION:
                correlation, is_learnt = np.clip(learnt, *_BOUNDS), True
        return cls(correlation, _listed_scores(map_scores, lists), is_learnt)

    def log_ratios(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """What every landmark is worth at every rank of a list.

        Args:
            scores: [r] standardised scores of the query.

        Returns:
            [h, r].
        """
        expected = self.correlation * self.listed_score
        return expected * scores - np.square(expected) / 2


def live_prior(seasons: Sequence[LandmarkStatistics]) -> LandmarkStatistics:
    """What is usual over all seasons that the map knows, taken alike: the best guess about another one."""
    return LandmarkStatistics(
        CALIBRATED_PRIOR_WEIGHT_FRAMES,
        np.mean([season.mean for season in seasons], axis=0),
        np.mean([season.square for season in seasons], axis=0),
    )


def _listed_scores(map_scores: NDArray[np.float64], lists: NDArray[np.uint16]) -> NDArray[np.float64]:
    n_landmarks = map_scores.shape[1]
    means = np.empty((len(lists), n_landmarks))
    images = np.arange(lists.shape[1])
    for rank, row in enumerate(lists):
        listed = map_scores[images, row]
        total = np.bincount(row, listed, n_landmarks) + _PSEUDO_IMAGES * listed.mean()
        means[rank] = total / (np.bincount(row, minlength=n_landmarks) + _PSEUDO_IMAGES)
    return means
