"""NetVLAD written out in numpy from the paper's equations, and files of weights in the layouts of the public ones.

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
MATLAB_MEAN = (123.68, 116.779, 103.939)


@dataclass(frozen=True)
class Network:
    """Every number of a network in the order of the paper: centres [K, D], whitening [outputs, inputs]."""

    kernels: tuple[Array, ...]  # [out, in, 3, 3]
    biases: tuple[Array, ...]
    assignment: Array  # [K, D]
    centres: Array  # [K, D]
    whitening: Array | None  # of a vector in the family's own order
    whitening_bias: Array | None
    cluster_major: bool
    mean: tuple[float, float, float]  # RGB of 0..255
    deviation: tuple[float, float, float]


IMAGENET = {
    "mean": (0.485 * 255, 0.456 * 255, 0.406 * 255),
    "deviation": (0.229 * 255, 0.224 * 255, 0.225 * 255),
}
ONES = {"mean": MATLAB_MEAN, "deviation": (1.0, 1.0, 1.0)}
# Family -> (index k * D + d, has a whitening, pixels), from the sources that publish the weights.
FAMILIES: dict[str, tuple[bool, bool, dict[str, Any]]] = {
    "matlab": (False, True, ONES),
    "pytorch_netvlad": (True, False, IMAGENET),
    "patch_netvlad": (True, True, IMAGENET),
    "openibl": (True, True, ONES),
}


def random_network(
    family: str, channels: tuple[int, ...] = SMALL, n_clusters: int = 5, n_outputs: int = 16, seed: int = 0
) -> Network:
    """A network of random numbers whose local features vary from place to place and choose among the clusters."""
    random = np.random.default_rng(seed)
    cluster_major, is_whitened, pixels = FAMILIES[family]
    kernels, biases, n_inputs = [], [], 3
    for number, width in enumerate(channels):
        # This scale keeps the size of the features from layer to layer; pixels that nothing divided are about 60.
        scale = np.sqrt(2 / (9 * n_inputs)) / (60 if number == 0 and pixels is ONES else 1)
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
    return Network(
        tuple(kernels), tuple(biases), np.float32(8) * centres, centres,
        whitening, whitening_bias, cluster_major, **pixels,
    )  # fmt: skip


def unit(vectors: Array, axis: int = -1) -> Array:
    """Of unit length along an axis."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=axis, keepdims=True))


def convolved(features: Array, kernel: Array, bias: Array) -> Array:
    """[in, h, w] to [out, h, w]: 3 x 3, stride 1, zeros outside."""
    height, width = features.shape[1:]
    padded = np.pad(features, ((0, 0), (1, 1), (1, 1)))
    total = np.repeat(np.repeat(bias[:, None, None], height, 1), width, 2).astype(features.dtype)
    for row in range(3):
        for column in range(3):
            shifted = padded[:, row : row + height, column : column + width]
            total += np.tensordot(kernel[:, :, row, column], shifted, axes=1)
    return total


def pooled(features: Array) -> Array:
    """The largest of 2 x 2 points; an odd row or column at the end is left out."""
    height, width = (side // 2 * 2 for side in features.shape[1:])
    even = features[:, :height, :width]
    return np.asarray(np.maximum.reduce([even[:, r::2, c::2] for r in (0, 1) for c in (0, 1)]))


def local_features(network: Network, image: Array, dtype: Any = np.float64) -> Array:
    """[D, places] of an image [h, w, 3] uint8 BGR."""
    rgb = image[..., ::-1].astype(dtype)
    features = ((rgb - np.asarray(network.mean, dtype)) / np.asarray(network.deviation, dtype)).transpose(2, 0, 1)
    n = len(network.kernels)
    for number, (kernel, bias) in enumerate(zip(network.kernels, network.biases, strict=True), start=1):
        features = convolved(features, kernel.astype(dtype), bias.astype(dtype))
        if number < n:
            features = np.maximum(features, 0)
        if number in POOL_BEHIND:
            features = pooled(features)
    return np.asarray(features.reshape(len(features), -1))


def aggregated(network: Network, local: Array) -> Array:
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


def encoding(network: Network, image: Array, dtype: Any = np.float64) -> Array:
    """The encoding of an image [h, w, 3] uint8 BGR, already of the network's size."""
    residuals = aggregated(network, local_features(network, image, dtype))
    vector = unit((residuals if network.cluster_major else residuals.T).ravel())
    if network.whitening is None:
        return vector
    return unit(network.whitening.astype(dtype, copy=False) @ vector + network.whitening_bias)


def write_matlab(path: Path, network: Network, compressed: bool = True) -> None:
    """As hloc's `Pitts30K_struct.mat`."""
    savemat(path, {"net": matlab_net(network)}, do_compression=compressed)


def matlab_net(network: Network) -> dict[str, Any]:
    """The struct `net`, 35 structs in a cell, numbers in single precision."""
    assert network.whitening is not None
    assert network.whitening_bias is not None
    layers = np.empty((1, N_LAYERS), object)
    for number in range(N_LAYERS):
        layers[0, number] = {"type": "relu", "name": f"relu{number}", "precious": False}
    for layer, kernel, bias in zip(LAYERS, network.kernels, network.biases, strict=True):
        layers[0, layer] = {
            "type": "conv", "name": f"conv{layer}", "pad": 1.0,
            "weights": cell(kernel.transpose(2, 3, 1, 0), bias[:, None]),
        }  # fmt: skip
    d_by_k = network.assignment.T[None, None]
    layers[0, 30] = {
        "type": "custom", "name": "vlad:core", "K": 64.0, "weights": cell(d_by_k, -network.centres.T[None, None]),
    }  # fmt: skip
    layers[0, 33] = {
        "type": "conv", "name": "WPCA",
        "weights": cell(network.whitening.T[None, None], network.whitening_bias[:, None]),
    }  # fmt: skip
    average = np.broadcast_to(np.array(network.mean, np.float32), (4, 4, 3))
    normalization = {"averageImage": average, "border": [0.0, 0.0], "interpolation": "bicubic"}
    return {"layers": layers, "meta": {"sessionID": "vd16_pitts30k", "normalization": normalization}}


def cell(*arrays: Array) -> Array:
    """A cell of one row."""
    found = np.empty((1, len(arrays)), object)
    for place, array in enumerate(arrays):
        found[0, place] = np.asarray(array, np.float32)
    return found


def torch_names(network: Network, trunk: str, pool: str, whitening: str) -> dict[str, torch.Tensor]:
    """A state dict; `{}` of `trunk` and `pool` takes the rest of the name."""
    named: dict[str, Array] = {}
    for layer, kernel, bias in zip(LAYERS, network.kernels, network.biases, strict=True):
        named[trunk.format(f"{layer}.weight")], named[trunk.format(f"{layer}.bias")] = kernel, bias
    named[pool.format("conv.weight")] = network.assignment[:, :, None, None]
    named[pool.format("centroids")] = network.centres
    if network.whitening is not None and network.whitening_bias is not None:
        named[f"{whitening}.weight"] = network.whitening[:, :, None, None]
        named[f"{whitening}.bias"] = network.whitening_bias
    return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in named.items()}


def write_pytorch_netvlad(path: Path, network: Network, **changes: Any) -> None:
    """As its `checkpoint.pth.tar`: numpy's numbers among the scores, an optimizer's state."""
    names = torch_names(network, "encoder.{}", "pool.{}", "WPCA.0")
    content = {
        "epoch": 3, "state_dict": names | changes, "recalls": {1: np.float64(0.5)}, "best_score": np.float64(0.5),
        "optimizer": {"state": {}, "param_groups": [{"lr": 0.1}]}, "parallel": False,
    }  # fmt: skip
    torch.save(content, path)


def write_parallel(path: Path, network: Network) -> None:
    """pytorch-NetVlad trained on several devices."""
    torch.save({"state_dict": torch_names(network, "encoder.module.{}", "pool.module.{}", "WPCA.0")}, path)


def write_patch_netvlad(path: Path, network: Network, **changes: Any) -> None:
    """As `mapillary_WPCA4096.pth.tar`."""
    names = torch_names(network, "encoder.{}", "pool.{}", "WPCA.0")
    torch.save({"num_pcs": 16, "state_dict": names | changes}, path)


def write_openibl(path: Path, network: Network, **changes: Any) -> None:
    """As `vgg16_netvlad.pth`, a state dict alone."""
    torch.save(torch_names(network, "base_model.base.{}", "net_vlad.{}", "pca_layer") | changes, path)


WRITERS: dict[str, Callable[[Path, Network], None]] = {
    "matlab": write_matlab,
    "pytorch_netvlad": write_pytorch_netvlad,
    "patch_netvlad": write_patch_netvlad,
    "openibl": write_openibl,
}
