"""Squared L2 against a slow obvious reference."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from deepsimbad.evaluators.feature_l2 import FeatureL2


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 30), r=st.integers(1, 12), d=st.integers(1, 40))
def test_squared_l2(seed, n, r, d):
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-3, 3)
    scenes = (rng.normal(3, 1, (n, d)) * scale).astype(np.float32)  # far from the origin: where cancelling bites
    landmarks = (rng.normal(3, 1, (r, d)) * scale).astype(np.float32)
    evaluator = FeatureL2("none")
    answer = evaluator.dissimilarities(scenes, evaluator.fit_landmarks(landmarks))
    for i in range(n):
        for j in range(r):
            expected = sum((float(a) - float(b)) ** 2 for a, b in zip(scenes[i], landmarks[j], strict=True))
            np.testing.assert_allclose(answer[i, j], expected, rtol=1e-5, atol=1e-12 * scale**2)


def test_more_rows_than_one_block():
    rng = np.random.default_rng(0)
    scenes, landmarks = rng.normal(size=(2500, 6)).astype(np.float32), rng.normal(size=(3, 6)).astype(np.float32)
    evaluator = FeatureL2("none")
    expected = np.square(scenes[:, None].astype(np.float64) - landmarks).sum(axis=2)
    answer = evaluator.dissimilarities(scenes, evaluator.fit_landmarks(landmarks))
    np.testing.assert_allclose(answer, expected, rtol=1e-6)
