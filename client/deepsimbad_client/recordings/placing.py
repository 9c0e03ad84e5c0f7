"""Frames as a source tells of them become frames along a route: in order, without spikes, measured, the rest named."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings import MOST_LEFT_OUT, Frame
from deepsimbad_client.recordings.names import FIRST_US
from deepsimbad_client.recordings.track import (
    DEADBAND_M,
    SPIKE_SPEEDS,
    Reals,
    Times,
    Track,
    arc_length_m,
    back_tolerance_m,
    by_turns,
    longest_rising,
    on_track,
    rising_m,
)

UNPLACED = math.nan  # position_m of a frame of which the source says none
LEAPS = 2.0  # Frames leap in an order where they go farther at once than so many of their longest steps
STATED_SPEEDS = 100.0  # A stated position may jump by so many usual steps: somebody may have meant it


@dataclass
class Placed:
    """Frames along the route, and what became of the others."""

    frames: Sequence[Frame]
    left_out_names: dict[str, list[str]] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    deadband_m: float = DEADBAND_M  # of the positions: within it nobody has moved

    def leave_out(self, usable: Sequence[bool], reason: str) -> None:
        """Keep the usable ones of the frames."""
        lost = [frame.name for frame, good in zip(self.frames, usable, strict=True) if not good]
        if lost:
            self.left_out_names[reason] = lost
        self.frames = [frame for frame, good in zip(self.frames, usable, strict=True) if good]

    def follow(self, later: "Placed") -> None:
        """Take over the frames of a later step, with what it left out and said."""
        self.frames = later.frames
        self.left_out_names |= later.left_out_names
        self.remarks += later.remarks

    def put_at(self, position_m: Reals) -> None:
        """Say where along the route each of the frames [n] is."""
        places = zip(self.frames, position_m.tolist(), strict=True)
        self.frames = [dataclasses.replace(frame, position_m=at) for frame, at in places]

    def number(self) -> None:
        """Count the frames' indices from 0."""
        self.frames = [dataclasses.replace(frame, index=index) for index, frame in enumerate(self.frames)]


def placed(frames: Sequence[Frame], where: str, deadband_m: float = DEADBAND_M) -> Placed:
    """Put frames on the route, by their stated `position_m` where any has one, else by the distance along x_m, y_m.

    Frames come in the order of their times, where half of them and more are known and that order does not leap about
    where the given one goes on. Indices count anew from 0. Stated positions that fall along the drive stay falling.

    Raises SourceError (no frame has a position, or positions go to and fro).
    """
    result = Placed(frames, deadband_m=deadband_m)
    stated = any(math.isfinite(frame.position_m) for frame in frames)
    has_place = [
        math.isfinite(frame.position_m) if stated else frame.x_m is not None and frame.y_m is not None
        for frame in frames
    ]
    result.leave_out(has_place, "without a position")
    if not result.frames:
        raise SourceError(f"{where}: none of {len(frames)} frames has a position")
    time_us = _in_time_order(result, stated)
    if stated:
        _use_stated(result, time_us, where)
    else:
        _measure(result, time_us, where)
    result.number()
    return result


def placed_on(
    track: Track, images: Sequence[tuple[str, int]], where: str, what: str = "the positions", *, together: bool = False
) -> Placed:
    """Put images, names and microseconds, where a track was at their times. Raises SourceError (none is on it).

    With `together`, images whose times do not count from 1970, as the track's do, begin with the track.
    """
    remarks, given_us = [], np.array([time for _, time in images], np.int64)
    if (np.diff(given_us) < 0).any():
        back = _step_back([Frame(0, name, UNPLACED) for name, _ in images], given_us)
        remarks.append(f"{back}: they are taken in the order of their times. Was a clock set on the way?")
    images = sorted(images, key=lambda image: image[1])
    if together and images[-1][1] < FIRST_US <= track.time_us[0]:
        images = [(name, time + int(track.time_us[0])) for name, time in images]
        remarks.append(f"{what} say the time, the images do not: they are taken to begin together")
    leaping = by_turns(track.x_m, track.y_m)
    if leaping is not None:
        raise SourceError(
            f"{where}: rows of {what} leap to and fro from {_moment(track.time_us[leaping])} on: are these several "
            "drives by turns? Give each a file of its own"
        )
    time_us = np.array([time for _, time in images], dtype=np.int64)
    poses = track.at(time_us)
    if not (poses.covered & ~poses.in_gap).any():
        raise SourceError(
            f"{where}: none of {len(images)} images has a position: they are of {_span(time_us)}, {what} of "
            f"{_span(track.time_us)}. Are they of one drive? --time-offset-s corrects the images' clock"
        )
    columns = (values.tolist() for values in (poses.position_m, poses.x_m, poses.y_m, poses.heading_rad))
    result = Placed(
        [
            Frame(0, name, position_m, time, x_m, y_m, None if math.isnan(heading_rad) else heading_rad)
            for (name, time), position_m, x_m, y_m, heading_rad in zip(images, *columns, strict=True)
        ],
        remarks=remarks,
    )
    result.remarks += track.remarks
    if track.n_skipped_rows:
        result.remarks.append(
            f"{track.n_skipped_rows} rows of {what} are not used (unreadable, without a place or a time, or where no "
            "robot can have been)"
        )
    result.leave_out(poses.covered.tolist(), f"before or after {what}")
    result.leave_out((~poses.in_gap[poses.covered]).tolist(), f"gap in {what}")
    result.number()
    _tell_standing(result, result.frames[-1].position_m - result.frames[0].position_m, f"{what} are not in metres")
    return result


def _span(time_us: Times) -> str:
    return f"{_moment(time_us.min())} to {_moment(time_us.max())}"


def _moment(time_us: np.int64) -> str:
    return datetime.fromtimestamp(int(time_us) / 1e6, UTC).isoformat(timespec="milliseconds")


def _in_time_order(result: Placed, stated: bool) -> Times | None:
    """Sort the frames by time where half of them and more have one and these differ; the times, filled in between.

    None: they stay in their own order, for their times are too few, or wrong.
    """
    known = [(place, frame.timestamp_us) for place, frame in enumerate(result.frames) if frame.timestamp_us is not None]
    if 2 * len(known) < len(result.frames) or len({time for _, time in known}) < 2:
        return None
    place, known_us = np.array(known, np.int64).T
    times = _filled(place, known_us, len(result.frames)).tolist()
    if len(known) < len(times):
        result.remarks.append(f"{len(times) - len(known)} frames say no time: they are taken between their neighbours")
    time_us = np.array(times, dtype=np.int64)
    fits = np.isin(np.arange(len(times)), longest_rising(times))
    if 0 < (~fits).sum() <= MOST_LEFT_OUT * len(times):  # a few wrong times, not wrong names
        result.leave_out(fits.tolist(), "whose time goes back")
        time_us = time_us[fits]
    order = np.argsort(time_us, kind="stable")
    if (np.diff(time_us) < 0).any():
        leap = _leap(result.frames, order, stated)
        if leap is not None:
            result.frames = [dataclasses.replace(frame, timestamp_us=None) for frame in result.frames]
            result.remarks.append(
                f"{_step_back(result.frames, time_us)}, and {leap}: a clock was set on the way. "
                "Frames stay in the order of their names, and their times are not used"
            )
            return None
        result.frames = [result.frames[place] for place in order]
        result.remarks.append("frames are taken in the order of their times, which is not that of their names")
    return _resolved(time_us[order])


def _resolved(time_us: Times) -> Times:
    """Rising times, those that are equal, of a clock too coarse for the frames, evenly before the next one."""
    starts = np.flatnonzero(np.diff(time_us, prepend=time_us[0] - 1))
    if len(starts) in {1, len(time_us)}:
        return time_us
    ends = np.append(starts[1:], len(time_us))
    last_us = time_us[-1] + np.median(np.diff(time_us[starts]))
    knots = np.append(starts, ends[-1])
    times = np.append(time_us[starts] - time_us[0], last_us - time_us[0])
    return np.asarray(time_us[0] + np.round(np.interp(np.arange(len(time_us)), knots, times)), np.int64)


def _leap(frames: Sequence[Frame], order: NDArray[np.intp], stated: bool) -> str | None:
    """In words, how frames leap from place to place in an order, as they do not in their own; None: they do not."""
    places = [(frame.position_m, 0.0) if stated else (frame.x_m, frame.y_m) for frame in frames]
    x_m, y_m = np.array(places, np.float64).T
    usable = on_track(x_m, y_m, None, STATED_SPEEDS if stated else SPIKE_SPEEDS)
    if usable.mean() < 1 - MOST_LEFT_OUT:
        return None
    own_m, other_m = (
        float(np.hypot(np.diff(x_m[rows]), np.diff(y_m[rows])).max())
        for rows in (np.flatnonzero(usable), order[usable[order]])
    )
    if other_m <= LEAPS * own_m:
        return None
    return f"in the order of times they would leap by {other_m:.0f} m, by their names they go {own_m:.1f} m at most"


def _step_back(frames: Sequence[Frame], time_us: Times) -> str:
    at = int(np.argmin(np.diff(time_us)))
    back_s = (time_us[at] - time_us[at + 1]) / 1e6
    return f"{frames[at + 1].name} says {back_s:.1f} s before {frames[at].name}"


def _filled(place: Times, time_us: Times, n: int) -> Times:
    """The times of all n frames, those at `place` known: the others evenly between, at the ends a usual step apart."""
    step_us = float(np.median(np.abs(np.diff(time_us)) / np.diff(place)))
    at = np.arange(n)
    filled = np.interp(at, place, time_us - time_us[0]) - step_us * np.maximum(place[0] - at, 0)
    filled += step_us * np.maximum(at - place[-1], 0)
    return np.asarray(time_us[0] + np.round(filled), np.int64)


def _measure(result: Placed, time_us: Times | None, where: str) -> None:
    x_m, y_m = (np.array([getattr(frame, axis) for frame in result.frames], np.float64) for axis in ("x_m", "y_m"))
    _refuse_turns(result, x_m, y_m, where)
    usable = on_track(x_m, y_m, time_us)
    _without_spikes(result, usable, x_m, y_m)
    along_m = arc_length_m(x_m[usable], y_m[usable], None if time_us is None else time_us[usable], result.deadband_m)
    _tell_standing(result, float(along_m[-1]), "x_m, y_m are no metres (degrees go into columns latitude, longitude)")
    result.put_at(along_m)


def _use_stated(result: Placed, time_us: Times | None, where: str) -> None:
    position_m = np.array([frame.position_m for frame in result.frames], np.float64)
    _refuse_turns(result, position_m, np.zeros_like(position_m), where)
    usable = on_track(position_m, np.zeros_like(position_m), time_us, STATED_SPEEDS)
    _without_spikes(result, usable, position_m, np.zeros_like(position_m))
    position_m = position_m[usable]
    risen, rises = rising_m(position_m)
    fallen, falls = rising_m(-position_m)
    turned_m, usable = (-fallen, falls) if falls.sum() > rises.sum() else (risen, rises)
    n_back = int((~usable).sum())
    if n_back > MOST_LEFT_OUT * len(usable):
        names = [frame.name for frame in result.frames]
        upwards = -position_m if falls.sum() > rises.sum() else position_m
        farthest = np.maximum.accumulate(upwards)
        at = int(np.argmax(upwards < farthest - back_tolerance_m(position_m)))
        before = int(np.argmax(upwards[:at]))
        raise SourceError(
            f"{where}: positions go to and fro: {names[at]} is at {position_m[at]:.2f} m after "
            f"{position_m[before]:.2f} m ({names[before]}), and {n_back} of {len(names)} frames go against the rest; a "
            "route goes one way. Give x_m, y_m in place of position_m, or cut the recording there into folders of its "
            "parts"
        )
    result.leave_out(usable.tolist(), "where the position goes back")
    _tell_standing(result, float(np.ptp(turned_m[usable])), "position_m is not in metres")
    result.put_at(turned_m[usable])


def _refuse_turns(result: Placed, x_m: Reals, y_m: Reals, where: str) -> None:
    """Raises SourceError: places leap to and fro as those of several drives by turns do."""
    leaping = by_turns(x_m, y_m)
    if leaping is not None:
        before, after = result.frames[leaping - 1 : leaping + 1]
        apart_m = math.hypot(x_m[leaping] - x_m[leaping - 1], y_m[leaping] - y_m[leaping - 1])
        raise SourceError(
            f"{where}: places leap to and fro, {before.name} and {after.name} are {apart_m:.0f} m apart: are these "
            "several drives by turns? Move each into a folder of its own"
        )


def _tell_standing(result: Placed, length_m: float, otherwise: str) -> None:
    if len(result.frames) > 2 and length_m < DEADBAND_M:
        result.remarks.append(f"all frames lie within {length_m:.2g} m: the robot stood, or {otherwise}")


def _without_spikes(result: Placed, usable: np.ndarray, x_m: Reals, y_m: Reals) -> None:
    """Leave out what no robot can have reached, saying how far off the first of it is."""
    if usable.all():
        return
    at = int(np.flatnonzero(~usable)[0])
    nearest = int(np.flatnonzero(usable)[np.abs(np.flatnonzero(usable) - at).argmin()])
    off_m = math.hypot(x_m[at] - x_m[nearest], y_m[at] - y_m[nearest])
    result.remarks.append(f"{result.frames[at].name} would be {off_m:.0f} m from {result.frames[nearest].name}")
    result.leave_out(usable.tolist(), "where no robot can have been")
