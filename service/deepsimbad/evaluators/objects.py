"""Object proposals (II-A, (3)): a scene is what a detector finds in it, and how that is laid out.

Labels are hashed to a fixed number of buckets, so that an encoding depends on no vocabulary: it is a spatial pyramid of
cells by buckets, each object shared out among the cells nearest to its middle. A label that no landmark has falls into
its bucket like any other.
"""

import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deepsimbad.evaluators.base import Image, named_lack_of_memory
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.detectors import Detector
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.scenes import Form, Objects, Scene

BUCKETS = 64  # of labels
GRIDS = ((1, 1), (2, 2), (4, 3))  # columns and rows of the pyramid
_SIZE_POWER = 0.25  # of a box's area: one of ten times the area counts not twice as much


class ObjectLayouts(FeatureL2):
    """Dissimilarity = squared L2 between unit layouts.

    Args:
        extractor: What finds objects in images; `none`: they are sent.
        compute: How that is computed.
    """

    def __init__(self, extractor: str, compute: Compute | None = None) -> None:
        super().__init__("none", compute)
        self._detector = None if extractor == "none" else Detector(extractor, self._compute)

    @property
    def forms(self) -> frozenset[Form]:
        """See `Evaluator`."""
        return frozenset({Form.OBJECTS} if self._detector is None else {Form.OBJECTS, Form.IMAGE})

    @property
    def takes_images(self) -> bool:
        """See `Evaluator`."""
        return Form.IMAGE in self.forms

    @property
    def input_size(self) -> tuple[int, int] | None:
        """See `Evaluator`: a detector takes images as they are."""
        return None

    @property
    def encoding_dim(self) -> int:
        """See `Evaluator`."""
        return BUCKETS * sum(columns * rows for columns, rows in GRIDS)

    @property
    def weights_sha256(self) -> str | None:
        """See `Evaluator`: layouts are of objects, whoever found them."""
        return None

    @property
    def largest_batch(self) -> int:
        """See `Evaluator`."""
        return 1

    def load(self) -> None:
        """See `Evaluator`."""
        if self._detector is not None:
            self._detector.load()

    def prepare(self, image: Image) -> Image:
        """See `Evaluator`."""
        self._check((image,))
        return image

    def encode(self, images: Sequence[Image | Scene]) -> NDArray[np.float32]:
        """See `Evaluator`; a scene without objects is all zeros."""
        layouts = [layout(self._objects(seen)) for seen in images]
        return np.stack(layouts) if layouts else np.empty((0, self.encoding_dim), np.float32)

    def _objects(self, seen: Image | Scene) -> Objects:
        if isinstance(seen, Scene) and seen.objects is not None:
            return seen.objects
        image = seen.image if isinstance(seen, Scene) else seen
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
        across, along = _shared_out((left + right) / 2, columns), _shared_out((top + bottom) / 2, rows)
        shares = weight[:, np.newaxis, np.newaxis] * along[:, :, np.newaxis] * across[:, np.newaxis, :]
        np.add.at(cells.transpose(2, 0, 1), bucket, shares)
        parts.append(cells.ravel())
    total = np.sqrt(np.concatenate(parts))
    # Rounded, so that a file holds it in half the bytes
    return np.asarray(total / max(float(np.linalg.norm(total)), 1e-12)).astype(np.float16).astype(np.float32)


def _shared_out(middle: NDArray[np.float64], n_cells: int) -> NDArray[np.float64]:
    """[n, cells] how much of an object each of a row of cells gets: the two nearest share it."""
    at = np.clip(middle * n_cells - 0.5, 0, n_cells - 1)
    return np.asarray(np.clip(1 - np.abs(np.arange(n_cells) - at[:, np.newaxis]), 0, None))
