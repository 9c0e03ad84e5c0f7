"""Where a single view places the robot: describe, retrieve, believe (II-C)."""

from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief import BeliefSummary, GridFilter, summarise
from deepsimbad.core.descriptor import rank_landmarks, ranks_from_ranked_landmarks, unpack_ranked_landmarks
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig, LocalizerState
from deepsimbad.core.map import Map
from deepsimbad.core.off_route import OFF_ROUTE_AT_START
from deepsimbad.core.planners import Plan
from deepsimbad.core.relevance import Query
from deepsimbad.core.retrieval import relevances, shortlist
from deepsimbad.engine.encoders import encode_images, ready_encodings
from deepsimbad.engine.views import Dissimilarities, EncodedImage, NothingSeen, PackedRanks, RankedLandmarks, View
from deepsimbad.errors import InvalidDissimilaritiesError, InvalidInputError, WeightsDifferError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.image import is_blank

DEFAULT_SHORTLIST = 10
_LARGEST_DISSIMILARITY = 1e15


@dataclass(frozen=True)
class Retrieval:
    """How well every map image answers one view."""

    ranks: NDArray[np.float32]  # [r] float32, 1..r, the landmarks of the view
    relevance: NDArray[np.float32]  # [n] float32, larger is better
    timings_ms: Mapping[str, float]  # milliseconds by stage


@dataclass(frozen=True)
class Localization:
    """The answer to one view."""

    snapshot: Map  # the map that answered
    retrieval: Retrieval  # of all map images
    shortlist: NDArray[np.int64]  # ids of the most relevant ones, best first
    belief: BeliefSummary  # after this one view, from a uniform prior
    plan: Plan | None  # the move that would tell most next; None where the map can name none
    timings_ms: Mapping[str, float]  # milliseconds by stage


def localize(snapshot: Map, evaluator: Evaluator, view: View, n_shortlist: int | None = None) -> Localization:
    """Localize one view on its own.

    Args:
        n_shortlist: Length of the shortlist and of the belief's top, 1..n; None: 10, or n where that is less.

    Raises:
        InvalidInputError: The view or `n_shortlist` cannot be used with this map.
    """
    length = shortlist_length(snapshot, n_shortlist)
    retrieval = retrieve(snapshot, evaluator, view)
    began = perf_counter()
    best = shortlist(retrieval.relevance, length)
    listed = perf_counter()
    belief = GridFilter.uniform(snapshot.route).updated(retrieval.relevance, snapshot.update_rule, step=0)
    # One view from a belief that expects nothing says nothing about being off the route.
    off_route = None if snapshot.off_route_model is None else OFF_ROUTE_AT_START
    summary = summarise(snapshot.route, belief.mass, length, off_route)
    believed = perf_counter()
    plan = None
    if snapshot.bits_ahead is not None or snapshot.q_values is not None:
        seen = LocalizerState(belief, None, retrieval.relevance, off_route, 1)
        plan = ActiveLocalizer(snapshot, LocalizerConfig()).plan(seen)
    planned = perf_counter()
    timings_ms = {
        **retrieval.timings_ms,
        "shortlist": 1000 * (listed - began),
        "belief": 1000 * (believed - listed),
        "plan": 1000 * (planned - believed),
    }
    return Localization(snapshot, retrieval, best, summary, plan, timings_ms)


def retrieve(snapshot: Map, evaluator: Evaluator, view: View) -> Retrieval:
    """The relevance of every map image to one view, by the map's statistics alone."""
    began = perf_counter()
    query = describe(snapshot, evaluator, view)
    described = perf_counter()
    relevance = np.zeros(snapshot.n_images, np.float32)
    if query.is_informative:
        relevance = relevances(snapshot, query)
    retrieved = perf_counter()
    timings_ms = {"describe": 1000 * (described - began), "retrieve": 1000 * (retrieved - described)}
    return Retrieval(query.ranks, relevance, timings_ms)


def describe(snapshot: Map, evaluator: Evaluator, view: View) -> Query:
    """Rank the landmarks for a view (II-A, II-C); one that shows nothing comes out as uninformative.

    Raises:
        InvalidInputError: The view is not of this map.
        WeightsDifferError: The map's images were encoded by other weights than the view.
    """
    if isinstance(view, RankedLandmarks):
        return Query(ranks_from_ranked_landmarks(view.landmark_ids, snapshot.n_landmarks))
    if isinstance(view, PackedRanks):
        landmark_ids = unpack_ranked_landmarks(view.body, snapshot.n_landmarks)
        return Query(ranks_from_ranked_landmarks(landmark_ids, snapshot.n_landmarks))
    if isinstance(view, Dissimilarities):
        if view.values.shape != (snapshot.n_landmarks,):
            raise InvalidDissimilaritiesError(
                f"{view.values.size} dissimilarities; this map has {snapshot.n_landmarks} landmarks",
                n_landmarks=snapshot.n_landmarks,
            )
        if np.ptp(view.values) == 0:
            return Query.uninformative(snapshot.n_landmarks)
        return Query(rank_landmarks(view.values), _as_float32(view.values))
    if isinstance(view, np.ndarray):
        view = NothingSeen() if is_blank(view) else encode_images(evaluator, [view])[0]
    if isinstance(view, NothingSeen):
        return Query.uninformative(snapshot.n_landmarks)
    if isinstance(view, EncodedImage):
        WeightsDifferError.check("the map", snapshot.weights_sha256, "the view", view.weights_sha256)
        encoding = view.values
    else:
        encoding = ready_encodings(view.values[np.newaxis])[0]
    dissimilarities = evaluator.dissimilarities(encoding[None, :], snapshot.landmark_model)[0]
    return Query(rank_landmarks(dissimilarities), dissimilarities, encoding)


def shortlist_length(snapshot: Map, wanted: int | None) -> int:
    """How many map images a shortlist holds.

    Raises:
        InvalidInputError: More than the map has, or fewer than one.
    """
    if wanted is None:
        return min(DEFAULT_SHORTLIST, snapshot.n_images)
    if not 1 <= wanted <= snapshot.n_images:
        raise InvalidInputError(
            f"shortlist is {wanted}; it must be within 1 and the number of map images, {snapshot.n_images}",
            minimum=1,
            maximum=snapshot.n_images,
        )
    return wanted


def _as_float32(values: NDArray[np.float64]) -> NDArray[np.float32]:
    """Ranks are already drawn from the full numbers; these are compared by squares, which must stay finite."""
    return np.clip(values, -_LARGEST_DISSIMILARITY, _LARGEST_DISSIMILARITY).astype(np.float32)
