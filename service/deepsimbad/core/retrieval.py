"""Building what retrieval reads from a traverse's dissimilarities, and the shortlist of an answer (II-C)."""

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.calibration import SeasonsOfRoute, live_prior
from deepsimbad.core.descriptor import nearest_landmarks, rank_landmarks
from deepsimbad.core.inverted_index import InvertedIndex
from deepsimbad.core.relevance import Relevance, RetrievalMap
from deepsimbad.core.statistics import LandmarkStatistics, common_factors
from deepsimbad.errors import InvalidMapConfigError

_SCAN_UP_TO = 64  # a longer shortlist is sorted whole
_BLOCK = 256  # values that are looked at in one vectorised sweep


@dataclass(frozen=True)
class SecondSeason:
    """What another drive of the mapped route tells of it; `deepsimbad.core.same_route` says whether one is.

    Attributes:
        dissimilarities: [m, r] of its frames to the landmarks.
        places: [k, 2] int64, (map image, its frame) where both saw the same place; some.
    """

    dissimilarities: NDArray[np.float32]
    places: NDArray[np.int64]


def build_retrieval_map(
    relevance: Relevance,
    dissimilarities: NDArray[np.float32],
    list_length: int,
    encodings: NDArray[np.float32] | None = None,
    second_season: SecondSeason | None = None,
) -> RetrievalMap:
    """Describe every map image by the h landmarks its relevance keeps.

    Args:
        relevance: What the map is built for.
        dissimilarities: [n, r] of the training traverse's frames to the landmarks, smaller is nearer.
        list_length: h.
        encodings: [n, d] of the same frames; kept for `brute_force` alone.
        second_season: Read by `calibrated` alone.

    Raises:
        InvalidMapConfigError: No image, or h not within 1..r.
    """
    if dissimilarities.ndim != 2 or dissimilarities.shape[0] == 0:
        raise InvalidMapConfigError("a map needs at least one image")
    n_landmarks = dissimilarities.shape[1]
    if not 1 <= list_length <= n_landmarks:
        raise InvalidMapConfigError(
            f"list_length {list_length} is not within 1 and the number of landmarks, {n_landmarks}",
            list_length=list_length,
            n_landmarks=n_landmarks,
        )
    ranks = rank_landmarks(dissimilarities)
    if relevance in {Relevance.STANDARDISED, Relevance.CALIBRATED}:
        return _standardised_map(relevance, ranks, list_length, second_season)
    lists = nearest_landmarks(ranks, list_length)
    values = None
    if relevance is Relevance.SIMBAD:
        listed = np.take_along_axis(dissimilarities, lists.T.astype(np.intp), axis=1)
        values = np.ascontiguousarray(listed.T, np.float32)
    kept = encodings if relevance is Relevance.BRUTE_FORCE else None
    return RetrievalMap(relevance, InvertedIndex(lists, n_landmarks, values), encodings=kept)


def _standardised_map(
    relevance: Relevance, ranks: NDArray[np.float32], list_length: int, second: SecondSeason | None
) -> RetrievalMap:
    own = LandmarkStatistics.of_map(ranks)
    scores = own.standardise(ranks)
    own = replace(own, loadings=common_factors(scores))
    if relevance is Relevance.STANDARDISED:
        return RetrievalMap(relevance, InvertedIndex(nearest_landmarks(scores, list_length), ranks.shape[1]), own)
    known = [own]
    seasons = SeasonsOfRoute.learn(scores)
    if second is not None:
        other_ranks = rank_landmarks(second.dissimilarities)
        other = LandmarkStatistics.of_map(other_ranks)
        seasons = SeasonsOfRoute.learn(scores, other.standardise(other_ranks), second.places)
        known.append(other)
    lists = nearest_landmarks(seasons.scores, list_length)
    index = InvertedIndex(lists, ranks.shape[1])
    return RetrievalMap(relevance, index, live_prior(known), seasons.calibration(lists))


def shortlist(values: NDArray[np.floating], length: int) -> NDArray[np.int64]:
    """The ids of the greatest values, best first, ties by id.

    Args:
        values: [n] relevances or masses.
        length: How many, at least 1; at most n come back.
    """
    if length <= _SCAN_UP_TO:
        return _scan(np.ascontiguousarray(values), min(length, values.size))
    return np.argsort(-values, kind="stable")[:length].astype(np.int64)


@njit(cache=True, nogil=True)
def _count_above(block: NDArray[np.floating], threshold: float) -> int:
    """How many values are greater. Counting vectorises where an early exit would not."""
    count = 0
    for place in range(block.size):
        count += block[place] > threshold
    return count


@njit(cache=True, nogil=True)
def _scan(values: NDArray[np.floating], length: int) -> NDArray[np.int64]:
    """One pass that keeps the best so far in order; a block with nothing better is passed over whole."""
    best = np.empty(length, np.int64)
    n_kept = 0
    for start in range(0, values.size, _BLOCK):
        block = values[start : start + _BLOCK]
        if n_kept == length and _count_above(block, values[best[length - 1]]) == 0:
            continue
        for candidate in range(start, start + block.size):
            value = values[candidate]
            if n_kept == length and not value > values[best[length - 1]]:
                continue
            place = min(n_kept, length - 1)
            while place > 0 and value > values[best[place - 1]]:
                best[place] = best[place - 1]
                place -= 1
            best[place] = candidate
            n_kept = min(n_kept + 1, length)
    return best


@njit(cache=True, nogil=True)
def shortlists(values: NDArray[np.floating], length: int) -> NDArray[np.int64]:
    """`shortlist` of many views, [e, n] to [e, length]; at most n of each."""
    best = np.empty((len(values), min(length, values.shape[1])), np.int64)
    for row in range(len(values)):
        best[row] = _scan(values[row], best.shape[1])
    return best
