"""Real images of two seasons, sent over real HTTP, reach the promised figures."""

import pytest

from bench.nordland import measure


@pytest.mark.slow
@pytest.mark.real_data
def test_anr_across_seasons(real_data, tmp_path):
    """400 of the 1,000 frames that `make bench` takes; the experiments' golden figures pin what other relevances do."""
    measured = measure(real_data / "nordland", tmp_path, ("standardised",), n_frames=400)
    assert measured.n_map_frames_left_out == 33
    assert measured.n_landmark_frames_left_out == 21
    summary = measured.summaries["standardised"]
    assert summary["n_map_images"] == summary["n_queries"] == 367
    assert (summary["n_left_out"], summary["n_broken"]) == (0, {})
    assert 0 < summary["anr"] <= 2.7
    assert summary["config"]["tolerance_m"] == 2.0
