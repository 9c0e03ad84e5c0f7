"""Every planner on beliefs whose best move is plain; which places are telling, against the definition in loops."""

import math

import numpy as np
import pytest

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import SecondSeason
from deepsimbad.core.map import Map
from deepsimbad.core.planners import (
    PlanningView,
    parse_planner,
    plan_at_random,
    plan_by_experience,
    plan_constantly,
    plan_for_telling_places,
    telling_bits,
)
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.core.retrieval import relevances
from deepsimbad.errors import InvalidInputError

from .conftest import a_map

ACTIONS_M = np.arange(1.0, 11.0)
N_IMAGES = 200


def sharp(place):
    """One place in mind, and as much doubt about it: the rest of the mass lies anywhere."""
    return 0.5 * np.eye(N_IMAGES)[place] + 0.5 / N_IMAGES


def view_of(mass=None, bits=None, closed=False, **more):
    actions_m = more.get("actions_m", ACTIONS_M)
    map_ = Map(
        config={"relevance": "rrf", "n_landmarks": 1},
        lists=np.zeros((1, N_IMAGES), np.uint16),
        position_m=np.arange(float(N_IMAGES)),
        closed=closed,
        actions_m=actions_m,
        telling_bits=None if bits is None else bits.copy(),
        q_values=more.get("q_values"),
    )
    mass = np.full(N_IMAGES, 1 / N_IMAGES) if mass is None else mass
    return PlanningView(map_, mass, more.get("relevance"), more.get("seed", 0), more.get("step", 1))


# --- telling -------------------------------------------------------------------------------------------------------


@pytest.fixture
def bits():
    """Every place tells one bit, but every 37th tells seven."""
    bits = np.ones(N_IMAGES, np.float32)
    bits[::37] = 7
    return bits


@pytest.mark.parametrize("away", [1, 4, 9])
def test_a_robot_that_knows_its_place_goes_to_the_telling_one(bits, away):
    plan = plan_for_telling_places(view_of(sharp(74 - away), bits))
    assert plan.action_m == away
    assert plan.values.argmax() == away - 1


def test_where_nobody_knows_what_is_telling_it_goes_far():
    plan = plan_for_telling_places(view_of(sharp(3)))
    assert (plan.action_m, plan.values) == (10, None)


def test_the_value_of_a_move_is_its_mean_bits_and_a_little_for_every_metre(bits):
    mass = np.random.default_rng(0).dirichlet(np.ones(N_IMAGES))
    plan = plan_for_telling_places(view_of(mass, bits))
    for action_m, value in zip(ACTIONS_M.astype(int).tolist(), plan.values.tolist(), strict=True):
        ahead = [bits[m + action_m] if m + action_m < N_IMAGES else bits.mean() for m in range(N_IMAGES)]
        doubt = -np.log2(sum(each**2 for each in mass)) / np.log2(N_IMAGES)
        expected = doubt**0.5 * sum(mass[m] * ahead[m] for m in range(N_IMAGES)) + 0.12 * action_m
        assert value == pytest.approx(expected, rel=1e-5)


def test_two_places_in_mind_agree_on_what_suits_both(bits):
    """One would rather go 4 m, the other 6 m, but 9 m tells something in either case."""
    bits[:] = 1
    bits[[54, 59]] = 4
    bits[[156, 159]] = 4
    assert plan_for_telling_places(view_of(sharp(50), bits)).action_m == 9
    bits[[54, 156]] = 8
    assert plan_for_telling_places(view_of(sharp(50), bits)).action_m == 4
    assert plan_for_telling_places(view_of(0.5 * sharp(50) + 0.5 * sharp(150), bits)).action_m == 9


def test_a_closed_route_goes_on_behind_its_end(bits):
    at_end = sharp(N_IMAGES - 3)
    assert plan_for_telling_places(view_of(at_end, bits, closed=True)).action_m == 3, "place 0 tells seven bits"
    assert plan_for_telling_places(view_of(at_end, bits)).action_m == 10


# --- the paper's ---------------------------------------------------------------------------------------------------


def test_nnql_averages_the_rows_of_the_most_relevant_images():
    rng = np.random.default_rng(1)
    q_values = rng.random((N_IMAGES, 10)).astype(np.float32)
    relevance = rng.random(N_IMAGES).astype(np.float32)
    plan = plan_by_experience(view_of(sharp(0), q_values=q_values, relevance=relevance))
    nearest = sorted(range(N_IMAGES), key=lambda m: -relevance[m])[:4]
    expected = [np.mean([q_values[m, a] for m in nearest]) for a in range(10)]
    np.testing.assert_allclose(plan.values, expected, rtol=1e-6)
    assert plan.action_m == ACTIONS_M[int(np.argmax(expected))]
    assert plan.planner == "nnql"


def test_nnql_knows_nothing_without_experience_or_a_view():
    relevance, q_values = np.ones(N_IMAGES, np.float32), np.ones((N_IMAGES, 10), np.float32)
    assert plan_by_experience(view_of(relevance=relevance)) is None
    assert plan_by_experience(view_of(q_values=q_values)) is None


def test_the_same_move_always():
    for mass in (None, sharp(7)):
        assert plan_constantly(4.0, view_of(mass)).action_m == 4


def test_random_moves_are_drawn_alike_from_the_seed_and_the_step():
    moves = [plan_at_random(view_of(seed=3, step=step)).action_m for step in range(2000)]
    counts = np.bincount(np.array(moves, int), minlength=11)[1:]
    assert counts.sum() == 2000
    assert abs(counts - 200).max() < 60
    again = [plan_at_random(view_of(seed=3, step=step)).action_m for step in range(2000)]
    other = [plan_at_random(view_of(seed=4, step=step)).action_m for step in range(2000)]
    assert again == moves != other


# --- by name -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["telling", "nnql", "random", "constant:10", "constant:2.5"])
def test_planners_by_name(text):
    ones = np.ones((N_IMAGES, 10), np.float32)
    plan = parse_planner(text, (1.0, 2.5, 10.0))(view_of(q_values=ones, relevance=ones[:, 0]))
    assert plan.planner == text
    assert text[:9] != "constant:" or plan.action_m == float(text[9:])


@pytest.mark.parametrize(
    "text", ["", "Telling", "clairvoyant", "constant", "constant:", "constant:3", "constant:nan", "random:1", "nnql "]
)
def test_no_such_planner_is_named_with_those_there_are(text):
    with pytest.raises(InvalidInputError) as caught:
        parse_planner(text, (1.0, 10.0))
    assert repr(text) in caught.value.message
    assert caught.value.hints["allowed"] == ["telling", "nnql", "random", "constant:1", "constant:10"]


@pytest.mark.parametrize("text", ["telling", "nnql", "random", "constant:1"])
def test_a_domain_of_one_move_gets_that_move(text):
    ones = np.ones(N_IMAGES, np.float32)
    known = {"relevance": ones, "actions_m": ACTIONS_M[:1], "q_values": ones[:, np.newaxis]}
    assert parse_planner(text, (1.0,))(view_of(sharp(4), ones, **known)).action_m == 1


# --- which places are telling ---------------------------------------------------------------------------------------

N_PLACES, N_LANDMARKS = 60, 15


@pytest.fixture
def two_seasons():
    """Dissimilarities [n, r] of a route in two seasons; its second half was hardly recognisable in the second."""
    rng = np.random.default_rng(0)
    place = rng.normal(size=(N_PLACES, N_LANDMARKS))
    second = place + rng.normal(size=place.shape) * np.where(np.arange(N_PLACES) < 30, 0.2, 2.0)[:, np.newaxis]
    return place.astype(np.float32), second.astype(np.float32)


def slow_rank(values, truth):
    """From 0: what is better, and half of what else is as good."""
    better = sum(value > values[truth] for value in values)
    tied = sum(value == values[truth] for value in values)
    return better + 0.5 * (tied - 1)


@pytest.mark.parametrize("closed", [False, True])
def test_what_a_place_tells_equals_its_definition(two_seasons, closed):
    first, second = two_seasons
    position_m = np.cumsum(np.random.default_rng(1).uniform(0.2, 2.5, N_PLACES))
    frames = np.random.default_rng(2).permutation(N_PLACES)[:45]
    places = np.stack([np.sort(frames), np.sort(frames)], axis=1)
    season = SecondSeason(second, places)
    built = a_map(Relevance.CALIBRATED, first, 3, closed=closed, position_m=position_m)
    found = telling_bits(built, season)

    bits = {}
    for image, frame in places.tolist():
        relevance = relevances(built, Query(rank_landmarks(second[frame]))).tolist()
        bits[image] = math.log2(N_PLACES / (1 + slow_rank(relevance, image)))
    for image in range(N_PLACES):
        weight = {
            other: math.exp(-0.5 * (position_m[other] - position_m[image]) ** 2)
            for other in bits
            if abs(position_m[other] - position_m[image]) <= 3
        }
        expected = np.mean(list(bits.values()))
        if weight:
            expected = sum(weight[other] * bits[other] for other in weight) / sum(weight.values())
        assert found[image] == pytest.approx(expected, rel=1e-5), image
    assert found[:25].mean() > found[35:].mean() + 1, "the recognisable half is the telling one"


def test_far_from_every_measurement_a_place_tells_the_mean(two_seasons):
    first, second = two_seasons
    built = a_map(Relevance.CALIBRATED, first, 3)
    known = np.arange(35, 55)
    places = np.stack([known, known], axis=1)
    found = telling_bits(built, SecondSeason(second, places))
    assert len(set(found[known].tolist())) > 15
    assert len(set(found[:32].tolist())) == 1, "further than three metres"
    measured = [
        math.log2(N_PLACES / (1 + slow_rank(relevances(built, Query(rank_landmarks(second[i]))).tolist(), i)))
        for i in known
    ]
    assert found[0] == pytest.approx(np.mean(measured))


def test_long_traverses_are_sampled(two_seasons):
    """More than 20,000 pairs are thinned evenly; what is left still covers the route."""
    first, second = two_seasons
    built = a_map(Relevance.CALIBRATED, first, 3)
    once = np.stack([np.arange(N_PLACES), np.arange(N_PLACES)], axis=1)
    found = telling_bits(built, SecondSeason(second, np.repeat(once, 20_000 // N_PLACES + 1, axis=0)))
    expected = telling_bits(built, SecondSeason(second, once))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
