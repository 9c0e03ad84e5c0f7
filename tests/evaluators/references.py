"""Networks written out in numpy from their papers, and files of weights in the layouts of the public ones.

Nothing here knows the code under test: convolutions are sums of shifted products, residuals are summed in a loop over
clusters, and each family's file is written key by key.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.io import savemat

Array: TypeAlias = NDArray[Any]
LAYERS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
N_LAYERS = 35  # of the MATLAB network, from conv1_1 to finalL2
POOL_BEHIND = (2, 4, 7, 10)  # convolutions, counted from 1, that a maximum of 2 x 2 follows
SMALL = (6, 6, 8, 8, 10, 10, 10, 12, 12, 12, 12, 12, 12)
FULL = (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
IMAGENET = ((0.485 * 255, 0.456 * 255, 0.406 * 255), (0.229 * 255, 0.224 * 255, 0.225 * 255))
MATCONVNET = ((123.68, 116.779, 103.939), (1.0, 1.0, 1.0))
# Family -> (index k * D + d, has a whitening, pixels), from the sources that publish the weights.
NETVLAD: dict[str, tuple[bool, bool, tuple[Any, Any]]] = {
    "matlab": (False, True, MATCONVNET),
    "pytorch_netvlad": (True, False, IMAGENET),
    "patch_netvlad": (True, True, IMAGENET),
    "openibl": (True, True, MATCONVNET),
}
# SqueezeNet's fire modules -> channels left by the squeeze, and of each expansion; torchvision's number of the layer.
FIRES = {2: (16, 64), 3: (16, 64), 4: (32, 128), 5: (32, 128), 6: (48, 192), 7: (48, 192), 8: (64, 256), 9: (64, 256)}
TORCHVISION_LAYERS = {2: 3, 3: 4, 4: 5, 5: 7, 6: 8, 7: 9, 8: 10, 9: 12}
SIDES = {"caffe": 227, "torchvision": 224}


def cosine(a: Array, b: Array) -> float:
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def scene(height: int, width: int, seed: int = 0) -> NDArray[np.uint8]:
    """[height, width, 3] uint8 of soft coloured blobs: places that differ, as in a photograph."""
    random = np.random.default_rng(seed)
    small = random.integers(0, 256, (1 + height // 12, 1 + width // 12, 3))
    image = np.kron(small, np.ones((12, 12, 1)))[:height, :width] + random.normal(0, 12, (height, width, 3))
    return np.clip(image, 0, 255).astype(np.uint8)


def unit(vectors: Array, axis: int = -1) -> Array:
    """Vectors made unit length along an axis."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=axis, keepdims=True))


def convolved(features: Array, kernel: Array, bias: Array, stride: int = 1, padding: int = 0) -> Array:
    """[in, h, w] by [out, in, k, k] to [out, h', w'], zeros outside."""
    padded = np.pad(features, ((0, 0), (padding, padding), (padding, padding)))
    side = kernel.shape[2]
    height, width = ((n - side) // stride + 1 for n in padded.shape[1:])
    total = np.zeros((len(kernel), height, width), features.dtype) + bias[:, None, None]
    for row in range(side):
        for column in range(side):
            rows, columns = slice(row, row + stride * height, stride), slice(column, column + stride * width, stride)
            total += np.tensordot(kernel[:, :, row, column], padded[:, rows, columns][:, :height, :width], axes=1)
    return total


def pooled(features: Array, side: int) -> Array:
    """The largest of each square, every two points; squares of 3 may hang over the edge, those of 2 may not."""
    if side == 3:
        over = [(0, 1 - n % 2) for n in features.shape[1:]]
        features = np.pad(features, ((0, 0), *over), constant_values=-np.inf)
    height, width = ((n - side) // 2 + 1 for n in features.shape[1:])
    places = [(row, column) for row in range(side) for column in range(side)]
    return np.maximum.reduce([features[:, r : r + 2 * height : 2, c : c + 2 * width : 2] for r, c in places])


def grid(features: Array, rows: int, columns: int) -> Array:
    """Means of the cells of a grid, each of unit length; cells share a row or column where sides do not divide."""
    n_channels, height, width = features.shape
    cells = np.empty((n_channels, rows, columns))
    for row in range(rows):
        for column in range(columns):
            inside = (
                slice(k * n // m, -(-(k + 1) * n // m)) for k, m, n in ((row, rows, height), (column, columns, width))
            )
            cells[:, row, column] = features[:, *inside].mean(axis=(1, 2))
    return unit(cells, axis=0).ravel()


@dataclass(frozen=True)
class Network:
    """Every number of a NetVLAD in the order of the paper: centres [K, D], whitening [outputs, inputs]."""

    kernels: tuple[Array, ...]  # [out, in, 3, 3]
    biases: tuple[Array, ...]
    assignment: Array  # [K, D]
    centres: Array  # [K, D]
    whitening: Array | None  # of a vector in the family's own order
    whitening_bias: Array | None
    cluster_major: bool
    mean: tuple[float, float, float]  # RGB of 0..255
    deviation: tuple[float, float, float]


def random_network(
    family: str, channels: tuple[int, ...] = SMALL, n_clusters: int = 5, n_outputs: int = 16, seed: int = 0
) -> Network:
    """A NetVLAD of random numbers whose local features vary from place to place and choose among the clusters."""
    random = np.random.default_rng(seed)
    cluster_major, is_whitened, pixels = NETVLAD[family]
    kernels, biases, n_inputs = [], [], 3
    for number, width in enumerate(channels):
        # This scale keeps the size of the features from layer to layer; pixels that nothing divided are about 60.
        scale = np.sqrt(2 / (9 * n_inputs)) / (60 if number == 0 and pixels is MATCONVNET else 1)
        kernels.append(random.standard_normal((width, n_inputs, 3, 3), np.float32) * np.float32(scale))
        biases.append(random.standard_normal(width, np.float32) * np.float32(0.1))
        n_inputs = width
    d = channels[-1]
    centres = random.standard_normal((n_clusters, d), np.float32)
    centres /= np.linalg.norm(centres, axis=1, keepdims=True) * 1.5
    whitening = whitening_bias = None
    if is_whitened:
        whitening = random.standard_normal((n_outputs, n_clusters * d), np.float32)
        whitening_bias = random.standard_normal(n_outputs, np.float32) * np.float32(0.2)
    tensors = (tuple(kernels), tuple(biases), np.float32(8) * centres, centres)
    return Network(*tensors, whitening, whitening_bias, cluster_major, *pixels)


def netvlad_encoding(network: Network, image: Array, dtype: Any = np.float64) -> Array:
    """The encoding of an image [h, w, 3] uint8 BGR, already of the network's size."""
    rgb = image[..., ::-1].astype(dtype)
    features = ((rgb - np.asarray(network.mean, dtype)) / np.asarray(network.deviation, dtype)).transpose(2, 0, 1)
    for number, (kernel, bias) in enumerate(zip(network.kernels, network.biases, strict=True), start=1):
        features = convolved(features, kernel.astype(dtype), bias.astype(dtype), padding=1)
        if number < len(network.kernels):
            features = np.maximum(features, 0)
        if number in POOL_BEHIND:
            features = pooled(features, 2)
    residuals = _aggregated(network, features.reshape(len(features), -1))
    vector = unit((residuals if network.cluster_major else residuals.T).ravel())
    if network.whitening is None:
        return vector
    return unit(network.whitening.astype(dtype, copy=False) @ vector + network.whitening_bias)


def _aggregated(network: Network, local: Array) -> Array:
    """V(j, k) of equation 1 with the soft assignment of equation 3, as [K, D], each cluster of unit length."""
    local = unit(local, axis=0)  # [D, places]
    scores = network.assignment.astype(local.dtype) @ local
    weights = np.exp(scores - scores.max(axis=0))
    weights /= weights.sum(axis=0)  # of each place, over the clusters
    residuals = np.zeros(network.centres.shape, local.dtype)
    for k, centre in enumerate(network.centres.astype(local.dtype)):
        for place in range(local.shape[1]):
            residuals[k] += weights[k, place] * (local[:, place] - centre)
    return unit(residuals, axis=1)


def write_matlab(path: Path, network: Network, compressed: bool = True) -> None:
    """Write a file laid out as hloc's `Pitts30K_struct.mat`."""
    savemat(path, {"net": matlab_net(network)}, do_compression=compressed)


def matlab_net(network: Network) -> dict[str, Any]:
    """The struct `net`, 35 structs in a cell, numbers in single precision."""
    layers = np.empty((1, N_LAYERS), object)
    for number in range(N_LAYERS):
        layers[0, number] = {"type": "relu", "name": f"relu{number}", "precious": False}
    for layer, kernel, bias in zip(LAYERS, network.kernels, network.biases, strict=True):
        weights = cell(kernel.transpose(2, 3, 1, 0), bias[:, None])
        layers[0, layer] = {"type": "conv", "name": f"conv{layer}", "pad": 1.0, "weights": weights}
    weights = cell(network.assignment.T[None, None], -network.centres.T[None, None])
    layers[0, 30] = {"type": "custom", "name": "vlad:core", "K": 64.0, "weights": weights}
    weights = cell(network.whitening.T[None, None], network.whitening_bias[:, None])
    layers[0, 33] = {"type": "conv", "name": "WPCA", "weights": weights}
    average = np.broadcast_to(np.array(network.mean, np.float32), (4, 4, 3))
    normalization = {"averageImage": average, "border": [0.0, 0.0], "interpolation": "bicubic"}
    return {"layers": layers, "meta": {"sessionID": "vd16_pitts30k", "normalization": normalization}}


def cell(*arrays: Array) -> Array:
    """A cell of one row."""
    row = np.empty((1, len(arrays)), object)
    for place, array in enumerate(arrays):
        row[0, place] = np.asarray(array, np.float32)
    return row


def torch_names(network: Network, trunk: str, pool: str, whitening: str) -> dict[str, torch.Tensor]:
    """A state dict; `{}` of `trunk` and `pool` takes the rest of the name."""
    arrays: dict[str, Array] = {}
    for layer, kernel, bias in zip(LAYERS, network.kernels, network.biases, strict=True):
        arrays[trunk.format(f"{layer}.weight")], arrays[trunk.format(f"{layer}.bias")] = kernel, bias
    arrays[pool.format("conv.weight")] = network.assignment[:, :, None, None]
    arrays[pool.format("centroids")] = network.centres
    if network.whitening is not None:
        arrays[f"{whitening}.weight"] = network.whitening[:, :, None, None]
        arrays[f"{whitening}.bias"] = network.whitening_bias
    return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}


def write_pytorch_netvlad(path: Path, network: Network, parallel: str = "") -> None:
    """Write a file laid out as its `checkpoint.pth.tar`: numpy's numbers among the scores, an optimizer's state."""
    names = torch_names(network, f"encoder.{parallel}{{}}", f"pool.{parallel}{{}}", "WPCA.0")
    content = {
        "epoch": 3, "state_dict": names, "recalls": {1: np.float64(0.5)}, "best_score": np.float64(0.5),
        "optimizer": {"state": {}, "param_groups": [{"lr": 0.1}]}, "parallel": False,
    }  # fmt: skip
    torch.save(content, path)


def write_patch_netvlad(path: Path, network: Network, **changes: Any) -> None:
    """Write a file laid out as `mapillary_WPCA4096.pth.tar`."""
    names = torch_names(network, "encoder.{}", "pool.{}", "WPCA.0")
    torch.save({"num_pcs": 16, "state_dict": names | changes}, path)


def write_openibl(path: Path, network: Network) -> None:
    """Write a file laid out as `vgg16_netvlad.pth`, a state dict alone."""
    torch.save(torch_names(network, "base_model.base.{}", "net_vlad.{}", "pca_layer"), path)


NETVLAD_WRITERS: dict[str, Callable[[Path, Network], None]] = {
    "matlab": write_matlab,
    "pytorch_netvlad": write_pytorch_netvlad,
    "patch_netvlad": write_patch_netvlad,
    "openibl": write_openibl,
}


def random_squeezenet() -> dict[str, Array]:
    """Random parameters by Caffe's names, kernels [out, in, rows, columns]."""
    random = np.random.default_rng(0)
    layers, n_inputs = [("conv1", 96, 3, 7)], 96
    for fire, (squeezed, expanded) in FIRES.items():
        layers.append((f"fire{fire}/conv1x1_1", squeezed, n_inputs, 1))
        layers += [(f"fire{fire}/conv{side}x{side}_2", expanded, squeezed, side) for side in (1, 3)]
        n_inputs = 2 * expanded
    parameters = {}
    for name, n_outputs, n, side in (*layers, ("conv_final", 10, 512, 1)):
        kernel = random.standard_normal((n_outputs, n, side, side)) * np.sqrt(2 / (n * side * side))
        parameters[f"{name}/w"] = kernel.astype(np.float32)
        parameters[f"{name}/b"] = random.normal(0, 0.1, n_outputs).astype(np.float32)
    return parameters


def write_caffe(path: Path, parameters: dict[str, Array]) -> None:
    """Write a file laid out as `squeezenet1_0_caffe.npz`."""
    with path.open("wb") as stream:
        np.savez(stream, allow_pickle=True, **parameters)


def torchvision_names(parameters: dict[str, Array]) -> dict[str, torch.Tensor]:
    origins = {"features.0": "conv1", "classifier.1": "conv_final"}
    for fire, layer in TORCHVISION_LAYERS.items():
        for part, caffes in (("squeeze", "conv1x1_1"), ("expand1x1", "conv1x1_2"), ("expand3x3", "conv3x3_2")):
            origins[f"features.{layer}.{part}"] = f"fire{fire}/{caffes}"
    return {
        f"{part}.{kind}": torch.from_numpy(parameters[f"{caffes}/{short}"])
        for part, caffes in origins.items()
        for kind, short in (("weight", "w"), ("bias", "b"))
    }


def write_torchvision(path: Path, parameters: dict[str, Array]) -> None:
    """Write a file laid out as `squeezenet1_0-b66bff10.pth`."""
    torch.save(torchvision_names(parameters), path)


SQUEEZENET_WRITERS: dict[str, Callable[[Path, dict[str, Array]], None]] = {
    "caffe": write_caffe,
    "torchvision": write_torchvision,
}


def squeezenet_maps(parameters: dict[str, Array], image: Array, family: str) -> dict[int, Array]:
    """Fire module -> its map, of an image [side, side, 3] uint8 BGR (the paper's table 1)."""
    if family == "caffe":
        pixels = image.astype(np.float64) - (104, 117, 123)
    else:
        pixels = (image[..., ::-1] - np.array(IMAGENET[0])) / np.array(IMAGENET[1])

    def rectified(features: Array, name: str, **shape: int) -> Array:
        return np.maximum(convolved(features, parameters[f"{name}/w"], parameters[f"{name}/b"], **shape), 0)

    features, maps = rectified(pixels.transpose(2, 0, 1).astype(np.float32), "conv1", stride=2), {}
    for fire in FIRES:
        if fire in {2, 5, 9}:
            features = pooled(features, 3)
        squeezed = rectified(features, f"fire{fire}/conv1x1_1")
        neighbourhood = rectified(squeezed, f"fire{fire}/conv3x3_2", padding=1)
        features = maps[fire] = np.concatenate([rectified(squeezed, f"fire{fire}/conv1x1_2"), neighbourhood])
    return maps
