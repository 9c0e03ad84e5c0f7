import datetime

import numpy as np
import pytest

from deepsimbad_client.campus.drive import BLOCK, WIDEST_M, Drive, drive_length_m
from deepsimbad_client.campus.ground_truth import ground_truth_rows
from deepsimbad_client.campus.route import Route

WINTER, SUMMER = datetime.date(2012, 1, 22), datetime.date(2012, 8, 4)


@pytest.fixture(scope="module")
def route():
    return Route(0, 900)


def test_a_longer_drive_begins_like_a_shorter_one(route):
    short, long = Drive(route, 0, WINTER, 130, 1.75), Drive(route, 0, WINTER, 400, 1.75)
    for name in ("position_m", "utime", "sunniness", "exposure"):
        np.testing.assert_array_equal(getattr(short, name), getattr(long, name)[:130])
    assert short.view(100) == long.view(100)


def test_drives_differ_but_cover_the_same_ground(route):
    winter, summer = Drive(route, 0, WINTER, 401, 1.75), Drive(route, 0, SUMMER, 401, 1.75)
    np.testing.assert_allclose(winter.position_m[::BLOCK], summer.position_m[::BLOCK])
    assert winter.position_m.max() <= drive_length_m(401, 1.75)
    first, second = (
        drive.pose_at(np.interp(np.arange(10, 600, 5.0), drive.position_m, drive.utime)) for drive in (winter, summer)
    )
    apart = np.abs(first.right_m - second.right_m)
    assert 0.2 < apart.mean() < 2 * WIDEST_M
    assert 1 < np.rad2deg(np.abs(first.yaw_rad - second.yaw_rad)).mean() < 14


def test_the_robot_stands_still_at_times_and_never_drives_back(route):
    drive = Drive(route, 0, WINTER, 400, 1.75)
    moves = np.diff(drive.position_m)
    assert (moves >= 0).all()
    assert 5 <= (moves < 1e-9).sum() <= 60
    still = int(np.flatnonzero(moves < 1e-9)[0])
    a, b = drive.view(still), drive.view(still + 1)
    assert (a.north_m, a.east_m, a.heading_rad) == (b.north_m, b.east_m, b.heading_rad)
    assert (np.diff(drive.utime) > 0).all()


def test_times_are_microseconds_of_the_date(route):
    drive = Drive(route, 0, SUMMER, 10, 1.75)
    assert drive.utime.dtype == np.int64
    assert all(len(str(utime)) == 16 for utime in drive.utime)
    assert datetime.datetime.fromtimestamp(drive.utime[0] / 1e6, datetime.UTC).date() == SUMMER


def _truth(drive, route, date):
    return np.concatenate(list(ground_truth_rows(route, drive, date, 0)))


def test_ground_truth_has_the_quirks_of_the_real_one(route):
    drive = Drive(route, 0, WINTER, 250, 1.75)
    rows = _truth(drive, route, WINTER)
    clock = rows[:, 0]
    assert np.isfinite(clock).all()
    assert (np.diff(clock) > 0).all()
    assert 95 < 1e6 / np.diff(clock).mean() < 105
    unknown = np.isnan(rows[:, 1])
    assert unknown[:3].all()
    assert 0.001 < unknown.mean() < 0.05
    assert (np.isnan(rows[:, 1:]).all(axis=1) == unknown).all()
    uncovered = (drive.utime < clock[~unknown][0]) | (drive.utime > clock[~unknown][-1])
    assert uncovered[0]
    assert uncovered[-1]
    assert 3 <= uncovered.sum() <= 8
    assert np.diff(clock[~unknown]).max() < 150_000  # a gap within never uncovers a picture


def test_ground_truth_is_where_the_pictures_are_taken(route):
    drive = Drive(route, 0, WINTER, 250, 1.75)
    rows = _truth(drive, route, WINTER)
    rows = rows[~np.isnan(rows[:, 1])]
    for frame in range(5, 245, 24):
        view = drive.view(frame)
        north, east = (np.interp(drive.utime[frame], rows[:, 0], rows[:, k]) for k in (1, 2))
        assert np.hypot(north - view.north_m, east - view.east_m) < 0.05
        yaw = np.interp(drive.utime[frame], rows[:, 0], np.unwrap(rows[:, 6]))
        assert np.cos(yaw - view.heading_rad) > np.cos(0.02)
    # The robot moves the way it looks, but for a few degrees.
    moved = rows[500:, 1:3] - rows[:-500, 1:3]
    far = np.hypot(*moved.T) > 4
    off = (np.arctan2(moved[:, 1], moved[:, 0]) - rows[250:-250, 6] + np.pi) % (2 * np.pi) - np.pi
    assert np.rad2deg(np.abs(off[far])).mean() < 8


def test_a_very_short_drive_still_has_a_ground_truth(route):
    rows = _truth(Drive(route, 0, WINTER, 2, 1.75), route, WINTER)
    assert len(rows) > 10
