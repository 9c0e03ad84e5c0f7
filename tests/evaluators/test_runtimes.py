"""Too little memory: smaller batches where they help, a named error where they do not; and which runtime is taken."""

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from deepsimbad.api.problems import status_of
from deepsimbad.errors import InvalidImageError, MissingPackageError, OutOfMemoryError
from deepsimbad.evaluators import image as image_module
from deepsimbad.evaluators import runtimes
from deepsimbad.evaluators.compute import Compute, Runtime
from deepsimbad.evaluators.image import decode_image
from deepsimbad.evaluators.runtimes import make_run


class Hungry(nn.Module):
    """The first pixel of every image; more images at once than it may take do not fit the memory."""

    def __init__(self, most: int, error: Exception) -> None:
        super().__init__()
        self.trunk = nn.Identity()
        self.most, self.error, self.batches = most, error, []

    def forward(self, pixels):
        self.batches.append(len(pixels))
        if len(pixels) > self.most:
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


def test_too_little_memory_to_decode_is_no_bad_image(monkeypatch):
    body = cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes()

    def starved(code):
        error = cv2.error("Insufficient memory")
        error.code = code

        def imdecode(*_):
            raise error

        monkeypatch.setattr(image_module.cv2, "imdecode", imdecode)

    starved(cv2.Error.StsNoMem)
    with pytest.raises(OutOfMemoryError):
        decode_image(body, 100)
    starved(cv2.Error.StsAssert)
    with pytest.raises(InvalidImageError):
        decode_image(body, 100)


def test_a_runtime_that_is_not_installed_is_said(monkeypatch):
    monkeypatch.setattr(runtimes, "has_onnxruntime", lambda: False)
    with pytest.raises(MissingPackageError, match=r"deep-simbad\[fast\]"):
        make_run(lambda: Hungry(1, MemoryError()), Compute(Runtime.ONNXRUNTIME), (1, 1), "hungry")


def test_what_cannot_be_exported_is_run_by_torch():
    run = make_run(lambda: Hungry(8, MemoryError()), Compute(Runtime.ONNXRUNTIME, largest_batch=8), (1, 1))
    np.testing.assert_array_equal(run(pixels(3))[:, 0], [0, 1, 2])
