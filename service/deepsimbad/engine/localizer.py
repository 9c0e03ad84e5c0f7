"""Where a single view places the robot: describe, retrieve, believe (II-C)."""

from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief.summary import BeliefSummary, summarise
from deepsimbad.core.building import MapPlan, compose_map
from deepsimbad.core.composed import is_composed
from deepsimbad.core.descriptor import rank_landmarks, ranks_from_ranked_landmarks
from deepsimbad.core.drive import Drive
from deepsimbad.core.index.retrieval import shortlist
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.map import Map
from deepsimbad.core.on_board import unpack_ranked_landmarks, unpack_unit_encoding
from deepsimbad.core.planners import Plan
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.engine.worker import EncodedImage, Stopwatch, encode_images
from deepsimbad.errors import (
    InvalidDissimilaritiesError,
    InvalidEncodingError,
    InvalidInputError,
    WeightsDifferError,
)
from deepsimbad.evaluators.base import Evaluator, Image
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.image import is_blank
from deepsimbad.evaluators.registry import EvaluatorKind
from deepsimbad.evaluators.scenes import Scene
from deepsimbad.evaluators.space import dissimilarities_and_vectors, squared_between

DEFAULT_SHORTLIST = 10
_LARGEST_DISSIMILARITY = 1e15
# Bounds of what `is_short`
_MOST_IMAGES = 1 << 15
_MOST_SUMMED = 1 << 18  # entries of lists
_MOST_PRODUCTS = 1 << 22  # of numbers of its encoding with landmarks
_LONGEST_SHORTLIST = 100

# The forms in which a view reaches the engine


@dataclass(frozen=True)
class RankedLandmarks:
    """Landmark ids, nearest first, from a robot that encodes on board: the descriptor itself."""

    landmark_ids: tuple[int, ...]


@dataclass(frozen=True)
class PackedRanks:
    """Ranked landmarks as `core.on_board.pack_ranked_landmarks` makes them; the map knows how many bits an id has."""

    body: bytes


@dataclass(frozen=True)
class PackedUnitEncoding:
    """What `composed` compares, as `core.on_board.pack_unit_encoding` makes it; the map knows how many numbers."""

    body: bytes


@dataclass(frozen=True)
class Dissimilarities:
    """Dissimilarities to all landmarks: [r] float64 in landmark order, smaller is nearer."""

    values: NDArray[np.float64]


@dataclass(frozen=True)
class ReadyEncoding:
    """An encoding that was computed elsewhere: [d] float64 as it was sent."""

    values: NDArray[np.float64]


@dataclass(frozen=True)
class NothingSeen:
    """An image that shows nothing: one grey wall, the dark."""


View: TypeAlias = (
    NothingSeen
    | Image
    | Scene
    | EncodedImage
    | ReadyEncoding
    | Dissimilarities
    | RankedLandmarks
    | PackedRanks
    | PackedUnitEncoding
)
"""One observation: an image [height, width, 3] uint8 BGR, a scene, or what was made of either here or on board."""


@dataclass(frozen=True)
class Localization:
    """The answer to one view."""

    snapshot: Map  # the map that answered
    relevance: NDArray[np.float32]  # [n] of every map image, larger is better
    shortlist: NDArray[np.int64]  # ids of the most relevant ones, best first
    belief: BeliefSummary  # after this one view, from a uniform prior
    plan: Plan | None  # the move that would tell most next; None where the map can name none
    is_informative: bool  # whether the view shows anything


def localize(
    snapshot: Map, evaluator: Evaluator, view: View, n_shortlist: int | None = None, watch: Stopwatch | None = None
) -> Localization:
    """Localize one view on its own: as a session's first, but by the map's statistics alone.

    Args:
        n_shortlist: Length of the shortlist and of the belief's top, 1..n; None: 10, or n where that is less.
        watch: Has a lap for every stage.

    Raises:
        InvalidInputError: The view or `n_shortlist` cannot be used with this map.
    """
    watch = watch or Stopwatch()
    length = shortlist_length(snapshot, n_shortlist)
    query = describe(snapshot, evaluator, view)
    watch.lap("describe")
    localizer = ActiveLocalizer(snapshot, LocalizerConfig(), perf_counter)
    step = localizer.observe(replace(localizer.start(), live=None), query)
    watch.lap("belief", {"retrieve": step.timings_ms["retrieve"]})
    ids = shortlist(step.relevance, length)
    watch.lap("shortlist")
    belief = step.state.belief
    summary = summarise(snapshot.route, belief.mass, length, belief.doubt.off_route)
    watch.lap("belief")
    plan = None
    if snapshot.view_bits is not None or snapshot.q_values is not None:
        plan = localizer.plan(step.state)
    watch.lap("plan")
    return Localization(snapshot, step.relevance, ids, summary, plan, step.shows_place)


def is_short(snapshot: Map, view: View, n_shortlist: int | None = None) -> bool:
    """Whether an encoded view is answered without waiting, in about three milliseconds at most."""
    n_landmarks = snapshot.n_landmarks
    if isinstance(view, PackedRanks) or (isinstance(view, RankedLandmarks) and len(view.landmark_ids) < n_landmarks):
        return False  # scores of landmarks that were not sent have to be expected ones, which takes longer
    if isinstance(view, ReadyEncoding | EncodedImage):
        # Others compare by networks of their own, or by those of another process.
        is_plain = snapshot.evaluator.get("kind") == EvaluatorKind.FEATURE_L2
        if not is_plain or view.values.size * n_landmarks > _MOST_PRODUCTS:
            return False
    n_summed = snapshot.list_length * max(snapshot.n_images, n_landmarks)
    is_listed = snapshot.values is None and snapshot.encodings is None  # else all of them are read, or more
    is_small = n_summed <= _MOST_SUMMED and snapshot.n_images <= _MOST_IMAGES
    return is_listed and is_small and (n_shortlist or 0) <= _LONGEST_SHORTLIST


def describe(snapshot: Map, evaluator: Evaluator, view: View) -> Query:
    """Rank the landmarks for a view (II-A, II-C); a view that shows nothing gives an uninformative query.

    Raises:
        InvalidInputError: The view does not fit this map.
        WeightsDifferError: The map's images were encoded by other weights than the view.
    """
    n_landmarks = snapshot.n_landmarks
    if isinstance(view, PackedRanks):
        view = RankedLandmarks(unpack_ranked_landmarks(view.body, n_landmarks))
    if isinstance(view, RankedLandmarks):
        return Query(ranks_from_ranked_landmarks(view.landmark_ids, n_landmarks))
    if isinstance(view, PackedUnitEncoding):
        view = _with_landmarks(snapshot, view)
    if isinstance(view, Dissimilarities):
        if view.values.shape != (n_landmarks,):
            raise InvalidDissimilaritiesError(
                f"{view.values.size} dissimilarities; this map has {n_landmarks} landmarks", n_landmarks=n_landmarks
            )
        if view.values.min() == view.values.max():  # whose difference may be beyond float64
            return Query.uninformative(n_landmarks)
        # Ranks are drawn from the full numbers; those that are compared by squares must stay finite.
        bounded = np.clip(view.values, -_LARGEST_DISSIMILARITY, _LARGEST_DISSIMILARITY)
        return Query(rank_landmarks(view.values), bounded.astype(np.float32))
    if isinstance(view, np.ndarray):
        view = evaluator.prepare(view)
        view = NothingSeen() if is_blank(view) else encode_images(evaluator, [view])[0]
    if isinstance(view, Scene):
        view = NothingSeen() if view.is_blank else encode_images(evaluator, [view.check_forms(evaluator.forms)])[0]
    if isinstance(view, NothingSeen):
        return Query.uninformative(n_landmarks)
    if isinstance(view, EncodedImage):
        WeightsDifferError.check("the map", snapshot.weights_sha256, "the view", view.weights_sha256)
        encoding = view.values
    else:
        encoding = ready_encodings(view.values[np.newaxis])[0]
    dissimilarities, vectors = dissimilarities_and_vectors(evaluator, encoding[None, :], snapshot.landmark_model)
    return Query(rank_landmarks(dissimilarities[0]), dissimilarities[0], vectors[0])


def _with_landmarks(snapshot: Map, view: PackedUnitEncoding) -> Dissimilarities:
    """The dissimilarities of a unit encoding, standardised on board by the map's statistics, to the map's landmarks."""
    model = snapshot.landmark_model
    if not is_composed(model):
        raise InvalidEncodingError(
            f"map {snapshot.version} compares ranks ({snapshot.relevance}), not unit encodings: send ranked landmarks"
        )
    prototypes = np.asarray(model["prototypes"], np.float32)
    u = unpack_unit_encoding(view.body, prototypes.shape[1])
    return Dissimilarities(squared_between(u, prototypes).astype(np.float64))


def ready_encodings(values: NDArray[Any]) -> NDArray[np.float32]:
    """Check encodings [n, d] that were computed elsewhere; [n, d] float32, the same array where it is that already.

    Raises:
        InvalidEncodingError: Empty, or NaN, infinity or too large a number somewhere.
    """
    if values.ndim != 2 or values.size == 0:
        raise InvalidEncodingError(f"encodings are [n, d] and not empty, not {list(values.shape)}")
    with np.errstate(over="ignore"):  # what overflows is refused below
        encodings = np.ascontiguousarray(values, np.float32)
    # In blocks, so that a large batch is not accompanied by as many booleans.
    for start in range(0, len(encodings), 1024):
        is_finite = np.isfinite(encodings[start : start + 1024]).all(axis=1)
        if not is_finite.all():
            row = start + int(np.flatnonzero(~is_finite)[0])
            raise InvalidEncodingError(f"encoding {row} holds NaN, infinity or a number too large for float32", row=row)
    return encodings


def shortlist_length(snapshot: Map, n_shortlist: int | None) -> int:
    """The length of a shortlist, the default where `n_shortlist` is None; raises InvalidInputError."""
    if n_shortlist is None:
        return min(DEFAULT_SHORTLIST, snapshot.n_images)
    if not 1 <= n_shortlist <= snapshot.n_images:
        raise InvalidInputError(
            f"shortlist is {n_shortlist}; it must be within 1 and the number of map images, {snapshot.n_images}",
            minimum=1,
            maximum=snapshot.n_images,
        )
    return n_shortlist


def warm_up() -> None:
    """Answer views on two small maps of the default kind and move on, which compiles the kernels: seconds, once.

    A map whose images stand at equal distances has kernels of its own.
    """
    evaluator = FeatureL2("none")
    encodings = np.random.default_rng(0).normal(size=(8, 5)).astype(np.float32)
    views = (RankedLandmarks((0, 1, 2, 3)), RankedLandmarks((0,)), ReadyEncoding(np.ones(5)))
    for position_m in (np.arange(8.0), np.arange(8.0) ** 1.1):
        drive = Drive(position_m=position_m, encodings=encodings)
        map_ = compose_map(MapPlan(Relevance.COMPOSED, 2, (1.0,)), drive, None, None, 4).map
        localizer = ActiveLocalizer(map_, LocalizerConfig())
        state = localizer.start()
        for view in views:
            state = localizer.step(state, describe(map_, evaluator, view), 1.0).state
            localize(map_, evaluator, view)
