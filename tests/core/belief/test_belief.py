"""The exact filter and the paper's against their definitions: moves, views, the lost state, trust in views."""

from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.belief.cells import Cells
from deepsimbad.core.belief.evidence import ViewEvidence, batch_evidence
from deepsimbad.core.belief.grid import GridFilter
from deepsimbad.core.belief.motion import motion_std_m
from deepsimbad.core.belief.particles import FilterKind, ParticleFilter
from deepsimbad.core.relevance import UpdateRule
from deepsimbad.core.route import Route
from deepsimbad.errors import PastTheEndError

ADDITIVE = (UpdateRule.ADDITIVE_RELEVANCE, UpdateRule.ADDITIVE_RECIPROCAL_RANK)
FILTERS = {FilterKind.GRID: GridFilter, FilterKind.PARTICLE: ParticleFilter}


@pytest.fixture
def route():
    return Route(np.arange(100.0))


def evidence_of(relevance, rule=UpdateRule.MIXTURE, scale=1.0, shared=0.0):
    return ViewEvidence.of(np.asarray(relevance, np.float32), rule, scale, shared)


def holding(route, mass, lost=0.0, rule=UpdateRule.MIXTURE):
    """A grid belief with masses [c] in this proportion, lost with this probability."""
    start = GridFilter.uniform(route, rule)
    arrays = start.arrays()
    arrays["lost"] = np.full_like(arrays["lost"], lost)
    arrays["masses"] = np.outer(1 - arrays["lost"], np.asarray(mass, float) / np.sum(mass))
    return GridFilter.from_arrays(route, arrays)


def after_views(belief, views, moves_m, std_m=0.2, rule=UpdateRule.MIXTURE, shared=0.0):
    """The belief after views [t, n] and the moves before all but the first of them."""
    for step, view in enumerate(views):
        if step:
            belief = belief.predicted(moves_m[step - 1], std_m, step)
        belief = belief.updated(evidence_of(view, rule, shared=shared if step else 0.0), step)
    return belief


# --- views ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", list(UpdateRule))
@pytest.mark.parametrize("kind", list(FilterKind))
def test_a_view_that_answers_every_place_alike_changes_nothing(kind, rule, route):
    start = FILTERS[kind].uniform(route, rule=rule)
    belief = start.updated(evidence_of(np.full(100, 0.7), rule), step=0)
    np.testing.assert_allclose(belief.mass, start.mass, atol=1e-3)
    assert belief.doubt.off_route == pytest.approx(0.02)


@pytest.mark.parametrize("rule", list(UpdateRule))
def test_evidence_of_a_batch_is_that_of_each_of_its_views(rule):
    relevance = np.random.default_rng(0).normal(size=(3, 40)).astype(np.float32).round(1)  # some are tied
    for row, batch_row in zip(relevance, batch_evidence(relevance, rule, 2.5), strict=True):
        values = evidence_of(row, rule, 2.5).values
        expected = values if rule in ADDITIVE else np.exp(values - values.max())
        np.testing.assert_allclose(batch_row, expected, rtol=1e-5)


def test_reciprocal_rank_shares_the_ranks_of_ties():
    belief = GridFilter.uniform(Route(np.arange(4.0)), UpdateRule.ADDITIVE_RECIPROCAL_RANK)
    belief = belief.updated(evidence_of([5, 1, 1, 0], UpdateRule.ADDITIVE_RECIPROCAL_RANK), step=0)
    expected = 1 + 1 / np.array([1, 2.5, 2.5, 4])
    np.testing.assert_allclose(belief.mass, expected / expected.sum())


@pytest.mark.parametrize("rule", [UpdateRule.MIXTURE, UpdateRule.LOG_LIKELIHOOD])
@pytest.mark.parametrize("kind", list(FilterKind))
def test_relevances_of_any_size_leave_a_belief(kind, rule, route):
    """Those of `simbad` and `brute_force` are distances in whatever units encodings have."""
    belief = FILTERS[kind].uniform(route, rule=rule)
    for step in range(3):
        belief = belief.updated(evidence_of(-1e6 * np.arange(100.0), rule), step)
    assert (belief.mass.sum(), belief.mass.argmax()) == (pytest.approx(1), 0)
    assert 0 <= belief.doubt.off_route <= 1


@pytest.mark.parametrize("log_likelihood", [-40, -75, -95, -1e5])
def test_a_view_that_excludes_all_that_is_believed_changes_nothing(log_likelihood, route):
    belief = holding(route, np.eye(100)[3], rule=UpdateRule.LOG_LIKELIHOOD)
    evidence = evidence_of(log_likelihood * np.eye(100)[3], UpdateRule.LOG_LIKELIHOOD)
    np.testing.assert_allclose(belief.updated(evidence, step=0).mass, belief.mass)


@pytest.mark.parametrize("log_likelihood", [30.0, 60.0, 95.0, 500.0])
@pytest.mark.parametrize("kind", list(FilterKind))
def test_a_belief_at_a_wrong_place_goes_on_however_surely_views_exclude_it(kind, log_likelihood, route):
    """Nothing is found on the way, so more and more is lost, and rounding alone leaves some on the route."""
    rule = UpdateRule.LOG_LIKELIHOOD
    belief = FILTERS[kind].around(route, 20.0, 2.0, rule=rule)
    for step in range(5):
        evidence = evidence_of(np.where(np.arange(100) < 80, 0.0, log_likelihood), rule)
        belief = belief.updated(evidence, step).predicted(1.0, 0.1, step + 1)
        assert belief.mass.sum() == pytest.approx(1)
    assert belief.doubt.off_route == pytest.approx(1)


def test_no_mass_gets_so_small_that_processors_take_it_slowly(route):
    belief, rule = GridFilter.uniform(route, UpdateRule.LOG_LIKELIHOOD), UpdateRule.LOG_LIKELIHOOD
    for step in range(10):
        belief = belief.updated(evidence_of(np.where(np.arange(100) < 50, 0.0, -9.5), rule), step)
    assert np.unique(belief.masses > 0, return_counts=True)[1].tolist() == [50, 50]
    assert belief.masses[belief.masses > 0].min() > np.finfo(np.float32).tiny


def error_matrix(n, action, std, closed=False, slipping=1.0):
    """[n, n] how the mass of every cell is spread by a move's error, none lost at the ends; all in cells.

    Six moves of ten err as odometry says, the others by a fifth of the way besides, or by `slipping` of that.
    """
    distance = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    distance = np.minimum(distance, n - distance) if closed else distance
    all_cells, matrix = np.abs(np.arange(-n, n + 1)), 0.0
    for share, deviation in ((0.6, std), (0.4, np.hypot(std, 0.2 * slipping * action))):

        def weight(cells, deviation=deviation):
            if deviation < 0.6:
                return np.where(cells == 0, 1 - deviation**2, np.where(cells == 1, deviation**2 / 2, 0))
            return np.where(cells <= 4 * deviation, np.exp(-0.5 * (cells / deviation) ** 2), 0)

        matrix = matrix + share * weight(distance) / weight(all_cells).sum()
    return matrix / matrix.sum(axis=1, keepdims=True)


def slow_mixture(route, views, moves, shared):
    """(mass, lost, trust) of three trusts by Bayes' rule in loops; images a metre apart, whole moves."""
    n = route.n_images
    masses, lost, weight = [np.full(n, 0.98 / n) for _ in range(3)], [0.02] * 3, [0.2, 0.4, 0.4]
    last = np.zeros(n)
    for number, (view, move) in enumerate(zip(views, moves, strict=True)):
        values = view - view.mean()
        news = values
        if number:
            carried = np.zeros(n)
            carried[move:] = last[: n - move]
            news = (values - shared * carried) / (1 + shared)
            for t in range(3):
                shifted_mass = np.zeros(n)
                shifted_mass[move:] = masses[t][: n - move]
                lost_mass = lost[t] + masses[t].sum() - shifted_mass.sum()
                leaving = 1 - np.exp(-0.0005 * move)
                spread = shifted_mass @ error_matrix(n, move, 0.0, slipping=0.0)
                masses[t] = spread * (1 - leaving) + 0.02 * lost_mass / n
                lost[t] = 0.98 * lost_mass + leaving * shifted_mass.sum()
        last = values
        for t, trust in enumerate((0.5, 1.0, 2.0)):
            likelihood = np.exp(trust * news)
            total = (masses[t] * likelihood).sum() + lost[t] * likelihood.mean()
            weight[t] *= total / likelihood.mean()
            masses[t], lost[t] = masses[t] * likelihood / total, lost[t] * likelihood.mean() / total
    weight = np.array(weight) / sum(weight)
    mass = sum(w * m for w, m in zip(weight, masses, strict=True))
    return mass / mass.sum(), float(weight @ lost), weight


@pytest.mark.parametrize("shared", [0.0, 0.6])
def test_a_mixture_is_three_trusts_weighed_by_what_they_predicted(shared):
    """So that of a season whose views are loud and wrong the cautious part wins."""
    route = Route(np.arange(60.0))
    views, moves = np.random.default_rng(2).normal(size=(5, 60)) * 2, [0, 3, 1, 7, 2]
    belief = after_views(GridFilter.uniform(route), views, np.array(moves[1:], float), 1e-6, shared=shared)
    mass, lost, trust = slow_mixture(route, views, moves, shared)
    np.testing.assert_allclose(belief.mass, mass, rtol=1e-3, atol=1e-6)
    assert belief.doubt.off_route == pytest.approx(lost, rel=1e-3)
    assert belief.doubt.trust == pytest.approx(trust, rel=1e-3)


@pytest.mark.parametrize("kind", list(FilterKind))
def test_standing_still_is_one_view_however_often_it_is_taken(kind, route):
    view = np.random.default_rng(3).normal(size=100) * 2
    start = FILTERS[kind].uniform(route)
    once, often = (after_views(start, [view] * n, np.zeros(n), 0.0, shared=1.0).mass for n in (1, 100))
    entropy_once, entropy_often = (-(mass[mass > 0] * np.log2(mass[mass > 0])).sum() for mass in (once, often))
    assert entropy_often > entropy_once - 0.3, "it is no surer"
    assert often.argmax() == once.argmax()
    assert kind is not FilterKind.GRID or np.abs(often - once).sum() < 0.05


# --- moves ---------------------------------------------------------------------------------------------------------


def moments(route, mass):
    mean = mass @ route.position_m
    return mean, mass @ np.square(route.position_m - mean)


def test_moves_blur_by_their_error_alone_however_images_stand():
    """A hundred of 0.37 m past images at uneven distances: the error's variance adds up, and nothing else does."""
    rng = np.random.default_rng(4)
    route = Route(np.cumsum(rng.uniform(0.3, 0.7, 400)))
    belief = GridFilter.around(route, 20.0, 2.0, UpdateRule.LOG_LIKELIHOOD)
    start_m, start_variance = moments(route, belief.mass)
    for step in range(1, 101):
        belief = belief.predicted(0.37, 0.05, step)
    mean_m, variance = moments(route, belief.mass)
    assert mean_m == pytest.approx(start_m + 37.0, abs=0.05)
    assert variance == pytest.approx(start_variance + 100 * 0.05**2, rel=0.05)


def test_where_images_stand_evenly_whole_moves_shift_masses_and_views_are_heard_as_they_are(route):
    rule = UpdateRule.LOG_LIKELIHOOD
    mass = np.random.default_rng(5).random(100)
    shifted_belief = holding(route, mass, rule=rule).predicted(7.0, 0.0, step=1)
    np.testing.assert_allclose(shifted_belief.mass[7:], mass[:93] / mass[:93].sum(), rtol=1e-6)
    view = np.random.default_rng(6).normal(size=100)
    belief = GridFilter.uniform(route, rule).updated(evidence_of(view, rule), 0)
    np.testing.assert_allclose(belief.mass, np.exp(view) / np.exp(view).sum(), rtol=1e-5)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("action", [0.7, 3.0, 12.3, -4.0])
@pytest.mark.parametrize("std", [0.2, 1.5])
def test_a_move_equals_its_definition(closed, action, std):
    rng = np.random.default_rng(4)
    route = Route(np.cumsum(rng.uniform(0.3, 2.0, 40)), closed)
    cells = route.cells
    n = cells.n_cells
    mass = rng.random(n)
    belief = holding(route, mass).predicted(action, std, step=1)
    shift = round(action / cells.step_m)
    target_mass, past_mass = np.zeros(n), 0.0
    for cell, share in enumerate(mass / mass.sum()):
        target = cell + shift
        if not closed and not 0 <= target < n:
            offset_m = action - shift * cells.step_m
            past_m = (target - (n - 1)) * cells.step_m + offset_m if target >= n else -target * cells.step_m - offset_m
            if past_m > 4 * std + cells.step_m / 2:
                past_mass += share
                continue
        target_mass[target % n if closed else min(max(target, 0), n - 1)] += share
    slipping = min(1.0, std / np.sqrt(0.05**2 + 0.01 * abs(action)))  # odometry more exact than usual slips less
    spread = target_mass @ error_matrix(n, action / cells.step_m, std / cells.step_m, closed, slipping)
    lost = past_mass * 0.98 + (1 - np.exp(-0.0005 * abs(action))) * (1 - past_mass)
    assert belief.doubt.off_route == pytest.approx(lost, rel=1e-6, abs=1e-12)
    expected = spread * np.exp(-0.0005 * abs(action)) + 0.02 * past_mass / n
    np.testing.assert_allclose(belief.masses[0] / belief.masses[0].sum(), expected / expected.sum(), atol=1e-6)
    assert belief.mass.sum() == pytest.approx(1)


def test_what_leads_past_the_end_is_lost(route):
    belief = holding(route, np.ones(100)).predicted(20.0, 1e-9, step=1)
    assert belief.doubt.off_route == pytest.approx(0.2 * 0.98 + 0.8 * (1 - np.exp(-0.01)))
    assert belief.mass[20:].sum() > 0.97
    doubtful_belief = holding(route, np.eye(100)[95], lost=0.2).predicted(20.0, 0.3, step=1)
    assert doubtful_belief.doubt.off_route > 0.8, "a robot that may be lost is refused no move"


@pytest.mark.parametrize("std", [1.0, 5.0])
def test_of_a_move_that_errs_past_both_ends_of_a_short_route_nothing_is_lost(std):
    start = holding(Route(np.arange(4.0)), [1, 0, 2, 1], rule=UpdateRule.ADDITIVE_RELEVANCE)
    belief = start.predicted(0.0, std, step=1)
    assert belief.masses.sum() == pytest.approx(1)


def test_images_of_one_stop_share_what_arrives_there():
    route = Route(np.array([0.0, 1.0, 2.0, 2.0, 2.0, 3.0]))
    belief = holding(route, [0, 1.0, 0, 0]).predicted(1.0, 0.0, step=1)
    np.testing.assert_allclose(belief.mass, [0, 0, 1 / 3, 1 / 3, 1 / 3, 0], atol=1e-2)
    standing_belief = belief.predicted(0.0, 0.0, step=2)
    np.testing.assert_allclose(standing_belief.mass, belief.mass, atol=1e-9)


@pytest.mark.parametrize("n_gaps", [3, 20])
def test_gaps_of_a_kilometre_leave_neighbouring_images_apart(n_gaps):
    """A tracked robot is still told from its neighbour a metre on, and the route needs no million cells."""
    steps_m = np.ones(300)
    steps_m[np.linspace(20, 250, n_gaps).astype(int)] = 1000.0
    route = Route(np.cumsum(steps_m))
    belief = GridFilter.around(route, float(route.position_m[270]), 0.5)
    belief = after_views(belief, 4.0 * np.eye(300)[270:280], np.ones(9), 0.1)
    assert belief.mass[279] > 0.9
    assert belief.masses.shape[1] < 40_000


@pytest.mark.parametrize("closed", [False, True])
def test_a_robot_in_a_gap_is_by_the_nearest_image(closed):
    route = Route(np.concatenate([np.arange(20.0), np.arange(1000.0, 1020.0)]), closed)
    for at_m, nearest in ((500.0, 19), (520.0, 20)):
        belief = GridFilter.around(route, at_m, 1.0).predicted(1.0, 0.1, step=1)
        assert belief.mass[nearest] == pytest.approx(1, abs=1e-3)  # a little is found anywhere
        assert belief.mass.sum() == pytest.approx(1)


@pytest.mark.parametrize("kind", list(FilterKind))
def test_a_closed_route_of_no_length_is_moved_along(kind):
    belief = FILTERS[kind].uniform(Route(np.array([5.0, 5.0]), closed=True)).updated(evidence_of([0.0, 1.0]), 0)
    next_belief = belief.predicted(1.0, 0.1, 1).updated(evidence_of([0.0, 1.0], shared=0.5), 1)
    np.testing.assert_allclose(next_belief.mass, 0.5)


def test_a_prior_narrower_than_the_spacing_keeps_its_nearest_image(route):
    mass = GridFilter.around(route, 40.4, 0.01).mass
    assert (mass[40], mass[41]) == pytest.approx((0.6, 0.4))


@pytest.mark.parametrize("kind", list(FilterKind))
@pytest.mark.parametrize("rule", sorted(set(UpdateRule) - {UpdateRule.MIXTURE}))
def test_to_the_papers_updates_a_move_past_the_end_is_impossible_and_nobody_is_lost(kind, rule, route):
    belief = FILTERS[kind].uniform(route, rule=rule).predicted(20.0, 1e-6, step=1)
    assert belief.doubt.off_route == pytest.approx(0.02)
    assert belief.mass[:20].sum() == pytest.approx(0, abs=1e-9)
    assert belief.mass[20:].sum() == pytest.approx(1)
    with pytest.raises(PastTheEndError):
        belief.predicted(120.0, 0.3, step=2)


@pytest.mark.parametrize("kind", list(FilterKind))
@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_odometry_that_is_a_tenth_off_loses_no_robot(kind, factor):
    route, rng = Route(np.arange(300.0)), np.random.default_rng(4)
    belief, is_held = FILTERS[kind].around(route, 2.0, 0.5), []
    for step, image in enumerate(range(2, 290, 6)):
        belief = belief.predicted(6.0 * factor, 0.25, step) if step else belief
        view = 0.4 * rng.normal(size=300) + 3.0 * np.exp(-0.5 * np.square((route.position_m - image) / 1.2))
        belief = belief.updated(evidence_of(view), step)
        descending = np.sort(belief.mass)[::-1]
        least_mass = descending[(np.cumsum(descending) < 0.95).sum()]
        is_held.append(belief.mass[image] >= least_mass)
    assert np.mean(is_held) > 0.9


@pytest.mark.parametrize("kind", list(FilterKind))
def test_a_robot_that_has_moved_may_always_have_been_carried(kind, route):
    """It is sure to be at the end, and moves on by 20 m."""
    belief = after_views(FILTERS[kind].around(route, 80.0, 0.5), 9.0 * np.eye(100)[80:100:5], [5.0] * 3)
    assert belief.doubt.off_route < 0.01
    assert belief.predicted(20.0, 0.3, 4).doubt.off_route > 0.9


# --- lost ----------------------------------------------------------------------------------------------------------


def test_what_a_move_found_is_there_until_a_view_says_where(route):
    belief = ParticleFilter.uniform(route).predicted(1000.0, 0.0, step=2)  # past the end, wherever it was
    for action_m in (0.0, 1.0):
        belief = belief.predicted(action_m, 0.1, step=3)  # the view between told nothing
        np.testing.assert_allclose(belief.mass, 0.01)


@pytest.mark.parametrize("kind", list(FilterKind))
def test_a_robot_that_was_carried_is_found_again(kind, route):
    """Every place looks like itself; the robot moves on by 5 m, and once, without a word, by 50."""
    rng = np.random.default_rng(0)
    belief, image, is_found, doubt = FILTERS[kind].around(route, 5.0, 1.0), 5, [], 0.0
    for step in range(16):
        if step:
            image = (image + (50 if step == 5 else 5)) % 100
            belief = belief.predicted(5.0, 0.2, step) if image >= 5 else FILTERS[kind].around(route, image, 1.0)
        view = 0.5 * rng.normal(size=100)
        view[image] += 4
        belief = belief.updated(evidence_of(view), step)
        if 5 <= step <= 13:
            is_found.append(abs(int(belief.mass.argmax()) - image) <= 2)
            doubt = max(doubt, belief.doubt.off_route)
    assert doubt > (0.2 if kind is FilterKind.GRID else 0.1)
    assert sum(is_found[:6]) >= 3
    assert all(is_found[4:])


def test_a_robot_off_the_route_is_called_lost_and_one_on_it_is_not(route):
    rng = np.random.default_rng(1)
    belief_on = belief_off = GridFilter.around(route, 10.0, 1.0)
    doubts = []
    for step in range(1, 12):
        view_on, view_off = 0.5 * rng.normal(size=(2, 100))
        view_on[10 + 5 * step] += 4
        view_off[rng.integers(100)] += 4  # what it sees there looks like anything
        belief_on = belief_on.predicted(5.0, 0.2, step).updated(evidence_of(view_on), step)
        belief_off = belief_off.predicted(5.0, 0.2, step).updated(evidence_of(view_off), step)
        doubts.append((belief_on.doubt.off_route, belief_off.doubt.off_route))
    most_on, most_off = np.max(doubts, axis=0)
    assert most_on < 0.02 < 0.05 < most_off


# --- particles -----------------------------------------------------------------------------------------------------


def in_finer_cells(route, factor):
    """The route with `factor` cells in place of each."""
    cells, finer = route.cells, Route(route.position_m, route.closed)
    n_cells = cells.n_cells * factor - (0 if route.closed else factor - 1)
    finer.__dict__["cells"] = replace(cells, step_m=cells.step_m / factor, n_cells=n_cells)
    return finer


# Added evidence counts at every place of a grid, but only where there are particles: on an open route none are left
# behind the last move, so the additive rules are compared on a loop. Theirs count for the nearest image, as in the
# paper, and so do cells that are the images; the others come near what cells come near as they get shorter.
@pytest.mark.parametrize(
    ("rule", "closed"),
    [*((rule, True) for rule in UpdateRule), (UpdateRule.LOG_LIKELIHOOD, False), (UpdateRule.MIXTURE, False)],
)
def test_particles_come_near_the_exact_filter_as_they_grow(rule, closed):
    route = Route(np.arange(60.0), closed)
    exact_route = route if rule in ADDITIVE else in_finer_cells(route, 8)
    views = np.random.default_rng(1).normal(size=(4, 60)) * 2
    differences = []
    for n_particles in (300, 30_000):
        exact, sampled = (
            after_views(start, views, (3.0, 7.0, 2.0), 1.0, rule, shared=0.5)
            for start in (
                GridFilter.uniform(exact_route, rule),
                ParticleFilter.uniform(route, n_particles, 3, rule),
            )
        )
        differences.append(np.abs(exact.mass - sampled.mass).sum() / 2)
    assert differences[1] < 0.04
    assert differences[1] < differences[0] / 3
    assert sampled.doubt.off_route == pytest.approx(exact.doubt.off_route, abs=0.01)


@pytest.mark.parametrize("kind", list(FilterKind))
def test_a_view_is_heard_of_between_images_as_the_way_leads_to_the_other(kind):
    """Images of one stop say what they say on average."""
    route = Route(np.array([0.0, 0.0, 8.0, 16.0]))
    belief = FILTERS[kind].uniform(in_finer_cells(route, 64)).updated(evidence_of([3.0, 5.0, 0.0, 0.0]), 0)
    expected, on_the_way = 0.0, 4 * (1 - np.arange(0.5, 512) / 512)  # from one place to the next
    for trust, probable in ((0.5, 0.2), (1.0, 0.4), (2.0, 0.4)):
        likelihood = np.exp(trust * on_the_way)
        mass = np.array([likelihood[:256].sum() / 2] * 2 + [likelihood[256:].sum() + 256, 256])
        expected = expected + probable * mass / mass.sum()
    np.testing.assert_allclose(belief.mass, expected, atol=0.005)


@pytest.mark.parametrize("offset_m", [-0.5, -0.3, -0.1, 0.0, 0.4])
@pytest.mark.parametrize("gap_m", [0.05, 2.0])
def test_cells_of_a_loop_hear_of_a_view_between_the_places_beside_them(gap_m, offset_m):
    """However near the loop's last place is to its first."""
    place_m = np.array([3.0, 4.0, 6.0, 8.0, 10.0])
    values, length_m = np.array([5.0, 1.0, -2.0, 0.0, 7.0]), 7.0 + gap_m
    cells = Cells.for_places(place_m, length_m, closed=True)
    at_m = cells.position_m + offset_m * cells.step_m
    expected = np.interp(at_m, place_m, values, period=length_m)
    np.testing.assert_allclose(cells.of_places(values, offset_m * cells.step_m), expected, atol=1e-9)


@pytest.mark.parametrize("n", [2, 3, 40])
@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("offset", [-0.5, -0.2, 0.0, 0.3, 0.5])
def test_cells_that_are_places_are_as_others(n, closed, offset):
    """Places at equal distances are the cells; one that is off by a hair makes every cell be looked up."""
    values, place_m = np.random.default_rng(0).random(n), 5 + 0.2 * np.arange(n)
    length_m, hair_m = 0.2 * (n if closed else n - 1), 1e-5 * (np.arange(n) == n - 1)
    even_cells, uneven_cells = (Cells.for_places(at_m, length_m, closed) for at_m in (place_m, place_m + hair_m))
    assert (even_cells.are_places, uneven_cells.are_places) == (True, False)
    for method in ("of_places", "to_places"):
        results = [getattr(cells, method)(values, offset * 0.2) for cells in (even_cells, uneven_cells)]
        np.testing.assert_allclose(*results, atol=1e-3)


def test_the_same_seed_and_steps_give_the_same_bits():
    route, view = Route(np.arange(30.0)), evidence_of(np.linspace(0, 12, 30))

    def run(seed, restore):
        belief = ParticleFilter.uniform(route, 200, seed).updated(view, 0)
        if restore:
            belief = ParticleFilter.from_arrays(route, belief.arrays(), seed)
        arrays = belief.predicted(2.0, 0.5, 1).updated(view, 1).arrays()
        return {name: array.tobytes() for name, array in arrays.items()}

    first = run(5, restore=False)
    assert run(5, restore=True) == first
    assert run(6, restore=False)["position_m"] != first["position_m"]


def test_no_place_has_less_than_nothing():
    belief = ParticleFilter.around(Route(np.arange(150.0)), 59.0, 2.0, seed=1)
    assert belief.updated(evidence_of(3 * np.cos(np.arange(150.0))), 0).mass.min() == 0


def test_particles_past_the_end_of_an_open_route_die():
    belief = ParticleFilter.uniform(Route(np.arange(101.0)), 1000, seed=0).predicted(40.0, 0.0, 1)
    assert belief.position_m.min() > 25  # a tenth of the move is its error
    assert belief.doubt.off_route > 0.3
    assert belief.mass.sum() == pytest.approx(1)


def test_moves_said_to_be_exact_spread_nothing():
    """And those said to be more exact than odometry usually is spread less."""
    route = Route(np.arange(200.0))
    start = GridFilter.around(route, 50.0, 0.01)
    masses = [start.predicted(10.0, std_m, step=1).mass[60] for std_m in (0.0, 0.1, motion_std_m(10.0))]
    assert masses[0] > 0.97 > 0.9 > masses[1] > 0.75 > masses[2]
