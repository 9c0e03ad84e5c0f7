"""ANR's rule for ties and truth, and recall; bootstrap intervals cover what they should, and pairs are pairs."""

import numpy as np
import pytest

from deepsimbad.core.metrics import RetrievalScorer, mean_interval, rank_of_truth


@pytest.mark.parametrize(
    ("relevance", "truth", "rank"),
    [
        ([3, 2, 1], [0], 0.0),
        ([3, 2, 1], [2], 2.0),
        ([3, 2, 1], [2, 1], 1.0),  # the best-placed true image counts
        ([1, 1, 1], [0], 1.0),  # half of the OTHER images tied
        ([2, 1, 1, 1, 1], [3], 2.5),
        ([1, 1], [0, 1], 0.5),
    ],
)
def test_rank_of_truth(relevance, truth, rank):
    assert rank_of_truth(np.array(relevance, np.float32), np.array(truth)) == rank


def test_scores_average_over_the_queries_that_have_a_truth():
    scorer = RetrievalScorer()
    assert scorer.add(np.array([5.0, 1, 2, 3]), np.array([0])) == 0
    assert scorer.add(np.array([5.0, 1, 2, 3]), np.array([1])) == 3
    assert scorer.add(np.array([5.0, 1, 2, 3]), np.array([], int)) is None
    result = scorer.result()
    assert (result.anr, result.n_queries, result.n_left_out) == (37.5, 2, 1)
    assert result.recall_at == {1: 50.0, 5: 100.0}


def test_recall_counts_the_first_k_ranks_and_no_more():
    scorer = RetrievalScorer()
    for image in range(6):
        scorer.add(np.array([6.0, 5, 4, 3, 2, 1]), np.array([image]))
    assert scorer.result().recall_at == pytest.approx({1: 100 / 6, 5: 500 / 6})


def test_nothing_scored_is_not_a_number_and_no_warning():
    assert np.isnan(RetrievalScorer().result().anr)


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
