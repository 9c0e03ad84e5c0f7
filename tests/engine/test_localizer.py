"""One view localized, against the formulas written out slowly."""

from statistics import NormalDist

import numpy as np
import pytest

from deepsimbad.core.map import Map
from deepsimbad.core.relevance import LOG_LIKELIHOOD_WEIGHT, Relevance
from deepsimbad.engine.localizer import localize, retrieve
from deepsimbad.engine.views import Dissimilarities, RankedLandmarks, ReadyEncoding
from deepsimbad.errors import (
    InvalidDissimilaritiesError,
    InvalidEncodingError,
    InvalidInputError,
    InvalidRankedLandmarksError,
)
from deepsimbad.evaluators.feature_l2 import FeatureL2

from .conftest import DIM, LIST_LENGTH, N_IMAGES, N_LANDMARKS, map_contents

EVALUATOR = FeatureL2("none")


def snapshot_for(relevance: Relevance, closed: bool = False) -> Map:
    return map_contents(relevance=relevance, closed=closed)


def test_rrf_is_the_papers_inner_product() -> None:
    snapshot = snapshot_for(Relevance.RRF)
    ranked = np.random.default_rng(3).permutation(N_LANDMARKS)
    retrieval = retrieve(snapshot, EVALUATOR, RankedLandmarks(tuple(ranked.tolist())))
    rank = {int(landmark): place + 1 for place, landmark in enumerate(ranked)}
    lists = snapshot.lists
    slow = [sum(1 / (j + 1) * 1 / rank[int(lists[j, image])] for j in range(LIST_LENGTH)) for image in range(N_IMAGES)]
    np.testing.assert_allclose(retrieval.relevance, slow, rtol=1e-6)


def test_standardised_belief_is_the_normalised_exponential() -> None:
    snapshot = map_contents()
    ranked = list(range(N_LANDMARKS))
    found = localize(snapshot, EVALUATOR, RankedLandmarks(tuple(ranked)), N_IMAGES)
    assert snapshot.statistics is not None
    mean, std = snapshot.statistics
    z = [(NormalDist().inv_cdf((rank + 0.5) / N_LANDMARKS) - mean[i]) / std[i] for rank, i in enumerate(ranked)]
    slow = np.array([-sum(z[snapshot.lists[j, m]] for j in range(LIST_LENGTH)) for m in range(N_IMAGES)])
    np.testing.assert_allclose(found.retrieval.relevance, slow, rtol=1e-5, atol=1e-6)
    mass = np.exp(LOG_LIKELIHOOD_WEIGHT * (slow - slow.max()))
    mass /= mass.sum()  # images are evenly spaced: a uniform prior weighs them alike
    np.testing.assert_allclose(found.belief.top_mass, np.sort(mass)[::-1], rtol=1e-4)
    assert found.belief.mean_m == pytest.approx(mass @ snapshot.position_m, rel=1e-4)
    assert found.shortlist.tolist() == np.argsort(-found.retrieval.relevance, kind="stable").tolist()
    assert set(found.timings_ms) == {"describe", "retrieve", "shortlist", "belief", "plan"}


@pytest.mark.parametrize("relevance", list(Relevance))
@pytest.mark.parametrize("closed", [False, True])
def test_every_relevance_finds_its_own_image(relevance: Relevance, closed: bool) -> None:
    snapshot = map_contents(relevance=relevance, closed=closed)
    encodings = np.random.default_rng(1).normal(size=(N_IMAGES, DIM)).astype(np.float32)
    hits = 0
    for image in range(N_IMAGES):
        found = localize(snapshot, EVALUATOR, ReadyEncoding(encodings[image].astype(np.float64)), 5)
        hits += image in found.shortlist
        assert found.belief.histogram_mass.sum() == pytest.approx(1)
    assert hits >= 0.8 * N_IMAGES


def test_huge_dissimilarities_are_ranked_all_the_same() -> None:
    snapshot = snapshot_for(Relevance.SIMBAD)
    values = np.linspace(1e300, 1, N_LANDMARKS)
    retrieval = retrieve(snapshot, EVALUATOR, Dissimilarities(values))
    assert retrieval.ranks.tolist() == list(range(N_LANDMARKS, 0, -1))


@pytest.mark.parametrize(
    ("view", "error"),
    [
        (RankedLandmarks(()), InvalidRankedLandmarksError),
        (RankedLandmarks((0, 0)), InvalidRankedLandmarksError),
        (RankedLandmarks((N_LANDMARKS,)), InvalidRankedLandmarksError),
        (Dissimilarities(np.ones(N_LANDMARKS - 1)), InvalidDissimilaritiesError),
        (Dissimilarities(np.full(N_LANDMARKS, np.nan)), InvalidDissimilaritiesError),
        (ReadyEncoding(np.ones(DIM + 1)), InvalidEncodingError),
        (ReadyEncoding(np.full(DIM, np.inf)), InvalidEncodingError),
        (ReadyEncoding(np.ones(0)), InvalidEncodingError),
    ],
)
def test_views_that_do_not_fit(view: RankedLandmarks | Dissimilarities | ReadyEncoding, error: type[Exception]) -> None:
    with pytest.raises(error):
        localize(snapshot_for(Relevance.STANDARDISED), EVALUATOR, view)


@pytest.mark.parametrize("length", [0, -1, N_IMAGES + 1])
def test_a_shortlist_that_does_not_fit(length: int) -> None:
    with pytest.raises(InvalidInputError) as caught:
        localize(snapshot_for(Relevance.RRF), EVALUATOR, RankedLandmarks((0,)), length)
    assert caught.value.hints == {"minimum": 1, "maximum": N_IMAGES}
