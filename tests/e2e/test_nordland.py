"""Real images of two seasons through real HTTP come to the figures that are promised."""

import pytest

from bench.nordland import Measured, measure

pytestmark = [pytest.mark.slow, pytest.mark.real_data]


@pytest.fixture(scope="module")
def measured(real_data, tmp_path_factory) -> Measured:
    return measure(real_data / "nordland", tmp_path_factory.mktemp("nordland"), ("standardised", "rrf"))


def test_frames_that_show_nothing_are_left_out(measured):
    assert measured.n_map_frames_left_out == 37
    assert measured.n_landmark_frames_left_out == 34
    for summary in measured.summaries.values():
        assert summary["n_map_images"] == summary["n_queries"] == 963
        assert summary["n_left_out"] == 0
        assert summary["n_broken"] == {}


@pytest.mark.parametrize(("relevance", "at_most"), [("standardised", 5.5), ("rrf", 8.0)])
def test_anr_across_seasons(measured, relevance, at_most):
    assert 0 < measured.summaries[relevance]["anr"] <= at_most
    assert measured.summaries[relevance]["config"]["tolerance_m"] == 2.0
