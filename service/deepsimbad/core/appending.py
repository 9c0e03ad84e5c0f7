"""Further images for a map that was built before: theirs are described, those that were there stay as they are."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.descriptor import nearest_landmarks, rank_landmarks
from deepsimbad.core.inverted_index import InvertedIndex
from deepsimbad.core.relevance import Relevance, RetrievalMap
from deepsimbad.core.route import Route
from deepsimbad.core.statistics import LandmarkStatistics


@dataclass(frozen=True)
class AppendedMap:
    """A map with further images, all in route order.

    Attributes:
        built: What retrieval reads.
        position_m: [n + m] float64, non-decreasing.
        source: [n + m] int64, what every image was: 0..n-1 an image of the old map, n..n+m-1 a new frame.
    """

    built: RetrievalMap
    position_m: NDArray[np.float64]
    source: NDArray[np.int64]


def append_images(
    built: RetrievalMap,
    route: Route,
    dissimilarities: NDArray[np.float32],
    position_m: NDArray[np.float64],
    encodings: NDArray[np.float32] | None = None,
) -> AppendedMap:
    """Describe new frames by a map's landmarks and merge them into it by route position.

    The new frames' lists come from their own drive's statistics, as those of any map do. A short drive says little of
    what is usual for a landmark (one frame: nothing), so its statistics begin as the map's, weighted as for a live
    session, and soon are its own. The map's statistics become those of all its images; its calibration, which only two
    seasons of one place can teach, stays.

    Args:
        built: The map.
        route: Where its images are.
        dissimilarities: [m, r] of the new frames to the map's landmarks, smaller is nearer.
        position_m: [m] where they were taken, along the same route; on a closed one any turn of it.
        encodings: [m, d] of them; kept for `brute_force` alone.

    Returns:
        The longer map; of images at one position the old come first.
    """
    n_old, n_new = route.n_images, len(dissimilarities)
    ranks = rank_landmarks(dissimilarities)
    before, statistics = built.statistics, built.statistics
    scores: NDArray[np.floating] = ranks
    if before is not None:
        drive = LandmarkStatistics.of_map(ranks)
        scores = before.pooled(before.weight, drive, n_new).standardise(ranks)
        statistics = before.pooled(n_old, drive, n_new)
    lists = nearest_landmarks(scores, built.index.list_length)
    values = None
    if built.relevance is Relevance.SIMBAD:
        values = np.take_along_axis(dissimilarities, lists.T.astype(np.intp), axis=1).T
    longer = built.index.append(lists, values)
    placed_m = np.concatenate([route.position_m, _on_route(route, position_m)])
    source = np.argsort(placed_m, kind="stable").astype(np.int64)
    index = InvertedIndex(
        np.ascontiguousarray(longer.lists[:, source]),
        longer.n_landmarks,
        None if longer.values is None else np.ascontiguousarray(longer.values[:, source]),
    )
    kept = None
    if built.encodings is not None and encodings is not None:
        kept = np.concatenate([built.encodings, encodings])[source]
    return AppendedMap(replace(built, index=index, statistics=statistics, encodings=kept), placed_m[source], source)


def nearest_known(
    route: Route, position_m: NDArray[np.float64], within_m: float
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The map image nearest to each position along the route, and whether it is within a distance.

    Args:
        route: Of the map.
        position_m: [m]; on a closed route any turn of it.
        within_m: The distance.
    """
    placed_m = _on_route(route, position_m)
    nearest = route.nearest_image(placed_m)
    apart_m = np.abs(route.offset_m(placed_m - route.position_m[nearest], 0.0))
    return nearest, apart_m <= within_m


def _on_route(route: Route, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions as the route counts them: of a closed one within its first turn."""
    if not route.closed or route.length_m <= 0:
        return position_m
    ahead_m = position_m - route.start_m
    outside = (ahead_m < 0) | (ahead_m >= route.length_m)
    # Only what lies outside is turned: the others keep their exact numbers.
    return np.where(outside, route.start_m + ahead_m % route.length_m, position_m)
