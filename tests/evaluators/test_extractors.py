"""Laws of the extractors that come with the service, and what they are good for."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepsimbad.evaluators.compute import Compute, Runtime
from deepsimbad.evaluators.extractors.efficientnet_lite0 import weights_file
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.image import decode_image
from deepsimbad.evaluators.registry import make_extractor
from deepsimbad.evaluators.weights.files import file_sha256

from .references import random_network, random_squeezenet, write_caffe, write_pytorch_netvlad
from .test_onnx_file import model


@pytest.fixture(params=["gradient_grid", "efficientnet_lite0"], scope="module")
def extractor(request):
    network = make_extractor(request.param, Compute())
    return lambda image: network.encode([image])[0]


def _scene(seed=0, width=320, height=240):
    """Smooth blobs: something with edges at every scale."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (9, 12, 3), dtype=np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def test_a_uniform_image_has_the_one_neutral_encoding():
    uniform = [np.full((8, width, 3), level, np.uint8) for level in (0, 1, 127, 255) for width in (1, 16, 320)]
    encodings = make_extractor("gradient_grid", Compute()).encode(uniform)
    np.testing.assert_array_equal(encodings, np.broadcast_to(encodings[0], encodings.shape))
    np.testing.assert_allclose(np.linalg.norm(encodings[0]), 1, rtol=1e-5)


def test_noise_of_a_dark_frame_is_not_a_scene(extractor):
    rng = np.random.default_rng(0)
    dark = [rng.integers(0, 3, (128, 128, 3), dtype=np.uint8) for _ in range(2)]
    distance = np.linalg.norm(extractor(dark[0]) - extractor(dark[1]))
    assert distance < np.linalg.norm(extractor(_scene(1)) - extractor(_scene(2)))


def test_exposure_size_and_a_small_shift_sideways_matter_less_than_the_place(extractor):
    scene, other = _scene(), _scene(5)
    shift = np.float32([[1, 0, 12], [0, 1, 0]])  # 4 % of the width
    shifted = cv2.warpAffine(scene, shift, (320, 240), borderMode=cv2.BORDER_REPLICATE)
    half = cv2.resize(scene, (160, 120), interpolation=cv2.INTER_AREA)
    distance = np.linalg.norm(extractor(scene) - extractor(other))
    for changed, share in (((scene * 0.5 + 20).astype(np.uint8), 0.45), (shifted, 0.6), (half, 0.3)):
        assert np.linalg.norm(extractor(scene) - extractor(changed)) < share * distance


@pytest.mark.parametrize(
    ("extractor", "file"),
    [("efficientnet_lite0", None), ("squeezenet:small.npz", "small.npz"), ("onnx:small.onnx", "small.onnx"),
     ("netvlad:small.pth", "small.pth")],
)  # fmt: skip
def test_another_recipe_is_told_apart_as_other_weights_are(tmp_path, monkeypatch, extractor, file):
    """The first recipe adds nothing: what was encoded before recipes were counted stays comparable."""
    write_caffe(tmp_path / "small.npz", random_squeezenet())
    (tmp_path / "small.onnx").write_bytes(model().SerializeToString())
    write_pytorch_netvlad(tmp_path / "small.pth", random_network("pytorch_netvlad"))
    kind = {"onnx": "onnx_file"}.get(extractor.partition(":")[0], extractor.partition(":")[0])
    compute, recipe = Compute(Runtime.TORCH, weights_dir=tmp_path), f"deepsimbad.evaluators.extractors.{kind}._RECIPE"
    monkeypatch.setattr(recipe, 1)
    first = make_extractor(extractor, compute).weights_sha256
    assert first == file_sha256(tmp_path / file if file else weights_file())
    monkeypatch.setattr(recipe, 2)
    second = make_extractor(extractor, compute).weights_sha256
    assert re.fullmatch("[0-9a-f]{64}", second)
    assert second != first


@pytest.mark.real_data
@pytest.mark.parametrize("extractor", ["gradient_grid", "efficientnet_lite0"])
def test_a_season_later_the_place_is_found(real_data, extractor):
    """Every tenth of 400 frames of the railway, one season against the other, by brute force."""
    evaluator = FeatureL2(extractor)

    def encoded(season: str, frames: range) -> np.ndarray:
        folder = Path(real_data) / "nordland" / season
        return evaluator.encode([decode_image((folder / f"{i:05d}.png").read_bytes(), 10**6) for i in frames])

    summer, winter = encoded("summer", range(1000, 1400)), encoded("winter", range(1000, 1400, 10))
    places = evaluator.dissimilarities(winter, evaluator.fit_landmarks(summer)).argmin(axis=1)
    assert np.mean(np.abs(places - np.arange(0, 400, 10)) <= 2) >= 0.7
