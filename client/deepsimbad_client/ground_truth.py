"""NCLT's ground truth: `groundtruth_<date>.csv`, read tolerantly and interpolated at the images' times.

Rows are `utime, x, y, z, roll, pitch, yaw` without a header: Unix microseconds, metres in the local frame shared by
all sessions of the dataset (x north, y east, z down) and radians. The files are long, unfinished in places and were
copied around for years, so a row is used only when all seven values are finite; the others are counted.
"""

import logging
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.arc_length import arc_length_m
from deepsimbad_client.errors import SourceError

N_COLUMNS = 7
MAX_GAP_S = 1.0
"""Between ground-truth rows farther apart than this nothing is interpolated: the robot may have turned."""

logger = logging.getLogger(__name__)

Reals = NDArray[np.float64]
Times = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses at asked times; where `covered` is False or `in_gap` True the values mean nothing.

    Attributes:
        covered: [n] bool, the time lies between the first and the last ground-truth row.
        in_gap: [n] bool, covered, but between two rows too far apart to interpolate.
        x_m: [n] float64 metres north.
        y_m: [n] float64 metres east.
        heading_rad: [n] float64 in (-pi, pi], from north towards east.
        position_m: [n] float64 metres along the track.
    """

    covered: NDArray[np.bool_]
    in_gap: NDArray[np.bool_]
    x_m: Reals
    y_m: Reals
    heading_rad: Reals
    position_m: Reals


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The track of one drive.

    Attributes:
        time_us: [m] int64, strictly increasing.
        x_m: [m] float64 metres north.
        y_m: [m] float64 metres east.
        heading_rad: [m] float64.
        position_m: [m] float64 metres along the track, non-decreasing (see `arc_length`).
        n_skipped_rows: Rows that held NaN, too few values or no numbers.
    """

    time_us: Times
    x_m: Reals
    y_m: Reals
    heading_rad: Reals
    position_m: Reals
    n_skipped_rows: int = 0

    def at(self, time_us: Times, max_gap_s: float = MAX_GAP_S) -> Poses:
        """Interpolate: x, y and position linearly, heading the short way round.

        Args:
            time_us: [n] int64 microseconds, in any order.
            max_gap_s: Times between two rows farther apart than this are `in_gap`.
        """
        covered = (time_us >= self.time_us[0]) & (time_us <= self.time_us[-1])
        last = len(self.time_us) - 1
        before = np.clip(np.searchsorted(self.time_us, time_us, side="right") - 1, 0, last)
        after = np.minimum(before + 1, last)
        # Differences of int64 first: absolute microseconds and fractions of them do not fit one float.
        step_us = self.time_us[after] - self.time_us[before]
        since_us = np.clip(time_us - self.time_us[before], 0, step_us)
        share = since_us / np.maximum(step_us, 1)
        in_gap = covered & (since_us > 0) & (step_us > max_gap_s * 1e6)

        def between(values: Reals) -> Reals:
            return np.asarray(values[before] + share * (values[after] - values[before]), dtype=np.float64)

        turn = wrapped_rad(self.heading_rad[after] - self.heading_rad[before])
        return Poses(
            covered=covered,
            in_gap=in_gap,
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
    sorted; of rows with one time the first stays.

    Raises:
        SourceError: the file cannot be read, or fewer than two usable rows are in it.
    """
    rows = _rows(path)
    # Unix microseconds have 16 digits: below 2^53 a float64 holds every one of them exactly.
    usable = rows[np.isfinite(rows).all(axis=1) & (np.abs(rows[:, 0]) < 2**53)]
    time_us, first = np.unique(usable[:, 0].astype(np.int64), return_index=True)
    if len(time_us) < 2:
        raise SourceError(
            f"{path}: {len(time_us)} usable rows among {len(rows)}; ground truth needs at least two rows of "
            "utime,x,y,z,roll,pitch,yaw without NaN"
        )
    track = usable[first]
    x_m, y_m = track[:, 1].copy(), track[:, 2].copy()
    n_skipped = len(rows) - len(usable)
    if n_skipped:
        logger.info("%s: %d of %d rows skipped (NaN or unreadable)", path, n_skipped, len(rows))
    return GroundTruth(
        time_us=time_us,
        x_m=x_m,
        y_m=y_m,
        heading_rad=wrapped_rad(track[:, 6]),
        position_m=arc_length_m(x_m, y_m, time_us),
        n_skipped_rows=n_skipped,
    )


def _rows(path: Path) -> Reals:
    """Read every row [m, 7] float64; one that is not seven numbers becomes NaN."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # numpy's word for an empty file; we say it better
            rows = np.loadtxt(path, delimiter=",", comments=None, ndmin=2, dtype=np.float64)
        if rows.size and rows.shape[1] >= N_COLUMNS:
            return rows[:, :N_COLUMNS]
    except OSError as error:
        raise SourceError(f"cannot read the ground truth {path}: {error.strerror or error}") from error
    except ValueError:
        pass  # some row is broken: the slow way finds out which
    return np.array(list(_rows_one_by_one(path)), dtype=np.float64).reshape(-1, N_COLUMNS)


def _rows_one_by_one(path: Path) -> Iterator[list[float]]:
    broken = [float("nan")] * N_COLUMNS
    with path.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if not line.strip():
                continue
            try:
                values = [float(field) for field in line.split(",")[:N_COLUMNS]]
            except ValueError:
                yield broken
            else:
                yield values if len(values) == N_COLUMNS else broken
