"""The two public families of SqueezeNet v1.0 weights, told apart by what a file holds.

Caffe's, as its authors trained it, in an npz (`conv1/w`, `fire2/conv1x1_1/w`, ...), and torchvision's checkpoint
(`features.0.weight`, `features.3.squeeze.weight`, ...). Each was trained on pixels of its own order and scale.
"""

import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from deepsimbad.errors import InvalidWeightsError
from deepsimbad.evaluators.nets.squeezenet import FIRST_FIRE, LAST_FIRE, SqueezeNet
from deepsimbad.evaluators.weights.files import check_size, fill, load_checkpoint

_FIRES = range(FIRST_FIRE, LAST_FIRE + 1)
_PARTS = ("squeeze", "expand_1x1", "expand_3x3")
_CAFFE_PARTS = dict(zip(_PARTS, ("conv1x1_1", "conv1x1_2", "conv3x3_2"), strict=True))
_TORCHVISION_PARTS = dict(zip(_PARTS, ("squeeze", "expand1x1", "expand3x3"), strict=True))
_TORCHVISION_LAYERS = dict(zip(_FIRES, (3, 4, 5, 7, 8, 9, 10, 12), strict=True))


@dataclass(frozen=True)
class Preset:
    """What goes with the weights of a family."""

    family: str  # its name
    is_rgb: bool  # whether the network takes red first
    mean: tuple[float, float, float]  # in that order, of pixels 0..255, taken away from them
    std: tuple[float, float, float]  # what they are then divided by
    side: int  # width and height in pixels


CAFFE = Preset("caffe", is_rgb=False, mean=(104.0, 117.0, 123.0), std=(1.0, 1.0, 1.0), side=227)
TORCHVISION = Preset(
    "torchvision", is_rgb=True, mean=(0.485 * 255, 0.456 * 255, 0.406 * 255),
    std=(0.229 * 255, 0.224 * 255, 0.225 * 255), side=224,
)  # fmt: skip


@dataclass(frozen=True)
class SqueezeNetWeights:
    """A file's weights under the names of `SqueezeNet`, and the preset they came with."""

    preset: Preset
    tensors: Mapping[str, Any]
    file: str

    def trunk(self, taken: tuple[int, ...]) -> SqueezeNet:
        """The network of these weights up to the last fire module taken; raises InvalidWeightsError."""
        trunk = SqueezeNet(taken)
        fill(trunk, self.tensors, self.file)
        return trunk


def read_squeezenet(path: Path) -> SqueezeNetWeights:
    """Read a file of either family; raises InvalidWeightsError."""
    return _of_caffe(path) if _is_npz(path) else _of_torchvision(path)


def preset_of(path: Path) -> Preset:
    """The preset of a file, told from a glance at it; whether it is whole shows when it is read."""
    return CAFFE if _is_npz(path) else TORCHVISION


def _is_npz(path: Path) -> bool:
    """Whether it is an archive of arrays; PyTorch's checkpoints are archives too."""
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except (zipfile.BadZipFile, OSError, ValueError):
        return False


def _of_caffe(path: Path) -> SqueezeNetWeights:
    check_size(path)
    tensors: dict[str, Any] = {}
    try:
        with np.load(path, allow_pickle=False) as arrays:
            for ours, theirs in _caffe_names().items():
                if theirs in arrays.files and arrays[theirs].dtype.kind == "f":
                    tensors[ours] = torch.from_numpy(np.array(arrays[theirs], np.float32))
    except (ValueError, OSError, EOFError, KeyError, MemoryError, NotImplementedError, RuntimeError, zlib.error,
            zipfile.BadZipFile) as error:  # fmt: skip
        raise InvalidWeightsError(f"{path.name} is no whole archive of arrays", file=path.name) from error
    return SqueezeNetWeights(CAFFE, tensors, path.name)


def _of_torchvision(path: Path) -> SqueezeNetWeights:
    content = load_checkpoint(path)
    if not isinstance(content, Mapping):
        raise InvalidWeightsError(f"{path.name} holds no weights by name", file=path.name)
    tensors = {ours: content.get(theirs) for ours, theirs in _torchvision_names().items()}
    return SqueezeNetWeights(TORCHVISION, tensors, path.name)


def _caffe_names() -> dict[str, str]:
    """Ours to Caffe's."""
    kinds = {"weight": "w", "bias": "b"}
    names = {f"stem.{ours}": f"conv1/{theirs}" for ours, theirs in kinds.items()}
    for fire in _FIRES:
        for part, theirs in _CAFFE_PARTS.items():
            names |= {f"fires.{fire}.{part}.{kind}": f"fire{fire}/{theirs}/{short}" for kind, short in kinds.items()}
    return names


def _torchvision_names() -> dict[str, str]:
    """Ours to torchvision's, which counts maxima as layers too."""
    names = {f"stem.{kind}": f"features.0.{kind}" for kind in ("weight", "bias")}
    for fire, layer in _TORCHVISION_LAYERS.items():
        for part, theirs in _TORCHVISION_PARTS.items():
            names |= {f"fires.{fire}.{part}.{kind}": f"features.{layer}.{theirs}.{kind}" for kind in ("weight", "bias")}
    return names
