"""What many live views at once say of the map: relevance, evidence, and the nearest map images (II-C, II-D)."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.relevance import Query, Relevance, RetrievalMap, relevances
from deepsimbad.core.retrieval import shortlists
from deepsimbad.core.statistics import LandmarkStatistics
from deepsimbad.core.update_rules import LOG_LIKELIHOOD_WEIGHT, UpdateRule, evidence


@dataclass(frozen=True)
class LiveViews:
    """A drive's described frames, looked at through a map.

    Attributes:
        built: The map.
        rule: How a view's relevance becomes evidence.
        n_neighbours: k, how many nearest map images a view has.
        ranks: [m, r] float32, of all landmarks.
        dissimilarities: [m, r] float32; read by `simbad` alone.
        encodings: [m, d] float32; read by `brute_force` alone.
    """

    built: RetrievalMap
    rule: UpdateRule
    n_neighbours: int
    ranks: NDArray[np.float32]
    dissimilarities: NDArray[np.float32] | None = None
    encodings: NDArray[np.float32] | None = None

    def observing(self, live: LandmarkStatistics | None, frames: NDArray[np.int64]) -> LandmarkStatistics | None:
        """The episodes' own statistics after one more frame each, [e, r]; None where the relevance has none."""
        start = live or self.built.statistics
        return None if start is None else start.observing(self.ranks[frames])

    def look(
        self, frames: NDArray[np.int64], live: LandmarkStatistics | None
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Look at the map from some frames.

        Args:
            frames: [e].
            live: The episodes' own statistics, [e, r].

        Returns:
            Evidence [e, n] float32, and the nearest map images [e, k] int64, best first.
        """
        relevance = self.relevance(frames, live)
        nearest = shortlists(relevance, self.n_neighbours)
        return _evidence(relevance, self.rule), nearest

    def relevance(self, frames: NDArray[np.int64], live: LandmarkStatistics | None) -> NDArray[np.float32]:
        """[e, n] float32; row by row what `core.relevance.relevances` gives."""
        worth = worth_tables(self.built, self.ranks[frames], live)
        if worth is not None:
            return self.built.index.sum_listed_many(worth)
        return np.stack([relevances(self.built, self._query(int(frame))) for frame in frames])

    def _query(self, frame: int) -> Query:
        return Query(
            self.ranks[frame],
            None if self.dissimilarities is None else self.dissimilarities[frame],
            None if self.encodings is None else self.encodings[frame],
        )


def of_episodes(live: LandmarkStatistics | None, some: slice) -> LandmarkStatistics | None:
    """The statistics of some of the episodes."""
    return None if live is None else replace(live, mean=live.mean[some], square=live.square[some])


def worth_tables(
    built: RetrievalMap, ranks: NDArray[np.float32], live: LandmarkStatistics | None
) -> NDArray[np.float32] | None:
    """What each landmark is worth at each rank of a list, [e, h, r] float32; None for a relevance that is no such sum.

    Args:
        built: The map.
        ranks: [e, r] of the views.
        live: Their statistics, [e, r]; None: the map's.
    """
    h = built.index.list_length
    statistics = live or built.statistics
    if built.relevance is Relevance.RRF:
        reciprocal = 1.0 / np.arange(1, h + 1)
        return (reciprocal[:, np.newaxis] * (1.0 / ranks.astype(np.float64))[:, np.newaxis]).astype(np.float32)
    if built.relevance is Relevance.BAG_OF_LANDMARKS:
        return np.repeat((ranks <= h).astype(np.float32)[:, np.newaxis], h, axis=1)
    if built.relevance is Relevance.STANDARDISED and statistics is not None:
        worth = -statistics.standardise(ranks).astype(np.float32)
        return np.repeat(worth[:, np.newaxis], h, axis=1)
    if built.relevance is Relevance.CALIBRATED and statistics is not None and built.calibration is not None:
        return built.calibration.log_ratios(statistics.standardise(ranks)[:, np.newaxis]).astype(np.float32)
    return None


def _evidence(relevance: NDArray[np.float32], rule: UpdateRule) -> NDArray[np.float32]:
    """Row by row what `core.update_rules.evidence` gives, in single precision; may overwrite its argument."""
    if rule is UpdateRule.ADDITIVE_RELEVANCE:
        return np.maximum(relevance, 0.0, out=relevance)
    if rule is UpdateRule.LOG_LIKELIHOOD:
        relevance -= relevance.max(axis=1, keepdims=True)
        relevance *= np.float32(LOG_LIKELIHOOD_WEIGHT)
        return np.exp(relevance, out=relevance)
    for row in relevance:
        row[:] = evidence(row, rule)
    return relevance
