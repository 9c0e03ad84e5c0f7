"""The calibrated relevance against its definition written out in loops, and when it learns."""

from statistics import NormalDist

import numpy as np
import pytest

from deepsimbad.core.calibration import DEFAULT_CORRELATION, SeasonsOfRoute, live_prior
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.relevance import Query, Relevance, relevances
from deepsimbad.core.retrieval import SecondSeason, build_retrieval_map
from deepsimbad.core.route import Route
from deepsimbad.core.same_route import second_season
from deepsimbad.core.statistics import LandmarkStatistics
from deepsimbad.core.true_images import same_places

N_IMAGES, N_LANDMARKS, LIST_LENGTH = 80, 12, 3


@pytest.fixture
def seasons():
    """A route whose places have scores, seen in two seasons with noise."""
    rng = np.random.default_rng(0)
    place = rng.normal(size=(N_IMAGES, N_LANDMARKS))
    first, second = (place + 0.5 * rng.normal(size=place.shape) for _ in range(2))
    return first.astype(np.float32), second.astype(np.float32)


# --- the slow reference: one number at a time, nothing of the product's --------------------------------------------


def slow_scores(dissimilarities):
    """Normal scores of the ranks, rows of lists."""
    found = []
    for row in dissimilarities.tolist():
        order = sorted(range(len(row)), key=lambda landmark: (row[landmark], landmark))
        rank = {landmark: place + 1 for place, landmark in enumerate(order)}
        found.append([NormalDist().inv_cdf((rank[i] - 0.5) / len(row)) for i in range(len(row))])
    return np.array(found)


def slow_model(first, second, pairs):
    """(lists [n][h], rho [r], what a landmark's score is at every rank [h][r], moments of the two seasons [r])."""
    scores = slow_scores(first), slow_scores(second)
    z = [(each - each.mean(axis=0)) / each.std(axis=0) for each in scores]
    rho = np.array([np.mean([z[0][m, i] * z[1][f, i] for m, f in pairs]) for i in range(N_LANDMARKS)])
    rho = np.minimum(np.maximum(rho, 0.05), 0.95)
    both = z[0].copy()
    for m, f in pairs:
        for i in range(N_LANDMARKS):
            variance = 1**2 + 0.6**2 + 2 * 0.6 * rho[i]  # of z1 + 0.6 z2, each of variance 1, correlated by rho
            both[m, i] = (z[0][m, i] + 0.6 * z[1][f, i]) / np.sqrt(variance)
    # A third season has covariance rho with each, so (1 + 0.6) rho with the sum.
    trust = np.array([1.6 * r / np.sqrt(1 + 0.36 + 1.2 * r) for r in rho])
    lists = [sorted(range(N_LANDMARKS), key=lambda i, row=row: (row[i], i))[:LIST_LENGTH] for row in both]
    listed = np.empty((LIST_LENGTH, N_LANDMARKS))
    for j in range(LIST_LENGTH):
        overall = np.mean([both[m, lists[m][j]] for m in range(N_IMAGES)])
        for i in range(N_LANDMARKS):
            same = [both[m, i] for m in range(N_IMAGES) if lists[m][j] == i]
            listed[j, i] = (sum(same) + 3 * overall) / (len(same) + 3)
    mean = (scores[0].mean(axis=0) + scores[1].mean(axis=0)) / 2
    square = ((scores[0] ** 2).mean(axis=0) + (scores[1] ** 2).mean(axis=0)) / 2
    return lists, np.minimum(trust, 0.95), listed, mean, square


def slow_relevance(model, query_scores):
    """[n], as the first view of a session whose prior counts 20 frames."""
    lists, trust, listed, mean, square = model
    live_mean = (20 * mean + query_scores) / 21
    live_std = np.sqrt((20 * square + query_scores**2) / 21 - live_mean**2)
    z = (query_scores - live_mean) / live_std
    return [
        sum(trust[i] * listed[j, i] * z[i] - (trust[i] * listed[j, i]) ** 2 / 2 for j, i in enumerate(lists[m]))
        for m in range(N_IMAGES)
    ]


# --- its definition ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_paired", [N_IMAGES, 50])
def test_relevance_equals_its_definition(seasons, n_paired):
    """With fewer pairs than images, the others keep the map's own scores."""
    first, second = seasons
    frames = np.random.default_rng(4).permutation(N_IMAGES)  # the other drive's frames have their own order
    images = np.sort(np.random.default_rng(5).permutation(N_IMAGES)[:n_paired])
    other = np.empty_like(second)
    other[frames] = second
    pairs = np.stack([images, frames[images]], axis=1)
    built = build_retrieval_map(Relevance.CALIBRATED, first, LIST_LENGTH, second_season=SecondSeason(other, pairs))
    model = slow_model(first, other, pairs.tolist())
    assert built.calibration.is_of_two_seasons
    assert built.index.lists.T.tolist() == model[0]
    for view in (7, 41):
        ranks = rank_landmarks(second[view])
        actual = relevances(built, Query(ranks), built.statistics.observing(ranks))
        expected = slow_relevance(model, slow_scores(second[view : view + 1])[0])
        np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)


def test_images_without_a_partner_keep_their_own_scores(seasons):
    own, second = (slow_scores(season) for season in seasons)
    own, second = ((each - each.mean(axis=0)) / each.std(axis=0) for each in (own, second))
    places = np.stack([np.arange(40), np.arange(40)], axis=1)
    found = SeasonsOfRoute.learn(own, second, places)
    np.testing.assert_array_equal(found.scores[40:], own[40:])
    assert np.abs(found.scores[:40] - own[:40]).max(axis=1).min() > 0.01


def test_lists_are_chosen_by_both_seasons():
    """A landmark that was near in one season only gives way to one that was near in both."""
    rng = np.random.default_rng(2)
    place = rng.normal(size=(200, 20))
    own, second = place + 0.3 * rng.normal(size=place.shape), place + 0.3 * rng.normal(size=place.shape)
    own[0], second[0] = 0.0, 0.0
    own[0, [3, 8]], second[0, [3, 8]] = (-2.0, -1.8), (1.5, -1.8)
    places = np.stack([np.arange(200), np.arange(200)], axis=1)
    alone, both = SeasonsOfRoute.learn(own), SeasonsOfRoute.learn(own, second, places)
    assert int(alone.scores[0].argmin()) == 3
    assert int(both.scores[0].argmin()) == 8


def test_what_two_seasons_teach_is_found_again():
    """Landmarks planted with known correlations; of the pair with a third season, not of one with the other."""
    rng = np.random.default_rng(6)
    planted = np.linspace(0.2, 0.9, 8)
    place = rng.normal(size=(20_000, 8))
    first, second, third = (
        np.sqrt(planted) * place + np.sqrt(1 - planted) * rng.normal(size=place.shape) for _ in range(3)
    )
    places = np.stack([np.arange(20_000)] * 2, axis=1)
    found = SeasonsOfRoute.learn(first, second, places)
    measured = [np.corrcoef(found.scores[:, i], third[:, i])[0, 1] for i in range(8)]
    np.testing.assert_allclose(found.correlation, measured, atol=0.02)
    np.testing.assert_allclose(found.scores.std(axis=0), 1, atol=0.02)
    assert (found.correlation > planted + 0.01).all(), "two seasons say more than one"


def test_log_ratios_are_those_of_two_normal_distributions():
    """log N(z_q; rho z_m, s) - log N(z_q; 0, s), at equal spread s = 1."""
    rng = np.random.default_rng(8)
    seasons = SeasonsOfRoute.learn(rng.normal(size=(50, 5)))
    calibration = seasons.calibration(np.argsort(seasons.scores, axis=1)[:, :2].T.astype(np.uint16))
    scores = rng.normal(size=5)
    for j in range(2):
        for i in range(5):
            here = NormalDist(calibration.correlation[i] * calibration.listed_score[j, i])
            expected = np.log(here.pdf(scores[i])) - np.log(NormalDist().pdf(scores[i]))
            assert calibration.log_ratios(scores)[j, i] == pytest.approx(expected)


# --- when it learns ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("second", ["none", "elsewhere", "unrelated", "too few"])
def test_without_two_seasons_of_one_route_it_falls_back(second, seasons):
    first = seasons[0]
    unrelated = np.random.default_rng(9).normal(size=first.shape).astype(np.float32)
    route = Route(np.arange(N_IMAGES, dtype=float))
    drive, driven = {
        "none": (seasons[1], route),
        "elsewhere": (seasons[1], Route(1000 + route.position_m)),
        "unrelated": (unrelated, route),
        "too few": (seasons[1][:29], Route(route.position_m[:29])),
    }[second]
    said = None if second == "none" else True
    given, _ = second_season(first, lambda: drive, route, driven, said)
    built = build_retrieval_map(Relevance.CALIBRATED, first, LIST_LENGTH, second_season=given)
    assert not built.calibration.is_of_two_seasons
    assert DEFAULT_CORRELATION == 0.6
    assert built.calibration.correlation.tolist() == [0.6] * N_LANDMARKS
    standardised = build_retrieval_map(Relevance.STANDARDISED, first, LIST_LENGTH)
    assert built.index.lists.tolist() == standardised.index.lists.tolist()
    np.testing.assert_allclose(built.statistics.mean, standardised.statistics.mean)
    np.testing.assert_allclose(built.statistics.std, standardised.statistics.std)
    assert built.statistics.weight == 20


def test_pairs_enough_are_learnt_from(seasons):
    route = Route(np.arange(N_IMAGES, dtype=float))
    given, _ = second_season(seasons[0], lambda: seasons[1][:30], route, Route(route.position_m[:30]), True)
    assert build_retrieval_map(
        Relevance.CALIBRATED, seasons[0], LIST_LENGTH, second_season=given
    ).calibration.is_of_two_seasons


def test_the_live_prior_takes_seasons_alike_however_long_they_are():
    rng = np.random.default_rng(1)
    short, long = (rank_landmarks(rng.normal(size=(n, 9))).astype(np.float32) for n in (20, 500))
    short[:, 0], long[:, 0] = 1, 9
    prior = live_prior([LandmarkStatistics.of_map(short), LandmarkStatistics.of_map(long)])
    assert prior.weight == 20
    assert prior.mean[0] == pytest.approx(0, abs=1e-9), "halfway between always first and always last"
    assert prior.square[0] == pytest.approx(NormalDist().inv_cdf(0.5 / 9) ** 2)


# --- which frames show the same place ------------------------------------------------------------------------------


def test_same_places_are_the_nearest_within_the_tolerance():
    frames, route = Route(np.array([0.4, 5.6, 30.0])), Route(np.arange(10.0))
    assert same_places(frames, route).tolist() == [[0, 0], [6, 1]]


def test_same_places_in_the_plane():
    x = np.arange(10.0)
    route = Route(x, x_m=x, y_m=np.zeros(10))
    frames = Route(np.array([0.0, 3.0]), x_m=np.array([2.2, 5.2]), y_m=np.array([0.3, 0.3]))
    assert same_places(frames, route).tolist() == [[2, 0], [5, 1]]
