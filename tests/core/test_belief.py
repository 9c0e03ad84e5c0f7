"""The grid belief and its summary."""

import numpy as np
import pytest

from deepsimbad.core.belief import DEFAULT_UPDATE, GridBelief, UpdateRule
from deepsimbad.core.relevance import Relevance
from deepsimbad.core.route import Route


@pytest.fixture
def route():
    return Route(np.arange(100.0))


@pytest.mark.parametrize("rule", list(UpdateRule))
def test_a_view_moves_mass_to_where_it_is_relevant(rule, route):
    relevance = np.zeros(100, np.float32)
    relevance[40] = 3.0
    belief = GridBelief.uniform(route).updated(relevance, rule)
    assert belief.mass.sum() == pytest.approx(1)
    assert belief.mass.argmax() == 40
    assert (np.delete(belief.mass, 40) < belief.mass[40]).all()


@pytest.mark.parametrize("rule", list(UpdateRule))
def test_a_view_that_says_nothing_changes_nothing(rule, route):
    start = GridBelief.uniform(route)
    after = start.updated(np.full(100, 0.7, np.float32), rule)
    np.testing.assert_allclose(after.mass, start.mass)


def test_additive_relevance_adds_to_the_papers_weights(route):
    relevance = np.linspace(0, 1, 100, dtype=np.float32)
    belief = GridBelief.uniform(route).updated(relevance, UpdateRule.ADDITIVE_RELEVANCE)
    expected = 1 + relevance
    np.testing.assert_allclose(belief.mass, expected / expected.sum(), rtol=1e-6)


def test_reciprocal_rank_shares_the_ranks_of_ties():
    relevance = np.array([5, 1, 1, 0], np.float32)
    belief = GridBelief.uniform(Route(np.arange(4.0))).updated(relevance, UpdateRule.ADDITIVE_RECIPROCAL_RANK)
    expected = 1 + 1 / np.array([1, 2.5, 2.5, 4])
    np.testing.assert_allclose(belief.mass, expected / expected.sum())


def test_every_relevance_has_a_default_update():
    assert set(DEFAULT_UPDATE) == set(Relevance)


def test_a_belief_that_every_view_excludes_starts_anew(route):
    belief = GridBelief(route, np.eye(100)[3])
    relevance = np.full(100, 0.0, np.float32)
    relevance[3] = -2000
    after = belief.updated(relevance, UpdateRule.LOG_LIKELIHOOD)
    np.testing.assert_allclose(after.mass, GridBelief.uniform(route).mass)


def test_summary_of_a_uniform_belief(route):
    summary = GridBelief.uniform(route).summary(3)
    assert summary.mean_m == pytest.approx(49.5)
    assert summary.std_m == pytest.approx(np.arange(100).std())
    assert summary.entropy_bits == pytest.approx(np.log2(100))
    assert summary.credible_95_m == (0.0, 94.0)
    assert summary.histogram_mass.sum() == pytest.approx(1)
    assert summary.histogram_edges_m.size == summary.histogram_mass.size + 1
    assert summary.top.tolist() == [0, 1, 2]


def test_summary_of_two_peaks(route):
    mass = np.zeros(100)
    mass[20], mass[70] = 0.4, 0.6
    summary = GridBelief(route, mass).summary(2)
    assert summary.mode_m == 70
    assert summary.mean_m == pytest.approx(50)
    assert summary.credible_95_m == (20.0, 70.0)
    assert (summary.top.tolist(), summary.top_mass.tolist()) == ([70, 20], [0.6, 0.4])
    assert summary.entropy_bits == pytest.approx(-(0.4 * np.log2(0.4) + 0.6 * np.log2(0.6)))


def test_on_a_closed_route_mean_deviation_and_interval_cross_the_start():
    mass = np.zeros(100)
    mass[[98, 99, 0, 1, 2]] = 0.2
    summary = GridBelief(Route(np.arange(100.0), closed=True), mass).summary(1)
    assert min(summary.mean_m, 100 - summary.mean_m) == pytest.approx(0, abs=1e-9)
    assert summary.std_m == pytest.approx(np.sqrt(2))
    assert summary.credible_95_m == (98.0, 2.0)


def test_a_map_of_one_image():
    belief = GridBelief.uniform(Route(np.array([5.0]))).updated(np.array([1.0], np.float32), UpdateRule.LOG_LIKELIHOOD)
    summary = belief.summary(10)
    assert (summary.mean_m, summary.mode_m, summary.std_m, summary.entropy_bits) == (5, 5, 0, 0)
    assert summary.credible_95_m == (5.0, 5.0)
    assert summary.histogram_mass.tolist() == [1.0]
