"""The paper's filter against the exact one, and its own promises."""

import numpy as np
import pytest

from deepsimbad.core.grid_filter import GridFilter
from deepsimbad.core.particle_filter import ParticleFilter
from deepsimbad.core.route import Route
from deepsimbad.core.update_rules import UpdateRule
from deepsimbad.errors import PastTheEndError


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
