"""SqueezeNet of both families against the paper's table in numpy; bad files end in a named error, and run nothing."""

import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from deepsimbad.errors import InvalidWeightsError, MissingWeightsError
from deepsimbad.evaluators.compute import Compute, Device, Runtime
from deepsimbad.evaluators.extractors.network import NetworkExtractor
from deepsimbad.evaluators.extractors.squeezenet import CELLS, ENCODING_DIM, TAKEN, squeezenet
from deepsimbad.evaluators.nets.squeezenet import SqueezeNet
from deepsimbad.evaluators.runtimes import has_onnxruntime
from deepsimbad.evaluators.weights.squeezenet_families import read_squeezenet

Array = NDArray[Any]
FIRES = {2: (16, 64), 3: (16, 64), 4: (32, 128), 5: (32, 128), 6: (48, 192), 7: (48, 192), 8: (64, 256), 9: (64, 256)}
TORCHVISION_LAYERS = {2: 3, 3: 4, 4: 5, 5: 7, 6: 8, 7: 9, 8: 10, 9: 12}
ALL = tuple(FIRES)
SIDES = {"caffe": 227, "torchvision": 224}


def random_parameters() -> dict[str, Array]:
    """By Caffe's names, kernels [out, in, rows, columns]."""
    random = np.random.default_rng(0)

    def layer(name: str, n_outputs: int, n_inputs: int, side: int) -> dict[str, Array]:
        spread = np.sqrt(2 / (n_inputs * side * side))
        kernel = random.standard_normal((n_outputs, n_inputs, side, side)) * spread
        return {
            f"{name}/w": kernel.astype(np.float32),
            f"{name}/b": random.normal(0, 0.1, n_outputs).astype(np.float32),
        }

    parameters, n_inputs = layer("conv1", 96, 3, 7), 96
    for fire, (squeezed, expanded) in FIRES.items():
        parameters |= layer(f"fire{fire}/conv1x1_1", squeezed, n_inputs, 1)
        parameters |= layer(f"fire{fire}/conv1x1_2", expanded, squeezed, 1)
        parameters |= layer(f"fire{fire}/conv3x3_2", expanded, squeezed, 3)
        n_inputs = 2 * expanded
    return parameters | layer("conv_final", 10, 512, 1)


def write_caffe(path: Path, parameters: dict[str, Array]) -> None:
    with path.open("wb") as stream:
        np.savez(stream, allow_pickle=True, **parameters)


def torchvision_names(parameters: dict[str, Array]) -> dict[str, torch.Tensor]:
    named = {"features.0": "conv1", "classifier.1": "conv_final"}
    for fire, layer in TORCHVISION_LAYERS.items():
        for theirs, caffes in (("squeeze", "conv1x1_1"), ("expand1x1", "conv1x1_2"), ("expand3x3", "conv3x3_2")):
            named[f"features.{layer}.{theirs}"] = f"fire{fire}/{caffes}"
    return {
        f"{theirs}.{kind}": torch.from_numpy(parameters[f"{caffes}/{short}"])
        for theirs, caffes in named.items()
        for kind, short in (("weight", "w"), ("bias", "b"))
    }


def write_torchvision(path: Path, parameters: dict[str, Array]) -> None:
    torch.save(torchvision_names(parameters), path)


WRITERS: dict[str, Callable[[Path, dict[str, Array]], None]] = {"caffe": write_caffe, "torchvision": write_torchvision}


def convolved(features: Array, parameters: dict[str, Array], name: str, stride: int = 1, padding: int = 0) -> Array:
    """With its ReLU."""
    kernel, bias = parameters[f"{name}/w"].astype(np.float64), parameters[f"{name}/b"].astype(np.float64)
    padded = np.pad(features, ((0, 0), (padding, padding), (padding, padding)))
    side = kernel.shape[2]
    height, width = ((n - side) // stride + 1 for n in padded.shape[1:])
    total = np.zeros((len(kernel), height, width)) + bias[:, None, None]
    for row in range(side):
        for column in range(side):
            rows, columns = slice(row, row + stride * height, stride), slice(column, column + stride * width, stride)
            total += np.tensordot(kernel[:, :, row, column], padded[:, rows, columns][:, :height, :width], axes=1)
    return np.maximum(total, 0)


def pooled(features: Array) -> Array:
    """The largest of 3 x 3 at stride 2; the last window may hang over the edge."""
    height, width = (-(-(n - 3) // 2) + 1 for n in features.shape[1:])
    return np.array([
        [features[:, 2 * row : 2 * row + 3, 2 * column : 2 * column + 3].max(axis=(1, 2)) for column in range(width)]
        for row in range(height)
    ]).transpose(2, 0, 1)  # fmt: skip


def maps(parameters: dict[str, Array], image: Array, family: str) -> dict[int, Array]:
    """Fire module -> its map, of an image [side, side, 3] uint8 BGR."""
    pixels = image.astype(np.float64)
    if family == "caffe":
        pixels = pixels - (104, 117, 123)
    else:
        pixels = (pixels[..., ::-1] / 255 - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
    features = convolved(pixels.transpose(2, 0, 1), parameters, "conv1", stride=2)
    found = {}
    for fire in FIRES:
        if fire in {2, 5, 9}:
            features = pooled(features)
        squeezed = convolved(features, parameters, f"fire{fire}/conv1x1_1")
        points = convolved(squeezed, parameters, f"fire{fire}/conv1x1_2")
        around = convolved(squeezed, parameters, f"fire{fire}/conv3x3_2", padding=1)
        features = found[fire] = np.concatenate([points, around])
    return found


def encoding(parameters: dict[str, Array], image: Array, family: str) -> Array:
    """Means of the cells of the grid, each of unit length; cells share a row or column where sides do not divide."""
    parts = []
    of_fire = maps(parameters, image, family)
    for fire in TAKEN:
        n_channels, height, width = of_fire[fire].shape
        cells = np.empty((n_channels, *CELLS))
        for row in range(CELLS[0]):
            rows = slice(row * height // CELLS[0], -(-(row + 1) * height // CELLS[0]))
            for column in range(CELLS[1]):
                columns = slice(column * width // CELLS[1], -(-(column + 1) * width // CELLS[1]))
                cells[:, row, column] = of_fire[fire][:, rows, columns].mean(axis=(1, 2))
        parts.append((cells / np.linalg.norm(cells, axis=0)).ravel())
    joined = np.concatenate(parts)
    return np.asarray(joined / np.linalg.norm(joined))


def scene(side: int) -> NDArray[np.uint8]:
    random = np.random.default_rng(1)
    blobs = np.kron(random.integers(0, 256, (20, 20, 3)), np.ones((12, 12, 1)))[:side, :side]
    return np.clip(blobs + random.normal(0, 10, blobs.shape), 0, 255).astype(np.uint8)


def cosine(a: Array, b: Array) -> float:
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def extractor(path: Path, runtime: Runtime = Runtime.TORCH) -> NetworkExtractor:
    return squeezenet(path.name, Compute(runtime, Device.CPU, weights_dir=path.parent))


@pytest.fixture(scope="module")
def parameters() -> dict[str, Array]:
    return random_parameters()


@pytest.mark.parametrize(("runtime", "least"), [(Runtime.TORCH, 0.9999), (Runtime.TORCH_BF16, 0.999)])
@pytest.mark.parametrize("family", sorted(WRITERS))
def test_agrees_with_the_papers_table(
    tmp_path: Path, parameters: dict[str, Array], family: str, runtime: Runtime, least: float
) -> None:
    path = tmp_path / "weights"
    WRITERS[family](path, parameters)
    made = extractor(path, runtime)
    assert made.input_size == (SIDES[family],) * 2
    image = scene(SIDES[family])
    found = made.encode([image])[0]
    assert found.shape == (ENCODING_DIM,)
    assert cosine(found, encoding(parameters, image, family)) > least


@pytest.mark.slow
@pytest.mark.skipif(not has_onnxruntime(), reason="ONNX Runtime is not installed")
def test_onnxruntime_agrees(tmp_path: Path, parameters: dict[str, Array]) -> None:
    path = tmp_path / "weights"
    write_caffe(path, parameters)
    image = scene(227)
    found = extractor(path, Runtime.ONNXRUNTIME).encode([image, image[::-1]])
    assert [each.suffix for each in (tmp_path / "exported").iterdir()] == [".onnx"]
    assert cosine(found[0], encoding(parameters, image, "caffe")) > 0.9999
    assert cosine(found[1], extractor(path).encode([image[::-1]])[0]) > 0.9999


@pytest.mark.parametrize("family", sorted(WRITERS))
def test_every_fire_module_agrees(tmp_path: Path, parameters: dict[str, Array], family: str) -> None:
    path = tmp_path / "weights"
    WRITERS[family](path, parameters)
    weights = read_squeezenet(path)
    assert weights.preset.family == family
    image = scene(SIDES[family])
    pixels = image if family == "caffe" else image[..., ::-1]
    normalised = (pixels - np.array(weights.preset.mean)) / np.array(weights.preset.std)
    with torch.inference_mode():
        given = torch.from_numpy(normalised.astype(np.float32).transpose(2, 0, 1)[None])
        found = weights.trunk(ALL)(given)
    for mine, (fire, expected) in zip(found, maps(parameters, image, family).items(), strict=True):
        assert mine[0].shape == expected.shape, fire
        np.testing.assert_allclose(mine[0].numpy(), expected, rtol=1e-3, atol=1e-4 * expected.max())


def test_another_familys_pixels_are_found(tmp_path: Path, parameters: dict[str, Array]) -> None:
    """The comparison would tell: the same numbers on the other family's pixels give another encoding."""
    image = scene(227)
    right, wrong = (encoding(parameters, image, family) for family in ("caffe", "torchvision"))
    assert cosine(right, wrong) < 0.999


def test_only_what_is_taken_is_computed() -> None:
    assert len(SqueezeNet((4,)).fires) == 3


@pytest.mark.real_data
def test_the_published_weights(real_data: Path) -> None:
    """Caffe's file as its authors trained it, against the reference."""
    path = real_data.parent / "weights" / "squeezenet1_0" / "squeezenet1_0_caffe.npz"
    if not path.is_file():
        pytest.skip(f"no weights at {path}")
    with np.load(path, allow_pickle=False) as arrays:
        published = {name: arrays[name] for name in arrays.files}
    image = scene(227)
    expected = encoding(published, image, "caffe")
    assert cosine(extractor(path).encode([image])[0], expected) > 0.9999
    assert cosine(extractor(path, Runtime.TORCH_BF16).encode([image])[0], expected) > 0.999


def refused(path: Path, message: str | None = None) -> None:
    with pytest.raises(InvalidWeightsError, match=message) as caught:
        extractor(path)
    assert path.name in caught.value.message


def test_a_missing_file_says_where_to_put_it(tmp_path: Path) -> None:
    with pytest.raises(MissingWeightsError, match="put it at"):
        extractor(tmp_path / "absent.npz")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.99])
@pytest.mark.parametrize("family", sorted(WRITERS))
def test_a_truncated_file(tmp_path: Path, parameters: dict[str, Array], family: str, share: float) -> None:
    path = tmp_path / "weights"
    WRITERS[family](path, parameters)
    body = path.read_bytes()
    path.write_bytes(body[: int(len(body) * share)])
    refused(path)


@pytest.mark.parametrize(
    "body", [b"PK\x03\x04" + bytes(50), bytes(range(256)) * 20, np.random.default_rng(0).bytes(5000)]
)
def test_no_file_of_weights_at_all(tmp_path: Path, body: bytes) -> None:
    path = tmp_path / "weights"
    path.write_bytes(body)
    refused(path)


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("fire7/conv3x3_2/w", np.zeros((192, 48, 1, 1), np.float32)),
        ("fire7/conv3x3_2/b", np.full(192, np.nan, np.float32)),
        ("fire7/conv3x3_2/b", np.zeros(192, np.int64)),
        ("conv1/w", np.zeros((64, 3, 3, 3), np.float32)),  # of version 1.1
        ("conv1/b", np.array([None])),
    ],
)
def test_wrong_arrays(tmp_path: Path, parameters: dict[str, Array], name: str, array: Array) -> None:
    path = tmp_path / "weights.npz"
    write_caffe(path, parameters | {name: array})
    refused(path)


def test_another_network(tmp_path: Path, parameters: dict[str, Array]) -> None:
    path = tmp_path / "weights"
    write_caffe(path, {name: array for name, array in parameters.items() if "fire5" not in name})
    refused(path, r"fires\.5")
    names = torchvision_names(parameters)
    del names["features.5.squeeze.weight"]
    torch.save(names, path)
    refused(path, r"fires\.4\.squeeze\.weight")
    for content in ([1.0], {}, {"features.0.weight": 3}):
        torch.save(content, path)
        refused(path)


def test_an_archive_that_unpacks_without_end(tmp_path: Path) -> None:
    path = tmp_path / "weights.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("conv1/w.npy", "w") as member:
        for _ in range(200):
            member.write(bytes(1 << 20))
    refused(path, "unpacks to")


def test_an_array_that_claims_more_than_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "weights.npz"
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1099511627776, 96), }".ljust(117) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("conv1/w.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    refused(path)


class _Sentinel:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.path,)


def test_code_in_a_file_is_not_run(tmp_path: Path, parameters: dict[str, Array]) -> None:
    sentinel, path = tmp_path / "it ran", tmp_path / "weights"
    write_caffe(path, parameters | {"conv1/w": np.array([_Sentinel(sentinel)], object)})
    refused(path)
    torch.save({"features.0.weight": _Sentinel(sentinel)}, path)
    refused(path, "more than tensors")
    path.write_bytes(pickle.dumps({"features.0.weight": _Sentinel(sentinel)}))
    refused(path)
    assert not sentinel.exists()
    pickle.loads(path.read_bytes())
    assert sentinel.exists()  # and it would have
