"""Route position: metres along a ground-truth track, unmoved by a robot that stands still.

A pose stream of 100-150 Hz trembles by centimetres, and summing its steps as they are turns a minute of standing
into a hundred metres of driving. Two things prevent that:

1. Where the poses come with times, each is first averaged with those within a quarter of a second (a tenth of the
   tremble remains; a robot at walking pace loses nothing).
2. The track is then walked by anchors: the position is the distance summed up to the last anchor plus the
   greatest distance from that anchor reached so far, and a pose at least `DEADBAND_M` away becomes the next anchor.
   A robot that stands adds once, at most, how far it trembles from its anchor, however long it stands; one that
   moves straight on gets its distance exactly, at every pose and not only at anchors. Rocking to and fro within
   the dead band is standing.
"""

from math import hypot

import numpy as np
from numpy.typing import NDArray

DEADBAND_M = 0.25
SMOOTHING_HALF_WIDTH_US = 250_000

Metres = NDArray[np.float64]


def arc_length_m(
    x_m: Metres, y_m: Metres, time_us: NDArray[np.int64] | None = None, deadband_m: float = DEADBAND_M
) -> Metres:
    """Measure how far a track has gone at each of its poses.

    Args:
        x_m: [n] float64, finite, in travel order.
        y_m: [n] float64, finite.
        time_us: [n] int64 microseconds, increasing; without it nothing is averaged over time.
        deadband_m: How far a pose must be from the last anchor to be the next.

    Returns:
        [n] float64 metres, non-decreasing, 0 at the first pose.
    """
    if time_us is not None:
        x_m, y_m = _smoothed(x_m, time_us), _smoothed(y_m, time_us)
    travelled = np.zeros(len(x_m), dtype=np.float64)
    if len(x_m) == 0:
        return travelled
    xs, ys = x_m.tolist(), y_m.tolist()
    anchor_x, anchor_y = xs[0], ys[0]
    up_to_anchor = farthest = 0.0
    for i, (x, y) in enumerate(zip(xs, ys, strict=True)):
        away = hypot(x - anchor_x, y - anchor_y)
        farthest = max(farthest, away)
        travelled[i] = up_to_anchor + farthest
        if away >= deadband_m:
            up_to_anchor += away
            anchor_x, anchor_y, farthest = x, y, 0.0
    return travelled


def _smoothed(values: Metres, time_us: NDArray[np.int64]) -> Metres:
    """Average each value with those within a quarter of a second, the window shrinking evenly at both ends.

    Evenly, because a window cut on one side alone would shift the ends of every drive (and both sides of every
    gap) along the track.
    """
    if len(values) == 0:
        return values
    breaks = np.flatnonzero(np.diff(time_us) > SMOOTHING_HALF_WIDTH_US) + 1
    starts = np.concatenate(([0], breaks))
    n_each = np.diff(np.concatenate((starts, [len(values)])))
    first_us = np.repeat(time_us[starts], n_each)
    last_us = np.repeat(time_us[starts + n_each - 1], n_each)
    half_us = np.minimum(SMOOTHING_HALF_WIDTH_US, np.minimum(time_us - first_us, last_us - time_us))
    low = np.searchsorted(time_us, time_us - half_us, side="left")
    high = np.searchsorted(time_us, time_us + half_us, side="right")
    centre = values.mean()  # keeps the running sum small, hence exact
    running = np.concatenate(([0.0], np.cumsum(values - centre)))
    return np.asarray(centre + (running[high] - running[low]) / (high - low), dtype=np.float64)
