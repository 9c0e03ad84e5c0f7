"""Ranks, short lists of ranks and normal scores, against their definitions."""

from statistics import NormalDist

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad.core.descriptor import (
    n_ranked,
    nearest_landmarks,
    normal_scores,
    rank_landmarks,
    ranks_from_ranked_landmarks,
)


@given(st.lists(st.integers(0, 6), min_size=1, max_size=30))
def test_ranks_count_nearer_landmarks_and_earlier_ties(dissimilarities):
    expected = [
        1 + sum(1 for j, other in enumerate(dissimilarities) if (other, j) < (dissimilarity, i))
        for i, dissimilarity in enumerate(dissimilarities)
    ]
    assert rank_landmarks(dissimilarities).tolist() == expected
    assert rank_landmarks([dissimilarities] * 2).tolist() == [expected] * 2


def test_unsent_landmarks_share_the_mean_of_the_ranks_left():
    assert ranks_from_ranked_landmarks([3, 1], 6).tolist() == [4.5, 2.0, 4.5, 1.0, 4.5, 4.5]
    assert ranks_from_ranked_landmarks([1, 0, 2], 3).tolist() == [2.0, 1.0, 3.0]


def test_how_many_landmarks_have_a_rank_of_their_own():
    order = [3, 1, 0, 5, 4, 2]
    assert [n_ranked(ranks_from_ranked_landmarks(order[:m], 6)) for m in range(1, 7)] == [1, 2, 3, 4, 6, 6]
    assert n_ranked(np.full(6, 3.5, np.float32)) == 0
    assert n_ranked(np.ones(1, np.float32)) == 1


def test_normal_scores_are_the_quantiles_of_the_ranks():
    ranks = np.array([[1, 2.5, 4], [4, 2, 1]], np.float32)
    expected = [[NormalDist().inv_cdf((v - 0.5) / 4) for v in row] for row in ranks]
    np.testing.assert_allclose(normal_scores(ranks, 4), expected)


def test_nearest_landmarks_are_planar_and_ties_go_by_id():
    values = np.array([[3.0, 1.0, 1.0, 2.0], [0.0, 5.0, -1.0, 0.0]])
    assert nearest_landmarks(values, 3).tolist() == [[1, 2], [2, 0], [3, 3]]
