"""Too little memory: smaller batches where they help, a named error where they do not; and which runtime is taken."""

import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from deepsimbad.api.problems import status_of
from deepsimbad.errors import InvalidImageError, MissingPackageError, OutOfMemoryError
from deepsimbad.evaluators import runtimes
from deepsimbad.evaluators.compute import Compute, Runtime
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.image import decode_image
from deepsimbad.evaluators.runtimes import make_run


class Hungry(nn.Module):
    """The first pixel of every image; more images at once than it may take do not fit the memory."""

    def __init__(self, n_most: int, error: Exception) -> None:
        super().__init__()
        self.trunk = nn.Identity()
        self.n_most, self.error, self.batches = n_most, error, []

    def forward(self, pixels):
        self.batches.append(len(pixels))
        if len(pixels) > self.n_most:
            raise self.error
        return pixels[:, 0, 0, :1].float()


def pixels(n):
    return np.arange(n, dtype=np.uint8).reshape(n, 1, 1, 1).repeat(3, axis=3)


TORCH = Compute(Runtime.TORCH, largest_batch=8)


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
        RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory: you tried to"),
        MemoryError(),
    ],
)
def test_a_batch_that_does_not_fit_is_halved_and_so_is_every_later_one(error, caplog):
    module = Hungry(2, error)
    run = make_run(lambda: module, TORCH, (1, 1))
    assert run.largest_batch == 8
    np.testing.assert_array_equal(run(pixels(8))[:, 0], np.arange(8))
    assert module.batches == [8, 4, 2, 2, 4, 2, 2]
    assert run.largest_batch == 2
    assert "a batch did not fit the memory" in caplog.messages


def test_where_not_even_one_image_fits_the_view_is_not_at_fault():
    run = make_run(lambda: Hungry(0, torch.OutOfMemoryError("CUDA out of memory")), TORCH, (1, 1))
    with pytest.raises(OutOfMemoryError) as caught:
        run(pixels(2))
    assert status_of(caught.value) == 503


def test_another_fault_stays_what_it_is():
    run = make_run(lambda: Hungry(0, RuntimeError("shapes differ")), TORCH, (1, 1))
    with pytest.raises(RuntimeError, match="shapes differ"):
        run(pixels(2))


def test_what_a_decoder_complains_of_is_the_images_fault(monkeypatch):
    def imdecode(*_):
        raise cv2.error("(-215:Assertion failed)")

    body = cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes()
    monkeypatch.setattr(cv2, "imdecode", imdecode)
    with pytest.raises(InvalidImageError):
        decode_image(body, 100)


STARVED = """
import resource, sys
import cv2, numpy as np
from deepsimbad.errors import OutOfMemoryError
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.image import decode_image

def written(side):
    image = np.zeros((side, side, 3), np.uint8)
    return [cv2.imencode(ending, image)[1].tobytes() for ending in (".png", ".jpg", ".webp", ".tiff")]

small, large = written(20), written(4000)
[decode_image(body, 400) for body in small]
taken = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (taken + (60 << 20),) * 2)  # room for the picture, and not for its decoder
for body in large:
    try:
        decode_image(body, 10**8)
    except OutOfMemoryError:
        print("starved")
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the limit is Linux's")
def test_a_decoder_without_memory_finds_no_fault_with_the_image():
    process = subprocess.run([sys.executable, "-c", STARVED], capture_output=True, text=True, check=True)
    assert set(process.stdout.split()) == {"starved"}, (
        "a decoder that needs little more than the picture may do without"
    )


def test_too_little_memory_to_bring_an_image_to_size_is_named():
    evaluator = FeatureL2("gradient_grid")
    evaluator.load()
    evaluator._loaded.prepare = evaluator._loaded.encode = Hungry(0, cv2.error("(-4:Insufficient memory)"))
    for work in (evaluator.prepare, lambda image: evaluator.encode([image])):
        with pytest.raises(OutOfMemoryError):
            work(np.zeros((4, 4, 3), np.uint8))


def test_a_runtime_that_is_not_installed_is_said(monkeypatch):
    monkeypatch.setattr(runtimes, "has_onnxruntime", lambda: False)
    with pytest.raises(MissingPackageError, match=r"deep-simbad\[fast\]"):
        make_run(lambda: Hungry(1, MemoryError()), Compute(Runtime.ONNXRUNTIME), (1, 1), "hungry")


def test_what_cannot_be_exported_is_run_by_torch():
    run = make_run(lambda: Hungry(8, MemoryError()), Compute(Runtime.ONNXRUNTIME, largest_batch=8), (1, 1))
    np.testing.assert_array_equal(run(pixels(3))[:, 0], [0, 1, 2])
