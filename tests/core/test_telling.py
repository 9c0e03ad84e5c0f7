"""Which places are telling, against the definition in loops."""

import math

import numpy as np
import pytest

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.relevance import Query, Relevance, relevances
from deepsimbad.core.retrieval import SecondSeason, build_retrieval_map
from deepsimbad.core.route import Route
from deepsimbad.core.telling import bits_ahead, telling_bits

N_IMAGES, N_LANDMARKS = 60, 15


@pytest.fixture
def two_seasons():
    """Dissimilarities [n, r] of a route in two seasons; its second half was hardly recognisable in the second."""
    rng = np.random.default_rng(0)
    place = rng.normal(size=(N_IMAGES, N_LANDMARKS))
    second = place + rng.normal(size=place.shape) * np.where(np.arange(N_IMAGES) < 30, 0.2, 2.0)[:, np.newaxis]
    return place.astype(np.float32), second.astype(np.float32)


def slow_rank(values, truth):
    """From 0: what is better, and half of what else is as good."""
    better = sum(value > values[truth] for value in values)
    tied = sum(value == values[truth] for value in values)
    return better + 0.5 * (tied - 1)


@pytest.mark.parametrize("closed", [False, True])
def test_what_a_place_tells_equals_its_definition(two_seasons, closed):
    first, second = two_seasons
    position_m = np.cumsum(np.random.default_rng(1).uniform(0.2, 2.5, N_IMAGES))
    route = Route(position_m, closed)
    frames = np.random.default_rng(2).permutation(N_IMAGES)[:45]
    places = np.stack([np.sort(frames), np.sort(frames)], axis=1)
    season = SecondSeason(second, places)
    built = build_retrieval_map(Relevance.CALIBRATED, first, 3)
    found = telling_bits(built, season, route)

    bits = {}
    for image, frame in places.tolist():
        relevance = relevances(built, Query(rank_landmarks(second[frame]))).tolist()
        bits[image] = math.log2(N_IMAGES / (1 + slow_rank(relevance, image)))
    for image in range(N_IMAGES):
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
    built = build_retrieval_map(Relevance.CALIBRATED, first, 3)
    known = np.arange(35, 55)
    places = np.stack([known, known], axis=1)
    found = telling_bits(built, SecondSeason(second, places), Route(np.arange(float(N_IMAGES))))
    assert len(set(found[known].tolist())) > 15
    assert len(set(found[:32].tolist())) == 1, "further than three metres"
    measured = [
        math.log2(N_IMAGES / (1 + slow_rank(relevances(built, Query(rank_landmarks(second[i]))).tolist(), i)))
        for i in known
    ]
    assert found[0] == pytest.approx(np.mean(measured))


def test_long_traverses_are_sampled(two_seasons):
    """More than 20,000 pairs are thinned evenly; what is left still covers the route."""
    first, second = two_seasons
    built = build_retrieval_map(Relevance.CALIBRATED, first, 3)
    route = Route(np.arange(float(N_IMAGES)))
    once = np.stack([np.arange(N_IMAGES), np.arange(N_IMAGES)], axis=1)
    found = telling_bits(built, SecondSeason(second, np.repeat(once, 20_000 // N_IMAGES + 1, axis=0)), route)
    expected = telling_bits(built, SecondSeason(second, once), route)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_bits_ahead_are_those_of_the_place_a_move_leads_to():
    bits = np.arange(10, dtype=np.float32)
    actions_m = np.array([1.0, 2.4, 8.0])
    ahead = bits_ahead(Route(np.arange(10.0)), bits, actions_m)
    mean = 4.5
    assert ahead[0].tolist() == [1, 2, 8]
    assert ahead[7].tolist() == [8, mean, mean], "7 + 2.4 is past the end, at 9"
    assert ahead[9].tolist() == [mean, mean, mean]
    around = bits_ahead(Route(np.arange(10.0), closed=True), bits, actions_m)
    assert around[7].tolist() == [8, 9, 5]
    assert around[9].tolist() == [0, 1, 7]
