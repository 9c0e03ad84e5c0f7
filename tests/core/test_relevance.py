"""Sums over lists, shortlists, batches of views, and what a relevance needs: `test_vpr` has the definitions."""

from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.composed import Moments
from deepsimbad.core.descriptor import LandmarkStatistics, rank_landmarks
from deepsimbad.core.index.retrieval import relevances, shortlist, sum_listed
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Query, Relevance, most_strange, strangeness
from deepsimbad.errors import InvalidInputError, InvalidMapConfigError

from .conftest import a_map

N_LANDMARKS = 9
N_IMAGES = 40


@pytest.fixture
def scene():
    rng = np.random.default_rng(5)
    return {
        "map": rng.random((N_IMAGES, N_LANDMARKS)).astype(np.float32),
        "query": rng.random((6, N_LANDMARKS)).astype(np.float32),
        "map encodings": rng.normal(size=(N_IMAGES, 7)).astype(np.float32),
        "query encodings": rng.normal(size=(6, 7)).astype(np.float32),
    }


@pytest.mark.parametrize("n_images", [1, 5000, 600_000])
def test_the_fused_sum_equals_indexing_at_every_size(n_images):
    rng = np.random.default_rng(n_images)
    lists = rng.integers(0, 300, (4, n_images)).astype(np.uint16)
    config = {"relevance": "rrf", "n_landmarks": 300}
    map_ = Map(config=config, lists=lists, position_m=np.arange(float(n_images)))
    tables = rng.random((2, 4, 300), dtype=np.float32)
    expected = [sum(table[j][lists[j]].astype(np.float64) for j in range(4)) for table in tables]
    np.testing.assert_allclose(sum_listed(map_, tables), expected, rtol=1e-5)
    assert np.array_equal(sum_listed(map_, tables[0]), sum_listed(map_, tables)[0])


def test_a_landmark_that_never_moved_says_little(scene):
    constant = np.tile(scene["map"][0], (5, 1))
    map_ = a_map(Relevance.STANDARDISED, constant, 3)
    assert np.isfinite(relevances(map_, Query(rank_landmarks(scene["query"][0])))).all()


def test_what_a_relevance_needs_is_asked_for(scene):
    ranks = rank_landmarks(scene["query"][0])
    for name in (Relevance.SIMBAD, Relevance.BRUTE_FORCE):
        map_ = a_map(name, scene["map"], 4, encodings=scene["map encodings"])
        with pytest.raises(InvalidInputError):
            relevances(map_, Query(ranks))
    with pytest.raises(InvalidInputError, match="numbers"):
        relevances(map_, Query(ranks, encoding=np.zeros(3, np.float32)))
    with pytest.raises(InvalidMapConfigError, match="needs statistics"):
        replace(map_, config={**map_.config, "relevance": "standardised"})


@pytest.mark.parametrize(("list_length", "n_images"), [(0, 5), (N_LANDMARKS + 1, 5), (2, 0)])
def test_impossible_maps_are_refused(list_length, n_images, scene):
    with pytest.raises(InvalidMapConfigError):
        a_map(Relevance.RRF, scene["map"][:n_images], list_length)


@pytest.mark.parametrize("length", [1, 7, 64, 65, 500])
def test_shortlist_is_the_stable_order(length):
    values = np.random.default_rng(length).integers(0, 40, 300).astype(np.float32)
    expected = np.argsort(-values, kind="stable")[:length].tolist()
    assert shortlist(values, length).tolist() == expected
    assert shortlist(np.stack([values, values]), length).tolist() == [expected, expected]


def test_live_statistics_start_as_the_maps_and_follow_the_views():
    rng = np.random.default_rng(0)
    statistics = LandmarkStatistics.of_map(rank_landmarks(rng.random((30, 6))))
    again = LandmarkStatistics.from_mean_std(np.stack([statistics.mean, statistics.std]))
    np.testing.assert_allclose(again.square, statistics.square)
    live = statistics
    view = rank_landmarks([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    for _ in range(5000):
        live = live.observing(view)
    np.testing.assert_allclose(live.standardise(view), 0, atol=0.15)


@pytest.mark.parametrize("relevance", sorted(set(Relevance) - {Relevance.COMPOSED}))
def test_a_batch_of_views_says_what_each_says_alone(relevance, scene):
    map_ = a_map(relevance, scene["map"], 4, encodings=scene["map encodings"])
    views = Query(rank_landmarks(scene["query"]), scene["query"], scene["query encodings"])
    single_live = [map_.live_statistics] * 6
    batch_live = map_.live_statistics
    for _ in range(3):
        batch_live = batch_live and replace(batch_live, ranks=batch_live.ranks.observing(views.ranks))
        batch = relevances(map_, views, batch_live)
        for e in range(6):
            single_live[e] = single_live[e] and single_live[e].observing(views.at(e))
            expected = relevances(map_, views.at(e), single_live[e])
            np.testing.assert_allclose(batch[e], expected, atol=1e-5)
            if relevance is not Relevance.BRUTE_FORCE:  # of which one matrix product rounds as it likes
                assert np.array_equal(batch[e], expected)
                assert shortlist(batch, 3)[e].tolist() == shortlist(expected, 3).tolist()


def test_a_short_drive_knows_little_of_what_is_strange():
    rng = np.random.default_rng(3)
    views = rng.normal(size=(4000, 300))
    # A share of 3 in 16 and three of its standard deviations, and of few views what Student's t adds to 2 in 44
    assert most_strange(views[:2000]) == pytest.approx(0.2551, abs=1e-3)
    assert most_strange(views[:5]) == pytest.approx(0.2551 + 0.1419 - 0.0455, abs=0.01)
    assert most_strange(np.zeros((1, 300))) == most_strange(np.ones((9, 300))) == pytest.approx(0.5606, abs=1e-3)
    # Neighbours that are alike teach once: each is the mean of nine views, so that 40 are worth some five
    drive = np.apply_along_axis(np.convolve, 0, views, np.ones(9) / 9, mode="valid")
    assert most_strange(drive[:40]) == pytest.approx(most_strange(views[:5]), abs=0.03)
    shares = [strangeness(drive[at + 40 : at + 80], Moments.of(drive[at : at + 40])) for at in range(0, 3600, 90)]
    excess = np.mean(shares) - 0.0455
    assert excess == pytest.approx(most_strange(drive[:40]) - most_strange(views[:2000]), abs=0.03)
