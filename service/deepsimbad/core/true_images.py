"""Which map images show the place of a frame: within a tolerance, driven in the same direction."""

from collections import defaultdict
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.route import Route

_NearPoint = Callable[[float, float], NDArray[np.intp]]


def true_images_of(
    query: Route,
    map_route: Route,
    tolerance_m: float,
    max_heading_rad: float = np.pi / 2,
    frames: NDArray[np.int64] | None = None,
) -> list[NDArray[np.int64]]:
    """For every query frame, or for some of them, the map images within the tolerance.

    In the plane (x, y) where both routes know it; else along the route. A map image within the tolerance in the
    plane but driven in another direction shows something else, so heading, taken from the paths themselves, must
    agree within `max_heading_rad`.

    Returns:
        One ascending int64 array of map image ids a query frame; empty where there is none.
    """
    asked = np.arange(query.n_images) if frames is None else frames
    if query.x_m is None or query.y_m is None or map_route.x_m is None or map_route.y_m is None:
        return [_near_along(map_route, float(query.position_m[frame]), tolerance_m) for frame in asked]
    x_m, y_m, headings = query.x_m, query.y_m, _headings(query)
    map_x_m, map_y_m, map_headings = map_route.x_m, map_route.y_m, _headings(map_route)
    candidates = _near_in_plane(map_x_m, map_y_m, tolerance_m)
    found = []
    for frame in asked:
        ids = candidates(float(x_m[frame]), float(y_m[frame]))
        near = np.hypot(map_x_m[ids] - x_m[frame], map_y_m[ids] - y_m[frame]) <= tolerance_m
        turn = np.abs((map_headings[ids] - headings[frame] + np.pi) % (2 * np.pi) - np.pi)
        found.append(ids[near & ~(turn > max_heading_rad)])  # an unknown heading excludes nothing
    return found


def same_places(frames: Route, map_route: Route, tolerance_m: float = 2.0) -> NDArray[np.int64]:
    """Pairs (map image, frame) [k, 2] of the same place: for every frame the nearest of its true map images."""
    planes = (frames.x_m, frames.y_m, map_route.x_m, map_route.y_m)
    pairs = []
    for frame, near in enumerate(true_images_of(frames, map_route, tolerance_m)):
        if near.size == 0:
            continue
        if any(axis is None for axis in planes):
            apart = np.abs(map_route.offset_m(map_route.position_m[near], float(frames.position_m[frame])))
        else:
            x_m, y_m, map_x_m, map_y_m = (np.asarray(axis) for axis in planes)
            apart = np.hypot(map_x_m[near] - x_m[frame], map_y_m[near] - y_m[frame])
        pairs.append((int(near[np.argmin(apart)]), frame))
    return np.array(pairs, np.int64).reshape(-1, 2)


def _near_along(map_route: Route, at_m: float, tolerance_m: float) -> NDArray[np.int64]:
    if map_route.closed:  # either end may be near
        return np.flatnonzero(np.abs(map_route.offset_m(map_route.position_m, at_m)) <= tolerance_m)
    slack_m = 1e-9 * (abs(at_m) + 1.0)  # the window may round otherwise than the distance that decides
    window_m = (at_m - tolerance_m - slack_m, at_m + tolerance_m + slack_m)
    first, last = np.searchsorted(map_route.position_m, window_m)
    near = np.abs(map_route.offset_m(map_route.position_m[first:last], at_m)) <= tolerance_m
    return np.asarray(first + np.flatnonzero(near), np.int64)


def _near_in_plane(x_m: NDArray[np.float64], y_m: NDArray[np.float64], tolerance_m: float) -> _NearPoint:
    """A function from a point to a few map images, all within the tolerance among them, in order.

    The plane is cut into squares as wide as the tolerance, so that whatever is near lies in the point's square or in
    one of the eight around it: a drive of 26,000 frames is matched in a second, not in half a minute.
    """
    every = np.arange(x_m.size)
    known = every[np.isfinite(x_m) & np.isfinite(y_m)]
    if not np.isfinite(tolerance_m) or tolerance_m <= 0:
        return lambda _x, _y: every
    nowhere = every[:0]
    squares: defaultdict[tuple[float, float], list[int]] = defaultdict(list)
    columns, rows = np.floor(x_m[known] / tolerance_m), np.floor(y_m[known] / tolerance_m)
    for image, column, row in zip(known.tolist(), columns.tolist(), rows.tolist(), strict=True):
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
    """[n] direction of travel in the plane, from the chord over about a metre to either side; NaN if unknown."""
    before = np.searchsorted(route.position_m, route.position_m - over_m, side="left")
    after = np.searchsorted(route.position_m, route.position_m + over_m, side="right") - 1
    x, y = route.x_m, route.y_m
    if x is None or y is None:
        return np.full(route.n_images, np.nan)
    dx, dy = x[after] - x[before], y[after] - y[before]
    return np.where((dx == 0) & (dy == 0), np.nan, np.arctan2(dy, dx))
