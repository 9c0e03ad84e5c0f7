"""Quantisers restore what their codebooks hold, and choosing medoids takes real rows."""

import numpy as np
import pytest

from bench.landmarks import greedy, medoids
from bench.quantised import product_quantised, residual_quantised
from deepsimbad.core.composed import unit


@pytest.fixture
def rows():
    return unit(np.random.default_rng(0).normal(size=(40, 12)))


@pytest.mark.parametrize("quantised", [product_quantised, residual_quantised])
def test_with_as_many_entries_as_places_nothing_is_lost_and_with_few_some_is(rows, quantised):
    np.testing.assert_allclose(quantised(rows, 3, 40), rows, atol=1e-6)
    cosine = (quantised(rows, 3, 8) * rows).sum(axis=1)
    assert 0.6 < cosine.mean() < 0.99


def test_medoids_are_distinct_rows_of_every_cluster(rows):
    clusters = unit(np.repeat(rows[:5], 30, axis=0) + 0.01 * np.random.default_rng(1).normal(size=(150, 12)))
    assert len(set(medoids(clusters, 150))) == 150
    assert {row // 30 for row in medoids(clusters, 20)} == set(range(5))


def test_a_beam_of_one_takes_the_nearest_landmark_first(rows):
    lists = greedy(rows, rows[:20], None)
    assert np.array_equal(lists[0], (rows @ rows[:20].T).argmax(axis=1))
    assert all(len(set(column)) == 4 for column in lists.T)
