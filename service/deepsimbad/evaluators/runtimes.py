"""Running a network: PyTorch in float32 or bfloat16, on the processor or CUDA, or ONNX Runtime.

A network here is an `nn.Module` from pixels [n, height, width, 3] uint8 BGR to encodings [n, d] float32 of unit length;
all that happens between, normalising the pixels included, is the module's own. So the one definition of a network is
its module, and ONNX Runtime gets an export of it.
"""

import hashlib
import logging
import os
import tempfile
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import MissingPackageError, OutOfMemoryError
from deepsimbad.evaluators.base import named_lack_of_memory
from deepsimbad.evaluators.compute import Compute, Device, Runtime, available_cores

if TYPE_CHECKING:
    from torch import nn

log = logging.getLogger(__name__)

# Threads of a network that wait for each other should soon sleep. OpenMP lets them spin for milliseconds, and where a
# job or a decoder wants the same core, an image then takes a second, not ten milliseconds; not to spin at all costs
# an idle machine a third of its speed. Read when torch is loaded; docs/decisions/0016.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

INSTALL_TORCH = (
    "install the service with its networks: pip install 'deep-simbad[service]' "
    "--extra-index-url https://download.pytorch.org/whl/cpu"
)
INSTALL_FAST = "install ONNX Runtime: pip install 'deep-simbad[fast]'"

_INPUT = "pixels"
_LARGE = ("trunk", "whitening")  # children of a network that are cast
_DIGEST_BYTES = 32
_BATCH_ON_CPU = 1  # a larger one leaves the caches: docs/results/encode.md
_BATCH_ON_CUDA = 32


class Run(Protocol):
    """A network that is ready to be computed."""

    largest_batch: int

    def __call__(self, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
        """[n, height, width, 3] uint8 BGR to [n, d] float32; n is at most `largest_batch`; raises OutOfMemoryError."""


def has_torch() -> bool:
    """Whether PyTorch is installed; it is not imported to find out."""
    return find_spec("torch") is not None


def has_onnxruntime() -> bool:
    """Whether ONNX Runtime, and what exports a network to it, are installed."""
    return all(find_spec(name) is not None for name in ("onnxruntime", "onnx", "onnxscript"))


def make_run(
    make_module: "Callable[[], nn.Module]", compute: Compute, example: tuple[int, int], exported_as: str | None = None
) -> Run:
    """Make a network ready.

    Args:
        make_module: Makes the module, in float32; its children `trunk` and `whitening` bear bfloat16. Not called where
            an export of it is at hand.
        compute: How it should be run.
        example: (width, height) of an input, for the export.
        exported_as: Name that stands for this very module with these very weights; None: it is not run by ONNX Runtime.

    Raises:
        MissingPackageError: What should run it is not installed.
    """
    runtime, device = _choose(compute, exported_as is not None)
    if runtime is Runtime.ONNXRUNTIME and exported_as is not None:
        return _onnx_run(make_module, compute, example, exported_as)
    return _TorchRun(make_module(), runtime is Runtime.TORCH_BF16, device, compute)


def _choose(compute: Compute, may_export: bool) -> tuple[Runtime, str]:
    """The runtime and torch device to use on this machine for what `compute` asks for."""
    device = _device(compute.device)
    runtime = compute.runtime
    if runtime is Runtime.ONNXRUNTIME:
        if not has_onnxruntime():
            raise MissingPackageError(f"the runtime onnxruntime is not installed: {INSTALL_FAST}")
        return (runtime, "cpu") if may_export else (Runtime.TORCH, device)
    if runtime is Runtime.AUTO:
        if device == "cpu" and may_export and has_onnxruntime():
            return Runtime.ONNXRUNTIME, "cpu"
        runtime = Runtime.TORCH_BF16 if device != "cpu" or _has_bf16_units() else Runtime.TORCH
    return runtime, device


def _device(device: Device) -> str:
    if device is Device.CPU:
        return "cpu"
    if not has_torch():
        if device is Device.CUDA:
            raise MissingPackageError(f"the device cuda needs PyTorch: {INSTALL_TORCH}")
        return "cpu"
    if device is Device.AUTO and not Path("/dev/nvidiactl").exists():
        return "cpu"  # asking torch would import it, a second that ONNX Runtime need not wait
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if device is Device.CUDA:
        raise MissingPackageError("the device cuda was asked for, and PyTorch finds none that works")
    return "cpu"


def _has_bf16_units() -> bool:
    """Whether the processor multiplies bfloat16 by itself; emulated, it is slower than float32."""
    import torch

    capabilities = torch.cpu.get_capabilities()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


class _TorchRun:
    """A module on a device, its large parts in float32 or bfloat16."""

    def __init__(self, module: "nn.Module", in_bf16: bool, device: str, compute: Compute) -> None:
        import torch

        self._torch, self._device = torch, device
        torch.set_num_threads(compute.n_threads or available_cores())
        module.eval().requires_grad_(False)
        for name, part in module.named_children():
            if in_bf16 and name in _LARGE:
                part.to(torch.bfloat16)
        with named_lack_of_memory("encode"):
            self._module = module.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.largest_batch = compute.largest_batch or (_BATCH_ON_CPU if device == "cpu" else _BATCH_ON_CUDA)

    def __call__(self, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
        """See `Run`. Where a batch does not fit the memory it is halved, and so is every later one."""
        try:
            with named_lack_of_memory("encode"), self._torch.inference_mode():
                tensor = self._torch.from_numpy(pixels).to(self._device)
                return np.asarray(self._module(tensor).cpu().numpy(), np.float32)
        except OutOfMemoryError:
            if len(pixels) == 1:
                raise
            half = len(pixels) // 2
            log.warning("a batch did not fit the memory", extra={"n_images": len(pixels), "now": half})
            self.largest_batch = min(self.largest_batch, half)
        return np.concatenate([self(pixels[:half]), self(pixels[half:])])


class _OnnxRun:
    """An exported module on the processor: every image on one thread, as many images at once as there are threads.

    That is a third more images a second than all threads on one image, and each has the same bits alone and in company.
    """

    def __init__(self, exported: bytes, compute: Compute) -> None:
        n_threads = compute.n_threads or available_cores()
        self._session = onnx_session(exported, n_threads=1)
        self.largest_batch = compute.largest_batch or 4 * n_threads  # so that threads seldom wait for the last image
        self._threads = ThreadPoolExecutor(n_threads, "onnxruntime")

    def __call__(self, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
        if len(pixels) == 1:
            return self._encode_one(pixels)
        return np.concatenate(list(self._threads.map(self._encode_one, np.split(pixels, len(pixels)))))

    def _encode_one(self, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
        with named_lack_of_memory("encode"):
            return np.asarray(self._session.run(None, {_INPUT: pixels})[0], np.float32)


def onnx_session(model: bytes, n_threads: int) -> Any:
    """ONNX Runtime's session of a model on the processor; raises what ONNX Runtime does of one that it cannot load."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = n_threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # as GOMP_SPINCOUNT above
    options.log_severity_level = 4  # what is wrong comes as an exception
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def _onnx_run(
    make_module: "Callable[[], nn.Module]", compute: Compute, example: tuple[int, int], exported_as: str
) -> _OnnxRun:
    """The run of the export in the weights' folder, which is made there first if needed; that takes some seconds."""
    file = compute.weights_dir / "exported" / f"{exported_as}.onnx"
    content = _read_export(file)
    if content is not None:
        return _OnnxRun(content, compute)
    log.info("preparing a network for ONNX Runtime, once", extra={"file": str(file)})
    with tempfile.TemporaryDirectory() as folder:
        exported = Path(folder) / file.name
        _export(make_module().eval().requires_grad_(False), exported, example)
        content = exported.read_bytes()
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, delete=False) as temporary:
            temporary.write(content + hashlib.sha256(content).digest())
        Path(temporary.name).replace(file)  # whole or not at all, whoever exports beside us
    except OSError as error:
        log.warning("an export for ONNX Runtime cannot be kept", extra={"file": str(file), "why": str(error)})
    return _OnnxRun(content, compute)


def _read_export(file: Path) -> bytes | None:
    """An export's content, without the digest at its end; None: there is no such file, or it is damaged."""
    try:
        stored_bytes = file.read_bytes()
    except OSError:
        return None
    content, digest = stored_bytes[:-_DIGEST_BYTES], stored_bytes[-_DIGEST_BYTES:]
    if hashlib.sha256(content).digest() == digest:
        return content
    log.warning("an export for ONNX Runtime is damaged and is made anew", extra={"file": str(file)})
    return None


def _export(module: "nn.Module", to: Path, example: tuple[int, int]) -> None:
    import torch

    width, height = example
    pixels = torch.zeros((2, height, width, 3), dtype=torch.uint8)
    exporter = logging.getLogger("torch.onnx")  # it tells about parts of torchvision that nobody here has
    level = exporter.level
    exporter.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            torch.onnx.export(
                module, (pixels,), to, dynamo=True, external_data=False, verbose=False,
                input_names=[_INPUT], dynamic_shapes=({0: torch.export.Dim("n", min=1)},),
            )  # fmt: skip
    finally:
        exporter.setLevel(level)
