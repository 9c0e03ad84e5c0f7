"""One view localized, against the formulas written out slowly."""

from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest

from deepsimbad.core.belief.evidence import TRUSTS
from deepsimbad.core.relevance import Relevance
from deepsimbad.engine import localizer
from deepsimbad.engine.localizer import (
    Dissimilarities,
    PackedRanks,
    RankedLandmarks,
    ReadyEncoding,
    describe,
    is_short,
    localize,
)
from deepsimbad.engine.worker import EncodedImage
from deepsimbad.evaluators.feature_l2 import FeatureL2

from .conftest import DIM, LIST_LENGTH, N_IMAGES, N_LANDMARKS, map_contents

EVALUATOR = FeatureL2("none")


def test_standardised_belief_is_the_normalised_exponential() -> None:
    snapshot = map_contents()
    localization = localize(snapshot, EVALUATOR, RankedLandmarks(tuple(range(N_LANDMARKS))), N_IMAGES)
    assert snapshot.statistics is not None
    mean, std = snapshot.statistics
    z = [(NormalDist().inv_cdf((i + 0.5) / N_LANDMARKS) - mean[i]) / std[i] for i in range(N_LANDMARKS)]
    slow = np.array([-sum(z[snapshot.lists[j, m]] for j in range(LIST_LENGTH)) for m in range(N_IMAGES)])
    np.testing.assert_allclose(localization.relevance, slow, rtol=1e-5, atol=1e-6)
    parts = np.array([np.exp(trust * snapshot.log_likelihood_scale * (slow - slow.mean())) for trust in TRUSTS])
    # Images are evenly spaced: a uniform prior weighs them alike, and a first view leaves trusts as they were.
    mass = np.array([0.2, 0.4, 0.4]) @ (parts / parts.sum(axis=1, keepdims=True))
    np.testing.assert_allclose(localization.belief.top_mass, np.sort(mass)[::-1], rtol=1e-4)
    assert localization.belief.mean_m == pytest.approx(mass @ snapshot.position_m, rel=1e-4)
    assert localization.shortlist.tolist() == np.argsort(-localization.relevance, kind="stable").tolist()


def test_huge_dissimilarities_are_ranked_all_the_same() -> None:
    view = Dissimilarities(1.7e308 * np.linspace(1, -1, 9))
    query = describe(map_contents(relevance=Relevance.SIMBAD), EVALUATOR, view)
    assert query.ranks.tolist() == list(range(9, 0, -1))


def test_what_takes_long_is_known_before_it_is_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    snapshot, ranking = map_contents(), RankedLandmarks(tuple(range(N_LANDMARKS)))
    assert is_short(snapshot, ranking)
    assert is_short(snapshot, ReadyEncoding(np.ones(DIM)))
    assert not is_short(snapshot, RankedLandmarks(ranking.landmark_ids[1:]))
    assert not is_short(snapshot, PackedRanks(b""))
    for relevance in (Relevance.SIMBAD, Relevance.BRUTE_FORCE):
        assert not is_short(map_contents(relevance=relevance), ranking)
    assert is_short(snapshot, ranking, 100)
    assert not is_short(snapshot, ranking, 101)
    fused = replace(snapshot, evaluator={"kind": "fused"})
    assert is_short(fused, ranking)
    assert not is_short(fused, ReadyEncoding(np.ones(DIM)))
    assert not is_short(fused, EncodedImage(np.ones(DIM, np.float32), None, 0.0))
    for name, bound in (("_MOST_IMAGES", N_IMAGES - 1), ("_MOST_SUMMED", LIST_LENGTH * N_IMAGES - 1)):
        with monkeypatch.context() as patched:
            patched.setattr(localizer, name, bound)
            assert not is_short(snapshot, ranking)
    monkeypatch.setattr(localizer, "_MOST_PRODUCTS", DIM * N_LANDMARKS - 1)
    assert not is_short(snapshot, ReadyEncoding(np.ones(DIM)))
