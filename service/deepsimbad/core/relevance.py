"""What is compared, and how much it counts: relevances, described views, and updates of the belief (II-C, III).

A relevance says how well a map image answers a view; larger is better. Four are the paper's and two ours; `simbad` and
`brute_force` are the paper's baselines that must store more than ids. An update says how it becomes evidence.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray


class Relevance(StrEnum):
    """The named relevances. A map is built for one of them."""

    STANDARDISED = "standardised"
    CALIBRATED = "calibrated"
    RRF = "rrf"
    BAG_OF_LANDMARKS = "bag_of_landmarks"
    SIMBAD = "simbad"
    BRUTE_FORCE = "brute_force"


DEFAULT_RELEVANCE = Relevance.CALIBRATED


@dataclass(frozen=True)
class Query:
    """One described view; or a batch of them, where every array has a leading axis [e] and all landmarks are ranked."""

    ranks: NDArray[np.float32]  # [r] float32, 1..r, of all landmarks
    # [r] float32, smaller is nearer; None when a robot sent ranks alone
    dissimilarities: NDArray[np.float32] | None = None
    encoding: NDArray[np.float32] | None = None  # [d] float32; None when a robot sent no encoding

    @classmethod
    def uninformative(cls, n_landmarks: int) -> "Query":
        """A view that shows nothing, a wall of grey: all landmarks share the mean rank."""
        return cls(np.full(n_landmarks, (n_landmarks + 1) / 2, np.float32))

    @property
    def is_informative(self) -> bool:
        """Whether some landmark is nearer than another; a view that says nothing must not move a belief."""
        return bool(self.ranks.min() < self.ranks.max())

    def at(self, rows: int | slice | NDArray[np.int64]) -> "Query":
        """One view of a batch, or some of them."""
        return Query(
            self.ranks[rows],
            None if self.dissimilarities is None else self.dissimilarities[rows],
            None if self.encoding is None else self.encoding[rows],
        )


class UpdateRule(StrEnum):
    """The named updates."""

    ADDITIVE_RELEVANCE = "additive_relevance"
    ADDITIVE_RECIPROCAL_RANK = "additive_reciprocal_rank"
    LOG_LIKELIHOOD = "log_likelihood"


DEFAULT_UPDATE = {
    Relevance.STANDARDISED: UpdateRule.LOG_LIKELIHOOD,
    Relevance.CALIBRATED: UpdateRule.LOG_LIKELIHOOD,
    Relevance.RRF: UpdateRule.ADDITIVE_RELEVANCE,
    Relevance.BAG_OF_LANDMARKS: UpdateRule.ADDITIVE_RELEVANCE,
    Relevance.SIMBAD: UpdateRule.ADDITIVE_RECIPROCAL_RANK,
    Relevance.BRUTE_FORCE: UpdateRule.ADDITIVE_RECIPROCAL_RANK,
}

# The h landmarks of a list are not independent witnesses: their summed log-likelihoods count by this share. Chosen on
# the development recordings; a belief that doubts too little keeps wrong modes.
LOG_LIKELIHOOD_WEIGHT = 0.3

_Float = TypeVar("_Float", np.float32, np.float64)


def evidence(relevance: NDArray[_Float], rule: UpdateRule) -> NDArray[_Float]:
    """What views of some relevance [..., n] add to weights, or multiply them by, [..., n], in the precision given.

    Additive rules give what is added to weights whose mean is 1; `log_likelihood` gives factors, the greatest of which
    is 1.
    """
    if rule is UpdateRule.LOG_LIKELIHOOD:
        factors: NDArray[_Float] = relevance - relevance.max(axis=-1, keepdims=True)
        factors *= relevance.dtype.type(LOG_LIKELIHOOD_WEIGHT)
        np.exp(factors, out=factors)
        return factors
    if rule is UpdateRule.ADDITIVE_RELEVANCE:
        return np.maximum(relevance, 0)
    if relevance.ndim > 1:
        return np.stack([evidence(row, rule) for row in relevance])
    return (1.0 / mean_ranks(relevance)).astype(relevance.dtype)


def weigh(weights: NDArray[np.float64], seen: NDArray[np.float64], rule: UpdateRule) -> NDArray[np.float64]:
    """Weights after the evidence, summing to 1.

    The paper adds `v[u_k]` to the weights of its particles (II-C). Weights are taken with mean 1 for that, so that
    the belief that knows nothing gives every hypothesis weight 1, however many there are.

    Args:
        weights: [m], summing to 1.
        seen: [m], the evidence there.
    """
    weighed = weights * seen if rule is UpdateRule.LOG_LIKELIHOOD else weights * weights.size + seen
    total = weighed.sum()
    if not np.isfinite(total) or total <= 0:  # every place this view allows was already excluded: keep what was known
        return weights
    return np.asarray(weighed / total, np.float64)


def mean_ranks(relevance: NDArray[np.floating]) -> NDArray[np.float64]:
    """[n] rank of every map image in the retrieval, from 1; tied images share their mean rank."""
    _, place, counts = np.unique(-relevance, return_inverse=True, return_counts=True)
    mean_rank = np.cumsum(counts) - (counts - 1) / 2
    return np.asarray(mean_rank[place], np.float64)
