"""Compiling what serving runs before anyone waits for it."""

import numpy as np

from deepsimbad.core.belief_summary import summarise
from deepsimbad.core.grid_filter import GridFilter
from deepsimbad.core.inverted_index import InvertedIndex
from deepsimbad.core.relevance import Query, Relevance, RetrievalMap, relevances
from deepsimbad.core.retrieval import shortlist
from deepsimbad.core.route import Route
from deepsimbad.core.update_rules import UpdateRule
from deepsimbad.evaluators.feature_l2 import squared_distances


def warm_up() -> None:
    """Answer one query on a map of two images; seconds on a fresh machine, milliseconds after."""
    index = InvertedIndex(np.array([[0, 1]], np.uint16), 2)
    built = RetrievalMap(Relevance.RRF, index)
    relevance = relevances(built, Query(np.array([1, 2], np.float32)))
    shortlist(relevance, 1)
    belief = GridFilter.uniform(Route(np.array([0.0, 1.0]))).updated(relevance, UpdateRule.ADDITIVE_RELEVANCE, step=0)
    summarise(belief.route, belief.predicted(0.5, 0.1, step=1).mass, 1)
    squared_distances(np.zeros((1, 2), np.float32), np.zeros((2, 2), np.float32))
