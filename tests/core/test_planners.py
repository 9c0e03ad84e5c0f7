"""Every planner on beliefs whose best move is plain; the value of moves against its definition in loops."""

import numpy as np
import pytest

from deepsimbad.core.map import Map
from deepsimbad.core.planners import (
    PlanningView,
    information_ahead,
    parse_planner,
    plan_at_random,
    plan_by_experience,
    plan_by_information,
)
from deepsimbad.errors import InvalidInputError

ACTIONS_M = np.arange(1.0, 11.0)
N_IMAGES = 200


def sharp(place):
    """One place in mind, and as much doubt about it: the rest of the mass lies anywhere."""
    return 0.5 * np.eye(N_IMAGES)[place] + 0.5 / N_IMAGES


def view_of(mass=None, bits=None, closed=False, **options):
    actions_m = options.get("actions_m", ACTIONS_M)
    n_images = N_IMAGES if bits is None else len(bits)
    map_ = Map(
        config={"relevance": "rrf", "n_landmarks": 1},
        lists=np.zeros((1, n_images), np.uint16),
        position_m=np.arange(float(n_images)),
        closed=closed,
        actions_m=actions_m,
        view_bits=None if bits is None else bits.copy(),
        novelty=options.get("novelty", np.r_[1.0, np.zeros(10)]),
        q_values=options.get("q_values"),
    )
    mass = np.full(N_IMAGES, 1 / N_IMAGES) if mass is None else mass
    return PlanningView(
        map_, mass, options.get("relevance"), options.get("seed", 0), options.get("step", 1), options.get("price", 0.0)
    )


# --- informed ------------------------------------------------------------------------------------------------------


@pytest.fixture
def bits():
    """Every place tells one bit, but every 37th tells seven."""
    bits = np.ones(N_IMAGES, np.float32)
    bits[::37] = 7
    return bits


def slow_values(bits, actions_m, news, price, closed):
    """Discounted bits by value iteration, images a metre apart."""
    n, best = len(bits), np.zeros(len(bits))
    for _ in range(60):
        values = np.empty((n, len(actions_m)))
        for x in range(n):
            for a, metres in enumerate(actions_m):
                to = int(x + metres) % n if closed else int(x + metres)
                inside = 0 <= to < n
                next_bits, next_best = (bits[to], best[to]) if inside else (bits.mean(), best.mean())
                values[x, a] = news[a] * next_bits - price * abs(metres) + 0.9 * next_best
        best = values.max(axis=1)
    return values


def slow_doubt_bits(mass, actions_m, closed=False):
    """Bits by which a robot more probably is not within 5 m of the mode after moves, images a metre apart."""
    n, mode, step_m = len(mass), int(mass.argmax()), 0.001
    ahead_m = np.arange(n) - mode
    if closed:
        ahead_m = (ahead_m + n // 2) % n - n // 2
    near = np.abs(ahead_m) <= 5
    bits = []
    for action_m in actions_m:
        std_m = np.sqrt(0.05**2 + 0.01 * abs(action_m))
        still = 0.0
        for share, error_m in ((0.6, std_m), (0.4, np.hypot(std_m, 0.2 * action_m))):
            for image in np.flatnonzero(near):
                off_m = np.arange(-5, 5, step_m) + step_m / 2 - ahead_m[image]
                density = np.exp(-0.5 * (off_m / error_m) ** 2) / (error_m * np.sqrt(2 * np.pi))
                still += mass[image] * share * density.sum() * step_m
        bits.append(2 * np.log2((1 - still) / (1 - mass[near].sum())))
    return np.array(bits)


@pytest.mark.parametrize("doubt", [0.5, 0.1, 0.01, 1e-4, 1e-9])
@pytest.mark.parametrize("actions_m", [(0.0, 10.0), (-20.0, 0.0, 20.0), (0.0, 50.0)])
def test_no_robot_stays_because_it_would_not_err(actions_m, doubt):
    mass = (1 - doubt) * np.eye(N_IMAGES)[90] + doubt * np.eye(N_IMAGES)[120]
    plan = plan_by_information(view_of(mass, np.full(N_IMAGES, 2, np.float32), actions_m=np.array(actions_m)))
    assert plan.action_m == actions_m[-1]


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("actions_m", [(1.0, 4.0, 10.0), (-3.0, 0.0, 5.0)])
def test_the_value_of_a_move_is_what_views_from_there_on_are_worth(closed, actions_m, bits):
    novelty = np.r_[1.0, 0.6, 0.3, 0.2, 0.1, np.zeros(6)]
    view = view_of(bits=bits, closed=closed, actions_m=np.array(actions_m), novelty=novelty)
    news = [1 - novelty[int(abs(metres))] for metres in actions_m]
    for price in (0.0, 0.2):
        expected = slow_values(bits, actions_m, news, price, closed)
        table = information_ahead(view.map, price)
        np.testing.assert_allclose(table[:, : len(actions_m)], expected, rtol=1e-4)


@pytest.mark.parametrize(("away", "to"), [(1, 74), (4, 74), (9, 74), (3, N_IMAGES)])  # on a loop the last is place 0
def test_a_robot_that_knows_its_place_goes_to_the_telling_one(bits, away, to):
    plan = plan_by_information(view_of(sharp(to - away), bits, closed=to == N_IMAGES))
    assert (plan.action_m, plan.values.argmax()) == (away, away - 1)


def test_where_nobody_knows_what_views_tell_it_goes_far():
    plan = plan_by_information(view_of(sharp(3)))
    assert (plan.action_m, plan.values) == (10, None)
    assert plan_by_information(view_of(sharp(40), actions_m=np.array([-4.0, 0.0, 1.0]))).action_m == -4


@pytest.mark.parametrize("known_bits", [True, False])
@pytest.mark.parametrize(
    ("place", "actions_m", "expected_m"),
    [
        (N_IMAGES - 1 - 4, (1.0, 4.0, 10.0), 4),
        (N_IMAGES - 1, (-3.0, 1.0, 10.0), -3),
        (2, (-3.0, -2.0, 1.0), -2),
        (2, (-9.0, 0.0), 0),
    ],
)
def test_no_move_leads_past_an_end_while_another_stays(place, actions_m, expected_m, known_bits):
    flat, farther_is_newer = np.ones(N_IMAGES, np.float32) if known_bits else None, np.linspace(1, 0, 11)
    plan = plan_by_information(view_of(sharp(place), flat, actions_m=np.array(actions_m), novelty=farther_is_newer))
    assert (plan.action_m, plan.chance_on_route > 0.97) == (expected_m, True)


def test_where_every_move_leads_past_the_end_it_is_the_one_that_most_probably_stays():
    mass = np.zeros(N_IMAGES)
    mass[[-12, -3, -1]] = 0.2, 0.2, 0.6
    plan = plan_by_information(view_of(mass, np.ones(N_IMAGES, np.float32), actions_m=np.array([1.0, 10.0])))
    assert (plan.action_m, plan.chance_on_route) == (1, pytest.approx(0.4))
    plan = plan_by_information(view_of(sharp(N_IMAGES - 1), actions_m=np.array([1.0, 10.0]), closed=True))
    assert (plan.action_m, plan.chance_on_route) == (10, pytest.approx(1))


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("place", [None, 2, 120])
def test_moves_are_weighed_by_the_whole_belief_and_by_what_they_leave_in_doubt(bits, place, closed):
    mass = np.random.default_rng(0).dirichlet(np.ones(N_IMAGES))
    if place is not None:
        mass = 0.02 * mass + 0.98 * np.eye(N_IMAGES)[place]
    view = view_of(mass, bits, closed=closed)
    plan = plan_by_information(view)
    table = mass @ information_ahead(view.map, 0.0)
    table[:10] -= slow_doubt_bits(mass, ACTIONS_M, closed)
    np.testing.assert_allclose(np.r_[plan.values, plan.bits], table, rtol=1e-4, atol=1e-4)
    to = [(m + 4) % N_IMAGES for m in range(N_IMAGES)]
    ahead = [bits[to[m]] if closed or to[m] == m + 4 else bits.mean() for m in range(N_IMAGES)]
    assert plan.bits[3] == pytest.approx(mass @ ahead, rel=1e-5)


def test_of_equal_moves_the_longer_one_forward():
    flat, mass = np.ones(N_IMAGES, np.float32), np.full(N_IMAGES, 1 / N_IMAGES)
    for actions_m, longest_m in (((-10.0, 0.0, 10.0), 10), ((-10.0, 0.0, 9.0), -10)):
        newer = view_of(mass, flat, actions_m=np.array(actions_m), novelty=np.linspace(1, 0, 11))
        assert plan_by_information(newer).action_m == longest_m


def test_a_robot_that_hardly_doubts_its_place_moves_no_farther_than_it_can_tell():
    flat, novelty = np.ones(N_IMAGES, np.float32), np.r_[1.0, 0.5, 0.3, 0.2, 0.15, 0.1, 0.08, 0.06, 0.04, 0.02, 0.0]
    moves_m = []
    for doubt in (0.5, 0.02, 0.002):
        mass = (1 - doubt) * np.eye(N_IMAGES)[50] + doubt * np.eye(N_IMAGES)[150]
        moves_m.append(plan_by_information(view_of(mass, flat, novelty=novelty)).action_m)
    assert moves_m[0] == 10 > moves_m[1] > moves_m[2] > 3


def test_places_that_hold_next_to_nothing_move_no_average():
    n_images, place = 2000, 700
    mass = np.full(n_images, 3.5e-9)
    mass[place] += 1 - mass.sum()
    view = view_of(mass, (1 + np.random.default_rng(0).random(n_images)).astype(np.float32))
    plan, row = plan_by_information(view), information_ahead(view.map, 0.0)[place]
    np.testing.assert_allclose(plan.values + slow_doubt_bits(mass, ACTIONS_M), row[:10], rtol=1e-4)
    np.testing.assert_allclose(plan.bits, row[10:], rtol=3e-6)


def test_metres_have_a_price(bits):
    flat = np.ones(N_IMAGES, np.float32)
    assert plan_by_information(view_of(sharp(50), flat, price=0.3)).action_m == 1
    assert plan_by_information(view_of(sharp(50), flat, novelty=np.linspace(1, 0, 11))).action_m == 10


def test_tables_of_few_prices_are_kept(bits):
    """Any robot may name its own price."""
    map_ = view_of(bits=bits).map
    tables = {price: information_ahead(map_, price) for price in np.linspace(0, 1, 50).tolist()}
    assert len(map_.information_tables) <= 8
    assert map_.information_tables[1.0] is tables[1.0]
    assert (information_ahead(map_, 0.0) == tables[0.0]).all()


# --- the paper's ---------------------------------------------------------------------------------------------------


def test_nnql_averages_the_rows_of_the_most_relevant_images():
    rng = np.random.default_rng(1)
    q_values = rng.random((N_IMAGES, 10)).astype(np.float32)
    relevance = rng.random(N_IMAGES).astype(np.float32)
    plan = plan_by_experience(view_of(sharp(0), q_values=q_values, relevance=relevance))
    nearest = sorted(range(N_IMAGES), key=lambda m: -relevance[m])[:4]
    expected = [np.mean([q_values[m, a] for m in nearest]) for a in range(10)]
    np.testing.assert_allclose(plan.values, expected, rtol=1e-6)
    assert (plan.planner, plan.action_m) == ("nnql", ACTIONS_M[int(np.argmax(expected))])
    for options in ({"relevance": relevance}, {"q_values": q_values}):
        assert plan_by_experience(view_of(**options)) is None, "without experience, or a view"


def test_random_moves_are_drawn_alike_from_the_seed_and_the_step():
    moves, again, other = (
        [plan_at_random(view_of(seed=seed, step=step)).action_m for step in range(2000)] for seed in (3, 3, 4)
    )
    counts = np.bincount(np.array(moves, int), minlength=11)[1:]
    assert (counts.sum(), abs(counts - 200).max() < 60) == (2000, True)
    assert again == moves != other


# --- by name -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["informed", "nnql", "random", "constant:10", "constant:2.5"])
def test_planners_by_name(text):
    q_values = np.ones((N_IMAGES, 10), np.float32)
    plan = parse_planner(text, (1.0, 2.5, 10.0))(view_of(q_values=q_values, relevance=q_values[:, 0]))
    assert plan.planner == text
    assert text[:9] != "constant:" or plan.action_m == float(text[9:])


@pytest.mark.parametrize(
    "text", ["", "Telling", "clairvoyant", "constant", "constant:", "constant:3", "constant:nan", "random:1", "nnql "]
)
def test_no_such_planner_is_named_with_those_there_are(text):
    with pytest.raises(InvalidInputError) as caught:
        parse_planner(text, (1.0, 10.0))
    assert repr(text) in caught.value.message
    assert caught.value.hints["allowed"] == ["informed", "nnql", "random", "constant:1", "constant:10"]


@pytest.mark.parametrize("text", ["informed", "nnql", "random", "constant:1"])
def test_a_domain_of_one_move_gets_that_move(text):
    relevance = np.ones(N_IMAGES, np.float32)
    options = {"relevance": relevance, "actions_m": ACTIONS_M[:1], "q_values": relevance[:, np.newaxis]}
    assert parse_planner(text, (1.0,))(view_of(sharp(4), relevance, **options)).action_m == 1
