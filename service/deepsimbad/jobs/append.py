"""A drive appended to a map of its route: its frames become images, or places seen again the mean of their seasons.

Seasons are fused in `composed` maps, made anew at the same bits from the drives that they are made of, which must still
be stored: images and the candidates that are landmarks stay, what a season changes is learnt from all seasons, and so
are the lists. What the map lacks becomes images of its own.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.building import (
    MapPlan,
    SeenTwice,
    composed_map,
    covers,
    listed_values,
    measured_dissimilarities,
    taught,
)
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
from deepsimbad.core.descriptor import LandmarkStatistics, nearest_landmarks, rank_landmarks
from deepsimbad.core.drive import Drive, SameRoute, SecondSeason, second_season
from deepsimbad.core.experience.nnql import NnqlConfig
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Relevance
from deepsimbad.core.route import same_places
from deepsimbad.errors import InvalidEncodingError, InvalidMapConfigError, NoActiveMapError, WeightsDifferError
from deepsimbad.jobs.check import traverses_in
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import DomainRecord, MapRecord
from deepsimbad.store.traverses import Traverse

LANDMARK_TRAVERSE, ACTIVE_MAP, TRAINING = "landmark_traverse", "active_map", "training_traverse"
"""Where a map's landmarks come from, as its `metrics.landmarks` says."""


def refuse_known_traverse(active: MapRecord, name: str) -> None:
    """Refuse to append a traverse that a map holds by name, though it may hold other frames by now.

    What is fused into places is held as images are: counted twice it would be taken for a season that is no other,
    and views trusted many times too far.

    Raises InvalidMapConfigError: the map is made of a traverse of that name.
    """
    version, is_fused = active.version, active.config.get("relevance") == Relevance.COMPOSED
    if name in traverses_in(active.config) or (is_fused and name in seasons_in(active.config, active.metrics)):
        raise InvalidMapConfigError(
            f"map {version}, which serves, holds traverse {name} already: nothing is appended twice. Append another "
            "drive (a new one needs a name of its own), or activate a map without this one first",
            traverse=name,
            map_version=version,
        )


def seasons_in(config: Mapping[str, Any], metrics: Mapping[str, Any]) -> dict[str | None, bool]:
    """The traverses that a map is made of, by its configuration and metrics in the catalog; None: of another server.

    The first is the training traverse; whether each sees the same at one place as that one.
    """
    names = {config["training_traverse"]: True}
    second = metrics.get("second_season") or {}
    if second.get("accepted"):
        names[second.get("traverse", config["landmark_traverse"])] = True
    return names | {added["traverse"]: added.get("fused", False) for added in config.get("appended", ())}


@dataclass(frozen=True)
class KnownDrives:
    """The drives that a map is made of."""

    seasons: tuple[Drive, ...]  # whose frames are images, or fused into them; the first is the training traverse
    agree: NDArray[np.bool_]  # which of them see the same at one place as the first
    source: NDArray[np.int64]  # [n, 2] of every image, which of them and which frame of it
    candidates: Drive | None  # that landmarks were chosen from; None: unknown
    halves: tuple[int, ...] = ()  # see `principal_directions`

    @classmethod
    def of(cls, map_: Map, seasons: Sequence[tuple[Drive, bool]], candidates: Drive | None) -> Self | None:
        """By the digests of the frames; None where some image's frame is in none of them."""
        if map_.frame_digest is None:
            return None
        places = {
            digest: (number, frame)
            for number, (drive, _) in enumerate(seasons)
            for frame, digest in enumerate(drive.digests().tolist())
        }
        source = [places.get(digest, (-1, -1)) for digest in map_.frame_digest.tolist()]
        found = np.array(source, np.int64).reshape(-1, 2)
        drives, agree = zip(*seasons, strict=True)
        return None if (found < 0).any() else cls(drives, np.array(agree), found, candidates)

    def fusable(self, places: NDArray[np.int64], number: int | None = None) -> NDArray[np.int64]:
        """Those pairs (map image, frame) whose image is not of the same season, `number`, and agrees with it."""
        season = self.source[places[:, 0], 0]
        is_fusable = self.agree[season] & (number is None or self.agree[number]) & (season != number)
        return np.asarray(places[is_fusable], np.int64)

    def basis(self, map_: Map) -> tuple[NDArray[np.float32] | None, NDArray[np.float64] | None]:
        """What encodings were projected by before a season's changes counted less, and by what they count less.

        Returns:
            [d, k], None where d = k; and P [k, k], None where the two cannot be told apart any more.
        """
        whole = map_.landmark_model.get("projection")
        drives = {id(drive): drive.encodings for drive in (self.seasons[0], self.candidates) if drive is not None}
        directions = principal_directions(*drives.values(), halves=self.halves)
        if directions is None or whole is None:
            k = self.seasons[0].encoding_dim
            return None, np.eye(k) if whole is None else np.asarray(whole, np.float64)
        whitening = np.linalg.lstsq(directions.astype(np.float64), np.asarray(whole, np.float64), rcond=None)[0]
        is_whole = np.allclose(directions @ whitening, whole, atol=1e-3 * float(np.abs(whole).max()))
        return (directions, whitening) if is_whole else (whole, None)


def known_drives(
    catalog: Catalog, domain: DomainRecord, map_: Map, drive: Drive, read: Callable[[str], Drive]
) -> KnownDrives | str:
    """What a domain's active map is made of, as far as it is still stored; else in a sentence why nothing can be fused.

    Args:
        drive: The one that is to be fused.
        read: Reads a traverse of the domain.
    """
    active = catalog.map(domain.name, domain.active_version or 0)
    if map_.relevance is not Relevance.COMPOSED:
        return f"places are fused in maps for composed alone, and this one is for {map_.relevance}"
    names, landmarks = seasons_in(active.config, active.metrics), active.config["landmark_traverse"]
    stored = Traverse.list(catalog.data_dir, domain.name)
    if gone := [name for name in names if name not in stored]:
        return f"of the drives that the map is made of {gone[0] or 'those of another server'} are not stored here"
    drives = [(read(name), agrees) for name, agrees in names.items() if name is not None]
    if any(known.encoding_dim != drive.encoding_dim for known, _ in drives):
        return "the drives that the map is made of come from another encoder by now"
    candidates = drives[0][0] if active.metrics.get("landmarks") == TRAINING else None
    if active.metrics.get("landmarks") == LANDMARK_TRAVERSE and landmarks in stored:
        candidates = read(landmarks)
    return KnownDrives.of(map_, drives, candidates) or "the drives that the map is made of hold other frames by now"


@dataclass(frozen=True)
class Fused:
    """A map with one drive more, and what it is checked by."""

    map: Map
    base: Map  # before new images
    drive: Drive
    new: NDArray[np.int64]  # frames that became images
    landmarks: NDArray[np.float32]  # [r, k] before they were moved to what the drive saw
    before: NDArray[np.float32]  # [n, k] sums over the earlier seasons
    u: NDArray[np.float32]  # [m, k] of the drive
    pairs: NDArray[np.int64]  # [p, 2] (map image, frame)

    def without(self, withheld: NDArray[np.int64]) -> Map:
        """The same map, had the drive's withheld frames not been fused."""
        others = self.pairs[~np.isin(self.pairs[:, 1], withheld)]
        places = unit(self.before + _season(self.u, others, self.base.n_images))
        learnt = learnt_landmarks(places, self.landmarks, self.base.list_length)
        base = replace(self.base, landmark_model={**self.base.landmark_model, "prototypes": learnt})
        return _with_new(
            replace(base, lists=_lists(base, places)), self.drive, self.new, _lists(base, self.u[self.new])
        )


def fuse(map_: Map, known: KnownDrives, drive: Drive, same_route: bool | None) -> tuple[Fused | None, SameRoute]:
    """The map with a drive fused into it, None where that is not of the same route; and the verdict.

    Args:
        map_: A `composed` map.
        same_route: False: it is said not to be; else its positions count along the map's route, and views decide.
    """
    basis, whitening = known.basis(map_)
    seasons = (*known.seasons, drive)
    rows = [described(season.encodings, Moments.of(season.encodings), basis) for season in seasons]
    own_rows = np.stack([rows[season][frame] for season, frame in known.source.tolist()])
    prototypes = np.asarray(map_.landmark_model["prototypes"], np.float32)
    unknown = np.full(map_.n_images, np.nan)
    own = Drive(
        position_m=map_.position_m,
        x_m=unknown if map_.x_m is None else map_.x_m,
        y_m=unknown if map_.y_m is None else map_.y_m,
        encodings=own_rows,
        dissimilarities=_dissimilarities(own_rows, whitening, prototypes),
    )
    seen_now = replace(drive, dissimilarities=_dissimilarities(rows[-1], whitening, prototypes))
    is_same = same_route is not False
    season, _, verdict = second_season(own, map_.closed, drive, is_same, lambda _: seen_now)
    if season is None:
        return None, verdict

    pairs = [
        known.fusable(same_places(earlier.route(), map_.route), number) for number, earlier in enumerate(known.seasons)
    ]
    pairs.append(known.fusable(season.places))
    if not pairs[-1].size:
        return None, replace(
            verdict, accepted=False, why="all that it saw again are images of drives that agree with none"
        )
    plan = MapPlan(Relevance.COMPOSED, map_.list_length, tuple(map_.actions_m.tolist()), map_.closed, is_same)
    if whitening is not None and covers(map_.position_m, np.concatenate(pairs)[:, 0]):
        seen_rows = np.concatenate([row[places[:, 1]] for row, places in zip(rows, pairs, strict=True)])
        learnt = within_place_whitening(seen_rows, own_rows[np.concatenate(pairs)[:, 0]])
        prototypes = unit(prototypes @ np.linalg.solve(whitening, learnt.astype(np.float64)))
        whitening = learnt.astype(np.float64)
        projection: NDArray[np.float32] | None = np.asarray(learnt if basis is None else basis @ learnt, np.float32)
    else:
        projection = map_.landmark_model.get("projection")

    u = [_units(row, whitening) for row in rows]
    before = _units(own_rows, whitening)
    for units, shared in zip(u[:-1], pairs[:-1], strict=True):
        before = before + _season(units, shared, map_.n_images)
    places = unit(before + _season(u[-1], pairs[-1], map_.n_images))
    before_it, prototypes = prototypes, learnt_landmarks(places, prototypes, map_.list_length)
    usual = Moments.of(*(other.encodings for other in seasons))
    model = {**map_.landmark_model, "prototypes": prototypes, "usual": usual.mean_std()}
    model |= {} if projection is None else {"projection": projection}
    own = replace(own, dissimilarities=_dissimilarities(own_rows, whitening, prototypes))
    made = composed_map(plan, own, places, usual, model)
    rehearsal = replace(made, landmark_model={**model, "prototypes": before_it})
    rehearsal = replace(rehearsal, lists=_lists(rehearsal, unit(before)))
    own_before, seen_before = (_dissimilarities(row, whitening, before_it) for row in (own_rows, rows[-1]))
    season = SecondSeason(seen_before, pairs[-1])
    made, _ = taught(made, rehearsal, own_before, _dissimilarities(places, None, prototypes), season, seasons)
    arrays: dict[str, Any] = dict(made.arrays())
    base = replace(map_, landmark_model=model, **arrays)
    new = np.setdiff1d(np.arange(drive.n_frames), pairs[-1][:, 1])
    longer = _with_new(base, drive, new, _lists(base, u[-1][new]))
    return Fused(longer, base, drive, new, before_it, before, u[-1], pairs[-1]), verdict


def _units(rows: NDArray[np.float32], whitening: NDArray[np.float64] | None) -> NDArray[np.float32]:
    return rows if whitening is None else unit(rows @ whitening.astype(np.float32))


def _dissimilarities(
    rows: NDArray[np.float32], whitening: NDArray[np.float64] | None, prototypes: NDArray[np.float32]
) -> NDArray[np.float32]:
    return np.asarray(np.clip(2 - 2 * _units(rows, whitening) @ prototypes.T, 0, 4), np.float32)


def _season(u: NDArray[np.float32], places: NDArray[np.int64], n_images: int) -> NDArray[np.float32]:
    """[n, k] what a season adds to every place: the direction of its frames there, weighted."""
    seen = np.zeros((n_images, u.shape[1]), np.float32)
    np.add.at(seen, places[:, 0], u[places[:, 1]])
    return np.asarray(SECOND_SEASON_WEIGHT * unit(seen), np.float32)


def _lists(map_: Map, places: NDArray[np.float32]) -> NDArray[np.uint16]:
    return compose(places, np.asarray(map_.landmark_model["prototypes"], np.float32), map_.list_length)


def _with_new(map_: Map, drive: Drive, new: NDArray[np.int64], lists: NDArray[np.uint16]) -> Map:
    return with_frames(map_, drive.at(new), lists) if new.size else map_


def append_drive(map_: Map, drive: Drive) -> Map:
    """Describe new frames by a map's landmarks and merge them into it by route position.

    The new frames' lists come from their own drive's statistics, as those of any map do. A short drive says little of
    what is usual for a landmark (one frame: nothing), so its statistics begin as the map's, weighted as for a live
    session, and soon are its own. The map's statistics become those of all its images; what only two seasons of one
    place can teach stays.

    Args:
        drive: The new frames, their dissimilarities to its landmarks measured; along the same route, on a closed one
            any turn of it.

    Returns:
        The longer map; of images at one position the old come first.

    Raises:
        InvalidRouteError: The new frames go backwards.
    """
    usual, ranks_of_frames = map_.live_statistics, rank_landmarks(measured_dissimilarities(drive))
    scores: NDArray[np.floating] = ranks_of_frames
    pooled: dict[str, Any] = {}
    if usual is not None:
        own = LandmarkStatistics.of_map(ranks_of_frames)
        scores = usual.ranks.pooled(usual.ranks.weight, own, drive.n_frames).standardise(ranks_of_frames)
        ranks = usual.ranks.pooled(map_.n_images, own, drive.n_frames)
        pooled["statistics"] = np.stack([ranks.mean, ranks.std])
    if usual is not None and usual.encodings is not None:
        own_encodings, model = Moments.counted(drive.encodings), map_.landmark_model
        soon_own = usual.encodings.pooled(usual.encodings.weight, own_encodings, drive.n_frames)
        u = described(drive.encodings, soon_own, model.get("projection"))
        lists = compose(u, model["prototypes"], map_.list_length)
        of_all = usual.encodings.pooled(map_.n_images, own_encodings, drive.n_frames).mean_std()
        pooled |= {"usual_encoding": of_all, "landmark_model": {**model, "usual": of_all}}
        if usual.products is not None:
            own_products = Moments.counted(u @ np.asarray(model["prototypes"], np.float32).T)
            pooled["usual_product"] = usual.products.pooled(map_.n_images, own_products, drive.n_frames).mean_std()
    else:
        lists = nearest_landmarks(scores, map_.list_length)
    return replace(with_frames(map_, drive, lists), **pooled)


def with_frames(map_: Map, drive: Drive, lists: NDArray[np.uint16]) -> Map:
    """With frames of known lists [h, m] among the images; each knows of its place what the nearest old one does."""
    route = drive.route(map_.closed)
    nearest, is_near = nearest_known(map_, route.position_m)
    q_values, bits = map_.q_values, map_.view_bits
    if q_values is not None:
        q_values = np.where(is_near[:, np.newaxis], q_values[nearest], np.float32(NnqlConfig().initial_q))
    if bits is not None:
        bits = np.where(is_near, bits[nearest], bits.mean(dtype=np.float32))
    chance = None if map_.coverage is None else np.where(is_near, map_.coverage[nearest], np.float32(np.nan))
    return map_.with_images(
        {
            "lists": lists,
            "position_m": _on_route(map_, route.position_m),
            "values": None if map_.values is None else listed_values(measured_dissimilarities(drive), lists),
            "encodings": None if map_.encodings is None else drive.encodings,
            "view_bits": bits,
            "coverage": chance,
            **drive.origins(),
            "x_m": route.x_m,
            "y_m": route.y_m,
            "q_values": q_values,
        }
    )


def nearest_known(map_: Map, position_m: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The map image nearest to each position [m], and whether it is within the longest move."""
    route, placed_m = map_.route, _on_route(map_, position_m)
    nearest = route.nearest_image(placed_m)
    apart_m = np.abs(route.offset_m(placed_m - route.position_m[nearest], 0.0))
    return nearest, apart_m <= map_.longest_action_m


def _on_route(map_: Map, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions as the route counts them; only what lies outside a closed one's first turn is turned."""
    route = map_.route
    ahead_m = position_m - route.start_m
    inside = (ahead_m >= 0) & (ahead_m < route.length_m)
    return np.where(inside, position_m, route.wrapped(position_m))


def camera_domain(catalog: Catalog, camera_of: str, domain: DomainRecord) -> DomainRecord:
    """The other domain that a camera is told to be of.

    Raises:
        UnknownDomainError: There is none such.
        InvalidMapConfigError: It is the domain itself, or has another evaluator.
    """
    other = catalog.domain(camera_of)
    if other.name == domain.name:
        raise InvalidMapConfigError(f"camera_of names domain {camera_of} itself: name one of another route")
    if other.evaluator != domain.evaluator:
        raise InvalidMapConfigError(
            f"domain {camera_of} has another evaluator than {domain.name}: what it learnt says nothing here",
            evaluator=other.evaluator,
        )
    return other


def seen_twice(catalog: Catalog, camera_of: str, domain: DomainRecord, training: Drive) -> tuple[SeenTwice, ...]:
    """What the camera of another domain saw twice there, for a map whose own route it saw in one season.

    Every further season of that domain's active map beside its first, from the drives that it is made of.

    Args:
        camera_of: The other domain.
        domain, training: Whose map is made, and from which drive.

    Raises:
        UnknownDomainError, NoActiveMapError: There is no such domain or map.
        InvalidMapConfigError: It cannot serve (`camera_domain`), learnt from no second season, or a drive is gone.
        InvalidEncodingError, WeightsDifferError: Its encodings are others.
    """
    other = camera_domain(catalog, camera_of, domain)
    if other.active_version is None:
        raise NoActiveMapError(f"domain {camera_of}, which camera_of names, has no active map", domain=camera_of)
    active = catalog.map(camera_of, other.active_version)
    names = [name or "?" for name, agrees in seasons_in(active.config, active.metrics).items() if agrees]
    its_map = f"map {active.version} of domain {camera_of}"
    if len(names) < 2:
        raise InvalidMapConfigError(f"{its_map} knows no second season: map it from two drives of its route first")
    stored = Traverse.list(catalog.data_dir, camera_of)
    if gone := [name for name in names if name not in stored]:
        raise InvalidMapConfigError(
            f"{its_map} is made of traverse {gone[0]}, which is not in this data directory: map it anew here first"
        )
    drives = []
    for name in names:
        with Traverse.open(catalog.data_dir, camera_of, name) as traverse:
            drives.append(traverse.read())
        what = f"traverse {name} of domain {camera_of}"
        if drives[-1].encoding_dim != training.encoding_dim:
            raise InvalidEncodingError(
                f"{what} holds encodings of {drives[-1].encoding_dim} numbers, not of {training.encoding_dim}"
            )
        WeightsDifferError.check(what, drives[-1].weights_sha256, training.name, training.weights_sha256)
    first, *seasons = drives
    route = first.route(other.closed)
    seen = [SeenTwice(first, season, same_places(season.route(), route)) for season in seasons]
    if not any(covers(route.position_m, twice.places[:, 0]) for twice in seen):
        raise InvalidMapConfigError(
            f"{its_map} knows too few places in two seasons: {LEAST_SHARED_PLACES} over half of the route are the least"
        )
    return tuple(seen)
