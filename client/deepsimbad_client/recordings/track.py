"""From positions as they were recorded, with jitter, spikes and gaps, to metres along the route: every reader's rules.

A spike is what nothing on the ground drives: positions that cannot be reached from those before and after them at five
times the recording's own speed. Noise is told by third differences, which neither driving nor turning makes large.
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
MOST_TREMBLE_M = 0.025  # of poses; what trembles more is a receiver's, and wanders too
WANDER_S, WANDER_M_S = 30.0, 0.4  # A standing receiver gets no farther than so fast within so long
MAX_GAP_S = 1.0  # Between rows of a track farther apart than this nothing is interpolated: the robot may have turned
FEWEST_FOR_NOISE = 16  # positions of which noise can be told
MOST_SPIKES = 1000  # in a row, after which a track goes on
MOST_NOISE_M = 10.0  # What leaps farther, as frames of two drives by turns, is none
FEWEST_BY_TURNS, BACK_WITHIN, LEAP_BY_TURNS_M = 10, 4, 3.0  # of several drives' frames by turns
SPIKE_M, SPIKE_NOISES, SPIKE_SPEEDS = 0.5, 8.0, 5.0
SLOWEST_LIMIT_M_S, FASTEST_M_S = 5.0, 100.0  # Whatever its usual speed, a robot may drive the one, none the other

Reals = NDArray[np.float64]
Times = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses at [n] asked times; where `covered` is False or `in_gap` True the values mean nothing."""

    covered: NDArray[np.bool_]  # the time lies between the first and the last of the track's
    in_gap: NDArray[np.bool_]  # covered, but between two rows too far apart to interpolate
    x_m: Reals
    y_m: Reals
    heading_rad: Reals  # in (-pi, pi], from x towards y; NaN: not known
    position_m: Reals  # along the track


@dataclass(frozen=True, eq=False)
class Track:
    """Where a robot was: as `Poses`, at [m] strictly increasing times."""

    time_us: Times
    x_m: Reals
    y_m: Reals
    heading_rad: Reals
    position_m: Reals
    n_skipped_rows: int = 0  # that held NaN, too few values, no numbers, or a place that no robot can have been at
    max_gap_s: float = MAX_GAP_S
    remarks: Sequence[str] = ()

    def at(self, time_us: Times) -> Poses:
        """Interpolate at [n] times, in any order: x, y and position linearly, heading the short way round."""
        covered = (time_us >= self.time_us[0]) & (time_us <= self.time_us[-1])
        last = len(self.time_us) - 1
        before = np.clip(np.searchsorted(self.time_us, time_us, side="right") - 1, 0, last)
        after = np.minimum(before + 1, last)
        # Differences of int64 first: absolute microseconds and fractions of them do not fit one float.
        step_us = self.time_us[after] - self.time_us[before]
        since_us = np.clip(time_us - self.time_us[before], 0, step_us)
        share = since_us / np.maximum(step_us, 1)

        def between(values: Reals) -> Reals:
            return np.asarray(values[before] + share * (values[after] - values[before]), dtype=np.float64)

        turn = wrapped_rad(self.heading_rad[after] - self.heading_rad[before])
        return Poses(
            covered=covered,
            in_gap=covered & (since_us > 0) & (step_us > self.max_gap_s * 1e6),
            x_m=between(self.x_m),
            y_m=between(self.y_m),
            heading_rad=wrapped_rad(self.heading_rad[before] + share * turn),
            position_m=between(self.position_m),
        )


def track_of(
    time_us: Times, x_m: Reals, y_m: Reals, heading_rad: Reals | None = None, deadband_m: float = DEADBAND_M
) -> Track | None:
    """The track that rows [k] tell, in whatever state they are; None: fewer than two can be used.

    Rows out of order are sorted, of one time the first stays, those with NaN and spikes are not used.
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
        *(times, x_m, y_m, wrapped_rad(heading_rad[rows]), arc_length_m(x_m, y_m, times, deadband_m)),
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
    """Which position [n] is the first to leap elsewhere and back, where a third and more do; None: fewer do.

    So do the positions of several drives by turns. White noise comes back so near in at most a ninth of all steps.
    """
    if len(x_m) < FEWEST_BY_TURNS:
        return None
    n = len(x_m) - BACK_WITHIN
    away_m = [
        np.hypot(x_m[apart : apart + n] - x_m[:n], y_m[apart : apart + n] - y_m[:n])
        for apart in range(1, BACK_WITHIN + 1)
    ]
    leaps = (away_m[0] > LEAP_BY_TURNS_M) & (5 * np.min(away_m[1:], axis=0) < away_m[0])
    return int(np.argmax(leaps)) + 1 if leaps.mean() >= 1 / 3 else None


def on_track(x_m: Reals, y_m: Reals, time_us: Times | None, speeds: float = SPIKE_SPEEDS) -> NDArray[np.bool_]:
    """Which positions [n], in travel order, a robot can have been at; False: a spike.

    Jumps cut the track into stretches; those are kept that make the longest way on which each is reached from the end
    of the one before, in the time between, at `speeds` times the usual speed. Without times a frame is the unit.
    """
    n = len(x_m)
    if n < 3:
        return np.ones(n, dtype=np.bool_)
    noise = noise_m(x_m, y_m)
    clock = np.arange(n, dtype=np.float64) if time_us is None else (time_us - time_us[0]) / 1e6
    ticks = np.abs(np.diff(clock))
    tick = float(np.median(ticks[ticks > 0])) if (ticks > 0).any() else 1.0

    def usual(apart: int, above: float) -> float:
        moved = np.hypot(x_m[apart:] - x_m[:-apart], y_m[apart:] - y_m[:-apart]) - DEADBAND_NOISES * noise
        speed = moved / np.maximum(np.abs(clock[apart:] - clock[:-apart]), tick)
        return float(np.median(speed[speed > above])) if (speed > above).any() else 0.0

    limit = speeds * usual(min(10, n // 3), 0.0)
    if time_us is not None:  # most of the time it may have stood
        limit = max(limit, speeds * usual(min(max(10, int(WANDER_S / tick)), n // 3), WANDER_M_S))
        limit = min(max(limit, SLOWEST_LIMIT_M_S), FASTEST_M_S)
    slack = SPIKE_M + SPIKE_NOISES * noise + limit * tick
    jumps = np.flatnonzero(np.hypot(np.diff(x_m), np.diff(y_m)) > slack + limit * ticks)
    starts = np.concatenate(([0], jumps + 1))
    ends = np.concatenate((jumps, [n - 1]))
    best = ends - starts + 1  # positions on the longest way that ends with each stretch
    before = np.full(len(starts), -1)
    for stretch in range(1, len(starts)):
        known = slice(max(0, stretch - MOST_SPIKES), stretch)
        last, start = ends[known], starts[stretch]
        away_m = np.hypot(x_m[last] - x_m[start], y_m[last] - y_m[start])
        reached = np.where(away_m <= slack + limit * np.abs(clock[start] - clock[last]), best[known], 0)
        if reached.any():
            before[stretch] = known.start + int(np.argmax(reached))
            best[stretch] += reached.max()
    ok, stretch = np.zeros(n, dtype=np.bool_), int(np.argmax(best))
    while stretch >= 0:
        ok[starts[stretch] : ends[stretch] + 1] = True
        stretch = int(before[stretch])
    return ok


def arc_length_m(x_m: Reals, y_m: Reals, time_us: Times | None = None, deadband_m: float = DEADBAND_M) -> Reals:
    """How far a track [n], in travel order, has gone at each of its poses: [n] metres, non-decreasing, 0 at the first.

    A pose stream of 100-150 Hz trembles by centimetres, GPS by decimetres, and summing its steps as they are turns
    a minute of standing into a hundred metres of driving. So, where non-decreasing times [n] are given, each pose is
    first averaged with those within a quarter of a second; the track is then walked by anchors (`walked_m`), at least
    `deadband_m` and six times the noise that is left apart. A robot that moves straight on gets its distance exactly,
    at every pose and not only at anchors.
    """
    if len(x_m) == 0:
        return np.zeros(0, dtype=np.float64)
    noise = noise_m(x_m, y_m)
    of_receiver = deadband_m > DEADBAND_M or noise > MOST_TREMBLE_M
    if time_us is not None:
        n_averaged = _window(time_us)
        x_m, y_m = _averaged(x_m, *n_averaged), _averaged(y_m, *n_averaged)
        noise /= float(np.sqrt(np.median(n_averaged[1] - n_averaged[0])))
        if of_receiver:
            x_m, y_m = _stood_still(x_m, y_m, time_us)
    return walked_m(x_m, y_m, max(deadband_m, DEADBAND_NOISES * noise))


def _stood_still(x_m: Reals, y_m: Reals, time_us: Times) -> tuple[Reals, Reals]:
    """A receiver's track [n] with each standstill a straight line from its beginning to its end.

    One that stands wanders by metres over minutes. It stands where it is slower than `WANDER_M_S` and a third of the
    usual speed, that at which half of the way was made, over half a minute, and than three quarters over six seconds,
    for a robot may drive in circles.
    """
    seconds = (time_us - time_us[0]) / 1e6

    def speed(over_s: float) -> Reals:
        before, after = (np.clip(seconds + half, 0, seconds[-1]) for half in (-over_s / 2, over_s / 2))
        apart = (np.interp(after, seconds, axis) - np.interp(before, seconds, axis) for axis in (x_m, y_m))
        return np.asarray(np.hypot(*apart) / np.maximum(after - before, 1e-6))

    quick = speed(6.0)
    order = np.argsort(quick)
    way = np.cumsum(quick[order])
    usual = float(quick[order][np.searchsorted(way, way[-1] / 2)])
    still = (speed(WANDER_S) < min(WANDER_M_S, usual / 3)) & (quick < 0.75 * usual)
    kept = ~still
    kept[1:] |= ~still[:-1]
    kept[:-1] |= ~still[1:]
    kept[[0, -1]] = True
    return np.interp(seconds, seconds[kept], x_m[kept]), np.interp(seconds, seconds[kept], y_m[kept])


def walked_m(x_m: Reals, y_m: Reals, deadband_m: float) -> Reals:
    """Walk a track [n] by anchors.

    The position is the distance summed up to the last anchor plus the greatest distance from it reached so far, and a
    pose at least `deadband_m` away becomes the next anchor.
    """
    travelled = np.zeros(len(x_m), dtype=np.float64)
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


def back_tolerance_m(position_m: Reals) -> float:
    """How far stated positions may step back while the robot stands."""
    return max(DEADBAND_M, DEADBAND_NOISES * noise_m(position_m))


def rising_m(position_m: Reals) -> tuple[Reals, NDArray[np.bool_]]:
    """Stated positions [n] without steps back within their noise: those, and which can be used.

    The longest sequence that does not fall is kept as it is; what lies beside it by no more than `DEADBAND_M` or six
    times the noise is taken as standing; the rest goes back, and the robot may have too.
    """
    tolerance = back_tolerance_m(position_m)
    chosen = longest_rising(position_m.tolist())
    place = np.arange(len(position_m))
    before = position_m[chosen][np.maximum(np.searchsorted(chosen, place, side="right") - 1, 0)]
    after = position_m[chosen][np.minimum(np.searchsorted(chosen, place), len(chosen) - 1)]
    usable = (position_m >= before - tolerance) & (position_m <= after + tolerance)
    risen = position_m.copy()
    risen[usable] = np.maximum.accumulate(position_m[usable])
    return risen, usable


def longest_rising(values: Sequence[float]) -> NDArray[np.intp]:
    """Places of the longest subsequence that does not fall."""
    tails: list[float] = []
    tail_places: list[int] = []
    previous = [-1] * len(values)
    for place, value in enumerate(values):
        at = bisect_right(tails, value)
        previous[place] = tail_places[at - 1] if at else -1
        tails[at : at + 1] = [value]
        tail_places[at : at + 1] = [place]
    chosen, place = [], tail_places[-1]
    while place >= 0:
        chosen.append(place)
        place = previous[place]
    return np.array(chosen[::-1], dtype=np.intp)


def _window(time_us: Times) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """From which pose to which each is averaged; one-sided windows would shift both ends of every drive and gap."""
    breaks = np.flatnonzero(np.diff(time_us) > SMOOTHING_HALF_WIDTH_US) + 1
    starts = np.concatenate(([0], breaks))
    lengths = np.diff(np.concatenate((starts, [len(time_us)])))
    first_us = np.repeat(time_us[starts], lengths)
    last_us = np.repeat(time_us[starts + lengths - 1], lengths)
    half_us = np.minimum(SMOOTHING_HALF_WIDTH_US, np.minimum(time_us - first_us, last_us - time_us))
    low = np.searchsorted(time_us, time_us - half_us, side="left")
    return low, np.searchsorted(time_us, time_us + half_us, side="right")


def _averaged(values: Reals, low: NDArray[np.intp], high: NDArray[np.intp]) -> Reals:
    """The mean of each pose's window."""
    centre = values.mean()  # keeps the running sum small, hence exact
    running = np.concatenate(([0.0], np.cumsum(values - centre)))
    return np.asarray(centre + (running[high] - running[low]) / (high - low), dtype=np.float64)
