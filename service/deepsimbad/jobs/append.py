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
    Moments,
    compose,
    described,
    learnt_landmarks,
    principal_directions,
    season_seen,
    unit,
    within_place_whitening,
)
from deepsimbad.core.descriptor import LandmarkStatistics, nearest_landmarks, rank_landmarks
from deepsimbad.core.drive import Drive, SameRoute, SecondSeason, judge, second_season
from deepsimbad.core.experience.nnql import NnqlConfig
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Relevance
from deepsimbad.core.route import same_places
from deepsimbad.errors import InvalidEncodingError, InvalidMapConfigError, NoActiveMapError, WeightsDifferError
from deepsimbad.evaluators.space import as_usual
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
    """The traverses that a map is made of, by its configuration and metrics in the catalog, training traverse first.

    Returns:
        Name (None: a traverse of another server) -> whether it sees the same at one place as the training traverse.
    """
    names = {config["training_traverse"]: True}
    verdict = metrics.get("second_season") or {}
    if verdict.get("accepted"):
        names[verdict.get("traverse", config["landmark_traverse"])] = True
    return names | {entry["traverse"]: entry.get("fused", False) for entry in config.get("appended", ())}


@dataclass(frozen=True)
class KnownDrives:
    """The drives that a map is made of."""

    seasons: tuple[Drive, ...]  # whose frames are images, or fused into them; the first is the training traverse
    agree: NDArray[np.bool_]  # which of them see the same at one place as the first
    source: NDArray[np.int64]  # [n, 2] (season, frame of it) of every map image
    candidates: Drive | None  # the drive that landmarks were chosen from; None: unknown
    halves: tuple[int, ...] = ()  # see `principal_directions`

    @classmethod
    def of(cls, map_: Map, seasons: Sequence[tuple[Drive, bool]], candidates: Drive | None) -> Self | None:
        """Find every map image's frame by its digest; None where one is in none of the drives."""
        if map_.frame_digest is None:
            return None
        places = {
            digest: (number, frame)
            for number, (drive, _) in enumerate(seasons)
            for frame, digest in enumerate(drive.digests().tolist())
        }
        sources = [places.get(digest, (-1, -1)) for digest in map_.frame_digest.tolist()]
        source_array = np.array(sources, np.int64).reshape(-1, 2)
        drives, agree = zip(*seasons, strict=True)
        return None if (source_array < 0).any() else cls(drives, np.array(agree), source_array, candidates)

    def fusable(self, places: NDArray[np.int64], number: int | None = None) -> NDArray[np.int64]:
        """Of the pairs (map image, frame) of season `number` (None: a new one), those whose image agrees with it.

        An image of that season itself has nothing to fuse.
        """
        season = self.source[places[:, 0], 0]
        is_fusable = self.agree[season] & (number is None or self.agree[number]) & (season != number)
        return np.asarray(places[is_fusable], np.int64)

    def agreeing(self, places: NDArray[np.int64], agrees: Callable[[NDArray[np.int64]], bool]) -> Self:
        """With what a new drive, which agrees, tells of seasons that did not, as those that had shared too few places.

        Args:
            places: [k, 2] pairs (map image, frame of the new drive).
            agrees: Whether the new drive sees the same as the images of some of the pairs.
        """
        agree, season = self.agree.copy(), self.source[places[:, 0], 0]
        for number in np.flatnonzero(~agree):
            agree[number] = agrees(places[season == number])
        return replace(self, agree=agree)

    def basis(self, map_: Map) -> tuple[NDArray[np.float32] | None, NDArray[np.float64] | None]:
        """Split a map's projection into what came before a season's changes counted less, and what lets them.

        Returns:
            [d, k] principal directions, None where d = k; and P [k, k], None where the two cannot be told apart.
        """
        projection = map_.landmark_model.get("projection")
        drives = {id(drive): drive.encodings for drive in (self.seasons[0], self.candidates) if drive is not None}
        directions = principal_directions(*drives.values(), halves=self.halves)
        if directions is None or projection is None:
            k = self.seasons[0].encoding_dim
            return None, np.eye(k) if projection is None else np.asarray(projection, np.float64)
        whitening = np.linalg.lstsq(directions.astype(np.float64), np.asarray(projection, np.float64), rcond=None)[0]
        is_split = np.allclose(directions @ whitening, projection, atol=1e-3 * float(np.abs(projection).max()))
        return (directions, whitening) if is_split else (projection, None)


def known_drives(
    catalog: Catalog, domain: DomainRecord, map_: Map, drive: Drive, read: Callable[[str], Drive]
) -> KnownDrives | str:
    """The drives that a domain's active map is made of, or in a sentence why nothing can be fused into it.

    Args:
        drive: The drive that is to be fused.
        read: Reads a traverse of the domain.
    """
    record = catalog.map(domain.name, domain.active_version or 0)
    if not map_.relevance.traits.compares_unit_vectors:
        return f"places are fused in maps for composed alone, and this one is for {map_.relevance}"
    names, landmarks = seasons_in(record.config, record.metrics), record.config["landmark_traverse"]
    stored_names = Traverse.list(catalog.data_dir, domain.name)
    if missing_names := [name for name in names if name not in stored_names]:
        return (
            f"of the drives that the map is made of {missing_names[0] or 'those of another server'} are not stored here"
        )
    drives = [(read(name), agrees) for name, agrees in names.items() if name is not None]
    if any(season.encoding_dim != drive.encoding_dim for season, _ in drives):
        return "the drives that the map is made of come from another encoder by now"
    candidates = drives[0][0] if record.metrics.get("landmarks") == TRAINING else None
    if record.metrics.get("landmarks") == LANDMARK_TRAVERSE and landmarks in stored_names:
        candidates = read(landmarks)
    return KnownDrives.of(map_, drives, candidates) or "the drives that the map is made of hold other frames by now"


@dataclass(frozen=True)
class FusedMap:
    """A map with one drive more, and what `without` makes it anew from."""

    map: Map
    known_drives: KnownDrives  # of the map before
    base: Map  # before new images
    drive: Drive
    new_frames: NDArray[np.int64]  # frames that became images
    landmarks: NDArray[np.float32]  # [r, k] before they were moved to what the drive saw
    season_sums: NDArray[np.float32]  # [n, k] sums over the earlier seasons
    u: NDArray[np.float32]  # [m, k] of the drive
    pairs: NDArray[np.int64]  # [p, 2] (map image, frame)

    def without(self, withheld_frames: NDArray[np.int64]) -> Map:
        """The map as it would be without the drive's withheld frames."""
        pairs = self.pairs[~np.isin(self.pairs[:, 1], withheld_frames)]
        places = unit(self.season_sums + season_seen(self.u, pairs, self.base.n_images))
        landmarks = learnt_landmarks(places, self.landmarks, self.base.list_length)
        base = replace(self.base, landmark_model={**self.base.landmark_model, "prototypes": landmarks})
        return _with_new(
            replace(base, lists=_lists(base, places)),
            self.drive,
            self.new_frames,
            _lists(base, self.u[self.new_frames]),
        )


def fuse(
    map_: Map, known_drives: KnownDrives, drive: Drive, same_route: bool | None
) -> tuple[FusedMap | None, SameRoute]:
    """The map with a drive fused into it, None where that is not of the same route; and the verdict.

    Args:
        map_: A `composed` map.
        same_route: False: it is said not to be; else its positions count along the map's route, and views decide.
    """
    basis, whitening = known_drives.basis(map_)
    seasons = (*known_drives.seasons, drive)
    rows = [described(season.encodings, Moments.of(season.encodings), basis) for season in seasons]
    map_rows = np.stack([rows[season][frame] for season, frame in known_drives.source.tolist()])
    prototypes = np.asarray(map_.landmark_model["prototypes"], np.float32)
    unknown_m = np.full(map_.n_images, np.nan)
    of_images, of_drive = (_dissimilarities(row, whitening, prototypes) for row in (map_rows, rows[-1]))
    map_drive = Drive(
        position_m=map_.position_m,
        x_m=unknown_m if map_.x_m is None else map_.x_m,
        y_m=unknown_m if map_.y_m is None else map_.y_m,
        encodings=map_rows,
        dissimilarities=of_images,
    )
    measured_drive = replace(drive, dissimilarities=of_drive)
    is_same = same_route is not False
    season, _, verdict = second_season(map_drive, map_.closed, drive, is_same, lambda _: measured_drive)
    if season is None:
        return None, verdict

    known_drives = known_drives.agreeing(
        season.places, lambda places: judge(of_images, of_drive, places, map_.position_m).accepted
    )
    pairs = [
        known_drives.fusable(same_places(earlier_drive.route(), map_.route), number)
        for number, earlier_drive in enumerate(known_drives.seasons)
    ]
    pairs.append(known_drives.fusable(season.places))
    if not pairs[-1].size:
        return None, replace(
            verdict, accepted=False, why="all that it saw again are images of drives that agree with none"
        )
    plan = MapPlan(Relevance.COMPOSED, map_.list_length, tuple(map_.actions_m.tolist()), map_.closed, is_same)
    if whitening is not None and covers(map_.position_m, np.concatenate(pairs)[:, 0]):
        frame_rows = np.concatenate([row[places[:, 1]] for row, places in zip(rows, pairs, strict=True)])
        new_whitening = within_place_whitening(frame_rows, map_rows[np.concatenate(pairs)[:, 0]])
        prototypes = unit(prototypes @ np.linalg.solve(whitening, new_whitening.astype(np.float64)))
        whitening = new_whitening.astype(np.float64)
        projection: NDArray[np.float32] | None = np.asarray(
            new_whitening if basis is None else basis @ new_whitening, np.float32
        )
    else:
        projection = map_.landmark_model.get("projection")

    u = [_units(row, whitening) for row in rows]
    season_sums = _units(map_rows, whitening)
    for units, places_seen in zip(u[:-1], pairs[:-1], strict=True):
        season_sums = season_sums + season_seen(units, places_seen, map_.n_images)
    places = unit(season_sums + season_seen(u[-1], pairs[-1], map_.n_images))
    initial_landmarks, prototypes = prototypes, learnt_landmarks(places, prototypes, map_.list_length)
    moments = Moments.of(*(season_drive.encodings for season_drive in seasons))
    model = {**map_.landmark_model, "prototypes": prototypes, "usual": moments.mean_std()}
    model |= {} if projection is None else {"projection": projection}
    map_drive = replace(map_drive, dissimilarities=_dissimilarities(map_rows, whitening, prototypes))
    fused_map = composed_map(plan, map_drive, places, moments, model)
    rehearsal = replace(fused_map, landmark_model={**model, "prototypes": initial_landmarks})
    rehearsal = replace(rehearsal, lists=_lists(rehearsal, unit(season_sums)))
    map_dissimilarities, drive_dissimilarities = (
        _dissimilarities(row, whitening, initial_landmarks) for row in (map_rows, rows[-1])
    )
    season = SecondSeason(drive_dissimilarities, pairs[-1])
    fused_map, _ = taught(
        fused_map, rehearsal, map_dissimilarities, _dissimilarities(places, None, prototypes), season, seasons
    )
    arrays: dict[str, Any] = dict(fused_map.arrays())
    base = replace(map_, landmark_model=model, **arrays)
    new_frames = np.setdiff1d(np.arange(drive.n_frames), pairs[-1][:, 1])
    longer_map = _with_new(base, drive, new_frames, _lists(base, u[-1][new_frames]))
    return FusedMap(
        longer_map, known_drives, base, drive, new_frames, initial_landmarks, season_sums, u[-1], pairs[-1]
    ), verdict


def _units(rows: NDArray[np.float32], whitening: NDArray[np.float64] | None) -> NDArray[np.float32]:
    return rows if whitening is None else unit(rows @ whitening.astype(np.float32))


def _dissimilarities(
    rows: NDArray[np.float32], whitening: NDArray[np.float64] | None, prototypes: NDArray[np.float32]
) -> NDArray[np.float32]:
    return np.asarray(np.clip(2 - 2 * _units(rows, whitening) @ prototypes.T, 0, 4), np.float32)


def _lists(map_: Map, places: NDArray[np.float32]) -> NDArray[np.uint16]:
    return compose(places, np.asarray(map_.landmark_model["prototypes"], np.float32), map_.list_length)


def _with_new(map_: Map, drive: Drive, new_frames: NDArray[np.int64], lists: NDArray[np.uint16]) -> Map:
    return with_frames(map_, drive.at(new_frames), lists) if new_frames.size else map_


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
    map_statistics, ranks_of_frames = map_.live_statistics, rank_landmarks(measured_dissimilarities(drive))
    scores: NDArray[np.floating] = ranks_of_frames
    fields: dict[str, Any] = {}
    if map_statistics is not None:
        drive_ranks = LandmarkStatistics.of_map(ranks_of_frames)
        scores = map_statistics.ranks.pooled(map_statistics.ranks.weight, drive_ranks, drive.n_frames).standardise(
            ranks_of_frames
        )
        ranks = map_statistics.ranks.pooled(map_.n_images, drive_ranks, drive.n_frames)
        fields["statistics"] = np.stack([ranks.mean, ranks.std])
    if map_statistics is not None and map_statistics.encodings is not None:
        model = map_.landmark_model
        drive_moments = Moments.counted(as_usual(drive.encodings, model))  # a half that a frame lacks is the usual one
        moments = map_statistics.encodings.pooled(map_statistics.encodings.weight, drive_moments, drive.n_frames)
        u = described(drive.encodings, moments, model.get("projection"))
        lists = compose(u, model["prototypes"], map_.list_length)
        usual_encoding = map_statistics.encodings.pooled(map_.n_images, drive_moments, drive.n_frames).mean_std()
        fields |= {"usual_encoding": usual_encoding, "landmark_model": {**model, "usual": usual_encoding}}
        if map_statistics.products is not None:
            drive_products = Moments.counted(u @ np.asarray(model["prototypes"], np.float32).T)
            fields["usual_product"] = map_statistics.products.pooled(
                map_.n_images, drive_products, drive.n_frames
            ).mean_std()
    else:
        lists = nearest_landmarks(scores, map_.list_length)
    return replace(with_frames(map_, drive, lists), **fields)


def with_frames(map_: Map, drive: Drive, lists: NDArray[np.uint16]) -> Map:
    """The map with a drive's frames of lists [h, m] among its images; the nearest image gives all else they need."""
    route = drive.route(map_.closed)
    nearest_images, is_near = nearest_known(map_, route.position_m)
    q_values, bits = map_.q_values, map_.view_bits
    if q_values is not None:
        q_values = np.where(is_near[:, np.newaxis], q_values[nearest_images], np.float32(NnqlConfig().initial_q))
    if bits is not None:
        bits = np.where(is_near, bits[nearest_images], bits.mean(dtype=np.float32))
    chance = None if map_.coverage is None else np.where(is_near, map_.coverage[nearest_images], np.float32(np.nan))
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
    nearest_images = route.nearest_image(placed_m)
    apart_m = np.abs(route.offset_m(placed_m - route.position_m[nearest_images], 0.0))
    return nearest_images, apart_m <= map_.longest_action_m


def _on_route(map_: Map, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions [m] as the route counts them: those outside a closed route's first turn are wrapped into it."""
    route = map_.route
    ahead_m = position_m - route.start_m
    is_inside = (ahead_m >= 0) & (ahead_m < route.length_m)
    return np.where(is_inside, position_m, route.wrapped(position_m))


def camera_domain(catalog: Catalog, camera_of: str, domain: DomainRecord) -> DomainRecord:
    """The other domain that `camera_of` names.

    Raises:
        UnknownDomainError: There is no such domain.
        InvalidMapConfigError: It is the domain itself, or has another evaluator.
    """
    camera_record = catalog.domain(camera_of)
    if camera_record.name == domain.name:
        raise InvalidMapConfigError(f"camera_of names domain {camera_of} itself: name one of another route")
    if camera_record.evaluator != domain.evaluator:
        raise InvalidMapConfigError(
            f"domain {camera_of} has another evaluator than {domain.name}: what it learnt says nothing here",
            evaluator=camera_record.evaluator,
        )
    return camera_record


def camera_seasons(catalog: Catalog, camera_of: str, domain: DomainRecord, training: Drive) -> tuple[SeenTwice, ...]:
    """The seasons that the camera of another domain saw there, for a map whose own route it saw in one.

    They are those of that domain's active map, every one but the first beside the first.

    Args:
        camera_of: The other domain.
        domain: The domain whose map is made.
        training: The drive that it is made from.

    Raises:
        UnknownDomainError, NoActiveMapError: There is no such domain or map.
        InvalidMapConfigError: It cannot serve (`camera_domain`), learnt from no second season, or a drive is gone.
        InvalidEncodingError, WeightsDifferError: Its encodings are others.
    """
    other = camera_domain(catalog, camera_of, domain)
    if other.active_version is None:
        raise NoActiveMapError(f"domain {camera_of}, which camera_of names, has no active map", domain=camera_of)
    record = catalog.map(camera_of, other.active_version)
    names = [name or "?" for name, agrees in seasons_in(record.config, record.metrics).items() if agrees]
    its_map = f"map {record.version} of domain {camera_of}"
    if len(names) < 2:
        raise InvalidMapConfigError(f"{its_map} knows no second season: map it from two drives of its route first")
    stored_names = Traverse.list(catalog.data_dir, camera_of)
    if missing_names := [name for name in names if name not in stored_names]:
        raise InvalidMapConfigError(
            f"{its_map} is made of traverse {missing_names[0]}, which is not in this data directory: map it anew here "
            "first"
        )
    drives = []
    for name in names:
        with Traverse.open(catalog.data_dir, camera_of, name) as traverse:
            drives.append(traverse.read())
        label = f"traverse {name} of domain {camera_of}"
        if drives[-1].encoding_dim != training.encoding_dim:
            raise InvalidEncodingError(
                f"{label} holds encodings of {drives[-1].encoding_dim} numbers, not of {training.encoding_dim}"
            )
        WeightsDifferError.check(label, drives[-1].weights_sha256, training.name, training.weights_sha256)
    first, *seasons = drives
    route = first.route(other.closed)
    seasons_seen = [SeenTwice(first, season, same_places(season.route(), route)) for season in seasons]
    if not any(covers(route.position_m, pair.places[:, 0]) for pair in seasons_seen):
        raise InvalidMapConfigError(
            f"{its_map} knows too few places in two seasons: {LEAST_SHARED_PLACES} over half of the route are the least"
        )
    return tuple(seasons_seen)
