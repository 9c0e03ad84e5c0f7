"""What is compared, and how much it counts: relevances, described views, and updates of the belief (II-C, III).

A relevance says how well a map image answers a view; larger is better. Four are the paper's and two ours; `simbad` and
`brute_force` are the paper's baselines that must store more than ids. An update says how it becomes evidence.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray


class Relevance(StrEnum):
    """The named relevances. A map is built for one of them."""

    COMPOSED = "composed"
    STANDARDISED = "standardised"
    RRF = "rrf"
    BAG_OF_LANDMARKS = "bag_of_landmarks"
    SIMBAD = "simbad"
    BRUTE_FORCE = "brute_force"


DEFAULT_RELEVANCE = Relevance.COMPOSED
_FARTHEST = np.float32(4.001)  # squared distance of opposite unit vectors, and its rounding


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
    def products(self) -> NDArray[np.float32] | None:
        """Products of unit vectors, from their squared distances; None where the dissimilarities are none such."""
        if self.dissimilarities is None or self.dissimilarities.min() < 0 or self.dissimilarities.max() > _FARTHEST:
            return None
        return np.asarray(1 - self.dissimilarities / 2, np.float32)

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
    MIXTURE = "mixture"


DEFAULT_UPDATE = {
    Relevance.COMPOSED: UpdateRule.MIXTURE,
    Relevance.STANDARDISED: UpdateRule.MIXTURE,
    Relevance.RRF: UpdateRule.ADDITIVE_RELEVANCE,
    Relevance.BAG_OF_LANDMARKS: UpdateRule.ADDITIVE_RELEVANCE,
    Relevance.SIMBAD: UpdateRule.ADDITIVE_RECIPROCAL_RANK,
    Relevance.BRUTE_FORCE: UpdateRule.ADDITIVE_RECIPROCAL_RANK,
}

# What a relevance counts as a log-likelihood, where nobody learnt it. The h landmarks of a list are not independent
# witnesses, so summed scores count by less than 1.
DEFAULT_LIKELIHOOD_SCALE = {Relevance.COMPOSED: 12.0}
OTHER_LIKELIHOOD_SCALE = 0.3


def mean_ranks(relevance: NDArray[np.floating]) -> NDArray[np.float64]:
    """[n] rank of every map image in the retrieval, from 1; tied images share their mean rank."""
    _, place, counts = np.unique(-relevance, return_inverse=True, return_counts=True)
    mean_rank = np.cumsum(counts) - (counts - 1) / 2
    return np.asarray(mean_rank[place], np.float64)
