"""How far each landmark can be trusted across seasons, learnt where two seasons of one route are known (ours).

A map knows the route in two domains: the training traverse that becomes the map, and the landmark traverse. Where both
saw the same place, their standardised scores of a landmark are a sample of what a view of a third season will score
against the map. Their correlation `rho` says how much of a landmark's score belongs to the place. A map image lists
the landmarks that were near in both seasons, and between its score z_m and the query's z_q, standard normal with
correlation rho, the log-likelihood ratio of "seen from the place that lists it" against "seen from anywhere" is, for
equal spread,

    rho * z_m * z_q - (rho * z_m)^2 / 2.

The map stores no z_m; its mean over the images that list the landmark at that rank stands for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.statistics import LandmarkStatistics

# A live season differs from those that the map knows: its own views soon say more than their statistics do.
CALIBRATED_PRIOR_WEIGHT_FRAMES = 20.0
# Without two seasons of one place nothing can be learnt; this is what the development recordings show on average.
DEFAULT_CORRELATION = 0.6
SECOND_SEASON_WEIGHT = 0.6  # of its score against the map's own, in choosing what an image lists
_BOUNDS = (0.05, 0.95)
_PSEUDO_IMAGES = 3.0  # weight of the rank's mean in a landmark's mean score at that rank


@dataclass(frozen=True)
class Calibration:
    """The model of every landmark.

    Attributes:
        correlation: [r] float64, rho: of what an image's list says with a view of another season.
        listed_score: [h, r] float64, mean standardised score of landmark i where a map image lists it at rank j + 1.
        is_of_two_seasons: Whether the correlations were learnt, or are the default.
    """

    correlation: NDArray[np.float64]
    listed_score: NDArray[np.float64]
    is_of_two_seasons: bool = False

    def log_ratios(self, scores: NDArray[np.float64], known: NDArray[np.float64] | float = 1.0) -> NDArray[np.float64]:
        """What every landmark is worth at every rank of a list, [h, r], for a query's standardised scores [r].

        Args:
            scores: z; expected ones where they are not known.
            known: How much of each is known, [r]. A landmark that was not sent, of which z is known but for a variance
                v, tells as much less: to second order in rho * z_m its ratio is rho * z_m * E[z_q] less (1 - v) of the
                square.
        """
        expected = self.correlation * self.listed_score
        return expected * scores - known * np.square(expected) / 2


@dataclass(frozen=True)
class SeasonsOfRoute:
    """The standardised scores of the map images over the seasons that are known.

    Attributes:
        scores: [n, r] float64, of both seasons where both are known, else of the map's own; about standard normal.
        correlation: [r] float64, of these scores with a season not yet seen.
        are_two: Whether a second season was learnt from.
    """

    scores: NDArray[np.float64]
    correlation: NDArray[np.float64]
    are_two: bool

    @classmethod
    def learn(
        cls,
        own: NDArray[np.float64],
        second: NDArray[np.float64] | None = None,
        places: NDArray[np.int64] | None = None,
    ) -> "SeasonsOfRoute":
        """Combine the seasons.

        Args:
            own: [n, r] scores of the map images by the map's own statistics.
            second: [m, r] scores of the landmark traverse's frames by theirs.
            places: [k, 2] (map image, frame) of the same place, k at least 1; given with `second`.
        """
        single = cls(own, np.full(own.shape[1], DEFAULT_CORRELATION), are_two=False)
        if second is None or places is None:
            return single
        of_map, of_second = places.T
        between = np.einsum("kr,kr->r", own[of_map], second[of_second]) / len(places)
        between = np.clip(between, *_BOUNDS)
        weight = SECOND_SEASON_WEIGHT
        spread = np.sqrt(1 + weight**2 + 2 * weight * between)
        scores = own.copy()
        scores[of_map] = (own[of_map] + weight * second[of_second]) / spread
        # Of a weighted mean of two equally related measurements with a third (Spearman and Brown).
        return cls(scores, np.clip(between * (1 + weight) / spread, *_BOUNDS), are_two=True)

    def calibration(self, lists: NDArray[np.uint16]) -> Calibration:
        """The model for images that list these landmarks, [h, n]."""
        n_landmarks = self.scores.shape[1]
        images = np.arange(lists.shape[1])
        means = np.empty((len(lists), n_landmarks))
        for rank, row in enumerate(lists):
            listed = self.scores[images, row]
            total = np.bincount(row, listed, n_landmarks) + _PSEUDO_IMAGES * listed.mean()
            means[rank] = total / (np.bincount(row, minlength=n_landmarks) + _PSEUDO_IMAGES)
        return Calibration(self.correlation, means, self.are_two)


def live_prior(seasons: Sequence[LandmarkStatistics]) -> LandmarkStatistics:
    """What is usual over all seasons that the map knows, taken alike: the best guess about another one.

    How landmarks go together is a matter of places more than of seasons: it stays the first one's.
    """
    return LandmarkStatistics(
        CALIBRATED_PRIOR_WEIGHT_FRAMES,
        np.mean([season.mean for season in seasons], axis=0),
        np.mean([season.square for season in seasons], axis=0),
        seasons[0].loadings,
    )
