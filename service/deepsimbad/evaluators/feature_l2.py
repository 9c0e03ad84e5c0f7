"""L2 between image features, the paper's own system (II-A): an extractor or ready encodings."""

import threading
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.composed import Moments, described, is_composed
from deepsimbad.errors import InvalidEncodingError, InvalidImageError, UnsupportedMediaTypeError
from deepsimbad.evaluators.base import Image, LandmarkModel, named_lack_of_memory
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.extractors.base import Extractor
from deepsimbad.evaluators.registry import ExtractorName, make_extractor

_SCENES_AT_ONCE = 16  # half a megabyte at d = 8,064, which stays in the cache
_NUMBERS_A_SUM = 256
_MOST_DEVIATIONS = 1e12  # from what is usual; the square of more has no place in float32


class FeatureL2:
    """Dissimilarity = squared L2 between encodings.

    Args:
        extractor: What makes encodings of images, by its name in a configuration; `none`: ready encodings alone.
        compute: How a network is computed; None: by the defaults.
    """

    def __init__(self, extractor: str, compute: Compute | None = None) -> None:
        self._name, self._compute = extractor, compute or Compute()
        self._loading = threading.Lock()
        self._loaded: Extractor | None = None

    @property
    def takes_images(self) -> bool:
        """See `Evaluator`."""
        return self._name != ExtractorName.NONE

    @property
    def input_size(self) -> tuple[int, int] | None:
        """(width, height) the extractor works at; None where it takes images as they are, or there is none."""
        return self._extractor.input_size if self.takes_images else None

    @property
    def encoding_dim(self) -> int | None:
        """Length of the extractor's encodings; None (any one length) without one."""
        return self._extractor.encoding_dim if self.takes_images else None

    @property
    def weights_sha256(self) -> str | None:
        """Of the extractor's weights; None without any."""
        return self._extractor.weights_sha256 if self.takes_images else None

    @property
    def largest_batch(self) -> int:
        """See `Evaluator`."""
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
        """See `Evaluator.prepare`."""
        self._check((image,))
        with named_lack_of_memory("prepare"):
            return self._extractor.prepare(image)

    def encode(self, images: Sequence[Image]) -> NDArray[np.float32]:
        """See `Evaluator.encode`."""
        self._check(images)
        with named_lack_of_memory("encode"):
            return self._extractor.encode(images)

    def _check(self, images: Sequence[Image]) -> None:
        if not self.takes_images:
            raise UnsupportedMediaTypeError(
                "this domain has no extractor and takes ready encodings alone", allowed=["application/json"]
            )
        for image in images:
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
                raise InvalidImageError(f"an image is [height, width, 3] uint8, not {list(image.shape)} {image.dtype}")

    def fit_landmarks(self, encodings: NDArray[np.float32]) -> LandmarkModel:
        """See `Evaluator.fit_landmarks`: the landmarks' encodings are the model."""
        prototypes = np.array(encodings, np.float32, order="C")
        if prototypes.ndim != 2 or prototypes.size == 0:
            raise InvalidEncodingError(f"landmark encodings are [r, d], not {list(prototypes.shape)}")
        if not np.isfinite(prototypes).all():
            raise InvalidEncodingError("a landmark's encoding holds NaN or infinity")
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
            usual, projection = model["usual"], model.get("projection")
            (k,), d = prototypes.shape[1:], usual.shape[-1]
            if usual.shape != (2, d) or (projection.shape if projection is not None else (k, k)) != (d, k):
                raise InvalidEncodingError(f"landmarks [{n_landmarks}, {k}] with usual {usual.shape} fit no projection")
            if not all(np.isfinite(array).all() for array in (usual, projection) if array is not None):
                raise InvalidEncodingError("a landmark model holds NaN or infinity")

    def dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """See `Evaluator.dissimilarities`: [n, r] squared L2, of a composed model between unit vectors."""
        prototypes = np.ascontiguousarray(model["prototypes"], np.float32)
        if is_composed(model):
            return _between_units(encodings, model, prototypes)
        if encodings.ndim != 2 or encodings.shape[1] != prototypes.shape[1]:
            raise InvalidEncodingError(
                f"an encoding of {encodings.shape[-1]} numbers cannot be compared with landmarks of "
                f"{prototypes.shape[1]}: they come from another encoder",
                encoding_dim=prototypes.shape[1],
            )
        answer = squared_distances(np.ascontiguousarray(encodings, np.float32), prototypes)
        if not np.isfinite(answer).all():
            raise InvalidEncodingError("an encoding holds NaN, infinity or numbers too large to compare")
        return answer


def _between_units(
    encodings: NDArray[np.float32], model: LandmarkModel, prototypes: NDArray[np.float32]
) -> NDArray[np.float32]:
    usual = np.asarray(model["usual"], np.float32)
    if encodings.ndim != 2 or encodings.shape[1] != usual.shape[1]:
        raise InvalidEncodingError(
            f"an encoding of {encodings.shape[-1]} numbers cannot be compared with landmarks of {usual.shape[1]}: they "
            "come from another encoder",
            encoding_dim=usual.shape[1],
        )
    moments = Moments.from_mean_std(usual)
    farthest = np.maximum(encodings.max(axis=0) - moments.mean, moments.mean - encodings.min(axis=0))
    if not (farthest <= _MOST_DEVIATIONS * moments.std).all():
        raise InvalidEncodingError("an encoding holds NaN, infinity or numbers too large to compare")
    projection = np.asarray(model["projection"], np.float32) if "projection" in model else None
    u = described(encodings, moments, projection)
    return np.asarray(np.clip(2 - 2 * (u @ prototypes.T), 0, 4), np.float32)


@njit(cache=True, nogil=True)
def squared_distances(scenes: NDArray[np.float32], landmarks: NDArray[np.float32]) -> NDArray[np.float32]:
    """[n, r] squared L2 between [n, d] and [r, d], summed from differences.

    Not by a matrix product: |a|² + |b|² - 2ab cancels badly in float32, and rounds differently with the number of rows,
    where an image must get the same ranks alone and in a batch. It is no slower than one in float64 either.
    """
    n_numbers = scenes.shape[1]
    answer = np.empty((len(scenes), len(landmarks)), np.float32)
    for first in range(0, len(scenes), _SCENES_AT_ONCE):
        for landmark in range(len(landmarks)):
            for scene in range(first, min(first + _SCENES_AT_ONCE, len(scenes))):
                total = np.float64(0)
                for start in range(0, n_numbers, _NUMBERS_A_SUM):  # short sums, for which float32 is enough
                    part = slice(start, start + _NUMBERS_A_SUM)
                    total += _squared_distance(scenes[scene, part], landmarks[landmark, part])
                answer[scene, landmark] = total
    return answer


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _squared_distance(first: NDArray[np.float32], second: NDArray[np.float32]) -> np.float32:
    total = np.float32(0)
    for k in range(first.size):
        apart = first[k] - second[k]
        total += apart * apart
    return total
