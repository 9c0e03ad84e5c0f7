"""How surely a place is recognised: the chance that one view there is placed rightly (ours).

A view of a place as it is in the map, were seasons as alike as they usually are, has some of its likelihood there: that
is known of every map. Where a second season of the route is known, its views are looked up too, and counted.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.drive import SecondSeason
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import Map
from deepsimbad.core.rehearsal import WITHIN_M, OwnViews, smoothed

_SMOOTHED_OVER_M = 5.0  # a view is placed rightly or not: neighbours tell of how often
_PRIOR_VIEWS = 1.0  # weight of the route's mean where few views are near
_MOST_VIEWS = 5000  # more would only take longer
_AT_ONCE = 256
_LEAST_STRETCH_M = 2 * WITHIN_M
_BELOW_MEAN = 0.75  # a stretch stands out where its chance is less than so much of the route's mean


@dataclass(frozen=True)
class Stretch:
    """A part of the route where views are placed rightly less often than elsewhere."""

    first: int  # map image
    last: int
    worst: int
    chance: float  # mean over its images


def placed_rightly(rehearsal: Map, own: OwnViews, season: SecondSeason | None) -> NDArray[np.float32]:
    """[n] the chance, 0 to 1, that a single view from a map image's place is placed within 5 m of it.

    Args:
        rehearsal: The map whose lists do not know the second season.
        own: What its places' own views tell.
        season: None: there is no other.
    """
    expected = _along(rehearsal, own.images, own.found)
    if season is None:
        return expected.astype(np.float32)
    images, frames = season.places[:: -(-len(season.places) // _MOST_VIEWS)].T
    found, route = np.empty(images.size), rehearsal.route
    for first in range(0, images.size, _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        best = relevances(rehearsal, season.views(frames[some])).argmax(axis=1)
        found[some] = np.abs(route.offset_m(route.position_m[best], route.position_m[images[some]])) <= WITHIN_M
    counted = _along(rehearsal, images, found)
    return ((expected + counted) / 2).astype(np.float32)  # which of them orders places better no recording decided


def _along(map_: Map, images: NDArray[np.int64], found: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n] share of views placed rightly, of views [k] from some images, smoothed along the route."""
    order = np.argsort(images, kind="stable")
    at_m = map_.position_m[images[order]]
    return smoothed(map_.position_m, at_m, found[order], _SMOOTHED_OVER_M, _PRIOR_VIEWS)


def worst_stretches(position_m: NDArray[np.float64], chance: NDArray[np.floating]) -> list[Stretch]:
    """Where the chance [n], perhaps NaN, is well below the route's mean, worst first."""
    is_low = chance < _BELOW_MEAN * np.nanmean(chance)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_low, [False]]).astype(int)))
    stretches = []
    for first, stop in edges.reshape(-1, 2):
        if position_m[stop - 1] - position_m[first] >= _LEAST_STRETCH_M or stop - first == chance.size:
            some = chance[first:stop]
            stretches.append(Stretch(int(first), int(stop - 1), int(first + np.nanargmin(some)), float(some.mean())))
    return sorted(stretches, key=lambda stretch: stretch.chance)
