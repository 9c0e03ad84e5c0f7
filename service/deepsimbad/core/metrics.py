"""Averaged normalised rank and recall (III), and bootstrap intervals of means and their differences."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_RESAMPLES = 2000
_LEVELS = (2.5, 97.5)


@dataclass(frozen=True)
class RetrievalScores:
    """The scores of a set of queries."""

    anr: float  # averaged normalised rank in percent; 0 is perfect, 50 chance
    recall_at: dict[int, float]  # R@k in percent by k
    n_queries: int  # queries scored
    n_left_out: int  # queries without a true image among the map's
    # [n_queries] share of map images ranked before the truth, 0..1, in query order
    normalised_ranks: NDArray[np.float64]


def rank_of_truth(relevance: NDArray[np.floating], true_images: NDArray[np.int64]) -> float:
    """Rank, from 0, of the best of at least one true image: the number of better images plus half the others tied."""
    best = relevance[true_images].max()
    n_better = np.count_nonzero(relevance > best)
    n_tied = np.count_nonzero(relevance == best)
    return n_better + 0.5 * (n_tied - 1)


class RetrievalScorer:
    """Collects queries one by one, so that no query x map matrix need exist."""

    def __init__(self, recall_ranks: Sequence[int] = (1, 5)) -> None:
        self._recall_ranks = tuple(recall_ranks)
        self._ranks: list[float] = []
        self._shares: list[float] = []
        self._n_left_out = 0

    def add(self, relevance: NDArray[np.floating], true_images: NDArray[np.int64]) -> float | None:
        """Score one query; returns its rank from 0, or None where the map holds no true image."""
        if true_images.size == 0:
            self._n_left_out += 1
            return None
        rank = rank_of_truth(relevance, true_images)
        self._ranks.append(rank)
        self._shares.append(rank / relevance.size)
        return rank

    def result(self) -> RetrievalScores:
        """The scores so far; NaN where no query was scored."""
        ranks, shares = np.array(self._ranks), np.array(self._shares)
        is_scored = ranks.size > 0
        return RetrievalScores(
            anr=float(100 * shares.mean()) if is_scored else float("nan"),
            recall_at={k: float(100 * (ranks < k).mean()) if is_scored else float("nan") for k in self._recall_ranks},
            n_queries=ranks.size,
            n_left_out=self._n_left_out,
            normalised_ranks=shares,
        )


def mean_interval(
    values: NDArray[np.float64], seed: int, block: NDArray[np.int64] | None = None
) -> tuple[float, float]:
    """95 % bootstrap interval of the mean of values [n]; drawn by blocks [n] where neighbouring values are alike."""
    rng = np.random.default_rng([seed, values.size])
    if block is None:
        block = np.arange(values.size)
    _, block = np.unique(block, return_inverse=True)
    sums, counts = np.bincount(block, values), np.bincount(block)
    draws = rng.integers(0, sums.size, (_RESAMPLES, sums.size))
    means = sums[draws].sum(axis=1) / counts[draws].sum(axis=1)
    low, high = np.percentile(means, _LEVELS)
    return float(low), float(high)
