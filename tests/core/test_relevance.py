"""Every relevance against a slow obvious reference, and the reference figures on real descriptors."""

import itertools
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest

from deepsimbad.core.descriptor import PRIOR_WEIGHT_FRAMES, LandmarkStatistics, rank_landmarks
from deepsimbad.core.index.retrieval import relevances, shortlist, sum_listed
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Query, Relevance
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


def slow_ranks(row):
    order = sorted(range(len(row)), key=lambda i: (row[i], i))
    return {landmark: place for place, landmark in enumerate(order, start=1)}


def slow_score(rank):
    return NormalDist().inv_cdf((rank - 0.5) / N_LANDMARKS)


def slow_relevance(name, scene, h):
    """[q, n] by loops over the definitions; standardised as one causal session."""
    map_ranks = [slow_ranks(row) for row in scene["map"]]
    scores = np.array([[slow_score(ranks[i]) for i in range(N_LANDMARKS)] for ranks in map_ranks])
    mean, variance = scores.mean(axis=0), scores.var(axis=0)
    seen = []
    answer = np.zeros((len(scene["query"]), N_IMAGES))
    for q, query in enumerate(scene["query"]):
        ranks = slow_ranks(query)
        own = np.array([slow_score(ranks[i]) for i in range(N_LANDMARKS)])
        seen.append(own)
        weight = PRIOR_WEIGHT_FRAMES + len(seen)
        live_mean = (PRIOR_WEIGHT_FRAMES * mean + sum(seen)) / weight
        live_square = (PRIOR_WEIGHT_FRAMES * (variance + mean**2) + sum(s**2 for s in seen)) / weight
        live_z = (own - live_mean) / np.sqrt(live_square - live_mean**2)
        for m in range(N_IMAGES):
            listed = [i for i in range(N_LANDMARKS) if map_ranks[m][i] <= h]
            if name is Relevance.RRF:
                answer[q, m] = sum(1 / map_ranks[m][i] * 1 / ranks[i] for i in listed)
            elif name is Relevance.BAG_OF_LANDMARKS:
                answer[q, m] = sum(1 for i in listed if ranks[i] <= h)
            elif name is Relevance.SIMBAD:
                hot = [scene["map"][m][i] if i in listed else 0.0 for i in range(N_LANDMARKS)]
                query_hot = [query[i] if ranks[i] <= h else 0.0 for i in range(N_LANDMARKS)]
                answer[q, m] = -np.linalg.norm(np.subtract(hot, query_hot))
            elif name is Relevance.BRUTE_FORCE:
                answer[q, m] = -np.linalg.norm(scene["map encodings"][m] - scene["query encodings"][q])
            else:
                z = (scores[m] - mean) / np.sqrt(variance)
                kept = sorted(range(N_LANDMARKS), key=lambda i: (z[i], i))[:h]
                answer[q, m] = sum(-live_z[i] for i in kept)
    return answer


@pytest.mark.parametrize("list_length", [1, 4, N_LANDMARKS])
@pytest.mark.parametrize("name", sorted(set(Relevance) - {Relevance.COMPOSED}))  # has tests of its own
def test_relevance_equals_its_definition(name, list_length, scene):
    built = a_map(name, scene["map"], list_length, encodings=scene["map encodings"])
    live = built.live_statistics
    fast = []
    for dissimilarities, encoding in zip(scene["query"], scene["query encodings"], strict=True):
        query = Query(rank_landmarks(dissimilarities), dissimilarities, encoding)
        live = live.observing(query) if live else None
        fast.append(relevances(built, query, live))
    np.testing.assert_allclose(fast, slow_relevance(name, scene, list_length), rtol=1e-4, atol=1e-5)


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
    built = a_map(Relevance.STANDARDISED, constant, 3)
    assert np.isfinite(relevances(built, Query(rank_landmarks(scene["query"][0])))).all()


def test_what_a_relevance_needs_is_asked_for(scene):
    ranks = rank_landmarks(scene["query"][0])
    for name in (Relevance.SIMBAD, Relevance.BRUTE_FORCE):
        built = a_map(name, scene["map"], 4, encodings=scene["map encodings"])
        with pytest.raises(InvalidInputError):
            relevances(built, Query(ranks))
    with pytest.raises(InvalidInputError, match="numbers"):
        relevances(built, Query(ranks, encoding=np.zeros(3, np.float32)))
    with pytest.raises(InvalidMapConfigError, match="needs statistics"):
        replace(built, config={**built.config, "relevance": "standardised"})


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


@pytest.mark.real_data
def test_reference_figures_on_real_netvlad_descriptors(real_data):
    """Mean ANR over the six permutations, worked out independently (stateless standardised: 3.76)."""
    folder = real_data / "nordland_netvlad64"
    drives = [np.load(folder / f"{name}.npy") for name in ("nr", "nq", "nq2")]
    anr = []
    for landmarks, training, test in itertools.permutations(drives):
        squares = lambda a, b: ((a[:, None] - b[None]) ** 2).sum(-1)  # noqa: E731
        apart = squares(landmarks, landmarks) + np.diag(np.full(len(landmarks), np.inf))
        prototypes = landmarks[np.argsort(-apart.min(1), kind="stable")[:300]]
        built = a_map(Relevance.STANDARDISED, squares(training, prototypes), 4)
        ranks = rank_landmarks(squares(test, prototypes))
        shares = []
        for at, row in enumerate(ranks):
            relevance = relevances(built, Query(row))
            best = relevance[max(0, at - 2) : at + 3].max()
            better, tied = (relevance > best).sum(), (relevance == best).sum()
            shares.append((better + (tied - 1) / 2) / len(relevance))
        anr.append(100 * np.mean(shares))
    assert np.mean(anr) == pytest.approx(3.76, abs=0.01)


def test_live_statistics_start_as_the_maps_and_follow_the_views():
    rng = np.random.default_rng(0)
    usual = LandmarkStatistics.of_map(rank_landmarks(rng.random((30, 6))))
    again = LandmarkStatistics.from_mean_std(usual.mean, usual.std)
    np.testing.assert_allclose(again.square, usual.square)
    followed = usual
    view = rank_landmarks([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    for _ in range(5000):
        followed = followed.observing(view)
    np.testing.assert_allclose(followed.standardise(view), 0, atol=0.15)


@pytest.mark.parametrize("relevance", sorted(set(Relevance) - {Relevance.COMPOSED}))
def test_a_batch_of_views_says_what_each_says_alone(relevance, scene):
    map_ = a_map(relevance, scene["map"], 4, encodings=scene["map encodings"])
    views = Query(rank_landmarks(scene["query"]), scene["query"], scene["query encodings"])
    alone = [map_.live_statistics] * 6
    together = map_.live_statistics
    for _ in range(3):
        together = together and replace(together, ranks=together.ranks.observing(views.ranks))
        batch = relevances(map_, views, together)
        for e in range(6):
            alone[e] = alone[e] and alone[e].observing(views.at(e))
            expected = relevances(map_, views.at(e), alone[e])
            np.testing.assert_allclose(batch[e], expected, atol=1e-5)
            if relevance is not Relevance.BRUTE_FORCE:  # of which one matrix product rounds as it likes
                assert np.array_equal(batch[e], expected)
                assert shortlist(batch, 3)[e].tolist() == shortlist(expected, 3).tolist()
