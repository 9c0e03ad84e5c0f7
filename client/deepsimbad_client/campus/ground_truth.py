"""Poses of a drive as NCLT publishes them, with the quirks a reader must survive."""

import datetime
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.drive import BLOCK, INTERVAL_US, Drive
from deepsimbad_client.campus.noise import stream
from deepsimbad_client.campus.route import Route

STEP_US = 10_000
UNCOVERED_FIRST, UNCOVERED_LAST = 2.4, 1.4
"""Intervals between pictures without a pose at the beginning and the end."""

NAN_SHARE = 0.004
NAN_FIRST = 3


def ground_truth_rows(route: Route, drive: Drive, date: datetime.date, seed: int) -> Iterator[NDArray[np.float64]]:
    """The poses at about 100 Hz, a block at a time so that any length fits in memory.

    The first and last few pictures lie outside of the time covered (unless the drive is too short for that), some
    rows hold NaN, and no row falls exactly on a picture.

    Yields:
        [m, 7] utime (microseconds), x (north), y (east), z (down) in metres, roll, pitch, yaw in radians.
    """
    n = len(drive.utime)
    cut = 1.0 if n >= 8 else 0.0
    first = int(drive.utime[0] + cut * UNCOVERED_FIRST * INTERVAL_US)
    last = int(drive.utime[-1] - cut * UNCOVERED_LAST * INTERVAL_US)
    block_us = BLOCK * INTERVAL_US
    for block, start in enumerate(range(first, max(last, first + 1), block_us)):
        rng = stream(seed, f"ground truth {date.isoformat()}", block)
        clock = np.arange(start, min(start + block_us, last + 1), STEP_US)
        clock = clock + rng.integers(-2_000, 2_000, len(clock))
        pose = drive.pose_at(clock.astype(np.float64))
        place = route.place(pose.position_m, pose.right_m)
        down = 0.4 * np.sin(pose.position_m / 60)
        columns = [clock, place[:, 0], place[:, 1], down, pose.roll_rad, pose.pitch_rad, pose.yaw_rad]
        rows = np.stack(columns, axis=1).astype(np.float64)
        unknown = rng.random(len(rows)) < NAN_SHARE
        burst = int(rng.integers(0, max(1, len(rows) - 10)))
        unknown[burst : burst + int(rng.integers(2, 8))] = len(rows) > 20
        if block == 0:
            unknown[:NAN_FIRST] = len(rows) > 20
        rows[unknown, 1:] = np.nan
        yield rows
