"""Bootstrap intervals: they cover what they should, and pairs are compared as pairs."""

import numpy as np
import pytest

from deepsimbad.jobs.paired import Comparison, compare, mean_interval


def test_the_interval_of_a_mean_is_about_two_standard_errors():
    values = np.random.default_rng(0).normal(3, 2, 1000)
    low, high = mean_interval(values, seed=0)
    error = values.std() / np.sqrt(1000)
    assert (low, high) == pytest.approx((values.mean() - 1.96 * error, values.mean() + 1.96 * error), abs=0.2 * error)
    assert mean_interval(values, seed=0) == (low, high)


def test_it_covers_the_truth_nineteen_times_of_twenty():
    rng = np.random.default_rng(1)
    covered = [low <= 0 <= high for low, high in (mean_interval(rng.normal(size=100), seed=s) for s in range(120))]
    assert 0.88 <= np.mean(covered) <= 0.99


def test_what_both_share_does_not_blur_the_difference():
    rng = np.random.default_rng(2)
    shared = 100 * rng.normal(size=500)
    found = compare(shared + rng.normal(size=500), shared + 1 + rng.normal(size=500), seed=0)
    assert found.difference == pytest.approx(-1, abs=0.2)
    assert found.interval[1] - found.interval[0] < 0.4
    assert found.excludes_zero


@pytest.mark.parametrize(
    ("interval", "excludes"), [((-1, 1), False), ((0.1, 1), True), ((-1, -0.1), True), ((0, 1), False)]
)
def test_zero_is_excluded_or_not(interval, excludes):
    assert Comparison(0.5, interval).excludes_zero is excludes
