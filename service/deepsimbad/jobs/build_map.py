"""Building a map in memory: landmarks chosen, every training frame described (II-B, II-C)."""

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.landmark_selection import select_landmarks
from deepsimbad.core.relevance import Relevance, RetrievalMap
from deepsimbad.core.retrieval import build_retrieval_map
from deepsimbad.core.route import Route
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.store.map_contents import MapContents
from deepsimbad.store.records import DomainRecord

_FRAMES_A_BLOCK = 1024


def choose_landmarks(
    candidates: NDArray[np.float32], n_landmarks: int, evaluator: Evaluator, on_progress: Callable[[float], None]
) -> LandmarkModel:
    """Select r of the landmark traverse's encodings and fit the evaluator's model to them.

    Args:
        candidates: [m, d] encodings.
        n_landmarks: r.
        evaluator: Fits the model.
        on_progress: Called with the share done; may raise to cancel.
    """
    return evaluator.fit_landmarks(candidates[select_landmarks(candidates, n_landmarks, on_progress)])


def describe(
    encodings: NDArray[np.float32],
    evaluator: Evaluator,
    model: LandmarkModel,
    relevance: Relevance,
    list_length: int,
    on_progress: Callable[[float], None],
) -> RetrievalMap:
    """Describe every training frame by its landmarks.

    Args:
        encodings: [n, d] of the training traverse, in route order.
        evaluator: Measures dissimilarities.
        model: The landmarks.
        relevance: What the map is built for.
        list_length: h.
        on_progress: Called with the share done; may raise to cancel.
    """
    blocks = []
    for start in range(0, len(encodings), _FRAMES_A_BLOCK):
        blocks.append(evaluator.dissimilarities(encodings[start : start + _FRAMES_A_BLOCK], model))
        on_progress(min(1.0, (start + _FRAMES_A_BLOCK) / len(encodings)))
    dissimilarities = np.concatenate(blocks) if blocks else np.empty((0, 0), np.float32)
    return build_retrieval_map(relevance, dissimilarities, list_length, encodings)


def map_contents(
    domain: DomainRecord,
    version: int,
    config: Mapping[str, Any],
    model: LandmarkModel,
    built: RetrievalMap,
    route: Route,
) -> MapContents:
    """Everything a map file holds of a described traverse.

    Args:
        domain: Whose map it is.
        version: Its number.
        config: What was asked for; kept with the map.
        model: The landmarks.
        built: What retrieval reads.
        route: Where the map images are.
    """
    statistics = built.statistics
    return MapContents(
        domain=domain.name,
        version=version,
        created_at=datetime.now(UTC).isoformat(timespec="seconds"),
        config={**config, "relevance": built.relevance.value, "n_landmarks": built.index.n_landmarks},
        evaluator=domain.evaluator,
        closed=domain.closed,
        actions_m=domain.actions_m,
        landmark_model=model,
        lists=built.index.lists,
        position_m=route.position_m,
        values=built.index.values,
        encodings=built.encodings,
        statistics=None if statistics is None else np.stack([statistics.mean, statistics.std]),
        x_m=route.x_m,
        y_m=route.y_m,
    )
