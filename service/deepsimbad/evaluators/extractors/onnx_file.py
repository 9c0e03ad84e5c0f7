"""Any model in an ONNX file, run by ONNX Runtime on the processor.

The file itself says how images are prepared: by its input's shape and, where it was not trained as models of ImageNet
are, by entries of its metadata (`metadata_props`). Pixels 0..255 are multiplied by `deepsimbad.scale`, then
`deepsimbad.mean` is subtracted and the rest divided by `deepsimbad.std`: one number or three, in the order of
`deepsimbad.channels`, RGB or BGR. `deepsimbad.layout` is NCHW or NHWC. Numbers are written as JSON.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import InvalidWeightsError, MissingPackageError, OutOfMemoryError
from deepsimbad.evaluators.base import is_lack_of_memory
from deepsimbad.evaluators.compute import Compute, available_cores
from deepsimbad.evaluators.extractors.base import IMAGENET_MEAN, IMAGENET_STD, NetworkExtractor
from deepsimbad.evaluators.runtimes import INSTALL_FAST, has_onnxruntime, onnx_session
from deepsimbad.evaluators.weights.files import encodings_sha256
from deepsimbad.evaluators.weights.lock import Lock

_RECIPE = 1  # see `encodings_sha256`
_SIDE = 224  # pixels of a side that the file leaves open
_LONGEST_SIDE = 4096
_LARGEST = 1e6  # number that images are normalised by
_MOST_BYTES = (2 << 30) - 1  # of a protocol buffer
_PREFIX = "deepsimbad."
_DEFAULTS: Mapping[str, Any] = {
    "mean": IMAGENET_MEAN,
    "std": IMAGENET_STD,
    "scale": 1 / 255,
    "channels": "RGB",
    "layout": "NCHW",
}
_CHOICES = {"channels": ("RGB", "BGR"), "layout": ("NCHW", "NHWC")}


def onnx_file(argument: str, compute: Compute) -> NetworkExtractor:
    """Make the extractor for the registry, on the processor whatever `compute` asks for; raises as `Evaluator.load`."""
    if not has_onnxruntime():
        raise MissingPackageError(f"onnx:{argument} needs ONNX Runtime: {INSTALL_FAST}")
    path, sha256 = Lock.read(compute.weights_dir).pinned_file(argument)
    if path.stat().st_size > _MOST_BYTES:
        raise InvalidWeightsError(f"{argument} is larger than an ONNX file can be", file=argument)
    run = _FileRun(argument, path.read_bytes(), compute)
    width, height = run.input_size
    encodings = run(np.zeros((1, height, width, 3), np.uint8))
    return NetworkExtractor(run, encodings.shape[1], encodings_sha256(sha256, _RECIPE), run.input_size)


@dataclass(frozen=True)
class _InputForm:
    """How a file's model takes images."""

    scale: NDArray[np.float32]  # [3] float32, factor of pixels, first
    mean: NDArray[np.float32]  # [3] float32, subtracted next
    std: NDArray[np.float32]  # [3] float32, divisor of the rest
    is_rgb: bool  # whether R comes first
    is_nchw: bool  # whether channels come before rows and columns

    @classmethod
    def read(cls, file: str, metadata: Mapping[str, str]) -> "_InputForm":
        """From a file's metadata, complete with the defaults; raises InvalidWeightsError."""
        entries = {key.removeprefix(_PREFIX): text for key, text in metadata.items() if key.startswith(_PREFIX)}
        values = dict(_DEFAULTS)
        for name, text in entries.items():
            if name not in _DEFAULTS:
                raise InvalidWeightsError(f"{file} has the metadata {_PREFIX}{name}, which means nothing", file=file)
            values[name] = _value(file, name, text)
        numbers = {name: np.broadcast_to(np.asarray(values[name], np.float32), 3) for name in ("scale", "mean", "std")}
        is_rgb = values["channels"] == "RGB"
        for name in {"mean", "std"} - set(entries) if not is_rgb else ():
            numbers[name] = numbers[name][::-1]
        return cls(numbers["scale"], numbers["mean"], numbers["std"], is_rgb, is_nchw=values["layout"] == "NCHW")

    def images(self, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Pixels [n, height, width, 3] uint8 BGR as the file's input, float32."""
        ordered = pixels[..., ::-1] if self.is_rgb else pixels
        images = (ordered.astype(np.float32) * self.scale - self.mean) / self.std
        return np.ascontiguousarray(images.transpose(0, 3, 1, 2) if self.is_nchw else images)


class _FileRun:
    """A file's model, from pixels to encodings; see `Run`.

    Attributes:
        input_size: (width, height) of its images.
        largest_batch: Most images at once; 1 where the file says so.
    """

    def __init__(self, file: str, content: bytes, compute: Compute) -> None:
        self._file = file
        _check_content(file, content)
        try:
            self._session = onnx_session(content, compute.n_threads or available_cores())
        except Exception as error:
            raise self._failure(f"is no model that ONNX Runtime can run: {_first_line(error)}", error) from error
        self._form = _InputForm.read(file, self._session.get_modelmeta().custom_metadata_map)
        self._input, batch, self.input_size = self._described_input()
        self._output = self._session.get_outputs()[0].name
        self.largest_batch = batch or compute.largest_batch or 1

    def __call__(self, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
        """See `Run`; raises InvalidWeightsError."""
        try:
            output = self._session.run([self._output], {self._input: self._form.images(pixels)})[0]
        except Exception as error:
            raise self._failure(f"cannot be run: {_first_line(error)}", error) from error
        shape: tuple[int, ...] = tuple(getattr(output, "shape", ()))  # a file may give a list, too
        if len(shape) == 4 and shape[2:] == (1, 1):
            output, shape = output[:, :, 0, 0], shape[:2]
        if len(shape) != 2 or shape[0] != len(pixels) or shape[1] == 0 or output.dtype.kind != "f":
            raise InvalidWeightsError(
                f"{self._file} gives {list(shape)} for {len(pixels)} images, and no encodings [{len(pixels)}, d]",
                file=self._file,
            )
        encodings = np.asarray(output, np.float32)
        length = np.linalg.norm(encodings, axis=1, keepdims=True)
        if not np.isfinite(length).all():
            raise InvalidWeightsError(f"{self._file} gives NaN, infinity or numbers too large", file=self._file)
        neutral = np.float32(shape[1] ** -0.5)  # where it sees nothing at all
        return np.where(length > 0, encodings / np.maximum(length, np.finfo(np.float32).tiny), neutral)

    def _described_input(self) -> tuple[str, int, tuple[int, int]]:
        """Name, size of a batch (0: any) and (width, height) of the one input."""
        inputs = self._session.get_inputs()
        expected = "[n, 3, height, width]" if self._form.is_nchw else "[n, height, width, 3]"
        actual = ", ".join(f"{tensor.type} {tensor.shape}" for tensor in inputs) or "nothing"
        if len(inputs) == 1 and inputs[0].type == "tensor(float)" and len(inputs[0].shape) == 4:
            batch, first, second, third = (size if isinstance(size, int) else None for size in inputs[0].shape)
            channels, height, width = (first, second, third) if self._form.is_nchw else (third, first, second)
            sides = (width or _SIDE, height or _SIDE)
            if channels == 3 and batch in {None, 1} and max(sides) <= _LONGEST_SIDE:
                return inputs[0].name, batch or 0, sides
        raise InvalidWeightsError(
            f"{self._file} takes {actual}, not one tensor(float) {expected} with n open or 1", file=self._file
        )

    def _failure(self, problem: str, error: Exception) -> InvalidWeightsError | OutOfMemoryError:
        if is_lack_of_memory(error):
            return OutOfMemoryError(f"there is too little memory for {self._file}")
        return InvalidWeightsError(f"{self._file} {problem}", file=self._file)


def _value(file: str, name: str, text: str) -> Any:
    """The value of a metadata entry."""
    if name in _CHOICES:
        if text in _CHOICES[name]:
            return text
        raise InvalidWeightsError(
            f"{file} has {_PREFIX}{name} = {text!r}, not {' or '.join(_CHOICES[name])}", file=file
        )
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        value = None
    numbers = value if isinstance(value, list) else [value]
    are_numbers = all(isinstance(number, int | float) and not isinstance(number, bool) for number in numbers)
    are_usable = are_numbers and all(abs(number) < _LARGEST and (number or name != "std") for number in numbers)
    if len(numbers) not in {1, 3} or not are_usable:
        raise InvalidWeightsError(f"{file} has {_PREFIX}{name} = {text!r}, not one or three numbers", file=file)
    return numbers


def _check_content(file: str, content: bytes) -> None:
    """Refuse what is no ONNX model, and one that would have other files opened."""
    import onnx

    try:
        model = onnx.ModelProto.FromString(content)
    except Exception as error:  # the parser's own kinds, which differ from one of its builds to another
        raise InvalidWeightsError(f"{file} is no whole ONNX file", file=file) from error
    if not model.graph.output:
        raise InvalidWeightsError(f"{file} is no whole ONNX file: it gives nothing", file=file)
    tensors = (part for part in _parts(model) if isinstance(part, onnx.TensorProto))
    if any(tensor.data_location == onnx.TensorProto.EXTERNAL for tensor in tensors):
        raise InvalidWeightsError(
            f"{file} keeps its numbers in another file: save it again with all of them inside", file=file
        )


def _parts(message: Any) -> Iterator[Any]:
    """A message of a protocol buffer, and all those within it."""
    yield message
    for field, value in message.ListFields():
        if field.message_type is not None:
            for part in [value] if hasattr(value, "ListFields") else value:
                yield from _parts(part)


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]
