"""Laws every registered evaluator keeps, whatever it is made of."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepsimbad.core.composed import Moments, is_composed, unit_encodings
from deepsimbad.errors import (
    CancelledError,
    InvalidEncodingError,
    InvalidImageError,
    TooFewToFitError,
    UnsupportedMediaTypeError,
)
from deepsimbad.evaluators.base import Fitting, Lesson
from deepsimbad.evaluators.compute import Compute, Runtime
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.registry import EvaluatorKind, evaluator_config, make_evaluator
from deepsimbad.evaluators.space import dissimilarities_and_vectors

from .references import random_network, random_squeezenet, write_caffe, write_matlab
from .test_onnx_file import model

EXTRACTORS = (
    *("efficientnet_lite0", "gradient_grid", "squeezenet:small.npz", "netvlad:small.mat", "onnx:small.onnx", "none"),
)
KINDS = [("feature_l2", extractor) for extractor in EXTRACTORS]
TOLD = {"objects", "language", "fused"}  # tests of their own: what they encode is no image
FITTED = [kind for kind in EvaluatorKind if kind not in {"feature_l2", *TOLD}]
KINDS += [(kind.value, name) for kind in FITTED for name in ("gradient_grid", "none")]


@pytest.fixture(scope="module")
def small_weights(tmp_path_factory):
    """A folder of weights that were drawn at random."""
    folder = tmp_path_factory.mktemp("weights")
    write_caffe(folder / "small.npz", random_squeezenet())
    write_matlab(folder / "small.mat", random_network("matlab"))
    (folder / "small.onnx").write_bytes(model().SerializeToString())
    return folder


@pytest.fixture(params=KINDS, ids=":".join, scope="module")
def evaluator(request, small_weights):
    """One a module: loading a network takes longer than all the laws."""
    compute, (kind, extractor) = Compute(Runtime.TORCH, weights_dir=small_weights), request.param
    return make_evaluator(evaluator_config({"kind": kind, "extractor": extractor}), compute)


def ready(kind):
    """An evaluator of a kind that takes ready encodings."""
    return make_evaluator(evaluator_config({"kind": kind, "extractor": "none"}))


def _fitted(evaluator, landmarks):
    return evaluator.fit(Lesson(landmarks, np.arange(len(landmarks)))).model


def _images(n, seed=0):
    rng = np.random.default_rng(seed)
    sizes = [(32, 64), (120, 160), (128, 128), (1, 1), (7, 300), (500, 1), (200, 90)]
    return [rng.integers(0, 256, (*sizes[k % len(sizes)], 3), dtype=np.uint8) for k in range(n)]


@cache
def _encoded(evaluator, n, seed):
    if evaluator.takes_images:
        return evaluator.encode(_images(n, seed))
    return np.random.default_rng(seed).normal(size=(n, 24)).astype(np.float32)


def _encodings(evaluator, n, seed=0):
    return _encoded(evaluator, n, seed).copy()


def test_encodings_have_the_stated_shape(evaluator):
    if not evaluator.takes_images:
        assert evaluator.encoding_dim is evaluator.input_size is evaluator.weights_sha256 is None
        with pytest.raises(UnsupportedMediaTypeError):
            evaluator.encode(_images(1))
        return
    encodings = evaluator.encode([*_images(7), np.full((240, 320, 3), 127, np.uint8)])
    assert (encodings.shape, encodings.dtype) == ((8, evaluator.encoding_dim), np.float32)
    assert evaluator.encode([]).shape == (0, evaluator.encoding_dim)
    assert evaluator.input_size is None or min(evaluator.input_size) >= 1
    assert evaluator.largest_batch >= 1
    np.testing.assert_allclose(np.linalg.norm(encodings, axis=1), 1, atol=5e-4)
    if evaluator.weights_sha256 is not None:  # networks' are kept in half the bytes without loss
        np.testing.assert_array_equal(encodings, encodings.astype(np.float16))


def test_an_image_is_encoded_the_same_alone_again_and_in_company(evaluator):
    if not evaluator.takes_images:
        pytest.skip("takes no images")
    images = _images(5)
    for image in images:
        image.setflags(write=False)
    together = evaluator.encode(images)
    for row, image in zip(together, images, strict=True):
        np.testing.assert_array_equal(evaluator.encode([image.copy()])[0], row)
        np.testing.assert_array_equal(evaluator.encode([evaluator.prepare(image)])[0], row)


@pytest.mark.parametrize(
    "wrong",
    [np.zeros((8, 8), np.uint8), np.zeros((8, 8, 4), np.uint8), np.zeros((8, 8, 3)), np.zeros((0, 8, 3), np.uint8)],
)
def test_what_is_no_image_is_refused(evaluator, wrong):
    with pytest.raises((InvalidImageError, UnsupportedMediaTypeError)):
        evaluator.encode([wrong])


def test_dissimilarities_against_every_landmark(evaluator):
    landmarks, scenes = _encodings(evaluator, 12, 1), _encodings(evaluator, 5, 2)
    model = _fitted(evaluator, landmarks)
    evaluator.check_model(model, 12)
    for bad_model, n_landmarks in ((model, 11), ({"others": landmarks}, 12)):
        with pytest.raises(InvalidEncodingError):
            evaluator.check_model(bad_model, n_landmarks)
    answer = evaluator.dissimilarities(scenes, model)
    assert (answer.shape, answer.dtype) == ((5, 12), np.float32)
    assert ((answer >= 0) & np.isfinite(answer)).all()
    assert all(isinstance(name, str) and isinstance(array, np.ndarray) for name, array in model.items())


def test_a_landmark_is_nearest_to_itself(evaluator):
    landmarks = _encodings(evaluator, 9 if evaluator.is_squared_l2 else 12, 1)
    answer = evaluator.dissimilarities(landmarks, _fitted(evaluator, landmarks))
    if evaluator.is_squared_l2:
        np.testing.assert_array_equal(answer.argmin(axis=1), np.arange(9))
        assert np.diag(answer).max() < 1e-9
    else:  # what is fitted takes neighbouring frames for one place, which random ones are not
        assert (np.diag(answer) < np.median(answer, axis=1)).all()


def test_a_scene_is_compared_the_same_alone_and_in_company(evaluator):
    model = _fitted(evaluator, _encodings(evaluator, 20, 1))
    scenes = _encodings(evaluator, 2100, 2) if not evaluator.takes_images else _encodings(evaluator, 20, 2)
    together = evaluator.dissimilarities(scenes, model)
    for k in range(0, len(scenes), 7):
        alone = evaluator.dissimilarities(scenes[k : k + 1], model)[0]
        np.testing.assert_allclose(alone, together[k], rtol=2e-7 if evaluator.is_squared_l2 else 2e-3, atol=1e-6)


def test_the_model_survives_a_copy_of_its_arrays_and_of_the_encodings(evaluator):
    landmarks, scenes = _encodings(evaluator, 12, 1), _encodings(evaluator, 4, 2)
    model = _fitted(evaluator, landmarks)
    expected = evaluator.dissimilarities(scenes, model)
    landmarks[:] = 0  # the caller's array is the caller's
    copied = {name: array.copy() for name, array in model.items()}
    np.testing.assert_array_equal(evaluator.dissimilarities(scenes, copied), expected)


def test_bad_encodings_are_refused(evaluator):
    landmarks = _encodings(evaluator, 12, 1)
    model = _fitted(evaluator, landmarks)
    short, holed, huge = landmarks[:, :-1], landmarks.copy(), np.full_like(landmarks, 3e38)
    holed[2, 1] = np.nan
    for bad in (short, holed, huge, landmarks[0]):
        with pytest.raises(InvalidEncodingError):
            evaluator.dissimilarities(bad, model)
    for bad in (holed, landmarks[:0], landmarks[0]):
        with pytest.raises(InvalidEncodingError):
            _fitted(evaluator, bad)


def test_a_composed_model_compares_unit_vectors_of_what_stands_for_encodings(evaluator):
    landmarks, scenes = _encodings(evaluator, 12, 1), _encodings(evaluator, 5, 2)
    model = dict(_fitted(evaluator, landmarks))
    _, vectors = dissimilarities_and_vectors(evaluator, scenes, model)
    assert vectors is scenes, "a map that composes nothing compares encodings as they are"
    vectors = evaluator.comparison_vectors(scenes, model)
    assert vectors is scenes, "of squared L2, and of what was fitted and went back to it"
    moments = Moments.of(evaluator.comparison_vectors(landmarks, model))
    units = unit_encodings(evaluator.comparison_vectors(landmarks, model), moments, None)
    model |= {"usual": moments.mean_std(), "prototypes": units}
    assert is_composed(model)
    evaluator.check_model(model, 12)
    expected = np.square(unit_encodings(vectors, moments, None)[:, np.newaxis] - units).sum(axis=2)
    np.testing.assert_allclose(evaluator.dissimilarities(scenes, model), expected, atol=1e-4)
    for answer in dissimilarities_and_vectors(evaluator, scenes, model):
        assert answer.shape[0] == 5
    with pytest.raises(InvalidEncodingError):
        evaluator.check_model({**model, "prototypes": units[:-1]}, 12)


@pytest.mark.parametrize("kind", FITTED)
def test_what_was_fitted_stands_beside_encodings_or_alone_in_maps_of_before(kind):
    evaluator = ready(kind.value)
    places, season, _ = _route()
    landmarks, pairs = np.arange(0, 60, 2), np.column_stack([np.arange(60)] * 2)
    model = dict(evaluator.fit(Lesson(places, landmarks, None, season, pairs)).model)
    dissimilarities = evaluator.dissimilarities(season, model)
    half = {**model, f"{kind.value}_beside": np.array([0.5], np.float32)}
    np.testing.assert_array_equal(
        evaluator.comparison_vectors(season, half), np.hstack([season, np.float32(0.5) * dissimilarities])
    )
    del model[f"{kind.value}_beside"]
    evaluator.check_model(model, 30)
    np.testing.assert_array_equal(evaluator.comparison_vectors(season, model), dissimilarities)


@pytest.mark.parametrize("kind", FITTED)
def test_of_one_season_what_is_no_better_in_another_light_stays_at_plain_l2(kind):
    evaluator = ready(kind.value)
    rng = np.random.default_rng(0)
    places = rng.normal(size=(60, 24)).astype(np.float32)
    warped = places[:, np.newaxis] + 0.3 * rng.normal(size=(60, 4, 24))
    relit = places[:, np.newaxis] + 2.5 * rng.normal(size=(60, 4, 24))  # nothing to be learnt about it from what moved
    views = np.concatenate([warped, relit], axis=1).astype(np.float32)
    fitted = evaluator.fit(Lesson(places, np.arange(60), None, views=views, seed=1))
    (warning,) = fitted.warnings
    assert warning.startswith(f"{kind.value}_no_better: on ")
    assert "of one season" in warning
    assert fitted.metrics["is_l2"]
    units = unit_encodings(places, Moments.of(places), None)
    by_l2 = np.square(units[:, np.newaxis] - units).sum(axis=2)
    answer = evaluator.dissimilarities(places, fitted.model)
    assert (answer.argsort(axis=1)[:, 1] == by_l2.argsort(axis=1)[:, 1]).mean() > 0.95
    assert evaluator.comparison_vectors(places, fitted.model) is places


def _route(n=60, d=24, seed=0):
    """A drive, another season of it, and views of it: places drift along the route, seasons add noise and a shift."""
    rng = np.random.default_rng(seed)
    places = rng.normal(size=(n, d))
    season = places + 0.5 * rng.normal(size=(n, d)) + rng.normal(size=d)
    views = places[:, np.newaxis] + 0.4 * rng.normal(size=(n, 4, d))
    return (array.astype(np.float32) for array in (places, season, views))


@pytest.mark.parametrize("kind", FITTED)
def test_what_is_fitted_learns_from_a_second_season_and_is_the_same_again(kind):
    evaluator = ready(kind.value)
    assert evaluator.fitting is not Fitting.NOTHING
    places, season, views = _route()
    landmarks, pairs = np.arange(0, 60, 2), np.column_stack([np.arange(60)] * 2)
    lesson = Lesson(places, landmarks, np.arange(60.0), season, pairs, views[landmarks], seed=3)
    fitted, again = evaluator.fit(lesson), evaluator.fit(lesson)
    for name, array in fitted.model.items():
        np.testing.assert_array_equal(array, again.model[name])
    scored = fitted.metrics["held_out"][kind.value]
    plain = fitted.metrics["held_out"]["l2"]["anr"]
    assert scored["anr"] < 1.1 * plain, "of a place that it did not see, seen in another season"
    assert scored["n_queries"] > 0
    assert fitted.metrics["n_dissimilarities"] > 1000
    nearest = evaluator.dissimilarities(season[landmarks], fitted.model).argmin(axis=1)
    assert (nearest == np.arange(30)).mean() > 0.9
    with pytest.raises(InvalidEncodingError):
        ready("feature_l2").check_model(fitted.model, 30)


@pytest.mark.parametrize("kind", [EvaluatorKind.SIAMESE, EvaluatorKind.AUTOENCODER])
def test_training_is_cancelled_between_batches_and_asks_for_frames_enough(kind):
    evaluator = ready(kind.value)
    places, *_ = _route()
    shares = []

    def cancel(share):
        shares.append(share)
        if share > 0.3:
            raise CancelledError("cancelled")

    with pytest.raises(CancelledError):
        evaluator.fit(Lesson(places, np.arange(60), on_progress=cancel))
    assert len(shares) > 5
    assert shares == sorted(shares)
    with pytest.raises(TooFewToFitError, match="feature_l2"):
        evaluator.fit(Lesson(places[:9], np.arange(9)))


def test_a_fitted_model_that_is_no_better_than_plain_l2_says_so():
    evaluator = ready("siamese")
    noise = np.random.default_rng(0).normal(size=(2, 60, 24)).astype(np.float32)
    pairs = np.column_stack([np.arange(60)] * 2)
    fitted = evaluator.fit(Lesson(noise[0], np.arange(60), None, noise[1], pairs, seed=1))
    scores = fitted.metrics["held_out"]
    assert bool(fitted.warnings) == (scores["siamese"]["anr"] >= scores["l2"]["anr"])
    places = np.repeat(np.eye(24, dtype=np.float32), 3, axis=0)  # nothing to win: plain L2 is perfect
    warnings = evaluator.fit(Lesson(places, np.arange(72), None, places, np.column_stack([np.arange(72)] * 2))).warnings
    assert [warning.partition(":")[0] for warning in warnings] == ["siamese_no_better"]


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 30), r=st.integers(1, 12), d=st.integers(1, 40))
def test_squared_l2_against_a_slow_obvious_reference(seed, n, r, d):
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
