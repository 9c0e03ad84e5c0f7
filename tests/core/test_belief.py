"""The exact filter, the update rules and the summary; the paper's filter against the exact one."""

import numpy as np
import pytest

from deepsimbad.core.belief import GridFilter, ParticleFilter, summarise
from deepsimbad.core.relevance import UpdateRule
from deepsimbad.core.route import Route
from deepsimbad.errors import PastTheEndError


@pytest.fixture
def route():
    return Route(np.arange(100.0))


@pytest.mark.parametrize("rule", list(UpdateRule))
def test_a_view_that_says_nothing_changes_nothing(rule, route):
    start = GridFilter.uniform(route)
    after = start.updated(np.full(100, 0.7, np.float32), rule, step=0)
    np.testing.assert_allclose(after.mass, start.mass)


def test_additive_relevance_adds_to_the_papers_weights(route):
    relevance = np.linspace(0, 1, 100, dtype=np.float32)
    belief = GridFilter.uniform(route).updated(relevance, UpdateRule.ADDITIVE_RELEVANCE, step=0)
    expected = 1 + relevance
    np.testing.assert_allclose(belief.mass, expected / expected.sum(), rtol=1e-6)


def test_reciprocal_rank_shares_the_ranks_of_ties():
    relevance = np.array([5, 1, 1, 0], np.float32)
    belief = GridFilter.uniform(Route(np.arange(4.0))).updated(relevance, UpdateRule.ADDITIVE_RECIPROCAL_RANK, step=0)
    expected = 1 + 1 / np.array([1, 2.5, 2.5, 4])
    np.testing.assert_allclose(belief.mass, expected / expected.sum())


def test_a_view_that_excludes_all_that_is_believed_changes_nothing(route):
    belief = GridFilter(route, np.eye(100)[3])
    relevance = np.zeros(100, np.float32)
    relevance[3] = -1e5
    np.testing.assert_allclose(belief.updated(relevance, UpdateRule.LOG_LIKELIHOOD, step=0).mass, belief.mass)


def slow_move(position, mass, action, std, closed_length=None):
    """Deposit every mass at its target by linear interpolation, then blur each place by a normal kernel."""
    n = len(position)
    moved = np.zeros(n)
    for i in range(n):
        target = position[i] + action
        if closed_length:
            target = position[0] + (target - position[0]) % closed_length
            ring = np.r_[position, position[0] + closed_length]
            k = np.searchsorted(ring, target, side="right") - 1
            share = (target - ring[k]) / (ring[k + 1] - ring[k])
            moved[k] += mass[i] * (1 - share)
            moved[(k + 1) % n] += mass[i] * share
        elif target <= position[-1]:
            k = min(np.searchsorted(position, target, side="right") - 1, n - 2)
            share = (target - position[k]) / (position[k + 1] - position[k])
            moved[k] += mass[i] * (1 - share)
            moved[k + 1] += mass[i] * share
    moved /= moved.sum()
    spread = np.zeros(n)
    for i in range(n):
        off = position - position[i]
        if closed_length:
            off = (off + closed_length / 2) % closed_length - closed_length / 2
        kernel = np.where(np.abs(off) <= 4 * std, np.exp(-0.5 * (off / std) ** 2), 0)
        spread += moved[i] * kernel / kernel.sum()
    return spread


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("action", [0.7, 3.0, 12.3])
@pytest.mark.parametrize("std", [0.2, 1.5])
def test_a_move_equals_its_definition(closed, action, std):
    rng = np.random.default_rng(4)
    position = np.cumsum(rng.uniform(0.3, 2.0, 40))
    route = Route(position, closed)
    mass = rng.random(40)
    mass /= mass.sum()
    moved = GridFilter(route, mass).predicted(action, std, step=1).mass
    expected = slow_move(position, mass, action, std, route.length_m if closed else None)
    np.testing.assert_allclose(moved, expected, atol=1e-7)


def test_a_move_past_the_end_of_an_open_route_is_impossible(route):
    believed = GridFilter.around(route, 95.0, 0.5)
    with pytest.raises(PastTheEndError):
        believed.predicted(20.0, 0.3, step=1)
    partly = GridFilter(route, np.full(100, 0.01)).predicted(20.0, 0.0, step=1)
    np.testing.assert_allclose(partly.mass[:20], 0)
    np.testing.assert_allclose(partly.mass[20:], 1 / 80)


def test_images_of_one_stop_share_what_arrives_there():
    route = Route(np.array([0.0, 1.0, 2.0, 2.0, 2.0, 3.0]))
    moved = GridFilter(route, np.array([0, 1.0, 0, 0, 0, 0])).predicted(1.0, 0.0, step=1)
    np.testing.assert_allclose(moved.mass, [0, 0, 1 / 3, 1 / 3, 1 / 3, 0])
    stood = GridFilter(route, np.array([0, 0, 0.2, 0.5, 0.3, 0])).predicted(0.0, 0.0, step=1)
    np.testing.assert_allclose(stood.mass, [0, 0, 0.2, 0.5, 0.3, 0])


def test_a_prior_narrower_than_the_spacing_keeps_its_nearest_image(route):
    assert GridFilter.around(route, 40.4, 0.01).mass[40] == pytest.approx(1)
    wide = GridFilter.around(route, 50.0, 5.0)
    assert summarise(route, wide.mass, 1).std_m == pytest.approx(5.0, rel=0.01)


def test_summary_of_a_uniform_belief(route):
    summary = summarise(route, GridFilter.uniform(route).mass, 3)
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
    summary = summarise(route, mass, 2)
    assert summary.mode_m == 70
    assert summary.mean_m == pytest.approx(50)
    assert summary.credible_95_m == (20.0, 70.0)
    assert (summary.top.tolist(), summary.top_mass.tolist()) == ([70, 20], [0.6, 0.4])
    assert summary.entropy_bits == pytest.approx(-(0.4 * np.log2(0.4) + 0.6 * np.log2(0.6)))


def test_on_a_closed_route_mean_deviation_and_interval_cross_the_start():
    mass = np.zeros(100)
    mass[[98, 99, 0, 1, 2]] = 0.2
    summary = summarise(Route(np.arange(100.0), closed=True), mass, 1)
    assert min(summary.mean_m, 100 - summary.mean_m) == pytest.approx(0, abs=1e-9)
    assert summary.std_m == pytest.approx(np.sqrt(2))
    assert summary.credible_95_m == (98.0, 2.0)


def test_a_map_of_one_image():
    belief = GridFilter.uniform(Route(np.array([5.0]))).updated(
        np.array([1.0], np.float32), UpdateRule.LOG_LIKELIHOOD, step=0
    )
    summary = summarise(belief.route, belief.mass, 10)
    assert (summary.mean_m, summary.mode_m, summary.std_m, summary.entropy_bits) == (5, 5, 0, 0)
    assert summary.credible_95_m == (5.0, 5.0)
    assert summary.histogram_mass.tolist() == [1.0]


# Added evidence counts at every place of a grid, but only where there are particles: on an open route none are left
# behind the last move, so the additive rules are compared on a loop.
@pytest.mark.parametrize(
    ("rule", "closed"), [*((rule, True) for rule in UpdateRule), (UpdateRule.LOG_LIKELIHOOD, False)]
)
def test_it_comes_near_the_exact_filter_as_particles_grow(rule, closed):
    route = Route(np.arange(60.0), closed)
    rng = np.random.default_rng(1)
    views = rng.normal(size=(4, 60)).astype(np.float32) * 3
    moves = (3.0, 7.0, 2.0)
    apart = []
    for n_particles in (300, 30_000):
        exact, sampled = GridFilter.uniform(route), ParticleFilter.uniform(route, n_particles, seed=3)
        for step, view in enumerate(views):
            if step:
                exact = exact.predicted(moves[step - 1], 1.0, step)
                sampled = sampled.predicted(moves[step - 1], 1.0, step)
            exact, sampled = exact.updated(view, rule, step), sampled.updated(view, rule, step)
        apart.append(np.abs(exact.mass - sampled.mass).sum() / 2)
    assert apart[1] < 0.12
    assert apart[1] < apart[0] / 2


def test_the_same_seed_and_steps_give_the_same_bits():
    route = Route(np.arange(30.0))
    view = np.linspace(0, 40, 30).astype(np.float32)

    def run(seed, restore):
        belief = ParticleFilter.uniform(route, 200, seed).updated(view, UpdateRule.LOG_LIKELIHOOD, 0)
        if restore:
            belief = ParticleFilter.from_arrays(route, belief.arrays(), seed)
        return belief.predicted(2.0, 0.5, 1).updated(view, UpdateRule.LOG_LIKELIHOOD, 1)

    first, again, other = run(5, restore=False), run(5, restore=True), run(6, restore=False)
    assert first.position_m.tobytes() == again.position_m.tobytes()
    assert first.weight.tobytes() == again.weight.tobytes()
    assert first.position_m.tobytes() != other.position_m.tobytes()


def test_particles_past_the_end_of_an_open_route_die():
    belief = ParticleFilter.uniform(Route(np.arange(101.0)), 1000, seed=0).predicted(40.0, 0.0, 1)
    assert belief.mass[:40].sum() == 0
    assert belief.mass.sum() == pytest.approx(1)
    with pytest.raises(PastTheEndError):
        belief.predicted(70.0, 0.1, 2)


def test_particles_on_a_loop_come_round():
    belief = ParticleFilter.around(Route(np.arange(100.0), closed=True), 97.0, 0.5, 500, seed=0).predicted(5.0, 0.1, 1)
    assert belief.mass[[0, 1, 2, 3, 4]].sum() > 0.99


def test_weights_that_excluded_everything_are_kept():
    belief = ParticleFilter.around(Route(np.arange(50.0)), 10.0, 0.1, 100, seed=0)
    relevance = np.full(50, -1e9, np.float32)
    relevance[40] = 0
    np.testing.assert_array_equal(belief.updated(relevance, UpdateRule.LOG_LIKELIHOOD, 1).weight, belief.weight)
