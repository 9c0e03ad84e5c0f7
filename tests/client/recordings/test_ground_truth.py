import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings.nclt import DEADBAND_M, arc_length_m, read_ground_truth


def test_quirks_are_tolerated_and_counted_and_microseconds_stay_whole(nclt_tree):
    t = nclt_tree.start_us
    rows = [
        f"{t - 10_000},NaN,NaN,NaN,NaN,NaN,NaN",
        nclt_tree.row(t + 20_001, 2, 0),
        nclt_tree.row(t, 0, 0),
        nclt_tree.row(t + 20_000, 1, 0),
        nclt_tree.row(t + 20_000, 77, 77),  # the same time again
        f"{t + 15_000},1.5,nan,0,0,0,0",
        f"{t + 16_000},inf,0,0,0,0,0",
        "1e300,0,0,0,0,0,0",
        nclt_tree.row(t + 30_000, 3, 0),
    ]
    clean = read_ground_truth(nclt_tree.truth(rows))
    broken = read_ground_truth(
        nclt_tree.truth(["utime,x,y,z,r,p,h", *rows, "", f"{t + 25_000},,,,,,", f"{t + 40_000},4.0,0."], "b.csv")
    )
    for truth, n_skipped in ((clean, 4), (broken, 7)):
        assert truth.time_us.dtype == np.int64
        assert (truth.time_us - t).tolist() == [0, 20_000, 20_001, 30_000]
        assert truth.x_m.tolist() == [0, 1, 2, 3]
        assert truth.n_skipped_rows == n_skipped


@pytest.mark.parametrize("lines", [[], ["hello"], ["1326030975726043,NaN,NaN,NaN,NaN,NaN,NaN"] * 3, ["1,2,3"]])
def test_a_file_without_usable_rows_is_refused_and_a_missing_one_named(nclt_tree, lines):
    with pytest.raises(SourceError, match=r"groundtruth_2012-01-22\.csv: 0 usable rows"):
        read_ground_truth(nclt_tree.truth(lines))
    with pytest.raises(SourceError, match=r"nowhere\.csv"):
        read_ground_truth(nclt_tree.root / "nowhere.csv")


def test_poses_are_interpolated_linearly_and_headings_the_short_way_round(nclt_tree):
    t = nclt_tree.start_us
    rows = [nclt_tree.row(t, 0, 10, 3.0), nclt_tree.row(t + 100_000, 2, 20, -3.0)]
    poses = read_ground_truth(nclt_tree.truth(rows)).at(np.array([t + 25_000, t + 75_000, t, t + 100_000]))
    np.testing.assert_allclose(poses.x_m, [0.5, 1.5, 0, 2], atol=1e-9)
    np.testing.assert_allclose(poses.y_m, [12.5, 17.5, 10, 20], atol=1e-9)
    short_way = 2 * np.pi - 6
    np.testing.assert_allclose(poses.heading_rad, [3 + short_way / 4, -3 - short_way / 4, 3, -3], atol=1e-9)
    np.testing.assert_allclose(poses.position_m, np.hypot(2, 10) * np.array([0.25, 0.75, 0, 1]), atol=1e-9)


def test_times_outside_and_in_long_gaps_are_marked(nclt_tree):
    t = nclt_tree.start_us
    rows = [nclt_tree.row(t + at, at / 1e6, 0) for at in (0, 10_000, 3_010_000, 3_500_000)]
    truth = read_ground_truth(nclt_tree.truth(rows))
    asked = np.array([-1, 0, 5_000, 10_000, 10_001, 3_009_999, 3_010_000, 3_200_000, 3_500_000, 3_500_001]) + t
    poses = truth.at(asked)
    assert poses.covered.tolist() == [False, *[True] * 8, False]
    assert poses.in_gap.tolist() == [False, False, False, False, True, True, False, False, False, False]


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
    there = np.linspace(0, 40, 4001)
    x = np.concatenate((there, there[::-1]))
    assert arc_length_m(x, np.zeros_like(x), times(len(x)))[-1] == pytest.approx(80, abs=2 * DEADBAND_M)


def test_the_ends_of_a_drive_and_the_sides_of_a_gap_are_not_shifted():
    time_us = np.concatenate((times(500), times(500) + 60_000_000))
    x = np.concatenate((np.linspace(0, 4.99, 500), np.linspace(10, 14.99, 500)))
    np.testing.assert_allclose(arc_length_m(x, np.zeros(1000), time_us), x, atol=1e-9)


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
    assert arc_length_m(x[:0], y[:0], np.zeros(0, np.int64)).shape == (0,)
    assert np.all(np.diff(travelled) >= 0)
    assert travelled[-1] <= np.hypot(np.diff(x), np.diff(y)).sum() + 1e-9
