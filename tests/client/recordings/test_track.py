import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad_client.recordings.track import DEADBAND_M, arc_length_m, on_track, rising_m, walked_m

RATE_US = 10_000  # 100 Hz


def times(n):
    return np.arange(n, dtype=np.int64) * RATE_US


def test_a_straight_drive_is_measured_exactly_at_every_pose():
    x = np.linspace(5, 105, 10_001)
    for time_us in (None, times(10_001)):
        np.testing.assert_allclose(arc_length_m(x, np.full_like(x, 3.0), time_us), x - 5, atol=1e-9)


@pytest.mark.parametrize("tremble_m", [0.005, 0.02, 0.05])
def test_a_standing_robot_does_not_crawl_however_its_pose_trembles(tremble_m):
    rng = np.random.default_rng(1)
    n_stand, n_drive = 12_000, 2_000  # two minutes still, then 20 m
    x = np.concatenate((np.zeros(n_stand), np.arange(1, n_drive + 1) / 100))
    x, y = x + rng.normal(0, tremble_m, len(x)), rng.normal(0, tremble_m, len(x))
    summed = np.hypot(np.diff(x), np.diff(y))[: n_stand - 1].sum()
    travelled = arc_length_m(x, y, times(len(x)))
    assert summed > 50, "the tremble would look like a long drive if its steps were summed"
    assert travelled[n_stand - 50] < 5 * tremble_m
    assert travelled[-1] == pytest.approx(20, abs=0.5)
    assert np.all(np.diff(travelled) >= 0)


def test_a_drive_back_over_its_own_track_goes_on_counting():
    way_out = np.linspace(0, 40, 4001)
    x = np.concatenate((way_out, way_out[::-1]))
    assert arc_length_m(x, np.zeros_like(x), times(len(x)))[-1] == pytest.approx(80, abs=2 * DEADBAND_M)


def test_the_ends_of_a_drive_and_the_sides_of_a_gap_are_not_shifted():
    time_us = np.concatenate((times(500), times(500) + 60_000_000))
    x = np.concatenate((np.linspace(0, 4.99, 500), np.linspace(10, 14.99, 500)))
    np.testing.assert_allclose(arc_length_m(x, np.zeros(1000), time_us), x, atol=1e-9)


def slow_reference(points, deadband):
    """The definition: the sum up to the present anchor, plus the farthest distance reached from it."""
    anchors, total, out = [0], 0.0, []
    for i, point in enumerate(points):
        reached = [math.dist(points[anchors[-1]], points[j]) for j in range(anchors[-1], i + 1)]
        out.append(total + max(reached))
        if math.dist(points[anchors[-1]], point) >= deadband:
            total = out[-1]
            anchors.append(i)
    return out


@given(st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=1, max_size=40))
def test_agrees_with_the_definition_and_never_goes_back_nor_beyond_the_path(points):
    x, y = (np.array(axis) for axis in zip(*points, strict=True))
    travelled = walked_m(x, y, DEADBAND_M)
    np.testing.assert_allclose(travelled, slow_reference(points, DEADBAND_M), atol=1e-9)
    assert travelled[0] == 0
    assert arc_length_m(x[:0], y[:0], np.zeros(0, np.int64)).shape == (0,)
    assert np.all(np.diff(travelled) >= 0)
    assert travelled[-1] <= np.hypot(np.diff(x), np.diff(y)).sum() + 1e-9


UTM = np.array([5_735_000.0, 619_000.0])


def drive(rng, noise_m, hz):
    """The x, y and times of 400 m at a metre a frame, with 300 frames of standing in the middle."""
    x = np.concatenate((np.arange(200.0), np.full(300, 200.0), np.arange(200.0, 401)))
    x, y = UTM[:, None] + np.stack((x, np.zeros_like(x))) + rng.normal(0, noise_m, (2, len(x)))
    return x, y, None if hz is None else 10**15 + (np.arange(len(x)) * 1_000_000 // hz).astype(np.int64)


@pytest.mark.parametrize("hz", [None, 1, 10])
@pytest.mark.parametrize(("noise_m", "longest_m"), [(0, 400.001), (0.1, 410), (0.3, 415), (1.0, 430)])
def test_jitter_of_gps_adds_no_length_however_long_the_robot_stands(hz, noise_m, longest_m):
    rng = np.random.default_rng(3)
    for _ in range(5):
        x, y, time_us = drive(rng, noise_m, hz)
        assert on_track(x, y, time_us).all()
        assert 399 < arc_length_m(x, y, time_us)[-1] < longest_m


SPIKES = {
    "one 0,0": ([250], lambda x, y, rows: (x.put(rows, 0), y.put(rows, 0))),
    "no fix at first": (range(12), lambda x, y, rows: (x.put(rows, 0), y.put(rows, 0))),
    "no fix for a while": (range(100, 112), lambda x, y, rows: (x.put(rows, 0), y.put(rows, 0))),
    "80 m aside": ([300], lambda x, y, rows: y.put(rows, y[rows] + 80)),
    "ever elsewhere": (range(20, 700, 60), lambda x, y, rows: y.put(rows, y[rows] + 15 + np.arange(len(rows)))),
    "aside for two seconds": (range(100, 120), lambda x, y, rows: y.put(rows, y[rows] + 60)),
    "at the end": ([699, 700], lambda x, y, rows: x.put(rows, x[rows] - 9_999)),
}


@pytest.mark.parametrize("hz", [None, 1, 10])
@pytest.mark.parametrize("spikes", SPIKES)
def test_spikes_alone_are_off_the_track(hz, spikes):
    for noise_m in (0, 0.3):
        x, y, time_us = drive(np.random.default_rng(1), noise_m, hz)
        places, spoil = SPIKES[spikes]
        spoil(x, y, np.array(places))
        assert np.flatnonzero(~on_track(x, y, time_us)).tolist() == list(places)


def test_a_robot_that_mostly_stood_may_drive_fast_and_its_receiver_wander():
    rng = np.random.default_rng(1)
    along_m = np.concatenate((np.arange(0, 200, 2.0), np.full(3000, 200.0), np.arange(200, 400, 2.0)))  # 20 m/s, 10 Hz
    wander = rng.normal(0, 1, (2, len(along_m)))
    for k in range(1, len(along_m)):  # correlated over a minute
        wander[:, k] = np.exp(-1 / 600) * wander[:, k - 1] + np.sqrt(1 - np.exp(-1 / 300)) * wander[:, k]
    x, y, time_us = along_m + wander[0], wander[1], np.arange(len(along_m)) * 100_000
    assert on_track(x, y, time_us).all()
    assert 390 < arc_length_m(x, y, time_us)[-1] < 415


def test_two_drives_by_turns_are_one_and_spikes():
    along_m = np.arange(200.0)
    by_turns = np.where(np.arange(200) % 2, along_m + 800, along_m)
    assert on_track(by_turns, 0 * along_m, None).sum() == 100


def test_honest_tracks_have_no_spikes():
    rng = np.random.default_rng(0)
    fast = np.cumsum(np.concatenate((np.full(300, 0.1), np.full(300, 3.0), np.zeros(50))))  # crawls, then 30 m/s, stops
    time_us = (np.arange(650) * 100_000).astype(np.int64)
    assert on_track(fast, 0 * fast, time_us).all()
    gap_us = time_us + np.where(np.arange(650) >= 400, 60_000_000, 0)  # a minute is missing, driven at 3 m/s
    steady = np.arange(650) * 0.3 + np.where(np.arange(650) >= 400, 180.0, 0)
    assert on_track(steady, 0 * steady, gap_us).all()
    assert on_track(steady, 0 * steady, gap_us // 1_000_000 * 1_000_000).all(), "times in whole seconds"
    turns = np.cumsum(rng.uniform(-1, 1, 500))
    assert on_track(np.cumsum(np.cos(turns)), np.cumsum(np.sin(turns)), None).all()


@pytest.mark.parametrize(
    ("stated", "risen", "unusable"),
    [
        ([0, 1, 2, 1.99, 2.01, 3], [0, 1, 2, 2, 2.01, 3], []),
        ([0, 1, 2, 500, 3, 4], [0, 1, 2, 3, 4], [3]),
        ([7, 8, 9, 0, 10, 11], [7, 8, 9, 10, 11], [3]),
        ([0, 1, 2, 3, 2, 1, 0], [0, 1, 2, 2], [3, 5, 6]),
        ([5.0], [5.0], []),
    ],
)
def test_stated_positions_rise_but_for_steps_back_of_centimetres(stated, risen, unusable):
    position_m, usable = rising_m(np.array(stated, np.float64))
    assert np.flatnonzero(~usable).tolist() == unusable
    assert position_m[usable].tolist() == risen


def test_a_step_back_within_the_noise_of_all_positions_is_standing():
    along_m = np.concatenate((np.arange(100.0), np.full(200, 100.0), np.arange(100.0, 200)))
    noisy = along_m + np.random.default_rng(2).normal(0, 0.3, len(along_m))
    position_m, usable = rising_m(noisy)
    assert usable.all()
    assert (np.diff(position_m) >= 0).all()
    assert np.abs(position_m - along_m).max() < 1.5
