"""Object proposals (II-A, (3)): a scene is the objects that a detector finds in it, and their layout.

Labels are hashed to a fixed number of buckets, so that an encoding depends on no vocabulary: it is a spatial pyramid of
cells by buckets, each object shared out among the cells nearest to its middle. A label that no landmark has falls into
its bucket like any other.
"""

import threading
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import InvalidWeightsError, MissingPackageError, MissingWeightsError
from deepsimbad.evaluators.base import Image, named_lack_of_memory
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.scenes import Form, Objects, Scene

BUCKETS = 64  # of labels
GRIDS = ((1, 1), (2, 2), (4, 3))  # columns and rows of the pyramid
_SIZE_POWER = 0.25  # of a box's area: one of ten times the area counts not twice as much
_WEIGHTS_ENUM = "FasterRCNN_ResNet50_FPN_V2_Weights"  # of torchvision: it knows the labels' names
_LEAST_SCORE = 0.3


class Detector:
    """A detector of torchvision, loaded at first need; `name` is `fasterrcnn_resnet50_fpn_v2:FILE` of weights."""

    def __init__(self, name: str, compute: Compute) -> None:
        self._name, _, file = name.partition(":")
        self._file = compute.weights_dir / file
        self._loading = threading.Lock()
        self._loaded: tuple[Any, list[str]] | None = None

    def load(self) -> tuple[Any, list[str]]:
        """The network and its labels; raises MissingPackageError, MissingWeightsError, InvalidWeightsError."""
        with self._loading:
            if self._loaded is None:
                self._loaded = self._load_network()
            return self._loaded

    def _load_network(self) -> tuple[Any, list[str]]:
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
            detections = network([pixels])[0]
        boxes, scores, labels = (detections[part].cpu().numpy() for part in ("boxes", "scores", "labels"))
        boxes = np.clip(boxes.astype(np.float64) / (width, height, width, height), 0, 1)
        is_kept = (scores >= _LEAST_SCORE) & (boxes[:, 0] < boxes[:, 2]) & (boxes[:, 1] < boxes[:, 3])
        return Objects(
            tuple(names[label] for label in labels[is_kept]), boxes[is_kept], scores[is_kept].astype(np.float64)
        )


class ObjectLayouts(FeatureL2):
    """Dissimilarity = squared L2 between unit layouts.

    Args:
        extractor: Name of the detector that finds objects in images; `none`: objects are sent.
        compute: Where its weights are; None: by the defaults.
    """

    input_size = None  # a detector takes images as they are
    encoding_dim = BUCKETS * sum(columns * rows for columns, rows in GRIDS)
    weights_sha256 = None  # layouts are of objects, whoever found them
    largest_batch = 1

    def __init__(self, extractor: str, compute: Compute | None = None) -> None:
        super().__init__("none", compute)
        self._detector = None if extractor == "none" else Detector(extractor, self._compute)
        self.forms = frozenset({Form.OBJECTS} if self._detector is None else {Form.OBJECTS, Form.IMAGE})

    def load(self) -> None:
        if self._detector is not None:
            self._detector.load()

    def prepare(self, image: Image) -> Image:
        self._check((image,))
        return image

    def encode(self, images: Sequence[Image | Scene]) -> NDArray[np.float32]:
        """See `Evaluator`; a scene without objects is all zeros."""
        layouts = [layout(self._objects(observation)) for observation in images]
        return np.stack(layouts) if layouts else np.empty((0, self.encoding_dim), np.float32)

    def _objects(self, observation: Image | Scene) -> Objects:
        if isinstance(observation, Scene) and observation.objects is not None:
            return observation.objects
        image = observation.image if isinstance(observation, Scene) else observation
        self._check(() if image is None else (image,))
        if image is None or self._detector is None:
            return Objects.read([])
        with named_lack_of_memory("look for objects in"):
            return self._detector.find(image)


def layout(objects: Objects) -> NDArray[np.float32]:
    """[d] of unit length: the square root of what lies in every cell of every bucket, by score and size."""
    bucket = np.array([zlib.crc32(label.strip().lower().encode()) % BUCKETS for label in objects.labels], np.intp)
    left, top, right, bottom = objects.boxes.T
    weight = objects.scores * ((right - left) * (bottom - top)) ** _SIZE_POWER
    parts = []
    for columns, rows in GRIDS:
        cells = np.zeros((rows, columns, BUCKETS))
        column_shares, row_shares = _shared_out((left + right) / 2, columns), _shared_out((top + bottom) / 2, rows)
        shares = weight[:, np.newaxis, np.newaxis] * row_shares[:, :, np.newaxis] * column_shares[:, np.newaxis, :]
        np.add.at(cells.transpose(2, 0, 1), bucket, shares)
        parts.append(cells.ravel())
    total = np.sqrt(np.concatenate(parts))
    # Rounded, so that a file holds it in half the bytes
    return np.asarray(total / max(float(np.linalg.norm(total)), 1e-12)).astype(np.float16).astype(np.float32)


def _shared_out(middle: NDArray[np.float64], n_cells: int) -> NDArray[np.float64]:
    """[n, cells] share of an object that each cell of a row gets, by its middle [n], 0..1: the nearest two share it."""
    centre = np.clip(middle * n_cells - 0.5, 0, n_cells - 1)
    return np.asarray(np.clip(1 - np.abs(np.arange(n_cells) - centre[:, np.newaxis]), 0, None))
