"""Which frames of a recording are taken, and in which order: every few, from the other end, one turn, one drive."""

import dataclasses
import math
import re
from collections import Counter
from itertools import pairwise

import numpy as np

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings import Recording
from deepsimbad_client.recordings.names import counted_anew, dates_in

EARLY_SHARE = 0.02  # of a step, by which a frame may come before it is due
FEWEST_OF_A_TURN, NEAR_START_M = 10, 1.0
FEWEST_OF_A_KIND = 3
LONGEST_PAUSE_S, SAME_PLACE_M = 3600.0, 10.0  # of one drive, unless the robot goes on where it stood


def thinned(recording: Recording, every_s: float | None, every_m: float | None) -> Recording:
    """The first frame of every so many seconds or metres, counted anew; with neither all of them.

    Raises SourceError (both are given, one is not above 0, or the frames have no times).
    """
    every = every_s if every_m is None else every_m
    if every is None:
        return recording
    if (every_s is not None and every_m is not None) or not (math.isfinite(every) and every > 0):
        raise SourceError("frames are taken every so many seconds (--every-s) or metres (--every-m), above 0")
    at = [frame.position_m if every_m else (frame.timestamp_us or 0) / 1e6 for frame in recording.frames]
    if every_s is not None and any(frame.timestamp_us is None for frame in recording.frames):
        raise SourceError(
            f"{recording.name} does not say when its frames were taken: --every-m goes by their positions"
        )
    steps = np.floor((np.array(at) - at[0]) / every + EARLY_SHARE)  # a clock that trembles skips no frame
    rows = np.flatnonzero(np.diff(steps, prepend=np.nan) != 0)
    frames = tuple(dataclasses.replace(recording.frames[row], index=index) for index, row in enumerate(rows.tolist()))
    encodings = None if recording.encodings is None else recording.encodings[rows]
    return dataclasses.replace(recording, frames=frames, encodings=encodings, n_before_slice=recording.n_whole)


def one_turn(recording: Recording) -> Recording:
    """Of a drive along a closed route: without what comes after it reached its start again.

    Told by x, y: near the first frame within two usual steps, in its direction. What is not known stays.
    """
    places = [(frame.x_m, frame.y_m) for frame in recording.frames if frame.x_m is not None and frame.y_m is not None]
    if len(places) < max(len(recording.frames), FEWEST_OF_A_TURN):
        return recording
    x_m, y_m = np.array(places, np.float64).T
    steps = np.hypot(np.diff(x_m), np.diff(y_m))
    near_m = max(NEAR_START_M, 2 * float(np.median(steps[steps > 0]))) if (steps > 0).any() else NEAR_START_M
    away_m = np.hypot(x_m - x_m[0], y_m - y_m[0])
    left = int(np.argmax(away_m > 3 * near_m))
    ahead_x, ahead_y = x_m[left] - x_m[0], y_m[left] - y_m[0]
    onwards = np.gradient(x_m) * ahead_x + np.gradient(y_m) * ahead_y >= 0
    back = np.flatnonzero((np.arange(len(x_m)) > left) & (away_m <= near_m) & onwards)
    if not left or not len(back):
        return recording
    visit = back[: int(np.argmax(np.diff(back, append=len(x_m) + 2) > 1)) + 1]
    end = int(visit[np.argmin(away_m[visit])]) + 1
    if end == len(recording.frames):
        return recording
    said = (
        f"the start is reached again at {recording.frames[end - 1].name}: {len(recording.frames) - end} frames of a "
        "second turn are not used"
    )
    return dataclasses.replace(recording.sliced(slice(0, end)), remarks=[*recording.remarks, said])


def turned_back(recording: Recording) -> Recording:
    """The frames in the other order: positions that fell rise now; those that rose count from the other end."""
    first_m, last_m = recording.frames[0].position_m, recording.frames[-1].position_m
    frames = tuple(
        dataclasses.replace(
            frame, index=index, position_m=last_m - frame.position_m if last_m >= first_m else frame.position_m
        )
        for index, frame in enumerate(recording.frames[::-1])
    )
    encodings = None if recording.encodings is None else np.ascontiguousarray(recording.encodings[::-1])
    return dataclasses.replace(recording, frames=frames, encodings=encodings)


def _check_names(recording: Recording) -> None:
    """Refuse frames placed evenly in the order of names that are of two kinds, one after the other or by turns."""
    frames = recording.frames
    metres = np.array([frame.position_m for frame in frames]) - frames[0].position_m
    steps = np.array([frame.index for frame in frames]) - frames[0].index
    if len(frames) < 2 or frames[0].x_m is not None:
        return
    if not np.allclose(metres, steps * (metres[-1] / max(1, steps[-1]))):
        return
    names = [frame.name for frame in frames]
    kinds = [re.sub(r"[0-9]+(?:[.,][0-9]+)*", "0", name) for name in names]
    changes = np.flatnonzero([before != kind for before, kind in pairwise(kinds)]) + 1
    if 2 * len(changes) >= len(frames) and min(Counter(kinds).values()) >= FEWEST_OF_A_KIND:
        after = frames[int(changes[0])]
        raise SourceError(
            f"{recording.name}: {frames[int(changes[0]) - 1].name} and {after.name} are names of several kinds by "
            "turns: are these several drives or cameras? Move each into a folder of its own, or say in a positions.csv "
            "where each image was taken"
        )
    if frames[0].timestamp_us is not None:  # which tell by themselves
        return
    if len(set(kinds)) == 1 and dates_in(names) is None:
        changes = np.array(counted_anew(names), np.intp)
    ends = [0, *changes.tolist(), len(frames)]
    if len(changes) and min(np.diff(ends)) >= FEWEST_OF_A_KIND and len(set(kinds)) in {1, len(changes) + 1}:
        before, after = frames[ends[1] - 1], frames[ends[1]]
        what = "count anew" if len(set(kinds)) == 1 else "are names of two kinds"
        raise SourceError(
            f"{recording.name}: {before.name} and {after.name} {what}: are these several drives? Name "
            f"one of them by a slice (#:{after.index} or #{after.index}:), move them apart, or say in a positions.csv "
            "where each image was taken"
        )


def check_one_drive(recording: Recording) -> None:
    """Refuse what was recorded in several goes, elsewhere each: the way between was not recorded, nor is its length."""
    _check_names(recording)
    frames = [frame for frame in recording.frames if frame.timestamp_us is not None]
    times = [frame.timestamp_us / 1e6 for frame in frames if frame.timestamp_us is not None]
    if not frames and (dates := dates_in([frame.name for frame in recording.frames])) is not None:
        frames, times = list(recording.frames), [date.timestamp() for date in dates]
    if len(times) < 3:
        return
    pauses_s = np.abs(np.diff(times))
    longest = int(np.argmax(pauses_s))
    if pauses_s[longest] < max(LONGEST_PAUSE_S, 100 * float(np.median(pauses_s))):
        return
    before, after = frames[longest : longest + 2]
    if None not in (before.x_m, before.y_m, after.x_m, after.y_m):
        apart_m = math.dist((before.x_m or 0, before.y_m or 0), (after.x_m or 0, after.y_m or 0))
        if apart_m <= SAME_PLACE_M:
            return
    raise SourceError(
        f"{recording.name}: between {before.name} and {after.name} pass {pauses_s[longest] / 3600:.1f} hours: these "
        f"are several drives. Name one of them by a slice (#:{after.index} or #{after.index}:), or move them apart"
    )
