"""Compiling what serving runs before anyone waits for it."""

import numpy as np

from deepsimbad.core.belief import GridFilter, summarise
from deepsimbad.core.map import Map
from deepsimbad.core.planners import PlanningView, plan_for_telling_places
from deepsimbad.core.relevance import Query, UpdateRule
from deepsimbad.core.retrieval import relevances, shortlist
from deepsimbad.evaluators.feature_l2 import squared_distances


def warm_up() -> None:
    """Answer one query on a map of two images; seconds on a fresh machine, milliseconds after."""
    config = {"relevance": "rrf", "n_landmarks": 2}
    map_ = Map(
        config=config,
        lists=np.array([[0, 1]], np.uint16),
        position_m=np.array([0.0, 1.0]),
        actions_m=np.array([1.0]),
        telling_bits=np.array([1, 2], np.float32),
    )
    relevance = relevances(map_, Query(np.array([1, 2], np.float32)))
    shortlist(relevance, 1)
    belief = GridFilter.uniform(map_.route).updated(relevance, UpdateRule.ADDITIVE_RELEVANCE, step=0)
    mass = belief.predicted(0.5, 0.1, step=1).mass
    summarise(belief.route, mass, 1)
    plan_for_telling_places(PlanningView(map_, mass, relevance, seed=0, step=1))
    landmarks = np.zeros((2, 2), np.float32)
    landmarks.setflags(write=False)  # as those of a map are: for a kernel that is another type
    squared_distances(np.zeros((1, 2), np.float32), landmarks)
