"""Relevance: how well every map image answers a query (II-C, III; larger is better).

Four of the paper and two of ours. Four of them give each listed landmark a worth at each rank, and sum it over a
map image's list; `simbad` and `brute_force` are the paper's baselines that must store more than ids.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.calibration import Calibration
from deepsimbad.core.inverted_index import InvertedIndex
from deepsimbad.core.statistics import LandmarkStatistics
from deepsimbad.errors import InvalidInputError, InvalidMapConfigError


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
    """One described view.

    Attributes:
        ranks: [r] float32, 1..r, of all landmarks.
        dissimilarities: [r] float32, smaller is nearer; None when a robot sent ranks alone.
        encoding: [d] float32; None when a robot sent no encoding.
    """

    ranks: NDArray[np.float32]
    dissimilarities: NDArray[np.float32] | None = None
    encoding: NDArray[np.float32] | None = None

    @classmethod
    def uninformative(cls, n_landmarks: int) -> "Query":
        """A view that shows nothing, a wall of grey: all landmarks share the mean rank."""
        return cls(np.full(n_landmarks, (n_landmarks + 1) / 2, np.float32))

    @property
    def is_informative(self) -> bool:
        """Whether some landmark is nearer than another; a view that says nothing must not move a belief."""
        return bool(self.ranks.min() < self.ranks.max())


@dataclass(frozen=True)
class RetrievalMap:
    """The part of a map that retrieval reads.

    Attributes:
        relevance: What the lists were built for.
        index: The landmark lists.
        statistics: What is usual for each landmark: of the map's traverse for `standardised`, of both seasons that
            the map knows for `calibrated`. A live session starts from them.
        calibration: How far a listed landmark can be trusted, for `calibrated`.
        encodings: [n, d] float32, for `brute_force`.
    """

    relevance: Relevance
    index: InvertedIndex
    statistics: LandmarkStatistics | None = None
    calibration: Calibration | None = None
    encodings: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        missing = {
            Relevance.STANDARDISED: self.statistics is None and "landmark statistics",
            Relevance.CALIBRATED: (self.statistics is None or self.calibration is None) and "a calibration",
            Relevance.SIMBAD: self.index.values is None and "listed dissimilarities",
            Relevance.BRUTE_FORCE: self.encodings is None and "encodings",
        }.get(self.relevance)
        if missing:
            raise InvalidMapConfigError(f"a map for {self.relevance} needs {missing}")


def relevances(built: RetrievalMap, query: Query, live: LandmarkStatistics | None = None) -> NDArray[np.float32]:
    """Relevance of every map image.

    Args:
        built: The map.
        query: The described view.
        live: A session's own statistics, in place of the map's.

    Returns:
        [n] float32, larger is better.

    Raises:
        InvalidInputError: The query lacks what the map's relevance compares.
    """
    return _RULES[built.relevance](built, query, live)


def _standardised(built: RetrievalMap, query: Query, live: LandmarkStatistics | None) -> NDArray[np.float32]:
    """Sum of -z over the list: a landmark counts by how unusually near it is."""
    statistics = live or built.statistics
    if statistics is None:
        raise InvalidMapConfigError("a standardised map needs landmark statistics")
    worth = -statistics.view(query.ranks).z
    return built.index.sum_listed(_same_at_every_rank(worth, built.index))


def _calibrated(built: RetrievalMap, query: Query, live: LandmarkStatistics | None) -> NDArray[np.float32]:
    """Sum over the list of log-likelihood ratios: seen from here, against seen from anywhere."""
    statistics = live or built.statistics
    if statistics is None or built.calibration is None:
        raise InvalidMapConfigError("a calibrated map needs landmark statistics and a calibration")
    seen = statistics.view(query.ranks)
    return built.index.sum_listed(built.calibration.log_ratios(seen.z, seen.known))


def _rrf(built: RetrievalMap, query: Query, _: LandmarkStatistics | None) -> NDArray[np.float32]:
    """Inner product of reciprocal rank features; the query keeps all r ranks, the map image h."""
    reciprocal = 1.0 / np.arange(1, built.index.list_length + 1)
    return built.index.sum_listed(np.outer(reciprocal, 1.0 / query.ranks.astype(np.float64)))


def _bag_of_landmarks(built: RetrievalMap, query: Query, _: LandmarkStatistics | None) -> NDArray[np.float32]:
    """How many landmarks the two lists of h share."""
    listed = query.ranks <= built.index.list_length
    return built.index.sum_listed(_same_at_every_rank(listed, built.index))


def _simbad(built: RetrievalMap, query: Query, _: LandmarkStatistics | None) -> NDArray[np.float32]:
    """-L2 between h-hot dissimilarity vectors, `|q - m|^2 = |q|^2 + sum over the list of (q_i - m_i)^2 - q_i^2`."""
    if query.dissimilarities is None or built.index.values is None:
        raise InvalidInputError("a simbad map compares dissimilarities; ranks alone cannot answer it")
    h_hot = np.where(query.ranks <= built.index.list_length, query.dissimilarities, 0.0).astype(np.float64)
    listed = h_hot[built.index.lists]  # [h, n]
    squared = np.square(h_hot).sum() + (np.square(listed - built.index.values) - np.square(listed)).sum(axis=0)
    return np.asarray(-np.sqrt(np.maximum(squared, 0.0)), np.float32)


def _brute_force(built: RetrievalMap, query: Query, _: LandmarkStatistics | None) -> NDArray[np.float32]:
    """-L2 between encodings."""
    if query.encoding is None or built.encodings is None:
        raise InvalidInputError("a brute_force map compares encodings; send an image or an encoding")
    if query.encoding.shape != built.encodings.shape[1:]:
        raise InvalidInputError(
            f"an encoding of {query.encoding.size} numbers; the map's have {built.encodings.shape[1]}"
        )
    distances = brute_force_relevances(built.encodings, query.encoding[np.newaxis])
    return np.asarray(distances[0], np.float32)


def brute_force_relevances(encodings: NDArray[np.float32], queries: NDArray[np.float32]) -> NDArray[np.float32]:
    """-L2 between every query and every map image, [q, n] float32, by one matrix product."""
    squares = np.einsum("nd,nd->n", encodings, encodings)
    query_squares = np.einsum("qd,qd->q", queries, queries)
    squared = query_squares[:, np.newaxis] + squares - 2.0 * (queries @ encodings.T)
    return np.asarray(-np.sqrt(np.maximum(squared, 0.0)), np.float32)


_RULES: dict[Relevance, Callable[[RetrievalMap, Query, LandmarkStatistics | None], NDArray[np.float32]]] = {
    Relevance.STANDARDISED: _standardised,
    Relevance.CALIBRATED: _calibrated,
    Relevance.RRF: _rrf,
    Relevance.BAG_OF_LANDMARKS: _bag_of_landmarks,
    Relevance.SIMBAD: _simbad,
    Relevance.BRUTE_FORCE: _brute_force,
}


def _same_at_every_rank(worth: NDArray[np.generic], index: InvertedIndex) -> NDArray[np.float32]:
    return np.tile(worth.astype(np.float32), (index.list_length, 1))
