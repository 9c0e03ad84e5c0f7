"""What is usual for each landmark, so that a rank can be read as surprising or not (`standardised`, design's own)."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.descriptor import normal_scores

PRIOR_WEIGHT_FRAMES = 50.0  # how many live frames the map's statistics are worth at the start of a session
_LEAST_STD = 1e-6


@dataclass(frozen=True)
class LandmarkStatistics:
    """Running mean and spread of every landmark's normal score, as weighted moments.

    Attributes:
        weight: How many frames the moments are worth.
        mean: [r] float64, mean normal score.
        square: [r] float64, mean squared normal score.
    """

    weight: float
    mean: NDArray[np.float64]
    square: NDArray[np.float64]

    @classmethod
    def of_map(cls, ranks: NDArray[np.float32]) -> Self:
        """The statistics of a map's traverse, weighed as the prior of a live session.

        Args:
            ranks: [n, r], ranks of every map image.
        """
        scores = normal_scores(ranks, ranks.shape[1])
        return cls(PRIOR_WEIGHT_FRAMES, scores.mean(axis=0), np.square(scores).mean(axis=0))

    @classmethod
    def from_mean_std(
        cls, mean: NDArray[np.float64], std: NDArray[np.float64], weight: float = PRIOR_WEIGHT_FRAMES
    ) -> Self:
        """From a map's stored mean and standard deviation, [r] each."""
        return cls(weight, mean, np.square(std) + np.square(mean))

    @property
    def std(self) -> NDArray[np.float64]:
        """[r] float64. A landmark that never moved is given the spread that normal scores have, 1."""
        std = np.sqrt(np.maximum(self.square - np.square(self.mean), 0.0))
        return np.where(std > _LEAST_STD, std, 1.0)

    def observing(self, ranks: NDArray[np.float32]) -> Self:
        """The statistics after one more frame, [r] ranks; that frame counts in its own standardisation."""
        scores = normal_scores(ranks, ranks.shape[-1])
        weight = self.weight + 1.0
        mean = self.mean + (scores - self.mean) / weight
        square = self.square + (np.square(scores) - self.square) / weight
        return type(self)(weight, mean, square)

    def pooled(self, n_frames: float, other: "LandmarkStatistics", n_others: float) -> Self:
        """The statistics of two drives together, each counted by its frames; the weight stays this one's."""
        share = n_others / (n_frames + n_others)
        mean = self.mean + (other.mean - self.mean) * share
        square = self.square + (other.square - self.square) * share
        return type(self)(self.weight, mean, square)

    def standardise(self, ranks: NDArray[np.float32]) -> NDArray[np.float64]:
        """z of ranks, [r] or [n, r]: normal scores less their mean, over their spread. Lowest is nearest."""
        return (normal_scores(ranks, ranks.shape[-1]) - self.mean) / self.std
