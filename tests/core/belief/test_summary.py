"""A belief in a few numbers, against sorting and sums."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad.core.belief.evidence import ViewEvidence
from deepsimbad.core.belief.grid import GridFilter
from deepsimbad.core.belief.summary import summarise
from deepsimbad.core.relevance import UpdateRule
from deepsimbad.core.route import Route


@pytest.fixture
def route():
    return Route(np.arange(100.0))


def test_of_a_uniform_belief(route):
    summary = summarise(route, GridFilter.uniform(route).mass, 3, 0.02)
    figures = (summary.mean_m, summary.std_m, summary.entropy_bits)
    assert figures == pytest.approx((49.5, np.arange(100).std(), np.log2(100)))
    assert summary.credible_95_m == (0.0, 99.0), "of equal masses all belong to the smallest set"
    assert summary.near_mode == pytest.approx(0.98 * 6 / 100), "the mode is the first image"
    assert summary.histogram_mass.sum() == pytest.approx(1)
    assert summary.histogram_edges_m.size == summary.histogram_mass.size + 1
    assert summary.top.tolist() == [0, 1, 2]


def test_of_two_peaks(route):
    mass = np.zeros(100, np.float32)
    mass[20], mass[70] = 0.4, 0.6
    summary = summarise(route, mass, 2, 0.0)
    entropy_bits = -(0.4 * np.log2(0.4) + 0.6 * np.log2(0.6))
    figures = (summary.mode_m, summary.mean_m, summary.near_mode, summary.entropy_bits)
    assert figures == pytest.approx((70, 50, 0.6, entropy_bits))
    assert summary.credible_95_m == (20.0, 70.0)
    assert summary.credible_95_sets_m == [(20.0, 20.0), (70.0, 70.0)]
    assert summary.top.tolist() == [70, 20]
    assert summary.top_mass.tolist() == pytest.approx([0.6, 0.4])


def test_on_a_closed_route_mean_deviation_and_set_cross_the_start():
    mass = np.zeros(100, np.float32)
    mass[[98, 99, 0, 1, 2]] = 0.2
    summary = summarise(Route(np.arange(100.0), closed=True), mass, 1, 0.0)
    assert min(summary.mean_m, 100 - summary.mean_m) == pytest.approx(0, abs=1e-9)
    assert summary.std_m == pytest.approx(np.sqrt(2))
    assert summary.credible_95_m == (98.0, 2.0)
    assert summary.near_mode == pytest.approx(1)


def test_of_a_map_of_one_image():
    route = Route(np.array([5.0]))
    evidence = ViewEvidence.of(np.array([1.0], np.float32), UpdateRule.LOG_LIKELIHOOD, 1.0)
    belief = GridFilter.uniform(route, UpdateRule.LOG_LIKELIHOOD).updated(evidence, step=0)
    summary = summarise(route, belief.mass, 10, belief.doubt.off_route)
    assert (summary.mean_m, summary.mode_m, summary.std_m, summary.entropy_bits) == (5, 5, 0, 0)
    assert summary.credible_95_m == (5.0, 5.0)
    assert summary.histogram_mass.tolist() == [1.0]


@given(st.lists(st.floats(0, 1), min_size=1, max_size=60).filter(lambda values: sum(values) > 1e-6), st.booleans())
def test_the_set_is_the_smallest_that_holds_its_share(values, closed):
    mass = (np.array(values) / sum(values)).astype(np.float32)
    route = Route(np.arange(0.0, 3 * mass.size, 3), closed)
    pieces = summarise(route, mass, 1, 0.0).credible_95_sets_m
    member = np.zeros(mass.size, bool)
    for low, high in pieces:
        x = route.position_m
        member |= (x >= low) & (x <= high) if low <= high else (x >= low) | (x <= high)
    descending = np.sort(mass)[::-1]
    n_needed = int(np.searchsorted(np.cumsum(descending, dtype=float), 0.95 - 2e-6)) + 1
    assert mass[member].sum() >= 0.95 - 2e-6
    assert (mass[member] >= descending[n_needed - 1] - 1e-12).sum() >= n_needed
