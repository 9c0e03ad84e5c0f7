"""The rules by which every reader turns recorded positions, with jitter, spikes and gaps, into metres along the route.

A spike is a stretch of positions that cannot be reached from those before and after it at five times the recording's
own speed. Noise is measured by third differences, which neither driving nor turning makes large.
"""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.frames import MAX_POSITION_M

DEADBAND_M = 0.25
DEADBAND_NOISES = 6.0
SMOOTHING_HALF_WIDTH_US = 250_000
MOST_TREMBLE_M = 0.025  # of poses; positions that tremble more are a receiver's, and wander too
WANDER_S, WANDER_M_S = 30.0, 0.4  # A standing receiver gets no farther than so fast within so long
MAX_GAP_S = 1.0  # Between rows of a track farther apart than this nothing is interpolated: the robot may have turned
FEWEST_FOR_NOISE = 16  # positions by which noise can be measured
MOST_SPIKES = 1000  # in a row, after which a track goes on
MOST_NOISE_M = 10.0  # larger leaps, such as between frames of two drives by turns, are no noise
FEWEST_BY_TURNS, BACK_WITHIN, LEAP_BY_TURNS_M = 10, 4, 3.0  # of several drives' frames by turns
SPIKE_M, SPIKE_NOISES, SPIKE_SPEEDS = 0.5, 8.0, 5.0
SLOWEST_LIMIT_M_S, FASTEST_M_S = 5.0, 100.0  # bounds of the speed limit, whatever the recording's typical speed

Reals = NDArray[np.float64]
Times = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses at [n] requested times; where `covered` is False or `in_gap` True the values mean nothing."""

    covered: NDArray[np.bool_]  # the time lies between the first and the last of the track's
    in_gap: NDArray[np.bool_]  # covered, but between two rows too far apart to interpolate
    x_m: Reals
    y_m: Reals
    heading_rad: Reals  # in (-pi, pi], from x towards y; NaN: not known
    position_m: Reals  # along the track


@dataclass(frozen=True, eq=False)
class Track:
    """A robot's poses, as in `Poses`, at [m] strictly increasing times."""

    time_us: Times
    x_m: Reals
    y_m: Reals
    heading_rad: Reals
    position_m: Reals
    n_skipped_rows: int = 0  # rows with NaN, too few values, no numbers, or a place that no robot can have been at
    max_gap_s: float = MAX_GAP_S
    remarks: Sequence[str] = ()

    def at(self, time_us: Times) -> Poses:
        """Interpolate at [n] times, in any order: x, y and position linearly, heading the short way round."""
        covered = (time_us >= self.time_us[0]) & (time_us <= self.time_us[-1])
        last = len(self.time_us) - 1
        left = np.clip(np.searchsorted(self.time_us, time_us, side="right") - 1, 0, last)
        right = np.minimum(left + 1, last)
        # Differences of int64 first: absolute microseconds and fractions of them do not fit one float.
        step_us = self.time_us[right] - self.time_us[left]
        elapsed_us = np.clip(time_us - self.time_us[left], 0, step_us)
        share = elapsed_us / np.maximum(step_us, 1)

        def interpolated(values: Reals) -> Reals:
            return np.asarray(values[left] + share * (values[right] - values[left]), dtype=np.float64)

        turn = wrapped_rad(self.heading_rad[right] - self.heading_rad[left])
        return Poses(
            covered=covered,
            in_gap=covered & (elapsed_us > 0) & (step_us > self.max_gap_s * 1e6),
            x_m=interpolated(self.x_m),
            y_m=interpolated(self.y_m),
            heading_rad=wrapped_rad(self.heading_rad[left] + share * turn),
            position_m=interpolated(self.position_m),
        )


def track_of(
    time_us: Times, x_m: Reals, y_m: Reals, heading_rad: Reals | None = None, deadband_m: float = DEADBAND_M
) -> Track | None:
    """The track of rows [k], in whatever state they are; None: fewer than two can be used.

    Rows out of order are sorted, of equal times the first is used, rows with NaN and spikes are not.
    """
    usable = np.isfinite(time_us) & (np.abs(x_m) <= MAX_POSITION_M) & (np.abs(y_m) <= MAX_POSITION_M)
    if heading_rad is None:
        heading_rad = np.full(len(x_m), np.nan)
    else:
        usable &= np.isfinite(heading_rad)
    times, first = np.unique(time_us[usable].astype(np.int64), return_index=True)
    rows = np.flatnonzero(usable)[first]
    rows_on_track = on_track(x_m[rows], y_m[rows], times)
    times, rows = times[rows_on_track], rows[rows_on_track]
    if len(rows) < 2:
        return None
    x_m, y_m = x_m[rows], y_m[rows]
    return Track(
        times,
        x_m,
        y_m,
        wrapped_rad(heading_rad[rows]),
        arc_length_m(x_m, y_m, times, deadband_m),
        n_skipped_rows=int((~usable).sum() + (~rows_on_track).sum()),
        max_gap_s=max(MAX_GAP_S, 5e-6 * float(np.median(np.diff(times)))),
    )


def wrapped_rad(angle_rad: Reals) -> Reals:
    """Bring angles into (-pi, pi]."""
    return np.asarray(np.pi - np.mod(np.pi - angle_rad, 2 * np.pi), dtype=np.float64)


def noise_m(*axes: Reals) -> float:
    """The standard deviation of white noise on a track's axes [n]; 0 where there are too few positions to tell."""
    if len(axes[0]) < FEWEST_FOR_NOISE:
        return 0.0
    differences = np.abs(np.concatenate([np.diff(axis, 3) for axis in axes]))
    noise = float(np.median(differences) / 0.6745 / np.sqrt(20))  # of a normal: median / sigma; 1 + 9 + 9 + 1
    return min(noise, MOST_NOISE_M)


def by_turns(x_m: Reals, y_m: Reals) -> int | None:
    """The row of the first of positions [n] to leap away and back, if at least a third do; None: fewer do.

    The positions of several drives by turns do so. White noise comes back so near in at most a ninth of all steps.
    """
    if len(x_m) < FEWEST_BY_TURNS:
        return None
    n = len(x_m) - BACK_WITHIN
    away_m = [np.hypot(x_m[lag : lag + n] - x_m[:n], y_m[lag : lag + n] - y_m[:n]) for lag in range(1, BACK_WITHIN + 1)]
    leaps = (away_m[0] > LEAP_BY_TURNS_M) & (5 * np.min(away_m[1:], axis=0) < away_m[0])
    return int(np.argmax(leaps)) + 1 if leaps.mean() >= 1 / 3 else None


def on_track(x_m: Reals, y_m: Reals, time_us: Times | None, speeds: float = SPIKE_SPEEDS) -> NDArray[np.bool_]:
    """[n] whether a robot can have been at each of positions [n] in travel order; False: a spike.

    Jumps cut the track into stretches; those are kept that make the longest way on which each is reached from the end
    of the one before, in the time between, at `speeds` times the typical speed. Without times a frame is the unit.
    """
    n = len(x_m)
    if n < 3:
        return np.ones(n, dtype=np.bool_)
    noise = noise_m(x_m, y_m)
    clock = np.arange(n, dtype=np.float64) if time_us is None else (time_us - time_us[0]) / 1e6
    ticks = np.abs(np.diff(clock))
    tick = float(np.median(ticks[ticks > 0])) if (ticks > 0).any() else 1.0

    def typical_speed(lag: int, above: float) -> float:
        travel_m = np.hypot(x_m[lag:] - x_m[:-lag], y_m[lag:] - y_m[:-lag]) - DEADBAND_NOISES * noise
        speed = travel_m / np.maximum(np.abs(clock[lag:] - clock[:-lag]), tick)
        return float(np.median(speed[speed > above])) if (speed > above).any() else 0.0

    limit = speeds * typical_speed(min(10, n // 3), 0.0)
    if time_us is not None:  # most of the time it may have stood
        limit = max(limit, speeds * typical_speed(min(max(10, int(WANDER_S / tick)), n // 3), WANDER_M_S))
        limit = min(max(limit, SLOWEST_LIMIT_M_S), FASTEST_M_S)
    slack = SPIKE_M + SPIKE_NOISES * noise + limit * tick
    jumps = np.flatnonzero(np.hypot(np.diff(x_m), np.diff(y_m)) > slack + limit * ticks)
    starts = np.concatenate(([0], jumps + 1))
    ends = np.concatenate((jumps, [n - 1]))
    best = ends - starts + 1  # positions on the longest way that ends with each stretch
    previous = np.full(len(starts), -1)
    for stretch in range(1, len(starts)):
        earlier = slice(max(0, stretch - MOST_SPIKES), stretch)
        earlier_ends, start = ends[earlier], starts[stretch]
        away_m = np.hypot(x_m[earlier_ends] - x_m[start], y_m[earlier_ends] - y_m[start])
        lengths = np.where(away_m <= slack + limit * np.abs(clock[start] - clock[earlier_ends]), best[earlier], 0)
        if lengths.any():
            previous[stretch] = earlier.start + int(np.argmax(lengths))
            best[stretch] += lengths.max()
    ok, stretch = np.zeros(n, dtype=np.bool_), int(np.argmax(best))
    while stretch >= 0:
        ok[starts[stretch] : ends[stretch] + 1] = True
        stretch = int(previous[stretch])
    return ok


def arc_length_m(x_m: Reals, y_m: Reals, time_us: Times | None = None, deadband_m: float = DEADBAND_M) -> Reals:
    """The way from the first pose to each pose of a track [n] in travel order: [n] metres, non-decreasing, from 0.

    A pose stream of 100-150 Hz trembles by centimetres, GPS by decimetres, and the plain sum of its steps makes a
    minute of standing a hundred metres of driving. So, where non-decreasing times [n] are given, each pose is first
    averaged with those within a quarter of a second; the track is then walked by anchors (`walked_m`) that are at least
    `deadband_m` and six times the remaining noise apart. A robot that moves straight on gets its exact way at every
    pose, not only at anchors.
    """
    if len(x_m) == 0:
        return np.zeros(0, dtype=np.float64)
    noise = noise_m(x_m, y_m)
    of_receiver = deadband_m > DEADBAND_M or noise > MOST_TREMBLE_M
    if time_us is not None:
        n_averaged = _window(time_us)
        x_m, y_m = _average(x_m, *n_averaged), _average(y_m, *n_averaged)
        noise /= float(np.sqrt(np.median(n_averaged[1] - n_averaged[0])))
        if of_receiver:
            x_m, y_m = _straighten_standstills(x_m, y_m, time_us)
    return walked_m(x_m, y_m, max(deadband_m, DEADBAND_NOISES * noise))


def _straighten_standstills(x_m: Reals, y_m: Reals, time_us: Times) -> tuple[Reals, Reals]:
    """A receiver's track [n] with each standstill a straight line from its beginning to its end.

    The fixes of a standing receiver wander by metres over minutes. It stands where it is slower, over half a minute,
    than `WANDER_M_S` and than a third of the typical speed, and over six seconds than three quarters of it, for a robot
    may drive in circles. Half of the way was made below the typical speed.
    """
    seconds = (time_us - time_us[0]) / 1e6

    def speed(over_s: float) -> Reals:
        start_s, end_s = (np.clip(seconds + half, 0, seconds[-1]) for half in (-over_s / 2, over_s / 2))
        steps_m = (np.interp(end_s, seconds, axis) - np.interp(start_s, seconds, axis) for axis in (x_m, y_m))
        return np.asarray(np.hypot(*steps_m) / np.maximum(end_s - start_s, 1e-6))

    speed_m_s = speed(6.0)
    order = np.argsort(speed_m_s)
    way = np.cumsum(speed_m_s[order])
    typical_m_s = float(speed_m_s[order][np.searchsorted(way, way[-1] / 2)])
    is_still = (speed(WANDER_S) < min(WANDER_M_S, typical_m_s / 3)) & (speed_m_s < 0.75 * typical_m_s)
    is_knot = ~is_still
    is_knot[1:] |= ~is_still[:-1]
    is_knot[:-1] |= ~is_still[1:]
    is_knot[[0, -1]] = True
    return np.interp(seconds, seconds[is_knot], x_m[is_knot]), np.interp(seconds, seconds[is_knot], y_m[is_knot])


def walked_m(x_m: Reals, y_m: Reals, deadband_m: float) -> Reals:
    """The way along a track [n] by anchors, [n] metres from 0.

    It is the sum of the distances up to the last anchor plus the greatest distance from it so far; a pose at least
    `deadband_m` away becomes the next anchor.
    """
    travelled_m = np.zeros(len(x_m), dtype=np.float64)
    xs, ys = x_m.tolist(), y_m.tolist()
    anchor_x, anchor_y = xs[0], ys[0]
    up_to_anchor = farthest = 0.0
    for i, (x, y) in enumerate(zip(xs, ys, strict=True)):
        away = hypot(x - anchor_x, y - anchor_y)
        farthest = max(farthest, away)
        travelled_m[i] = up_to_anchor + farthest
        if away >= deadband_m:
            up_to_anchor += away
            anchor_x, anchor_y, farthest = x, y, 0.0
    return travelled_m


def back_tolerance_m(position_m: Reals) -> float:
    """How far stated positions may step back while the robot stands."""
    return max(DEADBAND_M, DEADBAND_NOISES * noise_m(position_m))


def rising_m(position_m: Reals) -> tuple[Reals, NDArray[np.bool_]]:
    """Stated positions [n] made non-decreasing, and [n] whether each can be used.

    The longest sequence that does not fall is kept as it is; positions off it by no more than `DEADBAND_M` or six times
    the noise are taken as standing; the rest go back and cannot be used, for the robot may have gone back too.
    """
    tolerance = back_tolerance_m(position_m)
    rising_rows = longest_rising(position_m.tolist())
    rows = np.arange(len(position_m))
    lower_m = position_m[rising_rows][np.maximum(np.searchsorted(rising_rows, rows, side="right") - 1, 0)]
    upper_m = position_m[rising_rows][np.minimum(np.searchsorted(rising_rows, rows), len(rising_rows) - 1)]
    usable = (position_m >= lower_m - tolerance) & (position_m <= upper_m + tolerance)
    risen_m = position_m.copy()
    risen_m[usable] = np.maximum.accumulate(position_m[usable])
    return risen_m, usable


def longest_rising(values: Sequence[float]) -> NDArray[np.intp]:
    """Indices of the longest subsequence that does not fall."""
    tails: list[float] = []
    tail_places: list[int] = []
    previous = [-1] * len(values)
    for place, value in enumerate(values):
        index = bisect_right(tails, value)
        previous[place] = tail_places[index - 1] if index else -1
        tails[index : index + 1] = [value]
        tail_places[index : index + 1] = [place]
    places, place = [], tail_places[-1]
    while place >= 0:
        places.append(place)
        place = previous[place]
    return np.array(places[::-1], dtype=np.intp)


def _window(time_us: Times) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """[n] first row and [n] end row of the window over which each pose is averaged.

    Windows are symmetric: one-sided ones would shift both ends of every drive and gap.
    """
    breaks = np.flatnonzero(np.diff(time_us) > SMOOTHING_HALF_WIDTH_US) + 1
    starts = np.concatenate(([0], breaks))
    lengths = np.diff(np.concatenate((starts, [len(time_us)])))
    first_us = np.repeat(time_us[starts], lengths)
    last_us = np.repeat(time_us[starts + lengths - 1], lengths)
    half_us = np.minimum(SMOOTHING_HALF_WIDTH_US, np.minimum(time_us - first_us, last_us - time_us))
    low = np.searchsorted(time_us, time_us - half_us, side="left")
    return low, np.searchsorted(time_us, time_us + half_us, side="right")


def _average(values: Reals, low: NDArray[np.intp], high: NDArray[np.intp]) -> Reals:
    """The mean of each pose's window."""
    centre = values.mean()  # keeps the running sum small, hence exact
    sums = np.concatenate(([0.0], np.cumsum(values - centre)))
    return np.asarray(centre + (sums[high] - sums[low]) / (high - low), dtype=np.float64)
