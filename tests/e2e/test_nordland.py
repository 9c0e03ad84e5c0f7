"""Real images of two seasons through real HTTP come to the figures that are promised."""

import pytest

from bench.nordland import measure


@pytest.mark.slow
@pytest.mark.real_data
def test_anr_across_seasons(real_data, tmp_path):
    """Other relevances differ in what the experiments' golden figures pin already."""
    measured = measure(real_data / "nordland", tmp_path, ("standardised",))
    assert measured.n_map_frames_left_out == 37
    assert measured.n_landmark_frames_left_out == 34
    summary = measured.summaries["standardised"]
    assert summary["n_map_images"] == summary["n_queries"] == 963
    assert (summary["n_left_out"], summary["n_broken"]) == (0, {})
    assert 0 < summary["anr"] <= 5.5
    assert summary["config"]["tolerance_m"] == 2.0
