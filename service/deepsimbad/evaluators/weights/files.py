"""Reading files of weights: what does not fit is a named error, and nothing that a file holds is ever run."""

import hashlib
import pickle
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import InvalidWeightsError, MissingWeightsError

if TYPE_CHECKING:
    from torch import nn

_MOST_BYTES = 4 << 30  # unpacked; the largest of the known files holds half a gigabyte
_MOST_RATIO = 20  # weights hardly compress: more is a file made to fill the memory
MATLAB_MAGIC = b"MATLAB"
_MATLAB_5 = b"MATLAB 5.0 MAT-file"
_HEADER_BYTES = 128
_MOST_PARTS = 100_000  # the known files have some hundreds
_DEEPEST = 12
_CHUNK = 16 << 20
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHAR = 1, 2, 4
_NUMBERS = range(6, 16)  # double, single and integers
_STORED: dict[int, str] = {
    1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8",
}  # fmt: skip


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
    """The digest by which encodings are told apart: of their weights and of how these are used.

    `recipe` counts up with whatever else changes an encoding (layers, grid, size, normalisation). The first adds
    nothing, so what was encoded before recipes were counted stays comparable.
    """
    return weights_sha256 if recipe == 1 else hashlib.sha256(f"{weights_sha256} {recipe}".encode()).hexdigest()


def load_checkpoint(path: Path) -> Any:
    """Load what `torch.save` wrote: tensors, numbers, texts, lists and dicts; code that a file names is not run.

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


def fill(module: "nn.Module", tensors: Mapping[str, Any], file: str, origins: Mapping[str, str] | None = None) -> None:
    """Fill a module's parameters and buffers by name.

    Args:
        module: The module, changed in place.
        tensors: By the module's names; further ones are passed over.
        file: Where they come from, for the error.
        origins: What the file calls them, by the module's names, for the error too; None: by these.

    Raises:
        InvalidWeightsError: One is missing, of another shape or not finite.
    """
    import torch

    if not isinstance(tensors, Mapping):
        raise InvalidWeightsError(f"{file} holds no weights by name", file=file)
    parameters = module.state_dict()
    for name, parameter in parameters.items():
        tensor, origin = tensors.get(name), (origins or {}).get(name, name)
        if (
            not isinstance(tensor, torch.Tensor)
            or tensor.layout is not torch.strided
            or tensor.is_floating_point() != parameter.is_floating_point()
        ):
            raise InvalidWeightsError(f"{file} has no {origin}: it is of another network", file=file, missing=origin)
        if tensor.shape != parameter.shape:
            raise InvalidWeightsError(
                f"{file} has {origin} of shape {list(tensor.shape)}, not {list(parameter.shape)}",
                file=file,
                name=origin,
            )
        if not torch.isfinite(tensor).all():
            raise InvalidWeightsError(f"{file} has NaN or infinity in {origin}", file=file, name=origin)
    # Assigned, not copied: a whitening is half a gigabyte, and the module may have been made without any memory.
    module.load_state_dict(
        {name: tensors[name].to(parameter.dtype) for name, parameter in parameters.items()}, assign=True
    )


def _numpy_scalars() -> list[Any]:
    """The globals that a checkpoint with a score in it names: numpy's numbers, which hold no code."""
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
    if unpacked > min(_MOST_BYTES, _MOST_RATIO * max(packed, 1)):
        _refuse_unpacked(path.name)


def read_variable(path: Path, name: str) -> Any:
    """A variable of a MATLAB file of version 5 (also `save -v6` and `-v7`): numbers, texts, cells and structs.

    SciPy's reader is not used: it follows cells inside cells by recursion in C, so that a file of a few megabytes ends
    the process, and it unpacks without a bound. Format: MathWorks, "MAT-File Format", chapter 1.

    Returns:
        Structs as dicts, cells as lists (column by column), numbers as arrays in MATLAB's order of axes, texts as str;
        None for what is none of these (objects, functions, complex and sparse matrices, arrays of structs): it is
        passed over.

    Raises:
        InvalidWeightsError: Truncated, no such file, too large unpacked, nested too deeply, or without that variable.
    """
    with path.open("rb") as stream:
        header = stream.read(_HEADER_BYTES)
        if not header.startswith(_MATLAB_5) or header[126:128] != b"IM":
            raise InvalidWeightsError(
                f"{path.name} is no MATLAB file of version 5: save it with -v7 on a little-endian machine",
                file=path.name,
            )
        unpacked = min(_MOST_BYTES, _MOST_RATIO * path.stat().st_size)
        while tag := stream.read(8):
            if len(tag) < 8:
                _refuse(path.name)
            kind, n_bytes = struct.unpack("<II", tag)
            body = _body(stream, kind, n_bytes, unpacked, path.name)
            unpacked -= len(body)
            variable = _Reader(body, path.name).variable()
            if variable.name == name:
                return variable.value
    raise InvalidWeightsError(f"{path.name} has no variable {name}: it is of another network", file=path.name)


def _body(stream: BinaryIO, kind: int, n_bytes: int, limit_bytes: int, file: str) -> bytearray:
    """The unpacked content of a top-level element, without its tag."""
    if kind not in {_MATRIX, _COMPRESSED}:
        _refuse(file)
    unpack = zlib.decompressobj() if kind == _COMPRESSED else None
    body = bytearray()
    while n_bytes:
        chunk = stream.read(min(n_bytes, _CHUNK))
        if not chunk:
            _refuse(file)
        n_bytes -= len(chunk)
        try:
            body += chunk if unpack is None else unpack.decompress(chunk, limit_bytes - len(body) + 1)
        except (zlib.error, MemoryError) as error:
            raise InvalidWeightsError(f"{file} is damaged, or does not fit the memory", file=file) from error
        if len(body) > limit_bytes or (unpack is not None and unpack.unconsumed_tail):
            _refuse_unpacked(file)
    if unpack is None:
        return body
    if not unpack.eof or len(body) < 8 or struct.unpack_from("<I", body) != (_MATRIX,):
        _refuse(file)
    del body[:8]
    return body


def _refuse_unpacked(file: str) -> NoReturn:
    raise InvalidWeightsError(
        f"{file} unpacks to more than {_MOST_RATIO} times its size, or than {_MOST_BYTES >> 30} GiB, "
        "which no file of weights does",
        file=file,
    )


def _refuse(file: str) -> NoReturn:
    raise InvalidWeightsError(f"{file} is no whole MATLAB file", file=file)


@dataclass(frozen=True)
class _Variable:
    name: str
    value: Any


class _Reader:
    """Walks the elements of one variable; every step is checked against the end of what holds it."""

    def __init__(self, body: bytearray, file: str) -> None:
        self._body, self._view, self._file = body, memoryview(body), file
        self._n_parts = 0

    def variable(self) -> _Variable:
        try:
            return self._matrix(0, len(self._body), 0)
        except (struct.error, ValueError, IndexError) as error:
            raise InvalidWeightsError(f"{self._file} is no whole MATLAB file", file=self._file) from error

    def _matrix(self, offset: int, end: int, depth: int) -> _Variable:
        """The array between two offsets: flags, dimensions, name, then what its class says."""
        self._n_parts += 1
        if depth > _DEEPEST or self._n_parts > _MOST_PARTS:
            raise InvalidWeightsError(
                f"{self._file} is nested deeper, or in more parts, than any file of weights", file=self._file
            )
        if offset == end:
            return _Variable("", np.empty(0))  # MATLAB's own form of an empty cell
        flags, offset = self._numbers(offset, end)
        sizes, offset = self._numbers(offset, end)
        name, offset = self._numbers(offset, end)
        kind, is_complex = int(flags[0]) & 0xFF, bool(int(flags[0]) & 0x800)
        shape = tuple(int(size) for size in sizes)
        if min(shape, default=-1) < 0:
            _refuse(self._file)
        value: Any = None
        if kind == _CELL:
            value = [item.value for item in self._matrices(offset, end, prod(shape), depth)]
        elif kind == _STRUCT and prod(shape) == 1:
            value = self._struct(offset, end, depth)
        elif kind == _CHAR:
            value = self._text(offset, end)
        elif kind in _NUMBERS and not is_complex:
            numbers, _ = self._numbers(offset, end)
            value = numbers.reshape(shape, order="F")
        return _Variable(bytes(name).decode("latin-1"), value)

    def _struct(self, offset: int, end: int, depth: int) -> dict[str, Any]:
        widths, offset = self._numbers(offset, end)
        texts, offset = self._numbers(offset, end)
        width, joined = int(widths[0]), bytes(texts)
        if width <= 0 or len(joined) % width:
            _refuse(self._file)
        fields = [joined[i : i + width].partition(b"\0")[0].decode("latin-1") for i in range(0, len(joined), width)]
        values = self._matrices(offset, end, len(fields), depth)
        return {field: item.value for field, item in zip(fields, values, strict=True)}

    def _matrices(self, offset: int, end: int, count: int, depth: int) -> list[_Variable]:
        if count > _MOST_PARTS:
            _refuse(self._file)
        matrices = []
        for _ in range(count):
            kind, start, stop, following = self._element(offset, end)
            if kind != _MATRIX:
                _refuse(self._file)
            matrices.append(self._matrix(start, stop, depth + 1))
            offset = following
        return matrices

    def _text(self, offset: int, end: int) -> str:
        kind, start, stop, _ = self._element(offset, end)
        return bytes(self._view[start:stop]).decode({16: "utf-8", 17: "utf-16-le", 4: "utf-16-le"}.get(kind, "latin-1"))

    def _numbers(self, offset: int, end: int) -> tuple[NDArray[Any], int]:
        """The numbers of an element, as a view, and where the next one begins."""
        kind, start, stop, following = self._element(offset, end)
        if kind not in _STORED:
            _refuse(self._file)
        if start == stop:
            return np.empty(0, _STORED[kind]), following
        return np.frombuffer(self._view[start:stop], _STORED[kind]), following

    def _element(self, offset: int, end: int) -> tuple[int, int, int, int]:
        """(type, first byte, byte behind the last, byte of the next element) of the element at an offset."""
        (word,) = struct.unpack_from("<I", self._view[:end], offset)
        if word >> 16:  # up to four bytes lie in the tag itself
            kind, start, n_bytes, following = word & 0xFFFF, offset + 4, word >> 16, offset + 8
        else:
            kind, n_bytes = struct.unpack_from("<II", self._view[:end], offset)
            start = offset + 8
            following = start + n_bytes + -n_bytes % 8
        if start + n_bytes > end:
            _refuse(self._file)
        return kind, start, start + n_bytes, following
