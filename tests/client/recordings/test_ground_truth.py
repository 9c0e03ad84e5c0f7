import numpy as np
import pytest

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings.nclt import read_ground_truth


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
    with pytest.raises(SourceError, match=r"groundtruth_2012-01-22\.csv: fewer than 2 usable rows"):
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
    rows = [nclt_tree.row(t + offset_us, offset_us / 1e6, 0) for offset_us in (0, 10_000, 3_010_000, 3_500_000)]
    truth = read_ground_truth(nclt_tree.truth(rows))
    time_us = np.array([-1, 0, 5_000, 10_000, 10_001, 3_009_999, 3_010_000, 3_200_000, 3_500_000, 3_500_001]) + t
    poses = truth.at(time_us)
    assert poses.covered.tolist() == [False, *[True] * 8, False]
    assert poses.in_gap.tolist() == [False, False, False, False, True, True, False, False, False, False]
