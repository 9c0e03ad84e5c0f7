"""Building a map from a drive: landmarks chosen, what every image lists, and what the seasons of its route teach.

A map knows the route in up to two seasons: the training traverse that becomes the map, and another drive of it, which
is the landmark traverse where there is one. What both saw is fused, and shows how far views of a third season can be
trusted: the second season is driven through a map whose lists do not know it, as no list knows the season to come.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.composed import (
    LEAST_SHARED_PLACES,
    Moments,
    compose,
    described,
    learnt_landmarks,
    principal_directions,
    season_seen,
    unit,
    within_place_whitening,
)
from deepsimbad.core.descriptor import LandmarkStatistics, common_factors, nearest_landmarks, rank_landmarks
from deepsimbad.core.drive import Drive, SameRoute, SecondSeason, second_season
from deepsimbad.core.landmark_model import farthest_first
from deepsimbad.core.map import Map
from deepsimbad.core.rehearsal import own_views, placed_rightly, rehearsed, view_bits
from deepsimbad.core.relevance import Relevance, most_strange
from deepsimbad.core.route import Route
from deepsimbad.errors import InvalidEncodingError, InvalidMapConfigError

_OWN_PLACE_M = 2.0  # a landmark from no farther away is a place's own
_SPREAD_OVER = 0.5  # share of the route that places seen in two seasons must at least span to tell of all of it
Measure = Callable[[Drive, Mapping[str, NDArray[Any]]], Drive]


@dataclass(frozen=True)
class MapPlan:
    """What a map is to be, and how it may be made."""

    relevance: Relevance
    list_length: int  # h
    actions_m: tuple[float, ...]
    closed: bool = False
    # Whether the drives' positions are comparable; None: they are where both know x, y
    same_route: bool | None = None
    bars_own_place: bool = False  # no image lists a landmark that was seen from its own place (`composed`)


@dataclass(frozen=True)
class Built:
    """A described traverse."""

    map: Map  # as it will serve, but for its experience database
    rehearsal: Map  # the map made without the second season's lists, for learning from that season as from one to come
    map_drive: Drive  # the training traverse, measured
    second: Drive | None = None  # the second drive, measured; None where none is of the same route
    same_route: SameRoute | None = None  # whether it is, and why not; None where there is no second drive
    places: NDArray[np.float32] | None = None  # [n, k] unit vectors that the lists stand for (`composed`)
    initial_landmarks: NDArray[np.float32] | None = None  # [r, k] before they moved to where their sums are nearer
    by_camera: bool = False  # whether what a season changes was learnt on another route
    fitting: Mapping[str, Any] | None = None  # how the evaluator was fitted, JSON-ready; None where it was not
    warnings: tuple[str, ...] = ()  # of the fitting


def build_from_dissimilarities(
    plan: MapPlan,
    training: Drive,
    second: Drive | None,
    model: Mapping[str, NDArray[Any]],
    measure: Measure,
    on_progress: Callable[[float], None] = lambda _: None,
) -> Built:
    """A map of any relevance but `composed`, by an evaluator's landmarks; it learns from a second season if it can.

    Args:
        second: Another drive, perhaps of the same route.
        model: The evaluator's landmark model.
        measure: Measures a drive's dissimilarities to a model's landmarks.

    Raises:
        InvalidMapConfigError: No image, or h not within 1..r.
        InvalidRouteError: The positions go backwards or are NaN.
    """
    map_drive = measure(training, model)
    on_progress(0.4)
    season = verdict = None
    other: Drive | None = None
    if second is not None:
        season, other, verdict = second_season(
            map_drive, plan.closed, second, plan.same_route, lambda drive: measure(drive, model)
        )
    on_progress(0.7)
    map_ = build_map(plan.relevance, map_drive, plan.list_length, plan.closed)
    map_ = replace(map_, landmark_model=model, actions_m=np.array(sorted(plan.actions_m)))
    dissimilarities = measured_dissimilarities(map_drive)
    if plan.relevance is Relevance.STANDARDISED:
        map_ = replace(map_, **rehearsed(map_, dissimilarities, season))
    views = own_views(map_, dissimilarities)
    if plan.relevance is Relevance.STANDARDISED:
        map_ = replace(map_, view_bits=view_bits(map_, views, map_, season))
    if season is not None and other is not None and not plan.relevance.traits.is_listed:
        season = replace(season, encodings=other.encodings)
    map_ = replace(map_, coverage=placed_rightly(map_, views, season))
    on_progress(1.0)
    return Built(map_, map_, map_drive, other, verdict)


@dataclass(frozen=True)
class SeenTwice:
    """Places of one route that a camera saw in two seasons."""

    first: Drive
    second: Drive
    places: NDArray[np.int64]  # [k, 2] frames of the first and the second


@dataclass(frozen=True)
class _Space:
    """The space in which unit encodings are compared, and its landmarks."""

    projection: NDArray[np.float32] | None  # [d, k]
    prototypes: NDArray[np.float32]  # [r, k]
    # [r] frames of the candidates that the landmarks are; None where they are another map's
    candidate_frames: NDArray[np.int64] | None = None

    @classmethod
    def first(
        cls,
        training: Drive,
        candidates: Drive | Mapping[str, NDArray[Any]],
        n_landmarks: int,
        halves: Sequence[int],
        on_progress: Callable[[float], None],
    ) -> Self:
        """The space before seasons are known, with landmarks chosen from a drive or those of another map's model."""
        d = candidates.encoding_dim if isinstance(candidates, Drive) else candidates["usual"].shape[1]
        if d != training.encoding_dim:
            raise InvalidEncodingError(
                f"encodings of {training.encoding_dim} numbers cannot be compared with landmarks of {d}: "
                "they come from another encoder"
            )
        if isinstance(candidates, Drive):
            drives = {id(drive): drive.encodings for drive in (training, candidates)}
            directions = principal_directions(*drives.values(), halves=halves, on_progress=on_progress)
            return cls.among(candidates, directions, n_landmarks)
        return cls(candidates.get("projection"), np.asarray(candidates["prototypes"], np.float32))

    @classmethod
    def among(cls, candidates: Drive, projection: NDArray[np.float32] | None, n_landmarks: int) -> Self:
        """The space of a projection, with landmarks chosen from a drive."""
        u = _unit_vectors(candidates, projection)
        frames = farthest_first(u, n_landmarks)
        return cls(projection, u[frames], frames)

    def fitted(self, places: NDArray[np.float32], list_length: int, barred: NDArray[np.bool_] | None) -> Self:
        """The same space with landmarks moved to where sums of them come nearer to places [n, k]."""
        return replace(self, prototypes=learnt_landmarks(places, self.prototypes, list_length, barred))

    def described_in(self, map_: Map, places: NDArray[np.float32], barred: NDArray[np.bool_] | None) -> Map:
        """The map with lists of other places [n, k], by the landmarks of this space."""
        lists = compose(places, self.prototypes, map_.list_length, barred)
        return replace(map_, lists=lists, landmark_model={**map_.landmark_model, "prototypes": self.prototypes})

    def model(self, moments: Moments) -> dict[str, NDArray[Any]]:
        """The landmark model that robots get: the landmarks, and what makes an encoding a unit vector."""
        arrays: dict[str, NDArray[Any]] = {"prototypes": self.prototypes, "usual": moments.mean_std()}
        return arrays if self.projection is None else {**arrays, "projection": self.projection}

    def unit_vectors(self, drive: Drive) -> NDArray[np.float32]:
        """[n, k] unit vectors of a drive's frames, by its own statistics."""
        return _unit_vectors(drive, self.projection)

    def measured(self, drive: Drive) -> Drive:
        """The drive with its dissimilarities: squared distances between unit vectors."""
        return replace(drive, dissimilarities=self.dissimilarities(self.unit_vectors(drive)))

    def dissimilarities(self, u: NDArray[np.float32]) -> NDArray[np.float32]:
        """[n, r] squared distances of unit vectors to the landmarks."""
        return np.asarray(np.clip(2 - 2 * (u @ self.prototypes.T), 0, 4), np.float32)

    def whitened(self, seasons: Sequence["SeenTwice"], candidates: Drive) -> Self:
        """The space in which what a season changes counts less, with landmarks chosen anew."""
        firsts = [self.unit_vectors(pair.first)[pair.places[:, 0]] for pair in seasons]
        seconds = [self.unit_vectors(pair.second)[pair.places[:, 1]] for pair in seasons]
        whitening = within_place_whitening(np.concatenate(seconds), np.concatenate(firsts))
        projection = whitening if self.projection is None else self.projection @ whitening
        return self.among(candidates, projection, len(self.prototypes))


def _unit_vectors(drive: Drive, projection: NDArray[np.float32] | None) -> NDArray[np.float32]:
    return described(drive.encodings, Moments.of(drive.encodings), projection)


def compose_map(
    plan: MapPlan,
    training: Drive,
    second: Drive | None,
    landmarks: Drive | Mapping[str, NDArray[Any]] | None,
    n_landmarks: int,
    on_progress: Callable[[float], None] = lambda _: None,
    camera: Sequence[SeenTwice] = (),
    halves: Sequence[int] = (),
) -> Built:
    """A map of `composed`, whose landmarks are chosen among unit encodings, or are those of another map's model.

    Args:
        second: Another drive, perhaps of the same route.
        landmarks: The drive from which they are chosen (the same object as `second` where it is that one: a rehearsal
            then leaves a place's own landmark out), the model in which they stay, or None: the training drive.
        n_landmarks: r.
        camera: Places of other routes that the camera saw in two seasons: what a season changes is learnt from them
            where this route was not seen in two, and its landmarks are chosen here.
        halves: See `principal_directions`.

    Raises:
        TooFewCandidatesError: The drive from which landmarks are chosen has fewer frames than `n_landmarks`.
        InvalidEncodingError: The model is of other encodings.
    """
    candidates = training if landmarks is None else landmarks
    space = _Space.first(training, candidates, n_landmarks, halves, lambda share: on_progress(0.6 * share))
    check_list_length(plan.list_length, len(space.prototypes))
    on_progress(0.7)
    map_drive, season, verdict = space.measured(training), None, None
    other: Drive | None = None
    if second is not None:
        season, other, verdict = second_season(map_drive, plan.closed, second, plan.same_route, space.measured)
    on_progress(0.75)
    seen_twice, by_camera = camera, bool(camera)
    if season is not None and other is not None and covers(training.position_m, season.places[:, 0]):
        seen_twice, by_camera = (SeenTwice(training, other, season.places),), False
    if seen_twice and isinstance(candidates, Drive):
        space = space.whitened(seen_twice, candidates)
    on_progress(0.85)
    moments, places = Moments.of(training.encodings), space.unit_vectors(training)
    fused_places = places
    if season is not None and other is not None:
        moments = Moments.of(training.encodings, other.encodings)
        fused_places = unit(places + season_seen(space.unit_vectors(other), season.places, len(places)))
    landmark_images = space.candidate_frames if candidates is training else None
    if candidates is second and season is not None and space.candidate_frames is not None:
        landmark_images = _images_of(season.places, space.candidate_frames)
    own_places = None if landmark_images is None else _own_places(map_drive.route(plan.closed), landmark_images)
    barred, initial_space = own_places if plan.bars_own_place else None, space
    if isinstance(candidates, Drive):
        space = space.fitted(fused_places, plan.list_length, barred)
        map_drive, other = space.measured(training), None if other is None else space.measured(other)
    # Landmarks may be another map's; the moments are this one's, so that robots make the same unit vectors as the map
    model = space.model(moments) if isinstance(candidates, Drive) else {**candidates, "usual": moments.mean_std()}
    map_ = composed_map(plan, map_drive, fused_places, moments, model, barred)
    rehearsal, dissimilarities = map_, measured_dissimilarities(map_drive)
    if season is not None and second is not None:
        # By the initial landmarks: moved to what both seasons saw, they would know the second one
        rehearsal = initial_space.described_in(map_, places, own_places if candidates is second else barred)
        dissimilarities = initial_space.dissimilarities(places)
        season = SecondSeason(initial_space.dissimilarities(initial_space.unit_vectors(second)), season.places)
    on_progress(0.92)
    seasons = (training,) if other is None else (training, other)
    map_, rehearsal = taught(map_, rehearsal, dissimilarities, space.dissimilarities(fused_places), season, seasons)
    if isinstance(candidates, Drive) and space.candidate_frames is not None:
        map_ = replace(map_, **candidates.landmark_origins(space.candidate_frames))
    on_progress(1.0)
    return Built(map_, rehearsal, map_drive, other, verdict, fused_places, initial_space.prototypes, by_camera)


def taught(
    map_: Map,
    rehearsal: Map,
    dissimilarities: NDArray[np.float32],
    places: NDArray[np.float32],
    season: SecondSeason | None,
    drives: Sequence[Drive],
) -> tuple[Map, Map]:
    """A `composed` map and its rehearsal with what a second season, or the map itself, tells of views to come.

    Args:
        dissimilarities: [n, r] of the map images to the rehearsal's landmarks.
        places: [n, r] dissimilarities of what the map's lists stand for to the map's landmarks.
        season: The second season, measured by the rehearsal's landmarks; None: there is none.
        drives: Every season of the route.
    """
    arrays = rehearsed(rehearsal, dissimilarities, season)
    map_, rehearsal = replace(map_, **arrays), replace(rehearsal, **arrays)
    views = own_views(map_, places)
    arrays = {
        "view_bits": view_bits(map_, views, rehearsal, season),
        "coverage": placed_rightly(rehearsal, views, season),
        "most_strange": np.array([most_strange(*(drive.encodings for drive in drives))]),
    }
    return replace(map_, **arrays), replace(rehearsal, **arrays)


def composed_map(
    plan: MapPlan,
    map_drive: Drive,
    places: NDArray[np.float32],
    moments: Moments,
    model: Mapping[str, NDArray[Any]],
    barred: NDArray[np.bool_] | None = None,
) -> Map:
    """The map of places [n, k] seen by `map_drive`, without what a rehearsal teaches."""
    prototypes = np.asarray(model["prototypes"], np.float32)
    dissimilarities, route = measured_dissimilarities(map_drive), map_drive.route(plan.closed)
    ranks = rank_landmarks(dissimilarities)
    statistics = LandmarkStatistics.of_map(ranks)
    return Map(
        config={"relevance": Relevance.COMPOSED.value, "n_landmarks": len(prototypes)},
        closed=plan.closed,
        actions_m=np.array(sorted(plan.actions_m)),
        landmark_model=model,
        position_m=route.position_m,
        x_m=route.x_m,
        y_m=route.y_m,
        lists=compose(places, prototypes, plan.list_length, barred),
        statistics=np.stack([statistics.mean, statistics.std]),
        loadings=common_factors(statistics.standardise(ranks)),
        usual_encoding=moments.mean_std(),
        usual_product=Moments.of((1 - dissimilarities / 2).astype(np.float32)).mean_std(),
    )


def measured_dissimilarities(drive: Drive) -> NDArray[np.float32]:
    """[n, r] dissimilarities of a drive; raises InvalidMapConfigError where they are not measured."""
    if drive.dissimilarities is None:
        raise InvalidMapConfigError("the drive's dissimilarities are not measured")
    return drive.dissimilarities


def covers(position_m: NDArray[np.float64], images: NDArray[np.int64]) -> bool:
    """Whether images that were seen in two seasons are enough, and spread over the route at `position_m`."""
    at_m = position_m[images]
    spread = np.ptp(at_m) >= _SPREAD_OVER * np.ptp(position_m) if at_m.size else False
    return bool(at_m.size >= LEAST_SHARED_PLACES and spread)


def _images_of(places: NDArray[np.int64], frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """[r] the map image that saw the same place as each frame [r], by pairs (map image, frame) [k, 2]; -1: none."""
    image_of = np.full(max(int(places[:, 1].max()), int(frames.max())) + 1, -1)
    image_of[places[:, 1]] = places[:, 0]
    return image_of[frames]


def _own_places(route: Route, landmark_images: NDArray[np.int64]) -> NDArray[np.bool_]:
    """[n, r] whether a landmark was seen from an image's own place, by the image at each landmark's; -1: none."""
    apart_m = np.abs(route.offset_m(route.position_m[:, np.newaxis], route.position_m[landmark_images]))
    return np.asarray((apart_m <= _OWN_PLACE_M) & (landmark_images >= 0))


def check_list_length(list_length: int, n_landmarks: int) -> None:
    """Raise InvalidMapConfigError where h is not within 1..r."""
    if not 1 <= list_length <= n_landmarks:
        raise InvalidMapConfigError(
            f"list_length {list_length} is not within 1 and the number of landmarks, {n_landmarks}: ask for "
            "shorter lists, or landmarks from a longer drive",
            list_length=list_length,
            n_landmarks=n_landmarks,
        )


def build_map(relevance: Relevance, drive: Drive, list_length: int, closed: bool = False) -> Map:
    """The map of a measured drive, of any relevance but `composed`, with the h landmarks that every image lists.

    Returns:
        The map as far as dissimilarities tell; its landmark model, actions and names are the caller's to add.

    Raises:
        InvalidMapConfigError: No image, or h not within 1..r.
        InvalidRouteError: The positions go backwards or are NaN.
    """
    dissimilarities = measured_dissimilarities(drive)
    if dissimilarities.ndim != 2 or len(dissimilarities) == 0:
        raise InvalidMapConfigError("a map needs at least one image")
    n_landmarks = dissimilarities.shape[1]
    check_list_length(list_length, n_landmarks)
    ranks = rank_landmarks(dissimilarities)
    arrays: dict[str, Any] = {}
    if relevance is Relevance.STANDARDISED:
        statistics = LandmarkStatistics.of_map(ranks)
        scores = statistics.standardise(ranks)
        arrays["statistics"] = np.stack([statistics.mean, statistics.std])
        arrays["loadings"] = common_factors(scores)
        lists = nearest_landmarks(scores, list_length)
    else:
        lists = nearest_landmarks(ranks, list_length)
    if relevance is Relevance.SIMBAD:
        arrays["values"] = listed_values(dissimilarities, lists)
    route = drive.route(closed)
    return Map(
        config={"relevance": relevance.value, "n_landmarks": n_landmarks},
        closed=closed,
        position_m=route.position_m,
        x_m=route.x_m,
        y_m=route.y_m,
        lists=lists,
        encodings=None if relevance.traits.is_listed else drive.encodings,
        **arrays,
    )


def listed_values(dissimilarities: NDArray[np.float32], lists: NDArray[np.uint16]) -> NDArray[np.float32]:
    """[h, n] float32, those dissimilarities [n, r] that belong to the landmarks of lists [h, n]."""
    return np.ascontiguousarray(np.take_along_axis(dissimilarities, lists.T.astype(np.intp), axis=1).T, np.float32)
