"""The prelearned route: where along it, and on Earth, map images were taken, and which show the same place (II-C)."""

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.belief.cells import SUMS, Cells
from deepsimbad.errors import InvalidRouteError

_NearPoint = Callable[[float, float], NDArray[np.intp]]
_HISTOGRAM_BINS = 200
_EQUATOR_M, _FLATTENING = 6_378_137.0, 1 / 298.257_223_563  # of the Earth's ellipsoid, WGS 84
_LEAST_LENGTH_M = 1e-9  # on a shorter route moves counted in its steps would overflow
_ROUNDING_M = 1e-9  # by which a position past an end is taken for the end


@dataclass(frozen=True)
class Places:
    """The distinct positions [p] of a route, the place of every image [n], and how many images share each place [p]."""

    position_m: NDArray[np.float64]
    of_image: NDArray[np.intp]
    n_images: NDArray[np.intp]

    def means(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """[n] values of images, in which all images of a place have the mean of theirs."""
        if self.position_m.size == values.size:
            return values
        return np.asarray((np.bincount(self.of_image, values) / self.n_images)[self.of_image], np.float32)


@dataclass(frozen=True)
class Route:
    """Route positions of the map images, in route order."""

    position_m: NDArray[np.float64]  # [n] float64, non-decreasing, metres driven along the route
    closed: bool = False  # whether the end joins the start
    # x_m, y_m: [n] float64 in the recording's plane, NaN where unknown; None where never known
    x_m: NDArray[np.float64] | None = None
    y_m: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if self.position_m.ndim != 1 or self.position_m.size == 0:
            raise InvalidRouteError("a route needs at least one position")
        if not np.isfinite(self.position_m).all():
            first = int(np.flatnonzero(~np.isfinite(self.position_m))[0])
            raise InvalidRouteError(f"route position of frame {first} is NaN or infinite", frame=first)
        steps = np.diff(self.position_m)
        if (steps < 0).any():
            first = int(np.flatnonzero(steps < 0)[0]) + 1
            raise InvalidRouteError(
                f"route position goes backwards at frame {first}: {self.position_m[first - 1]:.3f} m then "
                f"{self.position_m[first]:.3f} m",
                frame=first,
            )
        if 0 < self.length_m < _LEAST_LENGTH_M:
            raise InvalidRouteError(
                f"the route is {self.length_m:g} m long: {_LEAST_LENGTH_M:g} m is the least above 0"
            )
        for array in (self.position_m, self.x_m, self.y_m):
            if array is not None:
                array.setflags(write=False)

    @cached_property
    def n_images(self) -> int:
        """n."""
        return int(self.position_m.size)

    @property
    def start_m(self) -> float:
        """Position of the first map image."""
        return float(self.position_m[0])

    @cached_property
    def length_m(self) -> float:
        """Metres from the first map image to the last; of a closed route once around."""
        span = float(self.position_m[-1] - self.position_m[0])
        return span + self._closing_gap_m if self.closed else span

    @cached_property
    def _closing_gap_m(self) -> float:
        """Metres from the last map image on to the first, in the plane where known, else the median step."""
        if self.x_m is not None and self.y_m is not None:
            gap = float(np.hypot(self.x_m[0] - self.x_m[-1], self.y_m[0] - self.y_m[-1]))
            if np.isfinite(gap):
                return gap
        steps = np.diff(self.position_m)
        moving = steps[steps > 0]
        return float(np.median(moving)) if moving.size else 0.0

    @cached_property
    def cell_m(self) -> NDArray[np.float64]:
        """[n] metres of route that each map image stands for: half the way to either neighbour.

        Images taken while the robot stood share one place's cell. A route of no length has equal cells.
        """
        steps = np.diff(self.position_m)
        if self.length_m <= 0:
            return np.ones(self.n_images)
        if self.closed:
            gap_before_m, gap_after_m = np.r_[self._closing_gap_m, steps], np.r_[steps, self._closing_gap_m]
        else:
            gap_before_m, gap_after_m = np.r_[steps[:1], steps], np.r_[steps, steps[-1:]]
        cells = (gap_before_m + gap_after_m) / 2
        return cells if cells.sum() > 0 else np.ones(self.n_images)

    def offset_m(self, position_m: NDArray[np.float64], from_m: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed metres along the route from `from_m` to positions, broadcast; on a closed route the short way."""
        offset = np.asarray(position_m, np.float64) - from_m
        if not self.closed or self.length_m <= 0:
            return offset
        half = self.length_m / 2
        return np.asarray((offset + half) % self.length_m - half)

    def apart_m(
        self, images: NDArray[np.int64], position_m: float, x_m: float | None, y_m: float | None
    ) -> NDArray[np.float64]:
        """[k] metres of images [k] from a place, in the plane where both are known there, else along the route."""
        along_m = np.abs(self.offset_m(self.position_m[images], position_m))
        if x_m is None or y_m is None or self.x_m is None or self.y_m is None:
            return along_m
        plane_m = np.hypot(self.x_m[images] - x_m, self.y_m[images] - y_m)
        return np.where(np.isfinite(plane_m), plane_m, along_m)

    def wrapped(self, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions brought into the first turn of a closed route; those of an open one unchanged."""
        if not self.closed or self.length_m <= 0:
            return position_m
        return np.asarray(self.start_m + (position_m - self.start_m) % self.length_m)

    def reaches(self, position_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether positions are on the route; those past the ends of an open one are not, but for rounding."""
        inside = (position_m >= self.start_m - _ROUNDING_M) & (position_m <= self.position_m[-1] + _ROUNDING_M)
        return np.asarray(inside | self.closed)

    def staying(self, action_m: float) -> slice:
        """The map images from which a move ends on the route, as `reaches` has it."""
        if self.closed:
            return slice(0, self.n_images)
        ends_m = self.position_m[0] - _ROUNDING_M, self.position_m[-1] + _ROUNDING_M
        first = int(np.searchsorted(self.position_m, ends_m[0] - action_m))
        return slice(first, max(first, int(np.searchsorted(self.position_m, ends_m[1] - action_m, side="right"))))

    @cached_property
    def places(self) -> Places:
        """The distinct positions."""
        position_m, of_image, n_images = np.unique(self.position_m, return_inverse=True, return_counts=True)
        return Places(position_m, of_image, n_images)

    @cached_property
    def cells(self) -> Cells:
        """Cells of equal length, for a grid belief."""
        return Cells.for_places(self.places.position_m, self.length_m, self.closed)

    @cached_property
    def heading_rad(self) -> NDArray[np.float64]:
        """[n] direction of travel in the plane at every map image, from x towards y; NaN where unknown."""
        return _headings(self)

    @cached_property
    def turn(self) -> NDArray[np.float64]:
        """[2, n] cosine and sine of every map image's angle around a closed route; [2, 0] of an open one."""
        if not self.closed or self.length_m <= 0:
            return np.empty((2, 0))
        angle = 2 * np.pi / self.length_m * (self.position_m - self.start_m)
        return np.stack([np.cos(angle), np.sin(angle)])

    def nearest_image(self, position_m: NDArray[np.float64]) -> NDArray[np.intp]:
        """The map image nearest to each position along the route; of two equally near the earlier."""
        images_m = self.position_m
        upper = np.clip(np.searchsorted(images_m, position_m), 1, max(self.n_images - 1, 1))
        if self.n_images == 1:
            return np.zeros(np.shape(position_m), np.intp)
        lower = upper - 1
        nearest = np.where(position_m - images_m[lower] <= images_m[upper] - position_m, lower, upper)
        if self.closed:  # behind the last image the first may be nearer
            behind = position_m - images_m[-1]
            nearest = np.where(behind > self._closing_gap_m - behind, 0, nearest)
        return np.asarray(nearest, np.intp)

    @cached_property
    def histogram_edges_m(self) -> NDArray[np.float64]:
        """[b + 1] edges of at most 200 equal bins over the whole route."""
        n_bins = min(_HISTOGRAM_BINS, self.n_images) if self.length_m > 0 else 1
        return np.linspace(self.start_m, self.start_m + self.length_m, n_bins + 1)

    def histogram_of(self, mass: NDArray[np.float32]) -> NDArray[np.float64]:
        """[b] masses of those bins, from masses of map images [n] that each spread over the stretch it stands for."""
        n_whole, share, share_behind = self._bin_ends
        if self.closed:  # the first image's stretch begins before the end
            mass = np.append(mass, share_behind * mass[0])
            mass[0] -= mass[-1]
        partial_mass = share * mass[np.minimum(n_whole, mass.size - 1)]
        bin_mass = _sums_up_to(mass, n_whole) + partial_mass
        bin_mass[1:] -= partial_mass[:-1]
        return np.maximum(bin_mass, 0.0)  # rounding may make it less

    @cached_property
    def _bin_ends(self) -> tuple[NDArray[np.intp], NDArray[np.float64], float]:
        """[b], [b] number of stretches that end before each bin's end, and the next one's share before it.

        And the share of the first image's stretch that a closed route has behind its last image, as one stretch more.
        """
        places_m = np.append(self.position_m, self.histogram_edges_m[-1]) if self.closed else self.position_m
        until_m = np.append((places_m[1:] + places_m[:-1]) / 2, self.histogram_edges_m[-1])
        from_m, end_m = np.append(self.start_m, until_m), self.histogram_edges_m[1:]
        n_whole = np.searchsorted(until_m, end_m, side="right")
        next_stretch, length_m = np.minimum(n_whole, until_m.size - 1), np.diff(from_m)
        share = (end_m - from_m[next_stretch]) / np.maximum(length_m[next_stretch], _LEAST_LENGTH_M)
        share_behind = length_m[-1] / max(length_m[0] + length_m[-1], _LEAST_LENGTH_M)
        return n_whole, np.where(n_whole < until_m.size, share, 0.0), float(share_behind)


@njit(cache=True, nogil=True, fastmath=SUMS)
def _sums_up_to(values: NDArray[np.float32], ends: NDArray[np.intp]) -> NDArray[np.float64]:
    """[b] sums of the values [n] between every end [b] and the end before."""
    sums, begin = np.zeros(ends.size), 0
    for number in range(ends.size):
        total, span = 0.0, values[begin : ends[number]]
        for i in range(span.size):
            total += span[i]
        sums[number], begin = total, ends[number]
    return sums


def true_images_of(
    query: Route,
    map_route: Route,
    tolerance_m: float,
    max_heading_rad: float = np.pi / 2,
    frames: NDArray[np.int64] | None = None,
) -> list[NDArray[np.int64]]:
    """The map images within the tolerance of every query frame, or of the given frames.

    Distance is in the plane (x, y) where both routes know it, else along the route. A map image near in the plane but
    driven in another direction shows something else, so the headings of the two paths must agree within
    `max_heading_rad`.

    Returns:
        For each query frame an ascending int64 array of map image ids; empty where there is none.
    """
    query_frames = np.arange(query.n_images) if frames is None else frames
    if query.x_m is None or query.y_m is None or map_route.x_m is None or map_route.y_m is None:
        return [_near_along(map_route, float(query.position_m[frame]), tolerance_m) for frame in query_frames]
    x_m, y_m, headings = query.x_m, query.y_m, query.heading_rad
    map_x_m, map_y_m, map_headings = map_route.x_m, map_route.y_m, map_route.heading_rad
    candidates = _near_in_plane(map_x_m, map_y_m, tolerance_m)
    near_frames = []
    for frame in query_frames:
        ids = candidates(float(x_m[frame]), float(y_m[frame]))
        is_near = np.hypot(map_x_m[ids] - x_m[frame], map_y_m[ids] - y_m[frame]) <= tolerance_m
        turn = np.abs((map_headings[ids] - headings[frame] + np.pi) % (2 * np.pi) - np.pi)
        near_frames.append(ids[is_near & ~(turn > max_heading_rad)])  # an unknown heading excludes nothing
    return near_frames


def same_places(frames: Route, map_route: Route, tolerance_m: float = 2.0) -> NDArray[np.int64]:
    """[k, 2] pairs (map image, frame) of the same place: every frame with the nearest of its true map images."""
    planes = (frames.x_m, frames.y_m, map_route.x_m, map_route.y_m)
    pairs = []
    for frame, near_images in enumerate(true_images_of(frames, map_route, tolerance_m)):
        if near_images.size == 0:
            continue
        if any(axis is None for axis in planes):
            distance_m = np.abs(map_route.offset_m(map_route.position_m[near_images], float(frames.position_m[frame])))
        else:
            x_m, y_m, map_x_m, map_y_m = (np.asarray(axis) for axis in planes)
            distance_m = np.hypot(map_x_m[near_images] - x_m[frame], map_y_m[near_images] - y_m[frame])
        pairs.append((int(near_images[np.argmin(distance_m)]), frame))
    return np.array(pairs, np.int64).reshape(-1, 2)


def _near_along(map_route: Route, at_m: float, tolerance_m: float) -> NDArray[np.int64]:
    if map_route.closed:  # images at either end may be near
        return np.flatnonzero(np.abs(map_route.offset_m(map_route.position_m, at_m)) <= tolerance_m)
    slack_m = 1e-9 * (abs(at_m) + 1.0)  # the window must not round to less than the distance below, which decides
    window_m = (at_m - tolerance_m - slack_m, at_m + tolerance_m + slack_m)
    first, last = np.searchsorted(map_route.position_m, window_m)
    is_near = np.abs(map_route.offset_m(map_route.position_m[first:last], at_m)) <= tolerance_m
    return np.asarray(first + np.flatnonzero(is_near), np.int64)


def _near_in_plane(x_m: NDArray[np.float64], y_m: NDArray[np.float64], tolerance_m: float) -> _NearPoint:
    """A function from a point to a few map images, in order, which include all within the tolerance.

    The plane is cut into squares as wide as the tolerance, so that all near images are in the point's square or in one
    of the eight around it: a drive of 26,000 frames is matched in a second, not in half a minute.
    """
    all_images = np.arange(x_m.size)
    known_images = all_images[np.isfinite(x_m) & np.isfinite(y_m)]
    if not np.isfinite(tolerance_m) or tolerance_m <= 0:
        return lambda _x, _y: all_images
    nowhere = all_images[:0]
    squares: defaultdict[tuple[float, float], list[int]] = defaultdict(list)
    columns, rows = np.floor(x_m[known_images] / tolerance_m), np.floor(y_m[known_images] / tolerance_m)
    for image, column, row in zip(known_images.tolist(), columns.tolist(), rows.tolist(), strict=True):
        squares[column, row].append(image)
    around = [(right, up) for right in (-1, 0, 1) for up in (-1, 0, 1)]

    def near(x: float, y: float) -> NDArray[np.intp]:
        if not (np.isfinite(x) and np.isfinite(y)):
            return nowhere
        column, row = float(np.floor(x / tolerance_m)), float(np.floor(y / tolerance_m))
        ids = [image for right, up in around for image in squares.get((column + right, row + up), ())]
        return np.array(sorted(ids), np.intp)

    return near


def _headings(route: Route, over_m: float = 1.0) -> NDArray[np.float64]:
    """[n] direction of travel in the plane, by the chord over `over_m`, or a neighbour, either way; NaN if unknown."""
    image, last = np.arange(route.n_images), route.n_images - 1
    begin = np.searchsorted(route.position_m, route.position_m - over_m, side="left")
    end = np.searchsorted(route.position_m, route.position_m + over_m, side="right") - 1
    begin, end = np.minimum(begin, np.maximum(image - 1, 0)), np.maximum(end, np.minimum(image + 1, last))
    x, y = route.x_m, route.y_m
    if x is None or y is None:
        return np.full(route.n_images, np.nan)
    dx, dy = x[end] - x[begin], y[end] - y[begin]
    return np.where((dx == 0) & (dy == 0), np.nan, np.arctan2(dy, dx))


def on_earth(
    x_m: float, y_m: float, lat_deg: float, lon_deg: float, bearing_deg: float, height_m: float
) -> tuple[float, float]:
    """(latitude, longitude) in degrees, WGS 84, of a place, by the meridian and the parallel through the origin.

    Args:
        lat_deg, lon_deg, height_m: Of the origin, the height above the ellipsoid.
        bearing_deg: Of the y axis, clockwise from north.
    """
    bearing_rad = math.radians(bearing_deg)
    east_m = x_m * math.cos(bearing_rad) + y_m * math.sin(bearing_rad)
    north_m = y_m * math.cos(bearing_rad) - x_m * math.sin(bearing_rad)
    latitude = math.radians(lat_deg)
    eccentricity = _FLATTENING * (2 - _FLATTENING)
    bulge = 1 - eccentricity * math.sin(latitude) ** 2
    meridian_m = _EQUATOR_M * (1 - eccentricity) / bulge**1.5 + height_m
    parallel_m = (_EQUATOR_M / math.sqrt(bulge) + height_m) * math.cos(latitude)
    longitude = lon_deg + math.degrees(east_m / max(parallel_m, 1e-6))
    return lat_deg + math.degrees(north_m / meridian_m), (longitude + 180) % 360 - 180
