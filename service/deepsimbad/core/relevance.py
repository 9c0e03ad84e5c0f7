"""What is compared, and how much it counts: relevances, described views, and updates of the belief (II-C, III).

A relevance says how well a map image answers a view; larger is better. Four are the paper's and two ours; `simbad` and
`brute_force` are the paper's baselines that must store more than ids. An update says how it becomes evidence.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.composed import Moments
from deepsimbad.core.descriptor import LandmarkStatistics


class Relevance(StrEnum):
    """The named relevances. A map is built for one of them."""

    COMPOSED = "composed"
    STANDARDISED = "standardised"
    RRF = "rrf"
    BAG_OF_LANDMARKS = "bag_of_landmarks"
    SIMBAD = "simbad"
    BRUTE_FORCE = "brute_force"


DEFAULT_RELEVANCE = Relevance.COMPOSED
FAR_STD = 2.0  # deviations from what is usual
_MOST_FAR = 3 / 16  # of a view's numbers; where places are seen, in whatever season, fewer are so far off
_SEASON_VIEWS, _SEASON_VARIETY = 10.0, 0.65  # from which on a session's views may be of a season that is odd
_ODDEST_SEASON = 1.5  # times as strange as a view may be
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

    @cached_property
    def products(self) -> NDArray[np.float32] | None:
        """Products of unit vectors, from their squared distances; None where the dissimilarities are none such."""
        if self.dissimilarities is None or self.dissimilarities.min() < 0 or self.dissimilarities.max() > _FARTHEST:
            return None
        return np.asarray(1 - self.dissimilarities / 2, np.float32)

    @cached_property
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


def strangeness(encodings: NDArray[np.floating], usual: Moments) -> NDArray[np.float64]:
    """[...] which share of the numbers of encodings [..., d] is farther than two deviations from what is usual."""
    far = np.abs(encodings - usual.mean) > FAR_STD * usual.std
    return np.asarray(far.mean(axis=-1))


def most_strange(first: NDArray[np.float32], second: NDArray[np.float32] | None = None) -> float:
    """The strangeness from which on a view shows nothing of a route.

    Noise, glare and the dark leave what an extractor shows of places, whichever season it is: 3 in 16 numbers far off,
    and three deviations of what that share is by chance. Where a second season was stranger to the first, that counts.

    Args:
        first: [n, d] encodings of the route.
        second: [m, d] of another season; None: there is none.
    """
    by_default = _MOST_FAR + 3 * float(np.sqrt(_MOST_FAR * (1 - _MOST_FAR) / first.shape[1]))
    if second is None:
        return by_default
    return max(by_default, float(np.quantile(strangeness(second, Moments.of(first)), 0.99)))


def is_strange(encoding: NDArray[np.float32], usual: Moments, live: Moments | None, most: float) -> bool:
    """Whether a view shows nothing of a route.

    A season may be stranger than `most`. Its views differ among themselves as the route's do, and noise hardly does:
    where a session's did, they are judged by their own mean.

    Args:
        encoding: [d].
        usual: On the map.
        live: The same with a session's views, which began as that.
    """
    seen = strangeness(encoding, usual)
    if seen <= most or live is None or seen > _ODDEST_SEASON * most:
        return bool(seen > most)
    season = _season(usual, live)
    return season is None or bool(strangeness(encoding, season) > most)


def _season(usual: Moments, live: Moments) -> Moments | None:
    """What is usual for a session's own views, with the route's deviations; None where they are few or all alike."""
    weight = live.weight - usual.weight
    if weight < _SEASON_VIEWS:
        return None
    mean, square = (
        (after * live.weight - before * usual.weight) / weight
        for after, before in ((live.mean, usual.mean), (live.square, usual.square))
    )
    variety = np.minimum((square - np.square(mean)) / np.square(usual.std), 2.0).mean()
    if variety < _SEASON_VARIETY:
        return None
    return replace(usual, mean=mean, square=np.square(mean) + np.square(usual.std))


def shows_nothing(blocks: Callable[[], Iterable[NDArray[np.float32]]]) -> NDArray[np.bool_]:
    """[n] which frames of a drive show nothing of its route: noise, glare, the dark.

    Args:
        blocks: Gives its encodings [_, d] in blocks, however often it is asked.
    """
    usual = Moments.of_blocks(blocks())
    strange = [strangeness(block, usual) > most_strange(block) for block in blocks()]
    return np.concatenate(strange) if strange else np.zeros(0, np.bool_)


@dataclass(frozen=True)
class LiveStatistics:
    """Of whatever a robot sends; each kind of view is compared with views of its own kind alone."""

    ranks: LandmarkStatistics  # normal scores of ranked landmarks
    encodings: Moments | None = None  # [d]; None where encodings are not compared
    products: Moments | None = None  # [r] products of unit encodings with landmarks; None likewise

    def observing(self, query: Query, worth: float = 1.0) -> "LiveStatistics":
        """With one view more, which counts in its own comparison; `worth` of one that saw little new is less than 1."""
        if self.encodings is not None and query.encoding is not None:
            return LiveStatistics(self.ranks, self.encodings.observing(query.encoding, worth), self.products)
        if self.products is not None and query.products is not None:
            return LiveStatistics(self.ranks, self.encodings, self.products.observing(query.products, worth))
        return LiveStatistics(self.ranks.observing(query.ranks, worth), self.encodings, self.products)

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        """All that changes, to be restored bit for bit."""
        arrays = {}
        for name, moments in self._moments().items():
            arrays[name] = np.stack([moments.mean, moments.square])
            arrays[f"{name}_weight"] = np.array([moments.weight])
        return arrays

    def from_arrays(self, arrays: dict[str, NDArray[np.float64]]) -> "LiveStatistics":
        """What `to_arrays` of statistics like these gave; raises KeyError where an array is missing."""
        restored: dict[str, Any] = {}
        for name, moments in self._moments().items():
            mean, square = arrays[name]
            restored[name] = replace(moments, mean=mean, square=square, weight=arrays[f"{name}_weight"].item())
        return replace(self, **restored)

    def _moments(self) -> dict[str, Moments]:
        named = {"ranks": self.ranks, "encodings": self.encodings, "products": self.products}
        return {name: moments for name, moments in named.items() if moments is not None}
