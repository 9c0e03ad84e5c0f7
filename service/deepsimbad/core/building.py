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
    SECOND_SEASON_WEIGHT,
    Moments,
    compose,
    described,
    learnt_landmarks,
    principal_directions,
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
_SPREAD_OVER = 0.5  # of the route, at least, that places seen twice must cover before they tell of all of it
Measure = Callable[[Drive, Mapping[str, NDArray[Any]]], Drive]


@dataclass(frozen=True)
class MapPlan:
    """What a map is to be, and what it is made of."""

    relevance: Relevance
    list_length: int  # h
    actions_m: tuple[float, ...]
    closed: bool = False
    # Whether the drives' positions are said to be comparable; None: where both know x, y
    same_route: bool | None = None
    bars_own_place: bool = False  # no image lists a landmark that was seen from its own place (`composed`)


@dataclass(frozen=True)
class Built:
    """A described traverse."""

    map: Map  # as it will serve, but for its experience database
    rehearsal: Map  # the map made without the second season's lists, for learning from that season as from one to come
    own: Drive  # the training traverse, measured
    second: Drive | None = None  # the second drive, measured, where it is of the same route
    same_route: SameRoute | None = None  # whether it is, and why not; None where there is no second drive
    places: NDArray[np.float32] | None = None  # [n, k] unit vectors that the lists stand for (`composed`)
    chosen: NDArray[np.float32] | None = None  # [r, k] landmarks before they moved to where sums of them are nearest
    by_camera: bool = False  # whether what a season changes was learnt on another route
    fitting: Mapping[str, Any] | None = None  # how the evaluator was fitted, JSON-ready; None: it was not, here
    warnings: tuple[str, ...] = ()  # of fitting


def build_from_dissimilarities(
    plan: MapPlan,
    training: Drive,
    second: Drive | None,
    model: Mapping[str, NDArray[Any]],
    measure: Measure,
    on_progress: Callable[[float], None] = lambda _: None,
) -> Built:
    """Describe every training frame by landmarks that are chosen, and learn from a second season where there is one.

    Args:
        second: Another drive, perhaps of the same route.
        model: The evaluator's landmark model.
        measure: Measures a drive's dissimilarities to a model's landmarks.

    Raises:
        InvalidMapConfigError: No image, or h not within 1..r.
        InvalidRouteError: The positions go backwards or are NaN.
    """
    own = measure(training, model)
    on_progress(0.4)
    season = verdict = None
    other: Drive | None = None
    if second is not None:
        season, other, verdict = second_season(
            own, plan.closed, second, plan.same_route, lambda drive: measure(drive, model)
        )
    on_progress(0.7)
    map_ = build_map(plan.relevance, own, plan.list_length, plan.closed)
    map_ = replace(map_, landmark_model=model, actions_m=np.array(sorted(plan.actions_m)))
    dissimilarities = measured_dissimilarities(own)
    if plan.relevance is Relevance.STANDARDISED:
        map_ = replace(map_, **rehearsed(map_, dissimilarities, season))
    told = own_views(map_, dissimilarities)
    if plan.relevance is Relevance.STANDARDISED:
        map_ = replace(map_, view_bits=view_bits(map_, told, map_, season))
    if season is not None and other is not None and plan.relevance is Relevance.BRUTE_FORCE:
        season = replace(season, encodings=other.encodings)
    map_ = replace(map_, coverage=placed_rightly(map_, told, season))
    on_progress(1.0)
    return Built(map_, map_, own, other, verdict)


@dataclass(frozen=True)
class SeenTwice:
    """Places of one route that a camera saw in two seasons."""

    first: Drive
    second: Drive
    places: NDArray[np.int64]  # [k, 2] frames of the first and the second


@dataclass(frozen=True)
class _Space:
    """Where unit encodings are compared, and the landmarks there."""

    projection: NDArray[np.float32] | None  # [d, k]
    prototypes: NDArray[np.float32]  # [r, k]
    chosen: NDArray[np.int64] | None = None  # [r] which candidates they were; None: they stay those of another map

    @classmethod
    def first(
        cls,
        training: Drive,
        candidates: Drive | Mapping[str, NDArray[Any]],
        n_landmarks: int,
        halves: Sequence[int],
        on_progress: Callable[[float], None],
    ) -> Self:
        """Before seasons are known: with landmarks chosen from a drive, or those of another map's model."""
        if isinstance(candidates, Drive):
            drives = {id(drive): drive.encodings for drive in (training, candidates)}
            directions = principal_directions(*drives.values(), halves=halves, on_progress=on_progress)
            return cls.among(candidates, directions, n_landmarks)
        if (d := candidates["usual"].shape[1]) != training.encoding_dim:
            raise InvalidEncodingError(
                f"encodings of {training.encoding_dim} numbers cannot be compared with landmarks of {d}"
            )
        return cls(candidates.get("projection"), np.asarray(candidates["prototypes"], np.float32))

    @classmethod
    def among(cls, candidates: Drive, projection: NDArray[np.float32] | None, n_landmarks: int) -> Self:
        """With landmarks chosen from a drive."""
        u = _unit_vectors(candidates, projection)
        chosen = farthest_first(u, n_landmarks)
        return cls(projection, u[chosen], chosen)

    def fitted(self, places: NDArray[np.float32], list_length: int, barred: NDArray[np.bool_] | None) -> Self:
        """Landmarks moved to where sums of them come nearer to places [n, k]."""
        return replace(self, prototypes=learnt_landmarks(places, self.prototypes, list_length, barred))

    def described_in(self, map_: Map, places: NDArray[np.float32], barred: NDArray[np.bool_] | None) -> Map:
        """The map with lists of other places [n, k], and of these landmarks."""
        lists = compose(places, self.prototypes, map_.list_length, barred)
        return replace(map_, lists=lists, landmark_model={**map_.landmark_model, "prototypes": self.prototypes})

    def model(self, usual: Moments) -> dict[str, NDArray[Any]]:
        """As a robot needs it: the landmarks, and what makes an encoding a unit vector."""
        arrays: dict[str, NDArray[Any]] = {"prototypes": self.prototypes, "usual": usual.mean_std()}
        return arrays if self.projection is None else {**arrays, "projection": self.projection}

    def unit_vectors(self, drive: Drive) -> NDArray[np.float32]:
        """[n, k] of a drive's frames, by its own statistics."""
        return _unit_vectors(drive, self.projection)

    def seen(self, drive: Drive) -> Drive:
        """The drive with its dissimilarities: squared distances between unit vectors."""
        return replace(drive, dissimilarities=self.dissimilarities(self.unit_vectors(drive)))

    def dissimilarities(self, u: NDArray[np.float32]) -> NDArray[np.float32]:
        """[n, r] squared distances of unit vectors to the landmarks."""
        return np.asarray(np.clip(2 - 2 * (u @ self.prototypes.T), 0, 4), np.float32)

    def whitened(self, seasons: Sequence["SeenTwice"], candidates: Drive) -> Self:
        """What a season changes counting less, landmarks chosen anew."""
        firsts = [self.unit_vectors(seen.first)[seen.places[:, 0]] for seen in seasons]
        seconds = [self.unit_vectors(seen.second)[seen.places[:, 1]] for seen in seasons]
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
    """The same for `composed`, which chooses its landmarks where it describes: among unit encodings.

    Args:
        second: Another drive, perhaps of the same route.
        landmarks: The drive that they are chosen from (the same object as `second` where it is that one: a rehearsal
            then leaves a place's own landmark out), the model in which they stay, or None: the training drive.
        n_landmarks: r.
        camera: What it saw twice on other routes: what a season changes is learnt from that where this route was
            not seen twice, and landmarks are chosen here.
        halves: See `principal_directions`.

    Raises:
        TooFewCandidatesError: That drive has fewer frames.
        InvalidEncodingError: The model is of other encodings.
    """
    candidates = training if landmarks is None else landmarks
    space = _Space.first(training, candidates, n_landmarks, halves, lambda share: on_progress(0.6 * share))
    check_list_length(plan.list_length, len(space.prototypes))
    on_progress(0.7)
    own, season, verdict = space.seen(training), None, None
    other: Drive | None = None
    if second is not None:
        season, other, verdict = second_season(own, plan.closed, second, plan.same_route, space.seen)
    on_progress(0.75)
    seen_twice, by_camera = camera, bool(camera)
    if season is not None and other is not None and covers(training.position_m, season.places[:, 0]):
        seen_twice, by_camera = (SeenTwice(training, other, season.places),), False
    if seen_twice and isinstance(candidates, Drive):
        space = space.whitened(seen_twice, candidates)
    on_progress(0.85)
    usual, places = Moments.of(training.encodings), space.unit_vectors(training)
    fused = places
    if season is not None and other is not None:
        usual, fused = Moments.of(training.encodings, other.encodings), places.copy()
        images, frames = season.places.T
        fused[images] = unit(places[images] + SECOND_SEASON_WEIGHT * space.unit_vectors(other)[frames])
    seen_from = space.chosen if candidates is training else None
    if candidates is second and season is not None and space.chosen is not None:
        seen_from = _images_of(season.places, space.chosen)
    own_places = None if seen_from is None else _own_places(own.route(plan.closed), seen_from)
    barred, as_chosen = own_places if plan.bars_own_place else None, space
    if isinstance(candidates, Drive):
        space = space.fitted(fused, plan.list_length, barred)
        own, other = space.seen(training), None if other is None else space.seen(other)
    # Landmarks may stay; what is usual is of this map, for robots that encode on board as here
    model = space.model(usual) if isinstance(candidates, Drive) else {**candidates, "usual": usual.mean_std()}
    map_ = composed_map(plan, own, fused, usual, model, barred)
    rehearsal, seen_before = map_, measured_dissimilarities(own)
    if season is not None and second is not None:
        # By landmarks as they were chosen: moved to what both seasons saw, they would know the second one
        rehearsal = as_chosen.described_in(map_, places, own_places if candidates is second else barred)
        seen_before = as_chosen.dissimilarities(places)
        season = SecondSeason(as_chosen.dissimilarities(as_chosen.unit_vectors(second)), season.places)
    on_progress(0.92)
    known = (training,) if other is None else (training, other)
    map_, rehearsal = taught(map_, rehearsal, seen_before, space.dissimilarities(fused), season, known)
    if isinstance(candidates, Drive) and space.chosen is not None:
        map_ = replace(map_, **candidates.landmark_origins(space.chosen))
    on_progress(1.0)
    return Built(map_, rehearsal, own, other, verdict, fused, as_chosen.prototypes, by_camera)


def taught(
    map_: Map,
    rehearsal: Map,
    own: NDArray[np.float32],
    places: NDArray[np.float32],
    season: SecondSeason | None,
    drives: Sequence[Drive],
) -> tuple[Map, Map]:
    """A `composed` map and its rehearsal with what a further season, or the map itself, tells of views to come.

    Args:
        own, places: [n, r] dissimilarities of the map images to the rehearsal's landmarks, and of what the map's lists
            stand for to the map's.
        season: Measured by the rehearsal's landmarks.
        drives: Every season of the route.
    """
    learnt = rehearsed(rehearsal, own, season)
    map_, rehearsal = replace(map_, **learnt), replace(rehearsal, **learnt)
    told = own_views(map_, places)
    first, *others = (drive.encodings for drive in drives)
    strangest = max([most_strange(first), *(most_strange(first, other) for other in others)])
    learnt = {
        "view_bits": view_bits(map_, told, rehearsal, season),
        "coverage": placed_rightly(rehearsal, told, season),
        "most_strange": np.array([strangest]),
    }
    return replace(map_, **learnt), replace(rehearsal, **learnt)


def composed_map(
    plan: MapPlan,
    own: Drive,
    places: NDArray[np.float32],
    usual: Moments,
    model: Mapping[str, NDArray[Any]],
    barred: NDArray[np.bool_] | None = None,
) -> Map:
    """The map of places [n, k] that were seen as `own`, but for what a rehearsal teaches."""
    prototypes = np.asarray(model["prototypes"], np.float32)
    dissimilarities, route = measured_dissimilarities(own), own.route(plan.closed)
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
        usual_encoding=usual.mean_std(),
        usual_product=Moments.of((1 - dissimilarities / 2).astype(np.float32)).mean_std(),
    )


def measured_dissimilarities(drive: Drive) -> NDArray[np.float32]:
    """[n, r] of a drive; raises InvalidMapConfigError where they are not measured."""
    if drive.dissimilarities is None:
        raise InvalidMapConfigError("the drive's dissimilarities are not measured")
    return drive.dissimilarities


def covers(position_m: NDArray[np.float64], images: NDArray[np.int64]) -> bool:
    """Whether images that were seen in two seasons are enough, and spread over the route at `position_m`."""
    at_m = position_m[images]
    spread = np.ptp(at_m) >= _SPREAD_OVER * np.ptp(position_m) if at_m.size else False
    return bool(at_m.size >= LEAST_SHARED_PLACES and spread)


def _images_of(places: NDArray[np.int64], frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """The map image at the place of each of another drive's frames, by pairs of (map image, frame); -1: none."""
    image_of = np.full(max(int(places[:, 1].max()), int(frames.max())) + 1, -1)
    image_of[places[:, 1]] = places[:, 0]
    return image_of[frames]


def _own_places(route: Route, seen_from: NDArray[np.int64]) -> NDArray[np.bool_]:
    """[n, r] which landmarks were seen from an image's own place, by the image at each one's place, -1: none."""
    apart_m = np.abs(route.offset_m(route.position_m[:, np.newaxis], route.position_m[seen_from]))
    return np.asarray((apart_m <= _OWN_PLACE_M) & (seen_from >= 0))


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
    """Describe every image of a measured drive by the h landmarks that any relevance but `composed` keeps.

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
        own = LandmarkStatistics.of_map(ranks)
        scores = own.standardise(ranks)
        arrays["statistics"] = np.stack([own.mean, own.std])
        arrays["loadings"] = common_factors(scores)
        lists = nearest_landmarks(scores, list_length)
    else:
        lists = nearest_landmarks(ranks, list_length)
    if relevance is Relevance.SIMBAD:
        arrays["values"] = listed(dissimilarities, lists)
    route = drive.route(closed)
    return Map(
        config={"relevance": relevance.value, "n_landmarks": n_landmarks},
        closed=closed,
        position_m=route.position_m,
        x_m=route.x_m,
        y_m=route.y_m,
        lists=lists,
        encodings=drive.encodings if relevance is Relevance.BRUTE_FORCE else None,
        **arrays,
    )


def listed(dissimilarities: NDArray[np.float32], lists: NDArray[np.uint16]) -> NDArray[np.float32]:
    """[h, n] the dissimilarities [n, r] of listed landmarks [h, n]."""
    return np.ascontiguousarray(np.take_along_axis(dissimilarities, lists.T.astype(np.intp), axis=1).T, np.float32)
