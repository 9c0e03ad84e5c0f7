"""SqueezeNet from a file of its public weights: a map from its middle, averaged in a grid, as by the default extractor.

The map is that behind the last fire module, at stride 16. On Nordland, the corridor and the rendered campus the modules
5, 7 and 8 found fewer places across seasons, and 7 and 9 together hardly more for nearly twice the numbers.

Two families of weights are public, told apart by what a file holds: Caffe's, as its authors trained it, in an npz
(`conv1/w`, `fire2/conv1x1_1/w`, ...), and torchvision's checkpoint (`features.0.weight`, `features.3.squeeze.weight`,
...). Each was trained on pixels of its own order and scale.
"""

import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deepsimbad.errors import InvalidWeightsError, MissingPackageError
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.extractors.base import IMAGENET_MEAN, IMAGENET_STD, NetworkExtractor, in_pixels
from deepsimbad.evaluators.runtimes import INSTALL_TORCH, has_torch, make_run
from deepsimbad.evaluators.weights.files import check_size, encodings_sha256, fill, load_checkpoint
from deepsimbad.evaluators.weights.lock import Lock

if TYPE_CHECKING:
    from torch import nn

CELLS = (6, 5)  # rows and columns, as of the default extractor
OUTPUT_FIRES = {9: 512}  # fire module -> its channels
ENCODING_DIM = CELLS[0] * CELLS[1] * sum(OUTPUT_FIRES.values())
_RECIPE = 1  # see `encodings_sha256`
# Fire module (the paper counts the first convolution as layer 1) -> torchvision's layer, which counts maxima too
_LAYERS = dict(zip(range(2, 10), (3, 4, 5, 7, 8, 9, 10, 12), strict=True))
# What a fire module's parts are called here, by Caffe and by torchvision
_PARTS = (
    ("squeeze", "conv1x1_1", "squeeze"), ("expand_1x1", "conv1x1_2", "expand1x1"),
    ("expand_3x3", "conv3x3_2", "expand3x3"),
)  # fmt: skip


def squeezenet(file: str, compute: Compute) -> NetworkExtractor:
    """Make the extractor for the registry from a file in the weights' folder; raises as `Evaluator.load`."""
    if not has_torch():
        raise MissingPackageError(f"squeezenet needs PyTorch: {INSTALL_TORCH}")
    path, sha256 = Lock.read(compute.weights_dir).pinned_file(file)
    # Only the kind of the file is looked at here; whether it is whole shows when it is read
    size = ((CAFFE if _is_npz(path) else TORCHVISION).side,) * 2
    run = make_run(lambda: _module(path), compute, size, f"squeezenet-{_RECIPE}-{sha256[:16]}")
    return NetworkExtractor(run, ENCODING_DIM, encodings_sha256(sha256, _RECIPE), size)


def _module(path: Path) -> "nn.Module":
    from deepsimbad.evaluators.nets.spatial_grid import SpatialGrid

    weights = read_squeezenet(path)
    preset = weights.preset
    return SpatialGrid(weights.trunk(tuple(OUTPUT_FIRES)), CELLS, preset.mean, preset.std, is_rgb=preset.is_rgb)


@dataclass(frozen=True)
class Preset:
    """How images are prepared for the weights of a family."""

    family: str  # its name
    is_rgb: bool  # whether the network takes red first
    mean: tuple[float, float, float]  # in that order, subtracted from pixels 0..255
    std: tuple[float, float, float]  # in that order, divisor of the rest
    side: int  # width and height in pixels


CAFFE = Preset("caffe", is_rgb=False, mean=(104.0, 117.0, 123.0), std=(1.0, 1.0, 1.0), side=227)
TORCHVISION = Preset("torchvision", is_rgb=True, mean=in_pixels(IMAGENET_MEAN), std=in_pixels(IMAGENET_STD), side=224)


@dataclass(frozen=True)
class SqueezeNetWeights:
    """A file's weights under the names of `SqueezeNet`, and the preset they came with."""

    preset: Preset
    tensors: Mapping[str, Any]
    file: str

    def trunk(self, output_fires: tuple[int, ...]) -> "nn.Module":
        """The network of these weights, with the maps of some fire modules; raises InvalidWeightsError."""
        from deepsimbad.evaluators.nets.squeezenet import SqueezeNet

        trunk = SqueezeNet(output_fires)
        fill(trunk, self.tensors, self.file)
        return trunk


def read_squeezenet(path: Path) -> SqueezeNetWeights:
    """Read a file of either family; raises InvalidWeightsError."""
    if _is_npz(path):
        return SqueezeNetWeights(CAFFE, _of_caffe(path), path.name)
    content = load_checkpoint(path)
    if not isinstance(content, Mapping):
        raise InvalidWeightsError(f"{path.name} holds no weights by name", file=path.name)
    tensors = {name: content.get(origin) for name, origin in _names(is_caffe=False).items()}
    return SqueezeNetWeights(TORCHVISION, tensors, path.name)


def _is_npz(path: Path) -> bool:
    """Whether it is an archive of arrays; PyTorch's checkpoints are archives too."""
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except (zipfile.BadZipFile, OSError, ValueError):
        return False


def _of_caffe(path: Path) -> dict[str, Any]:
    import torch

    check_size(path)
    tensors: dict[str, Any] = {}
    try:
        with np.load(path, allow_pickle=False) as arrays:
            for name, origin in _names(is_caffe=True).items():
                if origin in arrays.files and arrays[origin].dtype.kind == "f":
                    tensors[name] = torch.from_numpy(np.array(arrays[origin], np.float32))
    except (ValueError, OSError, EOFError, KeyError, MemoryError, NotImplementedError, RuntimeError, zlib.error,
            zipfile.BadZipFile) as error:  # fmt: skip
        raise InvalidWeightsError(f"{path.name} is no whole archive of arrays", file=path.name) from error
    return tensors


def _names(is_caffe: bool) -> dict[str, str]:
    """The family's names, by those of `SqueezeNet`."""
    names: dict[str, str] = {}
    for kind, short in (("weight", "w"), ("bias", "b")):
        names[f"stem.{kind}"] = f"conv1/{short}" if is_caffe else f"features.0.{kind}"
        for fire, layer in _LAYERS.items():
            for part, caffe, torchvision in _PARTS:
                origin = f"fire{fire}/{caffe}/{short}" if is_caffe else f"features.{layer}.{torchvision}.{kind}"
                names[f"fires.{fire}.{part}.{kind}"] = origin
    return names
