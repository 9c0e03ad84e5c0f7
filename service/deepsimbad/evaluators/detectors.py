"""Detectors of torchvision by name, for `objects`; their weights are a file in the weights' folder."""

import threading
from typing import Any

import numpy as np

from deepsimbad.errors import InvalidWeightsError, MissingPackageError, MissingWeightsError
from deepsimbad.evaluators.base import Image
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.scenes import Objects

_WEIGHTS_ENUM = "FasterRCNN_ResNet50_FPN_V2_Weights"  # of torchvision: it knows the labels' names
_LEAST_SCORE = 0.3


class Detector:
    """A detector, loaded at first need; `name` is `fasterrcnn_resnet50_fpn_v2:FILE`."""

    def __init__(self, name: str, compute: Compute) -> None:
        self._name, _, file = name.partition(":")
        self._file = compute.weights_dir / file
        self._loading = threading.Lock()
        self._loaded: tuple[Any, list[str]] | None = None

    def load(self) -> tuple[Any, list[str]]:
        """The network and its labels; raises MissingPackageError, MissingWeightsError, InvalidWeightsError."""
        with self._loading:
            if self._loaded is None:
                self._loaded = self._made()
            return self._loaded

    def _made(self) -> tuple[Any, list[str]]:
        try:
            import torch
            from torchvision.models import detection
        except (ImportError, RuntimeError) as error:  # RuntimeError: torchvision of another PyTorch than this one
            raise MissingPackageError(
                f"a package that {self._name} needs cannot be imported, or is of another PyTorch: {error}: pip install "
                "'deep-simbad[detect]'"
            ) from error
        if not self._file.is_file():
            raise MissingWeightsError(
                f"there are no weights {self._file.name} in {self._file.parent}: put torchvision's file of "
                f"{self._name} there"
            )
        network = getattr(detection, self._name)(weights=None, weights_backbone=None)
        try:
            network.load_state_dict(torch.load(self._file, map_location="cpu", weights_only=True))
        except Exception as error:  # a file of anything raises anything
            raise InvalidWeightsError(f"{self._file.name} holds no weights of {self._name}: {error}") from error
        return network.eval(), list(getattr(detection, _WEIGHTS_ENUM).DEFAULT.meta["categories"])

    def find(self, image: Image) -> Objects:
        """The objects in an image."""
        import torch

        network, names = self.load()
        height, width = image.shape[:2]
        pixels = torch.from_numpy(np.ascontiguousarray(image[..., ::-1].transpose(2, 0, 1))).float() / 255
        with torch.inference_mode():
            found = network([pixels])[0]
        boxes, scores, labels = (found[part].cpu().numpy() for part in ("boxes", "scores", "labels"))
        boxes = np.clip(boxes.astype(np.float64) / (width, height, width, height), 0, 1)
        kept = (scores >= _LEAST_SCORE) & (boxes[:, 0] < boxes[:, 2]) & (boxes[:, 1] < boxes[:, 3])
        return Objects(tuple(names[label] for label in labels[kept]), boxes[kept], scores[kept].astype(np.float64))
