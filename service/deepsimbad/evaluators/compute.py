"""How, and on which device, networks are computed: chosen for an evaluator, and the same for all its networks."""

import os
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path


class Runtime(StrEnum):
    """What runs a network. All agree to 1e-3 in cosine."""

    AUTO = "auto"  # the fastest of what is installed, by docs/results/encode.md
    TORCH = "torch"  # in float32
    TORCH_BF16 = "torch_bf16"
    ONNXRUNTIME = "onnxruntime"  # in float32; networks that it does not know are run by PyTorch


class Device(StrEnum):
    """Where a network runs."""

    AUTO = "auto"  # CUDA where there is one that works, else the processor
    CPU = "cpu"
    CUDA = "cuda"


DEFAULT_WEIGHTS_DIR = Path("~/.cache/deepsimbad/weights")


def available_cores() -> int:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


@dataclass(frozen=True)
class Compute:
    """How networks are computed."""

    runtime: Runtime = Runtime.AUTO
    device: Device = Device.AUTO
    n_threads: int = 0  # processor threads a network may use; 0: as many as there are cores
    largest_batch: int = 0  # most images that are encoded at once; 0: what measures best on the device
    # Folder of files of weights, named by configurations without their folder
    weights_dir: Path = field(default_factory=DEFAULT_WEIGHTS_DIR.expanduser)
