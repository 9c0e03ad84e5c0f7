"""Which of many maps a view is of: all at once as one by one."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core import atlas as atlas_module
from deepsimbad.core.atlas import Atlas, _find, _shelf, log_evidence, posterior
from deepsimbad.core.building import MapPlan, compose_map
from deepsimbad.core.drive import Drive
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.errors import InvalidMapConfigError

PLAN = MapPlan(Relevance.COMPOSED, 4, (1.0,))


def composed_map(seed, n, d, n_landmarks, plan=PLAN, landmarks=None):
    encodings = np.random.default_rng(seed).normal(seed, 1 + 0.1 * seed, size=(n, d)).astype(np.float32)
    drive = Drive(position_m=np.arange(float(n)), encodings=encodings)
    return compose_map(plan, drive, None, landmarks, n_landmarks).map


def query_of(map_, encoding):
    return Query(np.arange(1, map_.n_landmarks + 1, dtype=np.float32), None, encoding)


@pytest.mark.parametrize("d", [24, 150])  # the longer ones are projected
def test_many_maps_at_once_say_what_each_says(d, monkeypatch):
    first = composed_map(0, 40, d, 20)
    maps = [first, composed_map(1, 70, d, 30), composed_map(0, 40, d, 20), composed_map(2, 5000, d, 25)]
    maps += [replace(first, lists=np.ascontiguousarray(first.lists[:, ::-1]))]  # of the same landmarks
    maps += [composed_map(1, 60, d, 25, MapPlan(Relevance.COMPOSED, 2, (1.0,)))]
    maps += [composed_map(seed, 30, d, 20) for seed in range(3, 40)]
    atlas = Atlas(maps)
    for seed in range(3):
        encoding = np.random.default_rng(seed).normal(size=d).astype(np.float32)
        expected = [log_evidence(map_, query_of(map_, encoding)) for map_ in maps]
        assert atlas.log_evidences(encoding) == pytest.approx(expected, abs=1e-4)
        names = [str(n) for n in range(len(maps))]
        p_domains, p_elsewhere = posterior(dict(zip(names, atlas.log_evidences(encoding).tolist(), strict=True)))
        slow_p_domains, slow_p_elsewhere = posterior(dict(zip(names, expected, strict=True)))
        assert p_domains == pytest.approx(slow_p_domains, abs=1e-6)
        assert p_elsewhere == pytest.approx(slow_p_elsewhere, abs=1e-6)
    encoding[: d // 3] = np.nan  # not told
    expected = [log_evidence(map_, query_of(map_, encoding)) for map_ in maps]
    assert atlas.log_evidences(encoding) == pytest.approx(expected, abs=1e-4)
    monkeypatch.setattr(atlas_module, "_AT_ONCE", 10)
    with ThreadPoolExecutor(2) as pool:
        assert atlas.log_evidences(encoding, pool).tolist() == atlas.log_evidences(encoding).tolist()


def test_the_evidence_of_one_map_slowly():
    map_ = composed_map(0, 50, 24, 20)
    encoding = np.random.default_rng(9).normal(size=24).astype(np.float32)
    mean, std = map_.usual_encoding.astype(np.float64)
    u = (encoding - mean) / std
    u /= np.linalg.norm(u)
    cosines = []
    for ids in map_.lists.T:
        place = sum(w * map_.landmark_model["prototypes"][i] for w, i in zip((1, 0.8, 0.65, 0.5), ids, strict=True))
        cosines.append(place @ u / np.linalg.norm(place))
    far_share = np.mean(np.abs(encoding - mean) > 2 * std)
    expected = 0.74 * map_.log_likelihood_scale * (max(cosines) - 0.43) - 34 * np.sqrt(24 / 1000) * (far_share - 0.16)
    assert log_evidence(map_, query_of(map_, encoding)) == pytest.approx(expected, abs=1e-4)


def test_probabilities_sum_to_1_and_parts_put_together_are_the_whole():
    logs = {"a": 900.0, "b": 899.0, "c": -900.0}
    probabilities, p_elsewhere = posterior(logs)
    assert sum(probabilities.values()) + p_elsewhere == pytest.approx(1)
    assert probabilities["a"] / probabilities["b"] == pytest.approx(np.e)
    assert posterior({}) == ({}, 1.0)
    assert posterior({"a": 0.0})[1] == pytest.approx(0.02)


def test_what_cannot_be_compared():
    map_ = composed_map(0, 30, 24, 20)
    assert log_evidence(map_, Query.uninformative(20)) == 0.0
    view = query_of(map_, np.zeros(24, np.float32))
    with pytest.raises(InvalidMapConfigError, match="rrf"):
        log_evidence(replace(map_, config={**map_.config, "relevance": "rrf"}), view)


def test_the_greatest_relevance_is_found_for_lists_of_any_lengths_beside_each_other():
    rng, r = np.random.default_rng(5), 20
    sizes = ((4, 30), (1, 2049), (6, 5), (3, 1), (9, 4100), (4, 2048))
    lists = [rng.integers(0, r, size).astype(np.uint16) for size in sizes]
    lengths = [rng.uniform(0.5, 2, n).astype(np.float32) for _, n in sizes]
    weights, products = rng.uniform(0.1, 1, 9).astype(np.float32), rng.normal(size=(2, r)).astype(np.float32)
    space_of, best_relevances = np.array([0, 1, 0, 1, 0, 1]), np.empty(len(sizes))
    _find(_shelf(lists), _shelf(lengths), weights, space_of, products, 0, len(sizes), best_relevances)
    for best, ids, length, space in zip(best_relevances, lists, lengths, space_of, strict=True):
        relevance = (weights[: len(ids), None] * products[space][ids]).sum(axis=0) / length
        assert best == pytest.approx(relevance.max(), rel=1e-5)
