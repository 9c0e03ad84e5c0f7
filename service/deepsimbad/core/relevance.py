"""What is compared, and how much it counts: relevances, described views, and updates of the belief (II-C, III).

A relevance says how well a map image answers a view; larger is better. Four are the paper's and two ours; `simbad` and
`brute_force` are the paper's baselines that must store more than ids. An update says how it becomes evidence.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from statistics import NormalDist
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

    @cached_property
    def traits(self) -> "RelevanceTraits":
        """What it compares, and what maps for it hold."""
        return _TRAITS[self]


DEFAULT_RELEVANCE = Relevance.COMPOSED
FAR_STD = 2.0  # standard deviations from the mean, beyond which a number of an encoding is far off
_MOST_FAR = 3 / 16  # share of a view's numbers; where it shows a place, in whatever season, fewer are far off
_MOST_FRAMES = 512  # by which it is judged how much of a drive's frames is new
_SEASON_VIEWS, _SEASON_VARIETY = 10.0, 0.65  # number and variety from which a session's views may be of an odd season
_ODDEST_SEASON = 1.5  # times the strangeness from which a view shows nothing, up to which it may be of an odd season
_FARTHEST = np.float32(4.001)  # squared distance of opposite unit vectors, and its rounding


@dataclass(frozen=True)
class Query:
    """One described view; or a batch of them, where every array has a leading axis [e] and all landmarks are ranked."""

    ranks: NDArray[np.float32]  # [r] float32, 1..r, of all landmarks
    # [r] float32, smaller is nearer; None where a robot sent ranks alone
    dissimilarities: NDArray[np.float32] | None = None
    encoding: NDArray[np.float32] | None = None  # [d] float32; None where a robot sent none

    @classmethod
    def uninformative(cls, n_landmarks: int) -> "Query":
        """A view that shows nothing, a wall of grey: all landmarks share the mean rank."""
        return cls(np.full(n_landmarks, (n_landmarks + 1) / 2, np.float32))

    @cached_property
    def products(self) -> NDArray[np.float32] | None:
        """[r] products of unit vectors, where dissimilarities are their squared distances; None where they are none."""
        if self.dissimilarities is None or self.dissimilarities.min() < 0 or self.dissimilarities.max() > _FARTHEST:
            return None
        return np.asarray(1 - self.dissimilarities / 2, np.float32)

    @cached_property
    def is_informative(self) -> bool:
        """Whether some landmark is nearer than another; another view says nothing and must not move a belief."""
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

    @property
    def is_additive(self) -> bool:
        """Whether evidence is added to weights, as in the paper, rather than multiplies them as a likelihood."""
        return self in {UpdateRule.ADDITIVE_RELEVANCE, UpdateRule.ADDITIVE_RECIPROCAL_RANK}


@dataclass(frozen=True)
class RelevanceTraits:
    """What a relevance compares, and what maps for it hold."""

    update: UpdateRule  # by default
    arrays: tuple[str, ...] = ()  # of a map, that are compared besides its lists
    compares_unit_vectors: bool = False  # by cosines, which mean the same in all maps; seasons are fused into them
    compares_encodings: bool = False  # of views
    compares_dissimilarities: bool = False  # of views
    is_listed: bool = True  # whether lists stand for map images, and not whole encodings
    # The factor that makes it a log-likelihood, where a map has not learnt it. The h landmarks of a list are not
    # independent witnesses, so summed scores count by less than 1.
    likelihood_scale: float = 0.3


_TRAITS = {
    Relevance.COMPOSED: RelevanceTraits(
        UpdateRule.MIXTURE,
        ("statistics", "usual_encoding", "usual_product"),
        compares_unit_vectors=True,
        compares_encodings=True,
        compares_dissimilarities=True,
        likelihood_scale=8.0,  # docs/decisions/0039-one-season-counts-less.md
    ),
    Relevance.STANDARDISED: RelevanceTraits(UpdateRule.MIXTURE, ("statistics",)),
    Relevance.RRF: RelevanceTraits(UpdateRule.ADDITIVE_RELEVANCE),
    Relevance.BAG_OF_LANDMARKS: RelevanceTraits(UpdateRule.ADDITIVE_RELEVANCE),
    Relevance.SIMBAD: RelevanceTraits(UpdateRule.ADDITIVE_RECIPROCAL_RANK, ("values",), compares_dissimilarities=True),
    Relevance.BRUTE_FORCE: RelevanceTraits(
        UpdateRule.ADDITIVE_RECIPROCAL_RANK, ("encodings",), compares_encodings=True, is_listed=False
    ),
}


def mean_ranks(relevance: NDArray[np.floating]) -> NDArray[np.float64]:
    """[n] rank of every map image in the retrieval, from 1; tied images share their mean rank."""
    _, place, counts = np.unique(-relevance, return_inverse=True, return_counts=True)
    mean_rank = np.cumsum(counts) - (counts - 1) / 2
    return np.asarray(mean_rank[place], np.float64)


def strangeness(encodings: NDArray[np.floating], moments: Moments) -> NDArray[np.float64]:
    """[...] the share of the numbers of encodings [..., d] that are over two standard deviations from the mean."""
    is_far = np.abs(encodings - moments.mean) > FAR_STD * moments.std
    return np.asarray(is_far.mean(axis=-1))


def most_strange(first: NDArray[np.float32], *seasons: NDArray[np.float32]) -> float:
    """The strangeness from which on a view shows nothing of a route.

    Views of places, in whatever season, have fewer numbers far off than noise, glare and the dark do. A short drive
    knows less than it seems of how far they lie apart, and what that adds by chance is added. Where another season was
    stranger to the first, its own strangeness is the least.

    Args:
        first: [n, d] encodings of the route.
        seasons: [m, d] of each other season that is known.
    """
    by_chance = _far_share(_independent_views(first)) - 2 * NormalDist().cdf(-FAR_STD)
    strangest = [float(np.quantile(strangeness(season, Moments.of(first)), 0.99)) for season in seasons]
    return max([_most_far(first.shape[1]) + by_chance, *strangest])


def _most_far(d: int) -> float:
    """At most 3 numbers in 16 are far off where a place is shown, and three standard deviations of that share of d."""
    return _MOST_FAR + 3 * float(np.sqrt(_MOST_FAR * (1 - _MOST_FAR) / d))


def _far_share(n_views: float) -> float:
    """How many numbers of a view are far off, on average, from the mean and deviation of so many views like it.

    They follow Student's distribution with n - 1 degrees of freedom, a deviation wider by sqrt(1 + 1 / n); its tail is
    that of a normal score by Wallace's approximation (Ann. Math. Statist. 30, 1959).
    """
    freedom = n_views - 1
    score = np.sqrt(freedom * np.log1p(FAR_STD**2 / (1 + 1 / n_views) / freedom))
    return 2 * NormalDist().cdf(-float(score * (8 * freedom + 1) / (8 * freedom + 3)))


def _independent_views(encodings: NDArray[np.float32]) -> float:
    """How many views that are nothing alike tell as much as a drive's [n, d], whose neighbours are alike; at least 2.

    n by 1 + 2 sum of the autocorrelation along the drive, up to where it ends.
    """
    frames = encodings[:: -(-len(encodings) // _MOST_FRAMES)]
    deviations = frames - frames.mean(axis=0)
    deviations /= max(float(np.abs(deviations).max()), 1e-30)
    products = deviations @ deviations.T
    covariance = np.array([np.trace(products, offset=lag) for lag in range(len(frames))])
    n_alike = int(np.argmax(np.append(covariance, 0.0) <= 0))
    if n_alike == 0:
        return 2.0
    return max(2.0, len(frames) / float(2 * covariance[:n_alike].sum() / covariance[0] - 1))


def is_strange(encoding: NDArray[np.float32], map_moments: Moments, live: Moments | None, threshold: float) -> bool:
    """Whether a view shows nothing of a route.

    A season may be stranger than the threshold. Its views differ among themselves as the route's do, which those of
    noise hardly do: where a session's views differ so, they are judged by their own mean.

    Args:
        encoding: [d].
        map_moments: Of the map's encodings.
        live: The same with a session's views added; None: there is no session.
        threshold: The strangeness from which on a view shows nothing.
    """
    share = strangeness(encoding, map_moments)
    if share <= threshold or live is None or share > _ODDEST_SEASON * threshold:
        return bool(share > threshold)
    season = _season(map_moments, live)
    return season is None or bool(strangeness(encoding, season) > threshold)


def _season(map_moments: Moments, live: Moments) -> Moments | None:
    """Mean of a session's own views with the deviations of the map's; None where they are few or all alike."""
    weight = live.weight - map_moments.weight
    if weight < _SEASON_VIEWS:
        return None
    mean = (live.mean * live.weight - map_moments.mean * map_moments.weight) / weight
    square = (live.square * live.weight - map_moments.square * map_moments.weight) / weight
    variety = np.minimum((square - np.square(mean)) / np.square(map_moments.std), 2.0).mean()
    if variety < _SEASON_VARIETY:
        return None
    return replace(map_moments, mean=mean, square=np.square(mean) + np.square(map_moments.std))


def shows_nothing(blocks: Callable[[], Iterable[NDArray[np.float32]]]) -> NDArray[np.bool_]:
    """[n] which frames of a drive show nothing of its route: noise, glare, the dark.

    Args:
        blocks: Yields its encodings in blocks [_, d]; called twice.
    """
    moments = Moments.of_blocks(blocks())
    masks = [strangeness(block, moments) > _most_far(block.shape[1]) for block in blocks()]
    return np.concatenate(masks) if masks else np.zeros(0, np.bool_)


@dataclass(frozen=True)
class LiveStatistics:
    """Running statistics of a session's views, by what a robot sends; each kind is compared with its own."""

    ranks: LandmarkStatistics  # normal scores of ranked landmarks
    encodings: Moments | None = None  # [d]; None where encodings are not compared
    products: Moments | None = None  # [r] products of unit encodings with landmarks; None likewise

    def observing(self, query: Query, worth: float = 1.0) -> "LiveStatistics":
        """With one view more, which counts in its own comparison; `worth` is below 1 of one that saw little new."""
        if self.encodings is not None and query.encoding is not None:
            return LiveStatistics(self.ranks, self.encodings.observing(query.encoding, worth), self.products)
        if self.products is not None and query.products is not None:
            return LiveStatistics(self.ranks, self.encodings, self.products.observing(query.products, worth))
        return LiveStatistics(self.ranks.observing(query.ranks, worth), self.encodings, self.products)

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        """The named arrays of what views change, from which `from_arrays` restores it bit for bit."""
        arrays = {}
        for name, moments in self._moments().items():
            arrays[name] = np.stack([moments.mean, moments.square])
            arrays[f"{name}_weight"] = np.array([moments.weight])
        return arrays

    def from_arrays(self, arrays: dict[str, NDArray[np.float64]]) -> "LiveStatistics":
        """The statistics whose arrays `to_arrays` gave, on the same map; raises KeyError where one is missing."""
        moments_by_name: dict[str, Any] = {}
        for name, moments in self._moments().items():
            mean, square = arrays[name]
            moments_by_name[name] = replace(moments, mean=mean, square=square, weight=arrays[f"{name}_weight"].item())
        return replace(self, **moments_by_name)

    def _moments(self) -> dict[str, Moments]:
        moments_by_name = {"ranks": self.ranks, "encodings": self.encodings, "products": self.products}
        return {name: moments for name, moments in moments_by_name.items() if moments is not None}
