"""Appended images: the old ones keep their lists, the new ones are described as the map's are."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad.core.appending import append_images, nearest_known
from deepsimbad.core.descriptor import nearest_landmarks, normal_scores, rank_landmarks
from deepsimbad.core.relevance import Query, Relevance, relevances
from deepsimbad.core.retrieval import build_retrieval_map
from deepsimbad.core.route import Route
from deepsimbad.core.statistics import LandmarkStatistics

R, H = 12, 3


def some(n, seed):
    return np.random.default_rng(seed).random((n, R)).astype(np.float32)


def a_map(relevance, n=20, seed=0, closed=False, position_m=None):
    found = some(n, seed)
    built = build_retrieval_map(relevance, found, H, found)
    return built, Route(np.arange(n, dtype=float) if position_m is None else position_m, closed)


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
    built, route = a_map(relevance, len(old_m), closed=closed, position_m=np.sort(old_m))
    found = some(len(new_m), 1)
    merged = append_images(built, route, found, np.sort(new_m), found)
    n_old, lists = len(old_m), merged.built.index.lists
    assert (np.diff(merged.position_m) >= 0).all()
    assert np.array_equal(np.sort(merged.source), np.arange(n_old + len(new_m)))
    where = np.argsort(merged.source)
    assert (np.diff(where[:n_old]) > 0).all()  # old images keep their order
    assert np.array_equal(lists[:, where[:n_old]], built.index.lists)
    assert np.array_equal(merged.position_m[where[:n_old]], route.position_m)
    if relevance is Relevance.SIMBAD:
        assert np.array_equal(merged.built.index.values[:, where[:n_old]], built.index.values)
        listed = np.take_along_axis(found, lists[:, where[n_old:]].T.astype(np.intp), axis=1)
        assert np.array_equal(merged.built.index.values[:, where[n_old:]].T, listed)
    if relevance is Relevance.BRUTE_FORCE:
        assert np.array_equal(merged.built.encodings[where[n_old:]], found)
    if not closed:
        assert np.array_equal(merged.position_m[where[n_old:]], np.sort(new_m))
    elif route.length_m > 0:
        assert (merged.position_m[where[n_old:]] >= route.start_m).all()
        assert (merged.position_m[where[n_old:]] < route.start_m + route.length_m + 1e-9).all()


@pytest.mark.parametrize("relevance", [Relevance.RRF, Relevance.BAG_OF_LANDMARKS, Relevance.SIMBAD])
def test_new_lists_are_the_nearest_landmarks_by_rank(relevance):
    built, route = a_map(relevance)
    found = some(7, 1)
    merged = append_images(built, route, found, np.arange(7) + 0.5)
    lists = merged.built.index.lists[:, np.argsort(merged.source)[20:]]
    assert np.array_equal(lists, nearest_landmarks(rank_landmarks(found), H))


@pytest.mark.parametrize("relevance", [Relevance.STANDARDISED, Relevance.CALIBRATED])
def test_new_lists_come_from_the_new_drives_own_statistics(relevance):
    """A season that lifts one landmark everywhere does not put it in every list."""
    built, route = a_map(relevance, 400)
    found = some(4000, 1)
    found[:, 5] /= 100
    merged = append_images(built, route, found, np.arange(4000) / 10)
    lists = merged.built.index.lists[:, np.argsort(merged.source)[400:]]
    own = nearest_landmarks(LandmarkStatistics.of_map(rank_landmarks(found)).standardise(rank_landmarks(found)), H)
    assert (lists == own).mean() > 0.95  # the map's statistics count for a few frames among 4,000
    naive = nearest_landmarks(built.statistics.standardise(rank_landmarks(found)), H)
    assert (naive == 5).any(axis=0).mean() > 0.95
    assert (lists == 5).any(axis=0).mean() < 0.6


def test_one_frame_alone_is_described_too():
    """Its own statistics would call everything usual, and list landmarks 0, 1, 2."""
    built, route = a_map(Relevance.CALIBRATED, 400)
    found = some(1, 9)
    merged = append_images(built, route, found, np.array([7.25]))
    image = np.argsort(merged.source)[400]
    assert merged.position_m[image] == 7.25
    assert merged.built.index.lists[0, image] == np.argmin(found)
    relevance = relevances(merged.built, Query(rank_landmarks(found[0])))
    assert relevance[image] > np.quantile(relevance, 0.95)


@pytest.mark.parametrize("relevance", [Relevance.STANDARDISED, Relevance.CALIBRATED])
def test_the_maps_statistics_become_those_of_all_its_images(relevance):
    built, route = a_map(relevance, 30)
    merged = append_images(built, route, some(10, 1), np.arange(10.0)).built
    scores = normal_scores(rank_landmarks(np.concatenate([some(30, 0), some(10, 1)])), R)
    assert merged.statistics.mean == pytest.approx(scores.mean(axis=0))
    assert merged.statistics.std == pytest.approx(scores.std(axis=0))
    assert merged.statistics.weight == built.statistics.weight
    assert merged.calibration is built.calibration


def test_of_two_images_at_one_position_the_old_comes_first():
    built, route = a_map(Relevance.RRF, 4)
    merged = append_images(built, route, some(2, 1), np.array([1.0, 1.0]))
    assert merged.source.tolist() == [0, 1, 4, 5, 2, 3]


def test_a_position_of_another_turn_lies_within_the_first():
    built, route = a_map(Relevance.RRF, 10, closed=True)  # once around is 10 m
    merged = append_images(built, route, some(3, 1), np.array([12.5, 19.75, 30.0]))
    assert merged.position_m[np.argsort(merged.source)[10:]].tolist() == [2.5, 9.75, 0.0]


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
    _, route = a_map(Relevance.RRF, 10, closed=closed)
    nearest, near = nearest_known(route, np.array([position_m]), within_m=2.0)
    assert (nearest[0], near[0]) == (image, is_near)
