"""How one view's relevance becomes evidence on the belief (II-C, and design section 4)."""

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.relevance import Relevance


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


def evidence(relevance: NDArray[np.float32], rule: UpdateRule) -> NDArray[np.float64]:
    """What a view adds to weights, or multiplies them by.

    Args:
        relevance: [n], larger is better.
        rule: Additive rules give what is added to weights whose mean is 1; `log_likelihood` gives factors, the
            greatest of which is 1.

    Returns:
        [n] float64, not negative.
    """
    values = relevance.astype(np.float64)
    if rule is UpdateRule.LOG_LIKELIHOOD:
        factors: NDArray[np.float64] = np.exp(LOG_LIKELIHOOD_WEIGHT * (values - values.max()))
        return factors
    if rule is UpdateRule.ADDITIVE_RELEVANCE:
        return np.maximum(values, 0.0)
    return 1.0 / mean_ranks(values)


def weigh(weights: NDArray[np.float64], seen: NDArray[np.float64], rule: UpdateRule) -> NDArray[np.float64]:
    """Weights after the evidence, summing to 1.

    The paper adds `v[u_k]` to the weights of its particles (II-C). Weights are taken with mean 1 for that, so that
    the belief that knows nothing gives every hypothesis weight 1, however many there are.

    Args:
        weights: [m], summing to 1.
        seen: [m], the evidence at every hypothesis.
        rule: How to combine them.
    """
    weighed = weights * seen if rule is UpdateRule.LOG_LIKELIHOOD else weights * weights.size + seen
    total = weighed.sum()
    if not np.isfinite(total) or total <= 0:  # every place this view allows was already excluded: keep what was known
        return weights
    return np.asarray(weighed / total, np.float64)


def mean_ranks(relevance: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n] rank of every map image in the retrieval, from 1; tied images share their mean rank."""
    _, place, counts = np.unique(-relevance, return_inverse=True, return_counts=True)
    mean_rank = np.cumsum(counts) - (counts - 1) / 2
    return np.asarray(mean_rank[place], np.float64)
