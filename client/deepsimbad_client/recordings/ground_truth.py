"""NCLT's ground truth: `utime,x,y,z,roll,pitch,yaw` a row, and how far along its track a robot has come.

Microseconds, metres in the local frame shared by all drives of the dataset (x north, y east, z down) and radians. The
files are long, unfinished in places and were copied around for years, so a row is used only when all seven values are
finite; the others are counted.

Route position is metres along the track, unmoved by a robot that stands still. A pose stream of 100-150 Hz trembles by
centimetres, and summing its steps as they are turns a minute of standing into a hundred metres of driving. So

1. where the poses come with times, each is first averaged with those within a quarter of a second (a tenth of the
   tremble remains; a robot at walking pace loses nothing);
2. the track is then walked by anchors: the position is the distance summed up to the last anchor plus the greatest
   distance from that anchor reached so far, and a pose at least `DEADBAND_M` away becomes the next anchor. A robot that
   stands adds once, at most, how far it trembles from its anchor; one that moves straight on gets its distance exactly,
   at every pose and not only at anchors. Rocking to and fro within the dead band is standing.
"""

import logging
import warnings
from dataclasses import dataclass
from math import hypot
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import SourceError

N_COLUMNS = 7
MAX_GAP_S = 1.0  # Between ground-truth rows farther apart than this nothing is interpolated: the robot may have turned
DEADBAND_M = 0.25
SMOOTHING_HALF_WIDTH_US = 250_000

logger = logging.getLogger(__name__)

Reals = NDArray[np.float64]
Times = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses at [n] asked times; where `covered` is False or `in_gap` True the values mean nothing."""

    covered: NDArray[np.bool_]  # the time lies between the first and the last ground-truth row
    in_gap: NDArray[np.bool_]  # covered, but between two rows too far apart to interpolate
    x_m: Reals  # north
    y_m: Reals  # east
    heading_rad: Reals  # in (-pi, pi], from north towards east
    position_m: Reals  # along the track


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The track of one drive: as `Poses`, at [m] strictly increasing times."""

    time_us: Times
    x_m: Reals
    y_m: Reals
    heading_rad: Reals
    position_m: Reals
    n_skipped_rows: int = 0  # that held NaN, too few values or no numbers

    def at(self, time_us: Times, max_gap_s: float = MAX_GAP_S) -> Poses:
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
            in_gap=covered & (since_us > 0) & (step_us > max_gap_s * 1e6),
            x_m=between(self.x_m),
            y_m=between(self.y_m),
            heading_rad=wrapped_rad(self.heading_rad[before] + share * turn),
            position_m=between(self.position_m),
        )


def wrapped_rad(angle_rad: Reals) -> Reals:
    """Bring angles into (-pi, pi]."""
    return np.asarray(np.pi - np.mod(np.pi - angle_rad, 2 * np.pi), dtype=np.float64)


def read_ground_truth(path: Path) -> GroundTruth:
    """Read a ground-truth file in whatever state it is.

    Rows with NaN, missing values or words (a header someone added) are skipped and counted; rows out of order are
    sorted; of rows with one time the first stays. Raises SourceError (the file cannot be read, or fewer than two
    usable rows are in it).
    """
    try:
        rows = _rows(path)
    except OSError as error:
        raise SourceError(f"cannot read the ground truth {path}: {error.strerror or error}") from error
    # Unix microseconds have 16 digits: below 2^53 a float64 holds every one of them exactly.
    usable = rows[np.isfinite(rows).all(axis=1) & (np.abs(rows[:, 0]) < 2**53)]
    time_us, first = np.unique(usable[:, 0].astype(np.int64), return_index=True)
    if len(time_us) < 2:
        raise SourceError(
            f"{path}: {len(time_us)} usable rows among {len(rows)}; ground truth needs at least two rows of "
            "utime,x,y,z,roll,pitch,yaw without NaN"
        )
    x_m, y_m, heading_rad = (usable[first, column].copy() for column in (1, 2, 6))
    n_skipped = len(rows) - len(usable)
    if n_skipped:
        logger.info("%s: %d of %d rows skipped (NaN or unreadable)", path, n_skipped, len(rows))
    return GroundTruth(time_us, x_m, y_m, wrapped_rad(heading_rad), arc_length_m(x_m, y_m, time_us), n_skipped)


def _rows(path: Path) -> Reals:
    """Read every row [m, 7] float64; one that is not seven numbers becomes NaN."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # numpy's word for an empty file; we say it better
            rows = np.loadtxt(path, delimiter=",", comments=None, ndmin=2, dtype=np.float64)
        if rows.size and rows.shape[1] >= N_COLUMNS:
            return rows[:, :N_COLUMNS]
    except ValueError:
        pass  # some row is broken: the slow way finds out which
    with path.open(encoding="utf-8", errors="replace") as lines:
        return np.array([_row(line) for line in lines if line.strip()], np.float64).reshape(-1, N_COLUMNS)


def _row(line: str) -> list[float]:
    broken = [float("nan")] * N_COLUMNS
    try:
        values = [float(cell) for cell in line.split(",")[:N_COLUMNS]]
    except ValueError:
        return broken
    return values if len(values) == N_COLUMNS else broken


def arc_length_m(x_m: Reals, y_m: Reals, time_us: Times | None = None, deadband_m: float = DEADBAND_M) -> Reals:
    """Measure how far a track has gone at each of its poses; see the top of this module.

    Args:
        x_m: [n] float64, finite, in travel order.
        y_m: [n] float64, finite.
        time_us: [n] int64 microseconds, increasing; without it nothing is averaged over time.
        deadband_m: How far a pose must be from the last anchor to be the next.

    Returns:
        [n] float64 metres, non-decreasing, 0 at the first pose.
    """
    travelled = np.zeros(len(x_m), dtype=np.float64)
    if len(x_m) == 0:
        return travelled
    if time_us is not None:
        x_m, y_m = _smoothed(x_m, time_us), _smoothed(y_m, time_us)
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


def _smoothed(values: Reals, time_us: Times) -> Reals:
    """Average each value with those within a quarter of a second, the window shrinking evenly at both ends.

    Evenly, because a window cut on one side alone would shift the ends of every drive (and both sides of every
    gap) along the track.
    """
    breaks = np.flatnonzero(np.diff(time_us) > SMOOTHING_HALF_WIDTH_US) + 1
    starts = np.concatenate(([0], breaks))
    lengths = np.diff(np.concatenate((starts, [len(values)])))
    first_us = np.repeat(time_us[starts], lengths)
    last_us = np.repeat(time_us[starts + lengths - 1], lengths)
    half_us = np.minimum(SMOOTHING_HALF_WIDTH_US, np.minimum(time_us - first_us, last_us - time_us))
    low = np.searchsorted(time_us, time_us - half_us, side="left")
    high = np.searchsorted(time_us, time_us + half_us, side="right")
    centre = values.mean()  # keeps the running sum small, hence exact
    running = np.concatenate(([0.0], np.cumsum(values - centre)))
    return np.asarray(centre + (running[high] - running[low]) / (high - low), dtype=np.float64)
