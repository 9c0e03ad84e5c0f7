"""ANR's rule for ties and truth, and recall."""

import numpy as np
import pytest

from deepsimbad.core.metrics import RetrievalScorer, rank_of_truth, true_images_of
from deepsimbad.core.route import Route


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


def test_truth_along_the_route():
    route = Route(np.arange(6.0))
    found = true_images_of(Route(np.array([0.0, 3.4, 9.0])), route, 2.0)
    assert [ids.tolist() for ids in found] == [[0, 1, 2], [2, 3, 4, 5], []]


def test_truth_in_the_plane_needs_the_same_direction():
    """A corridor driven up and back down: the same place has two route positions, one of them facing us."""
    up = np.arange(10.0)
    x = np.r_[up, up[::-1]]
    there_and_back = Route(np.arange(20.0), x_m=x, y_m=np.zeros(20))
    upward = Route(np.arange(10.0), x_m=up, y_m=np.full(10, 0.5))
    found = true_images_of(upward, there_and_back, 1.2)
    assert found[4].tolist() == [3, 4, 5]


def test_truth_in_the_plane_finds_both_visits_of_a_place():
    circle = np.linspace(0, 4 * np.pi, 200)
    twice_round = Route(np.arange(200.0), x_m=50 * np.cos(circle), y_m=50 * np.sin(circle))
    found = true_images_of(twice_round, twice_round, 2.0)
    assert {100, 0} <= set(found[100].tolist()) | set(found[0].tolist())
    assert all(abs(i - 50) < 3 or abs(i - 149.5) < 3 for i in found[50].tolist())
    assert len(found[50]) >= 2
