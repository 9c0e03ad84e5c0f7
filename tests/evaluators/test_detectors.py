"""Torchvision's detectors at their seam: a module that looks like it stands in for the package."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from deepsimbad.errors import InvalidWeightsError, MissingPackageError, MissingWeightsError
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.objects import ObjectLayouts

NAME = "fasterrcnn_resnet50_fpn_v2"


class Tiny(torch.nn.Module):
    """Finds three things, in pixels: one sure, one not, one without width."""

    def __init__(self):
        super().__init__()
        self.score = torch.nn.Parameter(torch.tensor(0.9))

    def forward(self, images):
        assert images[0].shape == (3, 60, 80)
        assert float(images[0].max()) <= 1
        boxes = torch.tensor([[8.0, 6, 40, 66], [0, 0, 9, 9], [5, 5, 5, 9]])
        scores = torch.stack([self.score, torch.tensor(0.2), torch.tensor(0.8)])
        return [{"boxes": boxes, "scores": scores, "labels": torch.tensor([1, 1, 1])}]


def stands_in(monkeypatch):
    models = ModuleType("torchvision.models")
    weights = SimpleNamespace(DEFAULT=SimpleNamespace(meta={"categories": ["__background__", "car"]}))
    models.detection = SimpleNamespace(
        **{NAME: lambda weights, weights_backbone: Tiny()}, FasterRCNN_ResNet50_FPN_V2_Weights=weights
    )
    package = ModuleType("torchvision")
    package.models = models
    monkeypatch.setitem(sys.modules, "torchvision", package)
    monkeypatch.setitem(sys.modules, "torchvision.models", models)


def test_objects_of_an_image_are_those_that_the_detector_is_sure_of_in_shares_of_its_sides(tmp_path, monkeypatch):
    stands_in(monkeypatch)
    torch.save(Tiny().state_dict(), tmp_path / "tiny.pth")
    evaluator = ObjectLayouts(f"{NAME}:tiny.pth", Compute(weights_dir=tmp_path))
    evaluator.load()
    image = np.full((60, 80, 3), 255, np.uint8)
    objects = evaluator._detector.find(image)
    assert (objects.labels, objects.scores.round(3).tolist()) == (("car",), [0.9])
    np.testing.assert_allclose(objects.boxes, [[0.1, 0.1, 0.5, 1.0]])
    assert np.linalg.norm(evaluator.encode([image])) == pytest.approx(1, abs=1e-3)


def test_what_a_detector_lacks_is_named(tmp_path, monkeypatch):
    evaluator = ObjectLayouts(f"{NAME}:tiny.pth", Compute(weights_dir=tmp_path))
    monkeypatch.setitem(sys.modules, "torchvision", None)
    with pytest.raises(MissingPackageError, match="detect"):
        evaluator.load()
    stands_in(monkeypatch)
    with pytest.raises(MissingWeightsError, match=r"tiny\.pth"):
        evaluator.load()
    (tmp_path / "tiny.pth").write_bytes(b"no weights")
    with pytest.raises(InvalidWeightsError, match=r"tiny\.pth"):
        evaluator.load()
