"""L2 between image features, the paper's own system (II-A): an extractor or ready encodings."""

import threading
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.composed import is_composed
from deepsimbad.errors import InvalidEncodingError, InvalidImageError, UnsupportedMediaTypeError
from deepsimbad.evaluators.base import Fitted, Fitting, Image, LandmarkModel, Lesson, named_lack_of_memory
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.extractors.base import Extractor
from deepsimbad.evaluators.registry import ExtractorName, make_extractor
from deepsimbad.evaluators.scenes import Form, Scene, picture_in
from deepsimbad.evaluators.space import between_units, check_length, check_units

_SCENES_AT_ONCE = 16  # half a megabyte at d = 8,064, which stays in the cache
_NUMBERS_A_SUM = 256


class FeatureL2:
    """Dissimilarity = squared L2 between encodings.

    Args:
        extractor: What makes encodings of images, by its name in a configuration; `none`: ready encodings alone.
        compute: How a network is computed; None: by the defaults.
    """

    fitting = Fitting.NOTHING
    is_squared_l2 = True

    def __init__(self, extractor: str, compute: Compute | None = None) -> None:
        self._name, self._compute = extractor, compute or Compute()
        self.forms = frozenset[Form]() if extractor == ExtractorName.NONE else frozenset({Form.IMAGE})
        self._loading = threading.Lock()
        self._loaded: Extractor | None = None

    def lacking(self, forms: frozenset[Form]) -> frozenset[Form]:  # noqa: ARG002
        return frozenset()

    @property
    def takes_images(self) -> bool:
        return Form.IMAGE in self.forms

    @property
    def input_size(self) -> tuple[int, int] | None:
        """(width, height) the extractor works at; None where it takes images as they are, or there is none."""
        return self._extractor.input_size if self.takes_images else None

    @property
    def encoding_dim(self) -> int | None:
        """Length of the extractor's encodings; None (any one length) without one."""
        return self._extractor.encoding_dim if self.takes_images else None

    @property
    def halves(self) -> tuple[int, ...]:
        return ()

    @property
    def weights_sha256(self) -> str | None:
        """See `Evaluator`; of the extractor, None without one."""
        return self._extractor.weights_sha256 if self.takes_images else None

    @property
    def largest_batch(self) -> int:
        return self._extractor.largest_batch if self.takes_images else 1

    def load(self) -> None:
        """See `Evaluator`: makes the extractor, and encodes one image so that nobody's first view waits for kernels."""
        if self.takes_images and self._loaded is None:
            self._extractor.encode([np.zeros((64, 64, 3), np.uint8)])

    @property
    def _extractor(self) -> Extractor:
        with self._loading:
            if self._loaded is None:
                self._loaded = make_extractor(self._name, self._compute)
            return self._loaded

    def prepare(self, image: Image) -> Image:
        self._check((image,))
        with named_lack_of_memory("prepare"):
            return self._extractor.prepare(image)

    def encode(self, images: Sequence[Image | Scene]) -> NDArray[np.float32]:
        pictures = [image for image in map(picture_in, images) if image is not None]
        self._check(pictures)
        with named_lack_of_memory("encode"):
            return self._extractor.encode(pictures)

    def _check(self, images: Sequence[Image]) -> None:
        if not self.takes_images:
            raise UnsupportedMediaTypeError(
                "this domain has no extractor and takes ready encodings alone", allowed=["application/json"]
            )
        for image in images:
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
                raise InvalidImageError(f"an image is [height, width, 3] uint8, not {list(image.shape)} {image.dtype}")

    def fit(self, lesson: Lesson) -> Fitted:
        return Fitted(self.fit_landmarks(checked_encodings(lesson.encodings)[lesson.landmarks]))

    def fit_landmarks(self, encodings: NDArray[np.float32]) -> LandmarkModel:
        """The landmarks' encodings [r, d] are the model; raises InvalidEncodingError."""
        prototypes = np.array(checked_encodings(encodings), np.float32, order="C")
        prototypes.setflags(write=False)
        return {"prototypes": prototypes}

    def check_model(self, model: LandmarkModel, n_landmarks: int) -> None:
        """See `Evaluator.check_model`; a composed model's prototypes are unit vectors."""
        prototypes = model.get("prototypes")
        if prototypes is None or prototypes.ndim != 2 or len(prototypes) != n_landmarks:
            has = "none" if prototypes is None else list(prototypes.shape)
            raise InvalidEncodingError(f"{n_landmarks} landmarks have prototypes [{n_landmarks}, d], not {has}")
        self.fit_landmarks(np.asarray(prototypes, np.float32))
        if is_composed(model):
            check_units(model, n_landmarks)

    def dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """See `Evaluator.dissimilarities`: [n, r] squared L2, of a composed model between unit vectors."""
        prototypes = np.ascontiguousarray(model["prototypes"], np.float32)
        if is_composed(model):
            return between_units(encodings, model)
        check_length(encodings, prototypes.shape[1])
        dissimilarities = squared_distances(np.ascontiguousarray(encodings, np.float32), prototypes)
        if not np.isfinite(dissimilarities).all():
            raise InvalidEncodingError("an encoding holds NaN, infinity or numbers too large to compare")
        return dissimilarities

    def comparison_vectors(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:  # noqa: ARG002
        return encodings


def checked_encodings(encodings: NDArray[np.float32]) -> NDArray[np.float32]:
    """Encodings of landmarks as they are; raises InvalidEncodingError unless they are [r >= 1, d] and finite."""
    if encodings.ndim != 2 or encodings.size == 0:
        raise InvalidEncodingError(f"landmark encodings are [r, d], not {list(encodings.shape)}")
    if not np.isfinite(encodings).all():
        raise InvalidEncodingError("a landmark's encoding holds NaN or infinity")
    return encodings


@njit(cache=True, nogil=True)
def squared_distances(scenes: NDArray[np.float32], landmarks: NDArray[np.float32]) -> NDArray[np.float32]:
    """[n, r] squared L2 between [n, d] and [r, d], summed from differences.

    Not by a matrix product: |a|² + |b|² - 2ab cancels badly in float32, and rounds differently with the number of rows,
    where an image must get the same ranks alone and in a batch. A product in float64 would be no faster.
    """
    n_numbers = scenes.shape[1]
    distances = np.empty((len(scenes), len(landmarks)), np.float32)
    for first in range(0, len(scenes), _SCENES_AT_ONCE):
        for landmark in range(len(landmarks)):
            for scene in range(first, min(first + _SCENES_AT_ONCE, len(scenes))):
                total = np.float64(0)
                for start in range(0, n_numbers, _NUMBERS_A_SUM):  # short sums, for which float32 is enough
                    part = slice(start, start + _NUMBERS_A_SUM)
                    total += _squared_distance(scenes[scene, part], landmarks[landmark, part])
                distances[scene, landmark] = total
    return distances


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _squared_distance(first: NDArray[np.float32], second: NDArray[np.float32]) -> np.float32:
    total = np.float32(0)
    for k in range(first.size):
        difference = first[k] - second[k]
        total += difference * difference
    return total
