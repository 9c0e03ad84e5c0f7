"""Bootstrap intervals over episodes: how much a figure would move had other starts been drawn."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

N_RESAMPLES = 2000
_TAILS = (2.5, 97.5)

Interval = tuple[float, float] | None
"""95 % from, to; None where nothing was counted."""


@dataclass(frozen=True)
class Resampling:
    """The same episodes drawn again and again with replacement, for every planner alike (paired by start).

    Attributes:
        times: [b, e] how often resample b holds episode e.
    """

    times: NDArray[np.float64]

    @classmethod
    def of(cls, n_episodes: int, seed: int = 0, n_resamples: int = N_RESAMPLES) -> "Resampling":
        """Draw the resamples."""
        rng = np.random.default_rng([seed, n_episodes])
        share = np.full(n_episodes, 1 / n_episodes)
        return cls(rng.multinomial(n_episodes, share, size=n_resamples).astype(np.float64))

    def means(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The mean of all known values of each resample.

        Args:
            values: [e, ...] one row for each episode, NaN where unknown.

        Returns:
            [b] float64; NaN for a resample in which nothing is known.
        """
        rows = values.reshape(len(values), -1)
        known = np.isfinite(rows)
        sums = self.times @ np.where(known, rows, 0.0).sum(1)
        counts = self.times @ known.sum(1)
        return np.asarray(np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0))

    def interval(self, values: NDArray[np.float64]) -> Interval:
        """95 % interval of the mean of values [e, ...]."""
        return _tails(self.means(values))

    def difference(self, values: NDArray[np.float64], others: NDArray[np.float64]) -> Interval:
        """95 % interval of the mean of `values` less that of `others`, resampled together."""
        return _tails(self.means(values) - self.means(others))


def mean_known(values: NDArray[np.float64]) -> float | None:
    """The mean of the values that are not NaN; None where all are."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else None


def _tails(drawn: NDArray[np.float64]) -> Interval:
    known = drawn[np.isfinite(drawn)]
    if not known.size:
        return None
    low, high = np.percentile(known, _TAILS)
    return float(low), float(high)
