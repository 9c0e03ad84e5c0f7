"""NetVLAD, the encodings of the paper's own system (II-A), from a file of public weights of any known family.

A whitening applied to a vector in the wrong order, or pixels normalised as another family's, give noise and no error;
so the family is recognised from what a file holds, and its order, normalisation and size come with it. Names, orders
and constants are those of the sources that wrote the files (hloc and netvlad_tf_open, pytorch-NetVlad, Patch-NetVLAD,
OpenIBL).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from deepsimbad.errors import InvalidWeightsError
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.extractors.base import IMAGENET_MEAN, IMAGENET_STD, NetworkExtractor, in_pixels
from deepsimbad.evaluators.nets.netvlad import N_CONVOLUTIONS, NetVlad
from deepsimbad.evaluators.runtimes import make_run
from deepsimbad.evaluators.weights.files import MATLAB_MAGIC, encodings_sha256, fill, load_checkpoint, read_variable
from deepsimbad.evaluators.weights.lock import Lock

_RECIPE = 1  # see `encodings_sha256`; the presets of the families are part of it
_USUAL_SIZE = (640, 480)
_SHORTEST_SIDE = 16  # pixels: of fewer, nothing is left behind four maxima
_LAYERS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)  # of the convolutions, ReLUs and maxima counted too
_IMAGENET = in_pixels(IMAGENET_MEAN), in_pixels(IMAGENET_STD)


def netvlad(file: str, compute: Compute) -> NetworkExtractor:
    """Make the extractor for the registry, never run by ONNX Runtime; raises as `Evaluator.load`."""
    path, sha256 = Lock.read(compute.weights_dir).pinned_file(file)
    weights = read_netvlad(path)
    preset = weights.preset
    run = make_run(weights.module, compute, preset.input_size or _USUAL_SIZE)
    digest = encodings_sha256(sha256, _RECIPE)
    return NetworkExtractor(run, weights.encoding_dim, digest, preset.input_size, _SHORTEST_SIDE)


@dataclass(frozen=True)
class Preset:
    """How images are prepared for the weights of a family, and in which order their vectors lie."""

    family: str  # its name
    cluster_major: bool  # see `NetVlad`
    mean: tuple[float, float, float] | None  # RGB, subtracted from pixels 0..255; None: the file holds it
    deviation: tuple[float, float, float]  # RGB, divisor of the rest
    input_size: tuple[int, int] | None  # (width, height) in pixels; None: the aspect is kept


@dataclass(frozen=True)
class _Names:
    """How a family's checkpoint calls things; `trunk` takes the number of a layer. None: it has no whitening."""

    trunk: str
    assignment: str
    centres: str
    whitening: str | None


MATLAB = Preset("matlab", cluster_major=False, mean=None, deviation=(1.0, 1.0, 1.0), input_size=None)
PATCH_NETVLAD = Preset("patch_netvlad", True, *_IMAGENET, (640, 480))
# Trained and tested on Pittsburgh's images of 640 x 480 as they are.
PYTORCH_NETVLAD = Preset("pytorch_netvlad", True, *_IMAGENET, (640, 480))
# Its weights begin from the MATLAB network's, and so do its pixels: MatConvNet's mean, and no division.
OPENIBL = Preset("openibl", True, (123.68, 116.779, 103.939), (1.0, 1.0, 1.0), (640, 480))

_POOL = ("encoder.{}", "pool.conv.weight", "pool.centroids")
# In the order in which they are tried: the first whose centres and whitening, if it has one, are there.
_CHECKPOINTS: tuple[tuple[Preset, _Names], ...] = (
    (PATCH_NETVLAD, _Names(*_POOL, "WPCA.0")),
    (PYTORCH_NETVLAD, _Names(*_POOL, None)),
    (OPENIBL, _Names("base_model.base.{}", "net_vlad.conv.weight", "net_vlad.centroids", "pca_layer")),
)


@dataclass(frozen=True)
class NetVladWeights:
    """A file's weights under the names of `NetVlad`, float32, and the preset they came with."""

    preset: Preset
    tensors: Mapping[str, Tensor]
    file: str
    origins: Mapping[str, str]  # what the file calls them; empty where it has no names for them

    @property
    def encoding_dim(self) -> int:
        whitening = self.tensors.get("whitening.bias")
        return self.tensors["centres"].numel() if whitening is None else len(whitening)

    def module(self) -> NetVlad:
        """The network of these weights, of the widths they have; raises InvalidWeightsError."""
        channels = [len(self.tensors[f"trunk.convolutions.{i}.weight"]) for i in range(N_CONVOLUTIONS)]
        n_whitened = self.encoding_dim if "whitening.bias" in self.tensors else None
        with torch.device("meta"):  # the file's tensors become the parameters: nothing is made to be overwritten
            module = NetVlad(channels, len(self.tensors["centres"]), n_whitened, self.preset.cluster_major)
        fill(module, self.tensors, self.file, self.origins)
        return module


def read_netvlad(path: Path) -> NetVladWeights:
    """Read a file of any family; raises InvalidWeightsError."""
    with path.open("rb") as stream:
        is_matlab = stream.read(len(MATLAB_MAGIC)) == MATLAB_MAGIC
    return _of_matlab(path) if is_matlab else _of_checkpoint(path)


def _of_checkpoint(path: Path) -> NetVladWeights:
    content = load_checkpoint(path)
    entries = content.get("state_dict", content) if isinstance(content, Mapping) else None
    if not isinstance(entries, Mapping):
        raise InvalidWeightsError(f"{path.name} holds no weights by name", file=path.name)
    # Networks trained on several devices have `.module.` in their names.
    tensors = {".".join(part for part in str(name).split(".") if part != "module"): t for name, t in entries.items()}
    for preset, names in _CHECKPOINTS:
        if names.centres in tensors and (names.whitening is None or f"{names.whitening}.weight" in tensors):
            return _renamed(preset, names, tensors, path.name)
    families = ", ".join([MATLAB.family, *(preset.family for preset, _ in _CHECKPOINTS)])
    raise InvalidWeightsError(f"{path.name} is of none of the known families of NetVLAD: {families}", file=path.name)


def _renamed(preset: Preset, names: _Names, tensors: Mapping[str, Any], file: str) -> NetVladWeights:
    """The tensors under the names of `NetVlad`; others than the family's are refused, as another network's."""
    origins = {
        f"trunk.convolutions.{number}.{kind}": f"{names.trunk.format(layer)}.{kind}"
        for number, layer in enumerate(_LAYERS)
        for kind in ("weight", "bias")
    } | {"assignment": names.assignment, "centres": names.centres}
    if names.whitening is not None:
        origins |= {f"whitening.{kind}": f"{names.whitening}.{kind}" for kind in ("weight", "bias")}
    unknown = sorted(set(tensors) - set(origins.values()))
    if unknown:
        raise InvalidWeightsError(
            f"{file} looks like the family {preset.family} and also has {unknown[0]}: it is of another network",
            file=file, unknown=unknown[:10],
        )  # fmt: skip
    checked = {our_name: _checked(tensors.get(origin), origin, file) for our_name, origin in origins.items()}
    for name in ("assignment", "whitening.weight"):  # convolutions of 1 x 1 there, products of matrices here
        if name in checked and checked[name].ndim == 4:
            checked[name] = checked[name].flatten(1)
    if checked["assignment"].shape != checked["centres"].shape:
        first, second = (f"{name} of shape {list(tensors[name].shape)}" for name in (names.assignment, names.centres))
        raise InvalidWeightsError(f"{file} has {first} and {second}, which do not fit together", file=file)
    return NetVladWeights(preset, checked | _colours(preset.mean, preset), file, origins)


def _checked(tensor: Any, name: str, file: str) -> Tensor:
    """A tensor whose numbers all lie in the file: shapes may not claim more than was read."""
    if not isinstance(tensor, Tensor) or tensor.layout is not torch.strided or not tensor.is_floating_point():
        raise InvalidWeightsError(f"{file} has no {name} of floating-point numbers", file=file, missing=name)
    if (
        tensor.ndim == 0
        or tensor.numel() == 0
        or tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes()
    ):
        raise InvalidWeightsError(
            f"{file} has {name} of shape {list(tensor.shape)}, which cannot be", file=file, name=name
        )
    return tensor.float().contiguous()


def _colours(mean: Sequence[float] | None, preset: Preset) -> dict[str, Tensor]:
    return {"mean": torch.tensor(mean), "deviation": torch.tensor(preset.deviation)}


def _of_matlab(path: Path) -> NetVladWeights:
    """The struct that hloc publishes: `net.layers{i}.weights`, columns first, centres with the opposite sign."""
    file = path.name
    net = read_variable(path, "net")
    tensors: dict[str, Tensor] = {}
    n_inputs = 3
    for number, layer in enumerate(_LAYERS):
        kernel, bias = _weights(net, layer, file)
        n_outputs = bias.size
        kernel = _shaped(kernel, (3, 3, n_inputs, n_outputs), layer, file)
        tensors[f"trunk.convolutions.{number}.weight"] = _tensor(kernel.transpose(3, 2, 0, 1))
        tensors[f"trunk.convolutions.{number}.bias"] = _tensor(bias.ravel(order="F"))
        n_inputs = n_outputs
    assignment, offsets = _weights(net, 30, file)
    n_clusters = assignment.size // n_inputs
    tensors["assignment"] = _tensor(_shaped(assignment, (n_inputs, n_clusters), 30, file).T)
    tensors["centres"] = -_tensor(_shaped(offsets, (n_inputs, n_clusters), 30, file).T)
    whitening, bias = _weights(net, 33, file)
    tensors["whitening.weight"] = _tensor(_shaped(whitening, (n_inputs * n_clusters, bias.size), 33, file).T)
    tensors["whitening.bias"] = _tensor(bias.ravel(order="F"))
    return NetVladWeights(MATLAB, tensors | _colours(_average_colour(net, file), MATLAB), file, {})


def _weights(net: Any, layer: int, file: str) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """The two arrays of a layer."""
    try:
        first, second = net["layers"][layer]["weights"]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InvalidWeightsError(
            f"{file} has no net.layers{{{layer + 1}}} with two weights: it is of another network", file=file
        ) from error
    for array in (first, second):
        if not isinstance(array, np.ndarray) or array.dtype.kind != "f" or array.size == 0:
            raise InvalidWeightsError(f"the weights of net.layers{{{layer + 1}}} of {file} are no numbers", file=file)
    return first, second


def _shaped(array: np.ndarray[Any, Any], shape: tuple[int, ...], layer: int, file: str) -> np.ndarray[Any, Any]:
    """MATLAB leaves out axes of length 1 at the end, and the layers add some before: all others must agree."""
    if [side for side in array.shape if side != 1] != [side for side in shape if side != 1]:
        raise InvalidWeightsError(
            f"{file} has weights of shape {list(array.shape)} in net.layers{{{layer + 1}}}, not {list(shape)}",
            file=file,
        )
    return array.reshape(shape, order="F")


def _tensor(array: np.ndarray[Any, Any]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))


def _average_colour(net: Any, file: str) -> list[float]:
    """RGB of `net.meta.normalization.averageImage`: three numbers, or an image of them, all its points alike."""
    try:
        average = np.asarray(net["meta"]["normalization"]["averageImage"], np.float64)
        colour = average.reshape(-1, 3, order="F")[0] if average.ndim == 3 else average.ravel()
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidWeightsError(f"{file} has no net.meta.normalization.averageImage", file=file) from error
    if colour.shape != (3,) or not np.isfinite(colour).all():
        raise InvalidWeightsError(f"the averageImage of {file} is no colour", file=file)
    return [float(value) for value in colour]
