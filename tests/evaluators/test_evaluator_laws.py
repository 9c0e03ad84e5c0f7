"""Laws every registered evaluator keeps, whatever it is made of."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepsimbad.errors import InvalidEncodingError, InvalidImageError, UnsupportedMediaTypeError
from deepsimbad.evaluators.compute import Compute, Runtime
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator

from .references import random_network, random_squeezenet, write_caffe, write_matlab
from .test_onnx_file import model

EXTRACTORS = (
    *("efficientnet_lite0", "gradient_grid", "squeezenet:small.npz", "netvlad:small.mat", "onnx:small.onnx", "none"),
)


@pytest.fixture(scope="module")
def small_weights(tmp_path_factory):
    """A folder of weights that were drawn at random."""
    folder = tmp_path_factory.mktemp("weights")
    write_caffe(folder / "small.npz", random_squeezenet())
    write_matlab(folder / "small.mat", random_network("matlab"))
    (folder / "small.onnx").write_bytes(model().SerializeToString())
    return folder


@pytest.fixture(params=EXTRACTORS, scope="module")
def evaluator(request, small_weights):
    """One a module: loading a network takes longer than all the laws."""
    compute = Compute(Runtime.TORCH, weights_dir=small_weights)
    return make_evaluator(evaluator_config({"kind": "feature_l2", "extractor": request.param}), compute)


def _images(n, seed=0):
    rng = np.random.default_rng(seed)
    sizes = [(32, 64), (120, 160), (128, 128), (1, 1), (7, 300), (500, 1), (200, 90)]
    return [rng.integers(0, 256, (*sizes[k % len(sizes)], 3), dtype=np.uint8) for k in range(n)]


def _encodings(evaluator, n, seed=0):
    if evaluator.takes_images:
        return evaluator.encode(_images(n, seed))
    return np.random.default_rng(seed).normal(size=(n, 24)).astype(np.float32)


def test_encodings_have_the_stated_shape(evaluator):
    if not evaluator.takes_images:
        assert evaluator.encoding_dim is evaluator.input_size is evaluator.weights_sha256 is None
        with pytest.raises(UnsupportedMediaTypeError):
            evaluator.encode(_images(1))
        return
    encodings = evaluator.encode([*_images(7), np.full((240, 320, 3), 127, np.uint8)])
    assert encodings.shape == (8, evaluator.encoding_dim)
    assert encodings.dtype == np.float32
    assert np.isfinite(encodings).all()
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
    landmarks, scenes = _encodings(evaluator, 9, 1), _encodings(evaluator, 5, 2)
    model = evaluator.fit_landmarks(landmarks)
    answer = evaluator.dissimilarities(scenes, model)
    assert answer.shape == (5, 9)
    assert answer.dtype == np.float32
    assert (answer >= 0).all()
    assert all(isinstance(name, str) and isinstance(array, np.ndarray) for name, array in model.items())


def test_a_landmark_is_nearest_to_itself(evaluator):
    landmarks = _encodings(evaluator, 9, 1)
    answer = evaluator.dissimilarities(landmarks, evaluator.fit_landmarks(landmarks))
    np.testing.assert_array_equal(answer.argmin(axis=1), np.arange(9))
    assert np.diag(answer).max() < 1e-9


def test_a_scene_is_compared_the_same_alone_and_in_company(evaluator):
    model = evaluator.fit_landmarks(_encodings(evaluator, 20, 1))
    scenes = _encodings(evaluator, 2100, 2) if not evaluator.takes_images else _encodings(evaluator, 20, 2)
    together = evaluator.dissimilarities(scenes, model)
    for k in range(0, len(scenes), 7):
        alone = evaluator.dissimilarities(scenes[k : k + 1], model)[0]
        np.testing.assert_allclose(alone, together[k], rtol=2e-7)


def test_the_model_survives_a_copy_of_its_arrays_and_of_the_encodings(evaluator):
    landmarks, scenes = _encodings(evaluator, 6, 1), _encodings(evaluator, 4, 2)
    model = evaluator.fit_landmarks(landmarks)
    before = evaluator.dissimilarities(scenes, model)
    landmarks[:] = 0  # the caller's array is the caller's
    copied = {name: array.copy() for name, array in model.items()}
    np.testing.assert_array_equal(evaluator.dissimilarities(scenes, copied), before)


def test_bad_encodings_are_refused(evaluator):
    landmarks = _encodings(evaluator, 4, 1)
    model = evaluator.fit_landmarks(landmarks)
    short, holed, huge = landmarks[:, :-1], landmarks.copy(), np.full_like(landmarks, 3e38)
    holed[2, 1] = np.nan
    for bad in (short, holed, huge, landmarks[0]):
        with pytest.raises(InvalidEncodingError):
            evaluator.dissimilarities(bad, model)
    for bad in (holed, landmarks[:0], landmarks[0]):
        with pytest.raises(InvalidEncodingError):
            evaluator.fit_landmarks(bad)


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
