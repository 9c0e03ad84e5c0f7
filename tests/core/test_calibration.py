"""The calibrated relevance against its definition, and when it learns."""

import numpy as np
import pytest

from deepsimbad.core.calibration import CALIBRATED_PRIOR_WEIGHT_FRAMES, DEFAULT_CORRELATION
from deepsimbad.core.descriptor import normal_scores, rank_landmarks
from deepsimbad.core.metrics import same_places
from deepsimbad.core.relevance import Query, Relevance, relevances
from deepsimbad.core.retrieval import SecondSeason, build_retrieval_map
from deepsimbad.core.route import Route


@pytest.fixture
def seasons():
    """A route whose places have scores, seen in two seasons with noise."""
    rng = np.random.default_rng(0)
    place = rng.normal(size=(80, 12))
    first, second = (place + 0.5 * rng.normal(size=place.shape) for _ in range(2))
    return first.astype(np.float32), second.astype(np.float32)


def test_relevance_equals_its_definition(seasons):
    first, second = seasons
    pairs = np.stack([np.arange(80), np.arange(80)], axis=1)
    built = build_retrieval_map(Relevance.CALIBRATED, first, 3, second_season=SecondSeason(second, pairs))
    scores = [normal_scores(rank_landmarks(season), 12) for season in seasons]
    z = [(each - each.mean(0)) / each.std(0) for each in scores]
    rho = np.clip((z[0] * z[1]).mean(0), 0.05, 0.95)
    lists = np.argsort(z[0], axis=1, kind="stable")[:, :3]
    mean = (scores[0].mean(0) + scores[1].mean(0)) / 2
    square = ((scores[0] ** 2).mean(0) + (scores[1] ** 2).mean(0)) / 2
    query = scores[1][7]
    live_mean = (20 * mean + query) / 21
    live_z = (query - live_mean) / np.sqrt((20 * square + query**2) / 21 - live_mean**2)
    expected = np.zeros(80)
    for j in range(3):
        overall = z[0][np.arange(80), lists[:, j]].mean()
        for m in range(80):
            i = lists[m, j]
            same = [z[0][other, i] for other in range(80) if lists[other, j] == i]
            listed = (sum(same) + 3 * overall) / (len(same) + 3)
            expected[m] += rho[i] * live_z[i] * listed - rho[i] ** 2 * listed**2 / 2
    ranks = rank_landmarks(second[7])
    assert CALIBRATED_PRIOR_WEIGHT_FRAMES == 20
    actual = relevances(built, Query(ranks), built.statistics.observing(ranks))
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("second", ["none", "elsewhere", "unrelated"])
def test_without_two_seasons_of_one_route_it_falls_back(second, seasons):
    first = seasons[0]
    unrelated = np.random.default_rng(9).normal(size=first.shape).astype(np.float32)
    pairs = np.stack([np.arange(80), np.arange(80)], axis=1)
    given = {
        "none": None,
        "elsewhere": SecondSeason(seasons[1], np.empty((0, 2), np.int64)),
        "unrelated": SecondSeason(unrelated, pairs),
    }[second]
    built = build_retrieval_map(Relevance.CALIBRATED, first, 3, second_season=given)
    assert not built.calibration.is_learnt
    assert (built.calibration.correlation == DEFAULT_CORRELATION).all()
    own = build_retrieval_map(Relevance.STANDARDISED, first, 3).statistics
    np.testing.assert_allclose(built.statistics.mean, own.mean)


def test_same_places_are_the_nearest_within_the_tolerance():
    frames, route = Route(np.array([0.4, 5.6, 30.0])), Route(np.arange(10.0))
    assert same_places(frames, route).tolist() == [[0, 0], [6, 1]]


def test_same_places_in_the_plane():
    x = np.arange(10.0)
    route = Route(x, x_m=x, y_m=np.zeros(10))
    frames = Route(np.array([0.0, 3.0]), x_m=np.array([2.2, 5.2]), y_m=np.array([0.3, 0.3]))
    assert same_places(frames, route).tolist() == [[2, 0], [5, 1]]
