"""Bootstrap intervals, of a mean and of the mean difference between two planners on the same starts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_RESAMPLES = 2000
_LEVELS = (2.5, 97.5)


@dataclass(frozen=True)
class Comparison:
    """A paired difference.

    Attributes:
        difference: Mean of first - second.
        interval: Its 95 % bootstrap interval.
    """

    difference: float
    interval: tuple[float, float]

    @property
    def excludes_zero(self) -> bool:
        """Whether one is better than the other by more than chance."""
        return not self.interval[0] <= 0 <= self.interval[1]


def compare(first: NDArray[np.float64], second: NDArray[np.float64], seed: int) -> Comparison:
    """Compare two scores [n] of the same starts."""
    difference = first - second
    return Comparison(float(difference.mean()), mean_interval(difference, seed))


def mean_interval(values: NDArray[np.float64], seed: int) -> tuple[float, float]:
    """95 % bootstrap interval of the mean of [n] values."""
    rng = np.random.default_rng([seed, values.size])
    means = [values[rng.integers(0, values.size, values.size)].mean() for _ in range(_RESAMPLES)]
    low, high = np.percentile(means, _LEVELS)
    return float(low), float(high)
