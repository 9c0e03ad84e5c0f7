"""ANR's rule for ties and truth, and recall."""

import numpy as np
import pytest

from deepsimbad.core.metrics import RetrievalScorer, rank_of_truth


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


def test_nothing_scored_is_not_a_number_and_no_warning():
    assert np.isnan(RetrievalScorer().result().anr)


def test_chance_is_fifty():
    rng = np.random.default_rng(0)
    scorer = RetrievalScorer()
    for _ in range(2000):
        scorer.add(rng.random(101), np.array([rng.integers(101)]))
    assert scorer.result().anr == pytest.approx(50, abs=2)
