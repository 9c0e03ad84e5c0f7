import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad_client.arc_length import DEADBAND_M, arc_length_m

RATE_US = 10_000  # 100 Hz


def times(n):
    return np.arange(n, dtype=np.int64) * RATE_US


def test_a_straight_drive_is_measured_exactly_at_every_pose():
    x = np.linspace(5, 105, 10_001)
    for time_us in (None, times(10_001)):
        np.testing.assert_allclose(arc_length_m(x, np.full_like(x, 3.0), time_us), x - 5, atol=1e-9)


def test_a_circle_has_its_circumference():
    angle = np.linspace(0, 2 * np.pi, 31_416)  # 50 m radius at 1 m/s
    travelled = arc_length_m(50 * np.cos(angle), 50 * np.sin(angle), times(len(angle)))
    assert travelled[-1] == pytest.approx(2 * np.pi * 50, rel=1e-4)


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


def test_standing_longer_adds_nothing():
    rng = np.random.default_rng(2)
    x, y = rng.normal(0, 0.02, (2, 30_000))
    travelled = arc_length_m(x, y, times(30_000))
    assert travelled[-1] - travelled[5_000] < 0.03


def test_rocking_within_the_dead_band_is_standing():
    x = 0.1 * np.sin(np.linspace(0, 200 * np.pi, 20_001))
    assert arc_length_m(x, np.zeros_like(x))[-1] < DEADBAND_M


def test_a_drive_back_over_its_own_track_goes_on_counting():
    there = np.linspace(0, 40, 4001)
    x = np.concatenate((there, there[::-1]))
    assert arc_length_m(x, np.zeros_like(x), times(len(x)))[-1] == pytest.approx(80, abs=2 * DEADBAND_M)


def test_the_ends_of_a_drive_and_the_sides_of_a_gap_are_not_shifted():
    time_us = np.concatenate((times(500), times(500) + 60_000_000))
    x = np.concatenate((np.linspace(0, 4.99, 500), np.linspace(10, 14.99, 500)))
    np.testing.assert_allclose(arc_length_m(x, np.zeros(1000), time_us), x, atol=1e-9)


def test_no_pose_and_one_pose():
    assert arc_length_m(np.zeros(0), np.zeros(0), np.zeros(0, np.int64)).shape == (0,)
    assert arc_length_m(np.array([7.0]), np.array([8.0]), np.array([5])).tolist() == [0.0]


def slow_reference(points, deadband):
    """Walk the definition: the summed anchors before, plus the farthest reached from the present one."""
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
    travelled = arc_length_m(x, y)
    np.testing.assert_allclose(travelled, slow_reference(points, DEADBAND_M), atol=1e-9)
    assert travelled[0] == 0
    assert np.all(np.diff(travelled) >= 0)
    assert travelled[-1] <= np.hypot(np.diff(x), np.diff(y)).sum() + 1e-9
