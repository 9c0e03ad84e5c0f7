import numpy as np
import pytest

from deepsimbad_client.errors import SourceError
from deepsimbad_client.ground_truth import read_ground_truth, wrapped_rad


def test_microseconds_stay_whole(nclt_tree):
    utimes = [1_326_030_975_726_043, 1_326_030_975_726_044, 1_365_126_879_999_999]
    truth = read_ground_truth(nclt_tree.truth(nclt_tree.row(t, i, 0) for i, t in enumerate(utimes)))
    assert truth.time_us.dtype == np.int64
    assert truth.time_us.tolist() == utimes


def test_quirks_are_tolerated_and_counted(nclt_tree):
    t = nclt_tree.start_us
    rows = [
        f"{t - 10_000},NaN,NaN,NaN,NaN,NaN,NaN",
        nclt_tree.row(t + 20_000, 2, 0),
        nclt_tree.row(t, 0, 0),
        nclt_tree.row(t + 10_000, 1, 0),
        nclt_tree.row(t + 10_000, 77, 77),  # the same time again
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
        assert (truth.time_us - t).tolist() == [0, 10_000, 20_000, 30_000]
        assert truth.x_m.tolist() == [0, 1, 2, 3]
        assert truth.n_skipped_rows == n_skipped


@pytest.mark.parametrize("lines", [[], ["hello"], ["1326030975726043,NaN,NaN,NaN,NaN,NaN,NaN"] * 3, ["1,2,3"]])
def test_a_file_without_usable_rows_is_refused(nclt_tree, lines):
    with pytest.raises(SourceError, match=r"groundtruth_2012-01-22\.csv: 0 usable rows"):
        read_ground_truth(nclt_tree.truth(lines))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SourceError, match=r"nowhere\.csv"):
        read_ground_truth(tmp_path / "nowhere.csv")


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
    assert not truth.at(asked, max_gap_s=5).in_gap.any()


def test_wrapped_rad():
    angles = np.array([np.pi, -np.pi, 3 * np.pi, 0.0, 7.0, -1.0])
    np.testing.assert_allclose(wrapped_rad(angles), [np.pi, np.pi, np.pi, 0, 7 - 2 * np.pi, -1], atol=1e-12)
