"""Reading files of weights: what does not fit is a named error, and nothing that a file holds is ever run."""

import hashlib
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deepsimbad.errors import InvalidWeightsError, MissingWeightsError

if TYPE_CHECKING:
    from torch import nn

_MOST_BYTES = 4 << 30  # unpacked; the largest of the known files holds half a gigabyte
_MOST_RATIO = 20  # weights hardly compress: more is a file made to fill the memory


def weights_path(folder: Path, name: str) -> Path:
    """The file of a name in the weights' folder; raises MissingWeightsError."""
    path = folder / name
    if not path.is_file():
        raise MissingWeightsError(
            f"there is no file of weights {name}: put it at {path}, or see `deepsimbad weights list`", file=name
        )
    return path


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, in hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def encodings_sha256(weights_sha256: str, recipe: int) -> str:
    """What encodings are told apart by: their weights, and what is done with them.

    `recipe` counts up with whatever else changes an encoding (layers, grid, size, normalisation). The first adds
    nothing, so what was encoded before recipes were counted stays comparable.
    """
    return weights_sha256 if recipe == 1 else hashlib.sha256(f"{weights_sha256} {recipe}".encode()).hexdigest()


def load_checkpoint(path: Path) -> Any:
    """What `torch.save` wrote: tensors, numbers, texts, lists and dicts; a file that names any code runs nothing.

    Raises:
        InvalidWeightsError: Truncated, no such file, too large unpacked, or with code in it.
    """
    import torch

    check_size(path)
    try:
        with torch.serialization.safe_globals(_numpy_scalars()):
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise InvalidWeightsError(
            f"{path.name} holds more than tensors, numbers and texts, and was not loaded", file=path.name
        ) from error
    except Exception as error:  # a damaged file leads the reader anywhere
        raise InvalidWeightsError(
            f"{path.name} is no whole file of weights that PyTorch can read", file=path.name
        ) from error


def fill(module: "nn.Module", tensors: Mapping[str, Any], file: str) -> None:
    """Fill a module's parameters and buffers by name.

    Args:
        module: Whose.
        tensors: By the module's names; further ones are passed over.
        file: Where they come from, for the error.

    Raises:
        InvalidWeightsError: One is missing, of another shape or not finite.
    """
    import torch

    if not isinstance(tensors, Mapping):
        raise InvalidWeightsError(f"{file} holds no weights by name", file=file)
    wanted = module.state_dict()
    for name, parameter in wanted.items():
        given = tensors.get(name)
        if (
            not isinstance(given, torch.Tensor)
            or given.layout is not torch.strided
            or given.is_floating_point() != parameter.is_floating_point()
        ):
            raise InvalidWeightsError(f"{file} has no {name}: it is of another network", file=file, missing=name)
        if given.shape != parameter.shape:
            raise InvalidWeightsError(
                f"{file} has {name} of shape {list(given.shape)}, not {list(parameter.shape)}", file=file, name=name
            )
        if not torch.isfinite(given).all():
            raise InvalidWeightsError(f"{file} has NaN or infinity in {name}", file=file, name=name)
    # Assigned, not copied: a whitening is half a gigabyte, and the module may have been made without any memory.
    module.load_state_dict({name: tensors[name].to(parameter.dtype) for name, parameter in wanted.items()}, assign=True)


def _numpy_scalars() -> list[Any]:
    """What a checkpoint names where training left a score in it: numpy's numbers, which are nothing but bytes."""
    scalar = np.float64(0).__reduce__()[0]
    return [
        (scalar, "numpy.core.multiarray.scalar"), (scalar, "numpy._core.multiarray.scalar"), np.dtype,
        *(type(np.dtype(kind)) for kind in ("f4", "f8", "i4", "i8")),
    ]  # fmt: skip


def check_size(path: Path) -> None:
    """Refuse a file that would fill the memory when unpacked, before anything is; raises InvalidWeightsError."""
    packed = path.stat().st_size
    unpacked = packed
    if zipfile.is_zipfile(path):
        try:
            with zipfile.ZipFile(path) as archive:
                unpacked = sum(member.file_size for member in archive.infolist())
        except (zipfile.BadZipFile, OSError, ValueError) as error:
            raise InvalidWeightsError(f"{path.name} is no whole file of weights", file=path.name) from error
    if unpacked > _MOST_BYTES or unpacked > _MOST_RATIO * max(packed, 1):
        raise InvalidWeightsError(
            f"{path.name} unpacks to {unpacked} bytes, more than any file of weights", file=path.name
        )
