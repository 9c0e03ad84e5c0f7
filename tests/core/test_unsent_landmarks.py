"""What a view that came as its nearest landmarks alone says of the others, against slow definitions."""

import math
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest

from deepsimbad.core.descriptor import LandmarkStatistics, common_factors, rank_landmarks, ranks_from_ranked_landmarks
from deepsimbad.core.relevance import Query

NORMAL = NormalDist()


def statistics_of(n_landmarks, seed=3, loadings=None):
    rng = np.random.default_rng(seed)
    mean, std = 0.5 * rng.normal(size=n_landmarks), rng.uniform(0.5, 1.2, n_landmarks)
    return replace(LandmarkStatistics.from_mean_std(np.stack([mean, std])), loadings=loadings)


def moments_beyond(mean, std, bound):
    """Mean and variance of a normal variable beyond a bound, by a sum over its density."""
    z = np.linspace(max(bound, mean - 9 * std), mean + 9 * std, 200_001)
    density = np.exp(-0.5 * ((z - mean) / std) ** 2)
    mean_beyond = (z * density).sum() / density.sum()
    return mean_beyond, (np.square(z - mean_beyond) * density).sum() / density.sum()


@pytest.mark.parametrize("n_sent", [1, 3, 7])
def test_a_landmark_by_itself_is_a_normal_variable_beyond_the_last_sent(n_sent):
    statistics, sent_ids = statistics_of(9), [4, 8, 1, 0, 6, 2, 3][:n_sent]
    view = statistics.view(ranks_from_ranked_landmarks(sent_ids, 9))
    last = NORMAL.inv_cdf(n_sent / 9)  # between the scores of ranks m and m + 1
    for landmark in range(9):
        if landmark in sent_ids:
            score = NORMAL.inv_cdf((sent_ids.index(landmark) + 0.5) / 9)
            z, variance = (score - statistics.mean[landmark]) / statistics.std[landmark], 0.0
        else:
            bound = (last - statistics.mean[landmark]) / statistics.std[landmark]
            z, variance = moments_beyond(0.0, 1.0, bound)
        assert view.z[landmark] == pytest.approx(z, abs=2e-4)
        assert view.certainty[landmark] == pytest.approx(1 - variance, abs=2e-4)


def test_landmarks_go_together_as_a_common_factor_says():
    """One factor: its most probable value is looked for on a fine grid, and its curvature taken there."""
    loadings = np.array([0.9, 0.8, -0.6, 0.3, 0.0], np.float32)[:, np.newaxis]
    statistics = statistics_of(5, loadings=loadings)
    sent_ids = [0, 3]
    view = statistics.view(ranks_from_ranked_landmarks(sent_ids, 5))
    own_variance = 1 - np.square(loadings[:, 0].astype(float))
    last = (NORMAL.inv_cdf(2 / 5) - statistics.mean) / statistics.std

    def log_probability(factor):
        total = -0.5 * factor**2
        for landmark in range(5):
            expected, std = loadings[landmark, 0] * factor, math.sqrt(own_variance[landmark])
            if landmark in sent_ids:
                total += -0.5 * ((view.z[landmark] - expected) / std) ** 2
            else:
                total += math.log(0.5 * math.erfc((last[landmark] - expected) / std / math.sqrt(2)))
        return total

    grid = np.linspace(-4, 4, 80_001)
    best = grid[np.argmax([log_probability(factor) for factor in grid])]
    step = 1e-3
    curvature = (log_probability(best + step) - 2 * log_probability(best) + log_probability(best - step)) / step**2
    for landmark in (1, 2, 4):
        expected, std = loadings[landmark, 0] * best, math.sqrt(own_variance[landmark])
        mean, variance = moments_beyond(expected, std, last[landmark])
        further, _ = moments_beyond(expected + step, std, last[landmark])
        follows = (further - mean) / step * loadings[landmark, 0]
        assert view.z[landmark] == pytest.approx(mean, abs=2e-3)
        assert view.certainty[landmark] == pytest.approx(1 - variance - follows**2 / -curvature, abs=5e-3)


def test_what_is_unusually_near_brings_its_likes_nearer():
    loadings = np.array([[0.9], [0.9], [0.0], [0.0], [0.0], [0.0]], np.float32)
    independent, correlated = statistics_of(6), statistics_of(6, loadings=loadings)
    ranks = ranks_from_ranked_landmarks([0], 6)
    assert correlated.view(ranks).z[1] < independent.view(ranks).z[1]
    assert correlated.view(ranks).certainty[1] > independent.view(ranks).certainty[1]
    assert correlated.view(ranks).z[2:] == pytest.approx(independent.view(ranks).z[2:])


def test_all_ranks_are_known_or_none():
    statistics = statistics_of(7)
    all_ranks = ranks_from_ranked_landmarks([3, 1, 0, 6, 5, 2, 4], 7)
    but_the_last = ranks_from_ranked_landmarks([3, 1, 0, 6, 5, 2], 7)
    no_ranks = Query.uninformative(7).ranks
    for ranks, z, certainty in (
        (all_ranks, statistics.standardise(all_ranks), 1),
        (but_the_last, statistics.standardise(all_ranks), 1),
        (no_ranks, 0, 0),
    ):
        view = statistics.view(ranks)
        assert ((view.z == z) & (view.certainty == certainty)).all()
    live = statistics.observing(no_ranks)
    assert (live.mean, live.square) == (pytest.approx(statistics.mean), pytest.approx(statistics.square))


def test_running_statistics_take_the_expected_moments():
    statistics = replace(statistics_of(9), weight=4.0)
    ranks = ranks_from_ranked_landmarks([5, 2, 7], 9)
    view, live = statistics.view(ranks), statistics.observing(ranks)
    for landmark in range(9):
        score = statistics.mean[landmark] + statistics.std[landmark] * view.z[landmark]
        square = score**2 + statistics.std[landmark] ** 2 * (1 - view.certainty[landmark])
        assert live.mean[landmark] == pytest.approx((4 * statistics.mean[landmark] + score) / 5)
        assert live.square[landmark] == pytest.approx((4 * statistics.square[landmark] + square) / 5)


def test_a_long_drive_of_short_lists_keeps_its_statistics_sane():
    """Views drawn as the statistics say, of which a tenth is sent: means and spreads stay where they were."""
    rng = np.random.default_rng(0)
    mean_scores = rng.normal(size=60)
    scores = mean_scores + 0.7 * rng.normal(size=(600, 60))
    truth = LandmarkStatistics.of_map(rank_landmarks(scores))
    live = replace(truth, weight=20.0)
    for row in scores:
        live = live.observing(ranks_from_ranked_landmarks(np.argsort(row)[:6].tolist(), 60))
    assert np.isfinite(live.mean).all()
    assert np.abs(live.mean - truth.mean).mean() < 0.15
    assert np.abs(live.std / truth.std - 1).mean() < 0.25


def test_far_beyond_what_is_usual_numbers_stay_numbers():
    for far in (-60.0, -30.0, 30.0, 60.0):
        statistics = LandmarkStatistics.from_mean_std(np.stack([np.full(5, far), np.full(5, 0.9)]))
        view = statistics.view(ranks_from_ranked_landmarks([2], 5))
        assert np.isfinite(view.z).all()
        assert ((view.certainty >= 0) & (view.certainty <= 1)).all()


def test_factors_give_the_correlations_of_the_drive():
    rng = np.random.default_rng(1)
    scores = rng.normal(size=(2000, 3)) @ rng.normal(size=(3, 12)) + 0.5 * rng.normal(size=(2000, 12))
    scores = (scores - scores.mean(axis=0)) / scores.std(axis=0)
    loadings = common_factors(scores)
    assert loadings.dtype == np.float32
    assert (loadings == loadings.astype(np.float16)).all()
    off = ~np.eye(12, dtype=bool)
    assert (loadings @ loadings.T)[off] == pytest.approx(np.corrcoef(scores.T)[off], abs=0.06)
    assert (np.square(loadings).sum(axis=1) < 1).all()


def test_chance_makes_no_factors():
    assert common_factors(np.random.default_rng(0).normal(size=(29, 12))) is None
    scores = np.random.default_rng(0).normal(size=(60, 12))
    scores = (scores - scores.mean(axis=0)) / scores.std(axis=0)
    loadings = common_factors(scores)
    assert np.abs((loadings @ loadings.T)[~np.eye(12, dtype=bool)]).max() < 0.2
