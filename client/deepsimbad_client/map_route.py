"""Where a domain's map images lie, fetched once, and which of them show the place of a query."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.http.models import Localization
from deepsimbad_client.recordings.recording import Frame

HEADING_CHORD_M = 1.0
"""A direction of travel is that of the chord over this much of the path to either side."""
OPPOSITE_RAD = np.pi / 2
"""Views of one place that differ by more than this in direction show different things."""


@dataclass(frozen=True)
class RoutePath:
    """Positions in travel order.

    Attributes:
        position_m: [n] float64 along the route.
        x_m: [n] float64, NaN where unknown.
        y_m: [n] float64, NaN where unknown.
    """

    position_m: NDArray[np.float64]
    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]

    @property
    def knows_xy(self) -> bool:
        """Whether any place of it is known in the plane."""
        return bool(np.isfinite(self.x_m).any() and np.isfinite(self.y_m).any())

    def headings_rad(self) -> NDArray[np.float64]:
        """[n] direction of travel, from x towards y; NaN where the path does not tell."""
        forward = np.argsort(self.position_m, kind="stable")  # frames taken backwards still look forwards
        along = self.position_m[forward]
        before = forward[np.searchsorted(along, self.position_m - HEADING_CHORD_M, side="left")]
        after = forward[np.searchsorted(along, self.position_m + HEADING_CHORD_M, side="right") - 1]
        dx = self.x_m[after] - self.x_m[before]
        dy = self.y_m[after] - self.y_m[before]
        return np.where((dx == 0) & (dy == 0), np.nan, np.arctan2(dy, dx))


def path_of_frames(frames: Sequence[Frame]) -> RoutePath:
    """The path of a recording's frames."""
    return RoutePath(
        np.array([frame.position_m for frame in frames], np.float64),
        np.array([np.nan if frame.x_m is None else frame.x_m for frame in frames], np.float64),
        np.array([np.nan if frame.y_m is None else frame.y_m for frame in frames], np.float64),
    )


@dataclass(frozen=True)
class MapRoute:
    """A map's images.

    Attributes:
        map_version: The version they belong to.
        path: Their places.
        closed: Whether the route's end is its start.
        length_m: The route's length.
    """

    map_version: int
    path: RoutePath
    closed: bool
    length_m: float

    @property
    def n_images(self) -> int:
        """How many there are."""
        return len(self.path.position_m)

    def along_m(self, position_m: float) -> NDArray[np.float64]:
        """[n] distance along the route from every map image to a position, the shorter way round a closed one."""
        apart = np.abs(self.path.position_m - position_m)
        if self.closed and self.length_m > 0:
            apart = np.mod(apart, self.length_m)
            apart = np.minimum(apart, self.length_m - apart)
        return apart


def map_route_of(answer: Localization, *, closed: bool, length_m: float) -> MapRoute:
    """Read a map's images out of an answer whose shortlist held them all."""
    retrieval = sorted(answer.retrieval, key=lambda entry: entry.map_image)
    position_m = np.array([entry.route_position_m for entry in retrieval], np.float64)
    x_m = np.full(len(position_m), np.nan)
    y_m = np.full(len(position_m), np.nan)
    for place in answer.belief.top:
        if place.x_m is not None and place.y_m is not None and 0 <= place.map_image < len(position_m):
            x_m[place.map_image], y_m[place.map_image] = place.x_m, place.y_m
    return MapRoute(answer.map_version, RoutePath(position_m, x_m, y_m), closed, length_m)


class Truth:
    """Tells which map images are right answers to the frames of a recording.

    In the plane where both sides know x and y, and there only driven in about the same direction; else along the
    route.

    Args:
        queries: The recording's path.
        route: The map's images.
        tolerance_m: How far a right answer may be.
    """

    def __init__(self, queries: RoutePath, route: MapRoute, tolerance_m: float) -> None:
        self._queries = queries
        self._route = route
        self._tolerance_m = tolerance_m
        self._query_heading = queries.headings_rad()
        self._map_heading = route.path.headings_rad()

    def apart_m(self, query: int) -> NDArray[np.float64]:
        """[n] distance from a query to every map image, in the plane where both know it, else along the route."""
        path = self._route.path
        along = self._route.along_m(float(self._queries.position_m[query]))
        plane = np.hypot(path.x_m - self._queries.x_m[query], path.y_m - self._queries.y_m[query])
        return np.where(np.isfinite(plane), plane, along)

    def true_images(self, query: int) -> NDArray[np.intp]:
        """The map images within the tolerance; none where the map does not hold the place."""
        near = self.apart_m(query) <= self._tolerance_m
        turn = self._map_heading - self._query_heading[query]
        turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
        return np.flatnonzero(near & ~(turn > OPPOSITE_RAD))  # an unknown heading excludes nothing
