"""From a source's frames to frames along a route: in order, without spikes, measured; the others are named."""

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

UNPLACED = math.nan  # position_m of a frame for which the source states none
LEAPS = 2.0  # frames leap in another order if a step is more than so many times the longest of their own order
STATED_SPEEDS = 100.0  # times the typical speed that stated positions may jump at: somebody may have meant it


@dataclass
class Placement:
    """Frames along the route, and the names of those left out."""

    frames: Sequence[Frame]
    left_out_names: dict[str, list[str]] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    deadband_m: float = DEADBAND_M  # positions that differ by less are one place

    def leave_out(self, usable: Sequence[bool], reason: str) -> None:
        """Keep the usable frames, and leave out the others for `reason`."""
        lost_names = [frame.name for frame, is_usable in zip(self.frames, usable, strict=True) if not is_usable]
        if lost_names:
            self.left_out_names[reason] = lost_names
        self.frames = [frame for frame, is_usable in zip(self.frames, usable, strict=True) if is_usable]

    def follow(self, later: "Placement") -> None:
        """Take over the frames of a later step, and add its left-out names and remarks."""
        self.frames = later.frames
        self.left_out_names |= later.left_out_names
        self.remarks += later.remarks

    def put_at(self, position_m: Reals) -> None:
        """Set the frames' positions along the route, [n] metres."""
        places = zip(self.frames, position_m.tolist(), strict=True)
        self.frames = [dataclasses.replace(frame, position_m=position) for frame, position in places]

    def number(self) -> None:
        """Count the frames' indices from 0."""
        self.frames = [dataclasses.replace(frame, index=index) for index, frame in enumerate(self.frames)]


def place_frames(frames: Sequence[Frame], source: str, deadband_m: float = DEADBAND_M) -> Placement:
    """Put frames on the route, by their stated `position_m` where any has one, else by the distance along x_m, y_m.

    Frames are put in the order of their times, if at least half of these are known and that order does not leap about
    where the given one goes on. Indices count anew from 0. Stated positions that fall along the drive stay falling.
    `source` names the frames' file or folder in errors.

    Raises SourceError (no frame has a position, or positions go to and fro).
    """
    placement = Placement(frames, deadband_m=deadband_m)
    is_stated = any(math.isfinite(frame.position_m) for frame in frames)
    has_place = [
        math.isfinite(frame.position_m) if is_stated else frame.x_m is not None and frame.y_m is not None
        for frame in frames
    ]
    placement.leave_out(has_place, "without a position")
    if not placement.frames:
        raise SourceError(f"{source}: none of {len(frames)} frames has a position")
    time_us = _in_time_order(placement, is_stated)
    if is_stated:
        _use_stated(placement, time_us, source)
    else:
        _measure(placement, time_us, source)
    placement.number()
    return placement


def place_on_track(
    track: Track,
    images: Sequence[tuple[str, int]],
    source: str,
    rows_name: str = "the positions",
    *,
    together: bool = False,
) -> Placement:
    """Put images, (name, microseconds), where a track was at their times. Raises SourceError (none is on it).

    `source` and `rows_name` name the images' folder and the track's rows in messages. With `together`, images whose
    times do not count from 1970, as the track's do, begin with the track.
    """
    remarks, given_us = [], np.array([time for _, time in images], np.int64)
    if (np.diff(given_us) < 0).any():
        step_text = _step_back([Frame(0, name, UNPLACED) for name, _ in images], given_us)
        remarks.append(f"{step_text}: they are taken in the order of their times. Was a clock set on the way?")
    images = sorted(images, key=lambda image: image[1])
    if together and images[-1][1] < FIRST_US <= track.time_us[0]:
        images = [(name, time + int(track.time_us[0])) for name, time in images]
        remarks.append(f"{rows_name} say the time, the images do not: they are taken to begin together")
    leap_row = by_turns(track.x_m, track.y_m)
    if leap_row is not None:
        raise SourceError(
            f"{source}: rows of {rows_name} leap to and fro from {_moment(track.time_us[leap_row])} on: are these "
            "several drives by turns? Give each a file of its own"
        )
    time_us = np.array([time for _, time in images], dtype=np.int64)
    poses = track.at(time_us)
    if not (poses.covered & ~poses.in_gap).any():
        raise SourceError(
            f"{source}: none of {len(images)} images has a position: they are of {_span(time_us)}, {rows_name} of "
            f"{_span(track.time_us)}. Are they of one drive? --time-offset-s corrects the images' clock"
        )
    columns = (values.tolist() for values in (poses.position_m, poses.x_m, poses.y_m, poses.heading_rad))
    placement = Placement(
        [
            Frame(0, name, position_m, time, x_m, y_m, None if math.isnan(heading_rad) else heading_rad)
            for (name, time), position_m, x_m, y_m, heading_rad in zip(images, *columns, strict=True)
        ],
        remarks=remarks,
    )
    placement.remarks += track.remarks
    if track.n_skipped_rows:
        placement.remarks.append(
            f"{track.n_skipped_rows} rows of {rows_name} are not used (unreadable, without a place or a time, or where "
            "no robot can have been)"
        )
    placement.leave_out(poses.covered.tolist(), f"before or after {rows_name}")
    placement.leave_out((~poses.in_gap[poses.covered]).tolist(), f"gap in {rows_name}")
    placement.number()
    _tell_standing(
        placement, placement.frames[-1].position_m - placement.frames[0].position_m, f"{rows_name} are not in metres"
    )
    return placement


def _span(time_us: Times) -> str:
    return f"{_moment(time_us.min())} to {_moment(time_us.max())}"


def _moment(time_us: np.int64) -> str:
    return datetime.fromtimestamp(int(time_us) / 1e6, UTC).isoformat(timespec="milliseconds")


def _in_time_order(placement: Placement, is_stated: bool) -> Times | None:
    """Sort the frames by time if at least half have one and these differ; returns [n] all times, filled in between.

    None: the frames stay in their own order, for their times are too few, or wrong.
    """
    timed_rows = [
        (place, frame.timestamp_us) for place, frame in enumerate(placement.frames) if frame.timestamp_us is not None
    ]
    if 2 * len(timed_rows) < len(placement.frames) or len({time for _, time in timed_rows}) < 2:
        return None
    place, known_us = np.array(timed_rows, np.int64).T
    times = _fill_times(place, known_us, len(placement.frames)).tolist()
    if len(timed_rows) < len(times):
        placement.remarks.append(
            f"{len(times) - len(timed_rows)} frames say no time: they are taken between their neighbours"
        )
    time_us = np.array(times, dtype=np.int64)
    fits = np.isin(np.arange(len(times)), longest_rising(times))
    if 0 < (~fits).sum() <= MOST_LEFT_OUT * len(times):  # a few wrong times, not wrong names
        placement.leave_out(fits.tolist(), "whose time goes back")
        time_us = time_us[fits]
    order = np.argsort(time_us, kind="stable")
    if (np.diff(time_us) < 0).any():
        leap = _leap(placement.frames, order, is_stated)
        if leap is not None:
            placement.frames = [dataclasses.replace(frame, timestamp_us=None) for frame in placement.frames]
            placement.remarks.append(
                f"{_step_back(placement.frames, time_us)}, and {leap}: a clock was set on the way. "
                "Frames stay in the order of their names, and their times are not used"
            )
            return None
        placement.frames = [placement.frames[place] for place in order]
        placement.remarks.append("frames are taken in the order of their times, which is not that of their names")
    return _spread_equal(time_us[order])


def _spread_equal(time_us: Times) -> Times:
    """[n] non-decreasing times with equal ones, of a clock too coarse for the frames, spread evenly up to the next."""
    starts = np.flatnonzero(np.diff(time_us, prepend=time_us[0] - 1))
    if len(starts) in {1, len(time_us)}:
        return time_us
    ends = np.append(starts[1:], len(time_us))
    last_us = time_us[-1] + np.median(np.diff(time_us[starts]))
    knots = np.append(starts, ends[-1])
    times = np.append(time_us[starts] - time_us[0], last_us - time_us[0])
    return np.asarray(time_us[0] + np.round(np.interp(np.arange(len(time_us)), knots, times)), np.int64)


def _leap(frames: Sequence[Frame], order: NDArray[np.intp], is_stated: bool) -> str | None:
    """In words, how frames leap from place to place in `order` but not in their own order; None: they do not."""
    places = [(frame.position_m, 0.0) if is_stated else (frame.x_m, frame.y_m) for frame in frames]
    x_m, y_m = np.array(places, np.float64).T
    is_usable = on_track(x_m, y_m, None, STATED_SPEEDS if is_stated else SPIKE_SPEEDS)
    if is_usable.mean() < 1 - MOST_LEFT_OUT:
        return None
    own_m, other_m = (
        float(np.hypot(np.diff(x_m[rows]), np.diff(y_m[rows])).max())
        for rows in (np.flatnonzero(is_usable), order[is_usable[order]])
    )
    if other_m <= LEAPS * own_m:
        return None
    return f"in the order of times they would leap by {other_m:.0f} m, by their names they go {own_m:.1f} m at most"


def _step_back(frames: Sequence[Frame], time_us: Times) -> str:
    row = int(np.argmin(np.diff(time_us)))
    back_s = (time_us[row] - time_us[row + 1]) / 1e6
    return f"{frames[row + 1].name} says {back_s:.1f} s before {frames[row].name}"


def _fill_times(known_rows: Times, known_us: Times, n: int) -> Times:
    """[n] the times of all frames, known at `known_rows`: between them even, beyond them a median step apart."""
    step_us = float(np.median(np.abs(np.diff(known_us)) / np.diff(known_rows)))
    rows = np.arange(n)
    offsets_us = np.interp(rows, known_rows, known_us - known_us[0]) - step_us * np.maximum(known_rows[0] - rows, 0)
    offsets_us += step_us * np.maximum(rows - known_rows[-1], 0)
    return np.asarray(known_us[0] + np.round(offsets_us), np.int64)


def _measure(placement: Placement, time_us: Times | None, source: str) -> None:
    x_m, y_m = (np.array([getattr(frame, axis) for frame in placement.frames], np.float64) for axis in ("x_m", "y_m"))
    _refuse_turns(placement, x_m, y_m, source)
    usable = on_track(x_m, y_m, time_us)
    _without_spikes(placement, usable, x_m, y_m)
    along_m = arc_length_m(x_m[usable], y_m[usable], None if time_us is None else time_us[usable], placement.deadband_m)
    _tell_standing(
        placement, float(along_m[-1]), "x_m, y_m are no metres (degrees go into columns latitude, longitude)"
    )
    placement.put_at(along_m)


def _use_stated(placement: Placement, time_us: Times | None, source: str) -> None:
    position_m = np.array([frame.position_m for frame in placement.frames], np.float64)
    _refuse_turns(placement, position_m, np.zeros_like(position_m), source)
    usable = on_track(position_m, np.zeros_like(position_m), time_us, STATED_SPEEDS)
    _without_spikes(placement, usable, position_m, np.zeros_like(position_m))
    position_m = position_m[usable]
    risen_m, rises = rising_m(position_m)
    fallen_m, falls = rising_m(-position_m)
    turned_m, usable = (-fallen_m, falls) if falls.sum() > rises.sum() else (risen_m, rises)
    n_back = int((~usable).sum())
    if n_back > MOST_LEFT_OUT * len(usable):
        names = [frame.name for frame in placement.frames]
        upwards = -position_m if falls.sum() > rises.sum() else position_m
        farthest = np.maximum.accumulate(upwards)
        back_row = int(np.argmax(upwards < farthest - back_tolerance_m(position_m)))
        top_row = int(np.argmax(upwards[:back_row]))
        raise SourceError(
            f"{source}: positions go to and fro: {names[back_row]} is at {position_m[back_row]:.2f} m after "
            f"{position_m[top_row]:.2f} m ({names[top_row]}), and {n_back} of {len(names)} frames go against the rest; "
            "a route goes one way. Give x_m, y_m in place of position_m, or cut the recording there into folders of "
            "its parts"
        )
    placement.leave_out(usable.tolist(), "where the position goes back")
    _tell_standing(placement, float(np.ptp(turned_m[usable])), "position_m is not in metres")
    placement.put_at(turned_m[usable])


def _refuse_turns(placement: Placement, x_m: Reals, y_m: Reals, source: str) -> None:
    """Check that places do not leap to and fro as those of several drives by turns do; raises SourceError."""
    leap_row = by_turns(x_m, y_m)
    if leap_row is not None:
        first, second = placement.frames[leap_row - 1 : leap_row + 1]
        apart_m = math.hypot(x_m[leap_row] - x_m[leap_row - 1], y_m[leap_row] - y_m[leap_row - 1])
        raise SourceError(
            f"{source}: places leap to and fro, {first.name} and {second.name} are {apart_m:.0f} m apart: are these "
            "several drives by turns? Move each into a folder of its own"
        )


def _tell_standing(placement: Placement, length_m: float, otherwise: str) -> None:
    if len(placement.frames) > 2 and length_m < DEADBAND_M:
        placement.remarks.append(f"all frames lie within {length_m:.2g} m: the robot stood, or {otherwise}")


def _without_spikes(placement: Placement, usable: np.ndarray, x_m: Reals, y_m: Reals) -> None:
    """Leave out the frames that are not usable, and remark how far off the first of them is."""
    if usable.all():
        return
    spike_row = int(np.flatnonzero(~usable)[0])
    nearest_row = int(np.flatnonzero(usable)[np.abs(np.flatnonzero(usable) - spike_row).argmin()])
    off_m = math.hypot(x_m[spike_row] - x_m[nearest_row], y_m[spike_row] - y_m[nearest_row])
    placement.remarks.append(
        f"{placement.frames[spike_row].name} would be {off_m:.0f} m from {placement.frames[nearest_row].name}"
    )
    placement.leave_out(usable.tolist(), "where no robot can have been")
