"""The route, the drives along it, their ground truth, and what stands beside it."""

import datetime

import numpy as np
import pytest

from deepsimbad_campus.route import BLOCK, WIDEST_M, Drive, Route, drive_length_m
from deepsimbad_campus.world import World

WINTER, SUMMER = datetime.date(2012, 1, 22), datetime.date(2012, 8, 4)


@pytest.fixture(scope="module")
def route():
    return Route(0, 900)


def test_position_is_arc_length_heading_is_the_way_it_goes_and_right_is_to_the_right(route):
    positions = np.arange(0, 780, 0.5)
    steps = np.diff(route.place(positions), axis=0)
    np.testing.assert_allclose(np.hypot(*steps.T), 0.5, rtol=2e-3)
    heading = route.heading(positions[:-1] + 0.25)
    assert np.abs((np.arctan2(steps[:, 1], steps[:, 0]) - heading + np.pi) % (2 * np.pi) - np.pi).max() < 0.03
    assert np.ptp(heading) > 0.5  # it bends
    sample = positions[20:21]
    (place,), (place_right,), (angle,) = route.place(sample), route.place(sample, 2), route.heading(sample)
    np.testing.assert_allclose(place_right - place, [-2 * np.sin(angle), 2 * np.cos(angle)], atol=1e-9)


def test_a_longer_drive_begins_like_a_shorter_one_and_stands_still_at_times(route):
    short, long = Drive(route, 0, WINTER, 130, 1.75), Drive(Route(0, 2000), 0, WINTER, 400, 1.75)
    for name in ("position_m", "utime", "sunniness", "exposure"):
        np.testing.assert_array_equal(getattr(short, name), getattr(long, name)[:130])
    assert short.view(100) == long.view(100)
    moves = np.diff(long.position_m)
    assert (moves >= 0).all()
    assert (np.diff(long.utime) > 0).all()
    assert 5 <= (moves < 1e-9).sum() <= 60
    still = int(np.flatnonzero(moves < 1e-9)[0])
    assert long.view(still)[:3] == long.view(still + 1)[:3]


def test_drives_differ_but_cover_the_same_ground(route):
    winter, summer = Drive(route, 0, WINTER, 401, 1.75), Drive(route, 0, SUMMER, 401, 1.75)
    np.testing.assert_allclose(winter.position_m[::BLOCK], summer.position_m[::BLOCK])
    assert winter.position_m.max() <= drive_length_m(401, 1.75)
    position_m = np.arange(10, 600, 5.0)
    (_, *place, yaw, _, _), (_, *other_place, other_yaw, _, _) = (
        drive.poses(np.interp(position_m, drive.position_m, drive.utime)) for drive in (winter, summer)
    )
    assert 0.2 < np.hypot(*np.subtract(place, other_place)).mean() < 2 * WIDEST_M
    assert 1 < np.rad2deg(np.abs(yaw - other_yaw)).mean() < 14


def test_ground_truth_is_where_the_pictures_are_taken_with_the_quirks_of_the_real_one(route):
    drive = Drive(route, 0, WINTER, 250, 1.75)
    rows = np.concatenate(list(drive.ground_truth()))
    clock, unknown = rows[:, 0], np.isnan(rows[:, 1])
    assert np.isfinite(clock).all()
    assert (np.diff(clock) > 0).all()
    assert 95 < 1e6 / np.diff(clock).mean() < 105
    assert unknown[:3].all()
    assert 0.001 < unknown.mean() < 0.05
    assert (np.isnan(rows[:, 1:]).all(axis=1) == unknown).all()
    rows = rows[~unknown]
    uncovered = (drive.utime < rows[0, 0]) | (drive.utime > rows[-1, 0])
    assert uncovered[[0, -1]].all()
    assert 3 <= uncovered.sum() <= 8
    assert np.diff(rows[:, 0]).max() < 150_000  # a gap within never uncovers a picture
    assert len(next(Drive(route, 0, WINTER, 2, 1.75).ground_truth())) > 10  # however short the drive
    for frame in range(5, 245, 24):
        view = drive.view(frame)
        north, east = (np.interp(drive.utime[frame], rows[:, 0], rows[:, k]) for k in (1, 2))
        assert np.hypot(north - view.north_m, east - view.east_m) < 0.05
        yaw = np.interp(drive.utime[frame], rows[:, 0], np.unwrap(rows[:, 6]))
        assert np.cos(yaw - view.heading_rad) > np.cos(0.02)
    # The robot moves the way it looks, but for a few degrees.
    moves = rows[500:, 1:3] - rows[:-500, 1:3]
    far = np.hypot(*moves.T) > 4
    turn = (np.arctan2(moves[:, 1], moves[:, 0]) - rows[250:-250, 6] + np.pi) % (2 * np.pi) - np.pi
    assert np.rad2deg(np.abs(turn[far])).mean() < 8


def _things(world, length_m):
    near = [section for section in world.sections if section.stretch.start_m < length_m]
    things = [(*thing[0], *thing[1:]) for section in near for thing in section.things]
    return things + [(*feet.ravel(), style) for section in near for feet, style in section.facades]


def test_a_longer_world_begins_like_a_shorter_one_and_seeds_make_different_worlds():
    assert _things(World(3, 400), 400) == _things(World(3, 2500), 400)
    assert _things(World(0, 200), 200) != _things(World(1, 200), 200)


@pytest.mark.parametrize("seed", [0, 5])
def test_nothing_stands_on_the_route_and_walls_look_outward(seed):
    world = World(seed, 1200)
    line = world.route.place(np.arange(0, 1500, 0.5))
    for section in world.sections:
        for place, *_ in section.things:
            assert np.hypot(*(line - place).T).min() >= 2.5
        for n, block in enumerate(section.blocks):
            for feet, _ in section.facades[4 * n : 4 * n + 4]:
                wall = feet[1] - feet[0]
                for share in np.linspace(0, 1, 40):
                    assert np.hypot(*(line - feet[0] - share * wall).T).min() >= 2.8
                assert np.array([-wall[1], wall[0]]) @ (feet.mean(axis=0) - block.centre) > 0
