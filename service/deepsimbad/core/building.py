"""Building a map from a drive's dissimilarities: what every image lists, and what the seasons of its route teach.

A map knows the route in two domains: the training traverse that becomes the map, and the landmark traverse. Where both
saw the same place, their standardised scores of a landmark are a sample of what a view of a third season will score
against the map. Their correlation `rho` says how much of a landmark's score belongs to the place. A map image lists
the landmarks that were near in both seasons, and between its score z_m and the query's z_q, standard normal with
correlation rho, the log-likelihood ratio of "seen from the place that lists it" against "seen from anywhere" is, for
equal spread,

    rho * z_m * z_q - (rho * z_m)^2 / 2.

A landmark that was not sent, of which z_q is known but for a variance v, tells as much less: to second order in
rho * z_m its ratio is rho * z_m * E[z_q] less (1 - v) of the square. The map stores no z_m; its mean over the images
that list the landmark at that rank stands for it (`Map.listed_score`).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.descriptor import (
    CALIBRATED_PRIOR_WEIGHT_FRAMES,
    LandmarkStatistics,
    common_factors,
    nearest_landmarks,
    rank_landmarks,
)
from deepsimbad.core.drive import UNKNOWN_TIMESTAMP, Drive, SecondSeason
from deepsimbad.core.map import Map
from deepsimbad.core.nnql import NnqlConfig
from deepsimbad.core.relevance import Relevance
from deepsimbad.errors import InvalidMapConfigError

# Without two seasons of one place nothing can be learnt; this is what the development recordings show on average.
DEFAULT_CORRELATION = 0.6
SECOND_SEASON_WEIGHT = 0.6  # of its score against the map's own, in choosing what an image lists
_BOUNDS = (0.05, 0.95)
_PSEUDO_IMAGES = 3.0  # weight of the rank's mean in a landmark's mean score at that rank


def build_map(
    relevance: Relevance,
    drive: Drive,
    list_length: int,
    closed: bool = False,
    second_season: SecondSeason | None = None,
) -> Map:
    """Describe every map image by the h landmarks its relevance keeps.

    Args:
        drive: The training traverse, its dissimilarities measured.
        second_season: Read by `calibrated` alone.

    Returns:
        The map as far as dissimilarities tell; its landmark model, actions and names are the caller's to add.

    Raises:
        InvalidMapConfigError: No image, or h not within 1..r.
        InvalidRouteError: The positions go backwards or are NaN.
    """
    dissimilarities = drive.dissimilarities
    if dissimilarities is None or dissimilarities.ndim != 2 or len(dissimilarities) == 0:
        raise InvalidMapConfigError("a map needs at least one image")
    n_landmarks = dissimilarities.shape[1]
    if not 1 <= list_length <= n_landmarks:
        raise InvalidMapConfigError(
            f"list_length {list_length} is not within 1 and the number of landmarks, {n_landmarks}",
            list_length=list_length,
            n_landmarks=n_landmarks,
        )
    arrays = _described(relevance, dissimilarities, list_length, second_season)
    route = drive.route(closed)
    return Map(
        config={"relevance": relevance.value, "n_landmarks": n_landmarks},
        closed=closed,
        position_m=route.position_m,
        x_m=route.x_m,
        y_m=route.y_m,
        encodings=drive.encodings if relevance is Relevance.BRUTE_FORCE else None,
        **arrays,
    )


def _described(
    relevance: Relevance, dissimilarities: NDArray[np.float32], list_length: int, second: SecondSeason | None
) -> dict[str, Any]:
    """The named arrays that follow from dissimilarities."""
    ranks = rank_landmarks(dissimilarities)
    if relevance not in {Relevance.STANDARDISED, Relevance.CALIBRATED}:
        lists = nearest_landmarks(ranks, list_length)
        return {"lists": lists, "values": _listed(dissimilarities, lists) if relevance is Relevance.SIMBAD else None}
    own = LandmarkStatistics.of_map(ranks)
    scores = own.standardise(ranks)
    own = replace(own, loadings=common_factors(scores))
    if relevance is Relevance.STANDARDISED:
        statistics = np.stack([own.mean, own.std])
        return {"lists": nearest_landmarks(scores, list_length), "statistics": statistics, "loadings": own.loadings}
    seasons, correlation = [own], np.full(len(own.mean), DEFAULT_CORRELATION)
    if second is not None:
        other_ranks = rank_landmarks(second.dissimilarities)
        seasons.append(LandmarkStatistics.of_map(other_ranks))
        scores, correlation = both_seasons(scores, seasons[1].standardise(other_ranks), second.places)
    lists = nearest_landmarks(scores, list_length)
    prior = live_prior(seasons)
    return {
        "lists": lists,
        "statistics": np.stack([prior.mean, prior.std]),
        "loadings": prior.loadings,
        "correlation": correlation,
        "listed_score": _listed_scores(scores, lists),
    }


def _listed(dissimilarities: NDArray[np.float32], lists: NDArray[np.uint16]) -> NDArray[np.float32]:
    """[h, n] the dissimilarities [n, r] of listed landmarks [h, n]."""
    return np.ascontiguousarray(np.take_along_axis(dissimilarities, lists.T.astype(np.intp), axis=1).T, np.float32)


def both_seasons(
    own: NDArray[np.float64], second: NDArray[np.float64], places: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The standardised scores of the map images over two seasons, and how these go with a season not yet seen.

    Args:
        own: [n, r] scores of the map images by the map's own statistics.
        second: [m, r] scores of the landmark traverse's frames by theirs.
        places: [k, 2] (map image, frame) of the same place, k at least 1.

    Returns:
        Scores [n, r], about standard normal; correlations [r].
    """
    of_map, of_second = places.T
    between = np.einsum("kr,kr->r", own[of_map], second[of_second]) / len(places)
    between = np.clip(between, *_BOUNDS)
    weight = SECOND_SEASON_WEIGHT
    spread = np.sqrt(1 + weight**2 + 2 * weight * between)
    scores = own.copy()
    scores[of_map] = (own[of_map] + weight * second[of_second]) / spread
    # Of a weighted mean of two equally related measurements with a third (Spearman and Brown).
    return scores, np.clip(between * (1 + weight) / spread, *_BOUNDS)


def _listed_scores(scores: NDArray[np.float64], lists: NDArray[np.uint16]) -> NDArray[np.float64]:
    """[h, r] mean score [n, r] of a landmark where an image of these lists [h, n] has it at a rank."""
    n_landmarks = scores.shape[1]
    images = np.arange(lists.shape[1])
    means = np.empty((len(lists), n_landmarks))
    for rank, row in enumerate(lists):
        listed = scores[images, row]
        total = np.bincount(row, listed, n_landmarks) + _PSEUDO_IMAGES * listed.mean()
        means[rank] = total / (np.bincount(row, minlength=n_landmarks) + _PSEUDO_IMAGES)
    return means


def live_prior(seasons: Sequence[LandmarkStatistics]) -> LandmarkStatistics:
    """What is usual over all seasons that the map knows, taken alike: the best guess about another one.

    How landmarks go together is a matter of places more than of seasons: it stays the first one's.
    """
    return LandmarkStatistics(
        CALIBRATED_PRIOR_WEIGHT_FRAMES,
        np.mean([season.mean for season in seasons], axis=0),
        np.mean([season.square for season in seasons], axis=0),
        seasons[0].loadings,
    )


def append_drive(map_: Map, drive: Drive) -> Map:
    """Describe new frames by a map's landmarks and merge them into it by route position.

    The new frames' lists come from their own drive's statistics, as those of any map do. A short drive says little of
    what is usual for a landmark (one frame: nothing), so its statistics begin as the map's, weighted as for a live
    session, and soon are its own. The map's statistics become those of all its images; what only two seasons of one
    place can teach stays. A new image knows of its place what the nearest old one does.

    Args:
        drive: The new frames, their dissimilarities to its landmarks measured; along the same route, on a closed one
            any turn of it.

    Returns:
        The longer map; of images at one position the old come first.

    Raises:
        InvalidRouteError: The new frames go backwards.
    """
    if drive.dissimilarities is None:
        raise InvalidMapConfigError("the new frames' dissimilarities are not measured")
    ranks, route = rank_landmarks(drive.dissimilarities), drive.route(map_.closed)
    before = map_.landmark_statistics
    scores: NDArray[np.floating] = ranks
    statistics = map_.statistics
    if before is not None:
        own = LandmarkStatistics.of_map(ranks)
        scores = before.pooled(before.weight, own, drive.n_frames).standardise(ranks)
        pooled = before.pooled(map_.n_images, own, drive.n_frames)
        statistics = np.stack([pooled.mean, pooled.std])
    lists = nearest_landmarks(scores, map_.list_length)
    nearest, is_near = nearest_known(map_, route.position_m)
    q_values, bits = map_.q_values, map_.telling_bits
    if q_values is not None:
        q_values = np.where(is_near[:, np.newaxis], q_values[nearest], np.float32(NnqlConfig().initial_q))
    if bits is not None:
        bits = np.where(is_near, bits[nearest], bits.mean(dtype=np.float32))
    longer = map_.with_images(
        {
            "lists": lists,
            "position_m": _on_route(map_, route.position_m),
            "values": None if map_.values is None else _listed(drive.dissimilarities, lists),
            "encodings": None if map_.encodings is None else drive.encodings,
            "telling_bits": bits,
            "timestamp_us": drive.timestamp_us if (drive.timestamp_us != UNKNOWN_TIMESTAMP).any() else None,
            "frame_digest": drive.digests(),
            "x_m": route.x_m,
            "y_m": route.y_m,
            "q_values": q_values,
        }
    )
    return replace(longer, statistics=statistics)


def nearest_known(map_: Map, position_m: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The map image nearest to each position [m], and whether it is within the longest move."""
    route, placed_m = map_.route, _on_route(map_, position_m)
    nearest = route.nearest_image(placed_m)
    apart_m = np.abs(route.offset_m(placed_m - route.position_m[nearest], 0.0))
    return nearest, apart_m <= map_.actions_m.max(initial=0.0)


def _on_route(map_: Map, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions as the route counts them; only what lies outside a closed one's first turn is turned."""
    route = map_.route
    ahead_m = position_m - route.start_m
    inside = (ahead_m >= 0) & (ahead_m < route.length_m)
    return np.where(inside, position_m, route.wrapped(position_m))
