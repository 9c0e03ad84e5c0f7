"""What a map is built of: the calibrated relevance against its definition written out in loops, and appended drives."""

from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad.core.building import DEFAULT_CORRELATION, append_drive, both_seasons, live_prior, nearest_known
from deepsimbad.core.descriptor import LandmarkStatistics, nearest_landmarks, normal_scores, rank_landmarks
from deepsimbad.core.drive import SecondSeason, second_season
from deepsimbad.core.map import UNKNOWN_FRAME
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.core.retrieval import relevances

from .conftest import a_drive, a_map

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
    rows = []
    for row in dissimilarities.tolist():
        order = sorted(range(len(row)), key=lambda landmark: (row[landmark], landmark))
        rank = {landmark: place + 1 for place, landmark in enumerate(order)}
        rows.append([NormalDist().inv_cdf((rank[i] - 0.5) / len(row)) for i in range(len(row))])
    return np.array(rows)


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
    built = a_map(Relevance.CALIBRATED, first, LIST_LENGTH, SecondSeason(other, pairs))
    model = slow_model(first, other, pairs.tolist())
    assert built.lists.T.tolist() == model[0]
    for view in (7, 41):
        ranks = rank_landmarks(second[view])
        actual = relevances(built, Query(ranks), built.landmark_statistics.observing(ranks))
        expected = slow_relevance(model, slow_scores(second[view : view + 1])[0])
        np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)


def test_what_two_seasons_teach_is_found_again():
    """Landmarks planted with known correlations; of the pair with a third season, not of one with the other."""
    rng = np.random.default_rng(6)
    planted = np.linspace(0.2, 0.9, 8)
    place = rng.normal(size=(20_000, 8))
    first, second, third = (
        np.sqrt(planted) * place + np.sqrt(1 - planted) * rng.normal(size=place.shape) for _ in range(3)
    )
    places = np.stack([np.arange(20_000)] * 2, axis=1)
    scores, correlation = both_seasons(first, second, places)
    measured = [np.corrcoef(scores[:, i], third[:, i])[0, 1] for i in range(8)]
    np.testing.assert_allclose(correlation, measured, atol=0.02)
    np.testing.assert_allclose(scores.std(axis=0), 1, atol=0.02)
    assert (correlation > planted + 0.01).all(), "two seasons say more than one"


# --- when it learns ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("second", ["none", "elsewhere", "unrelated", "too few"])
def test_without_two_seasons_of_one_route_it_falls_back(second, seasons):
    unrelated = np.random.default_rng(9).normal(size=seasons[0].shape).astype(np.float32)
    own = a_drive(seasons[0])
    drive = {
        "none": a_drive(seasons[1]),
        "elsewhere": a_drive(seasons[1], position_m=1000 + own.position_m),
        "unrelated": a_drive(unrelated),
        "too few": a_drive(seasons[1][:29]),
    }[second]
    season, measured, _ = second_season(own, False, drive, None if second == "none" else True, lambda other: other)
    assert (season, measured) == (None, None)
    built = a_map(Relevance.CALIBRATED, seasons[0], LIST_LENGTH, season)
    assert DEFAULT_CORRELATION == 0.6
    assert built.correlation.tolist() == [0.6] * N_LANDMARKS
    standardised = a_map(Relevance.STANDARDISED, seasons[0], LIST_LENGTH)
    assert built.lists.tolist() == standardised.lists.tolist()
    np.testing.assert_allclose(built.statistics, standardised.statistics)
    assert built.landmark_statistics.weight == 20


def test_pairs_enough_are_learnt_from(seasons):
    season, *_ = second_season(a_drive(seasons[0]), False, a_drive(seasons[1][:30]), True, lambda other: other)
    assert set(a_map(Relevance.CALIBRATED, seasons[0], LIST_LENGTH, season).correlation.tolist()) != {0.6}


def test_the_live_prior_takes_seasons_alike_however_long_they_are():
    rng = np.random.default_rng(1)
    short, long = (rank_landmarks(rng.normal(size=(n, 9))).astype(np.float32) for n in (20, 500))
    short[:, 0], long[:, 0] = 1, 9
    prior = live_prior([LandmarkStatistics.of_map(short), LandmarkStatistics.of_map(long)])
    assert prior.weight == 20
    assert prior.mean[0] == pytest.approx(0, abs=1e-9), "halfway between always first and always last"
    assert prior.square[0] == pytest.approx(NormalDist().inv_cdf(0.5 / 9) ** 2)


# --- appended drives -----------------------------------------------------------------------------------------------

R, H = 12, 3


def some(n, seed):
    return np.random.default_rng(seed).random((n, R)).astype(np.float32)


def old_map(relevance, n=20, seed=0, **more):
    return a_map(relevance, some(n, seed), H, actions_m=(1.0, 2.0), **more)


def millimetres(least_m, most_m):
    """Positions that are no shorter a route than there may be."""
    return st.integers(1000 * least_m, 1000 * most_m).map(lambda position_mm: position_mm / 1000)


@pytest.mark.parametrize("relevance", list(Relevance))
@given(
    old_m=st.lists(millimetres(0, 100), min_size=1, max_size=20),
    new_m=st.lists(millimetres(-20, 120), min_size=1, max_size=20),
    closed=st.booleans(),
)
def test_old_images_stay_as_they_are_and_all_lie_in_route_order(relevance, old_m, new_m, closed):
    old = old_map(relevance, len(old_m), closed=closed, position_m=np.sort(old_m))
    added = a_drive(some(len(new_m), 1), position_m=np.sort(new_m), timestamp_us=np.arange(len(new_m)))
    merged = append_drive(old, added)
    n_old, route = len(old_m), old.route
    assert (np.diff(merged.position_m) >= 0).all()
    is_new = merged.frame_digest != UNKNOWN_FRAME
    assert np.array_equal(merged.lists[:, ~is_new], old.lists)
    assert np.array_equal(merged.position_m[~is_new], old.position_m)
    assert (merged.timestamp_us[~is_new] == -1).all()
    frames = [added.digests().tolist().index(digest) for digest in merged.frame_digest[is_new].tolist()]
    assert sorted(frames) == list(range(len(new_m)))
    assert merged.timestamp_us[is_new].tolist() == frames
    if relevance is Relevance.SIMBAD:
        assert np.array_equal(merged.values[:, ~is_new], old.values)
        rows, listed = added.dissimilarities[frames], merged.lists[:, is_new].T.astype(np.intp)
        assert np.array_equal(merged.values[:, is_new].T, np.take_along_axis(rows, listed, axis=1))
    if relevance is Relevance.BRUTE_FORCE:
        assert np.array_equal(merged.encodings[is_new], added.encodings[frames])
    if not closed:
        assert np.array_equal(merged.position_m[is_new], added.position_m[frames])
    elif route.length_m > 0:
        inside = merged.position_m[is_new] - route.start_m
        assert ((inside >= 0) & (inside < route.length_m + 1e-9)).all()
    assert merged.n_images == n_old + len(new_m)


@pytest.mark.parametrize("relevance", [Relevance.RRF, Relevance.BAG_OF_LANDMARKS, Relevance.SIMBAD])
def test_new_lists_are_the_nearest_landmarks_by_rank(relevance):
    merged = append_drive(old_map(relevance), a_drive(some(7, 1), position_m=np.arange(7) + 0.5))
    lists = merged.lists[:, merged.frame_digest != UNKNOWN_FRAME]
    assert np.array_equal(lists, nearest_landmarks(rank_landmarks(some(7, 1)), H))


@pytest.mark.parametrize("relevance", [Relevance.STANDARDISED, Relevance.CALIBRATED])
def test_new_lists_come_from_the_new_drives_own_statistics(relevance):
    """A season that lifts one landmark everywhere does not put it in every list."""
    old = old_map(relevance, 400)
    season = some(4000, 1)
    season[:, 5] /= 100
    merged = append_drive(old, a_drive(season, position_m=np.arange(4000) / 10))
    lists = merged.lists[:, merged.frame_digest != UNKNOWN_FRAME]
    own = nearest_landmarks(LandmarkStatistics.of_map(rank_landmarks(season)).standardise(rank_landmarks(season)), H)
    assert (lists == own).mean() > 0.95  # the map's statistics count for a few frames among 4,000
    naive = nearest_landmarks(old.landmark_statistics.standardise(rank_landmarks(season)), H)
    assert (naive == 5).any(axis=0).mean() > 0.95
    assert (lists == 5).any(axis=0).mean() < 0.6


def test_one_frame_alone_is_described_too():
    """Its own statistics would call everything usual, and list landmarks 0, 1, 2."""
    merged = append_drive(old_map(Relevance.CALIBRATED, 400), a_drive(some(1, 9), position_m=[7.25]))
    (image,) = np.flatnonzero(merged.frame_digest != UNKNOWN_FRAME)
    assert merged.position_m[image] == 7.25
    assert merged.lists[0, image] == np.argmin(some(1, 9))
    relevance = relevances(merged, Query(rank_landmarks(some(1, 9)[0])))
    assert relevance[image] > np.quantile(relevance, 0.95)


@pytest.mark.parametrize("relevance", [Relevance.STANDARDISED, Relevance.CALIBRATED])
def test_the_maps_statistics_become_those_of_all_its_images(relevance):
    old = old_map(relevance, 30)
    merged = append_drive(old, a_drive(some(10, 1)))
    scores = normal_scores(rank_landmarks(np.concatenate([some(30, 0), some(10, 1)])), R)
    assert merged.statistics == pytest.approx(np.stack([scores.mean(axis=0), scores.std(axis=0)]))
    assert merged.landmark_statistics.weight == old.landmark_statistics.weight
    assert merged.correlation is old.correlation


def test_of_two_images_at_one_position_the_old_comes_first():
    merged = append_drive(old_map(Relevance.RRF, 4), a_drive(some(2, 1), position_m=[1.0, 1.0]))
    assert (merged.frame_digest != UNKNOWN_FRAME).tolist() == [False, False, True, True, False, False]


def test_a_position_of_another_turn_lies_within_the_first():
    old = old_map(Relevance.RRF, 10, closed=True)  # once around is 10 m
    merged = append_drive(old, a_drive(some(3, 1), position_m=[12.5, 19.75, 30.0]))
    assert merged.position_m[merged.frame_digest != UNKNOWN_FRAME].tolist() == [0.0, 2.5, 9.75]


@pytest.mark.parametrize(
    ("closed", "position_m", "image", "is_near"),
    [
        (False, 3.4, 3, True),
        (False, 10.0, 9, True),
        (False, 11.5, 9, False),
        (False, -2.5, 0, False),
        (True, 9.9, 0, True),  # the start is nearer behind the last image
        (True, 23.2, 3, True),
    ],
)
def test_the_nearest_old_image(closed, position_m, image, is_near):
    nearest, near = nearest_known(old_map(Relevance.RRF, 10, closed=closed), np.array([position_m]))
    assert (nearest[0], near[0]) == (image, is_near)


def test_a_new_image_knows_of_its_place_what_the_nearest_old_one_does():
    rng = np.random.default_rng(0)
    bits, q_values = rng.random(9).astype(np.float32), rng.random((9, 2)).astype(np.float32)
    old = replace(old_map(Relevance.RRF, 9), telling_bits=bits, q_values=q_values, off_route_model=np.array([1.0, 2.0]))
    known = {"timestamp_us": np.array([5, 6]), "x_m": np.array([1.0, np.nan]), "y_m": np.array([2.0, np.nan])}
    made = append_drive(old, a_drive(some(2, 1), position_m=[3.2, 90.0], **known))
    assert np.flatnonzero(made.frame_digest != UNKNOWN_FRAME).tolist() == [4, 10], "where the new ones are"
    assert made.telling_bits[[4, 10]] == pytest.approx([bits[3], bits.mean()])
    assert np.delete(made.telling_bits, [4, 10]).tolist() == bits.tolist()
    assert made.q_values[[4, 10]].tolist() == [q_values[3].tolist(), [np.float32(1e-4)] * 2]
    assert made.timestamp_us.tolist() == [-1, -1, -1, -1, 5, -1, -1, -1, -1, -1, 6]
    assert made.x_m[4] == 1.0
    assert np.isnan(np.delete(made.x_m, 4)).all()
    assert made.off_route_model is old.off_route_model
