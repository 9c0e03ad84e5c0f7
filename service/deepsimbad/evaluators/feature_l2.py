"""L2 between image features, the paper's own system (II-A): an embedded extractor or ready encodings."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import InvalidEncodingError, InvalidImageError, UnsupportedMediaTypeError
from deepsimbad.evaluators.base import LandmarkModel, Observation
from deepsimbad.evaluators.extractors.base import Extractor
from deepsimbad.evaluators.registry import DEFAULT_EXTRACTOR, ExtractorName, extractor_class

_BLOCK_ROWS = 1024  # bounds the float64 copy of the encodings to 32 MiB at d = 4,096


class FeatureL2:
    """Dissimilarity = squared L2 between encodings.

    Args:
        extractor: Name of an embedded extractor, or `none` for ready encodings alone.
    """

    def __init__(self, extractor: str = DEFAULT_EXTRACTOR.value) -> None:
        make = extractor_class(ExtractorName(extractor))
        self._extractor: Extractor | None = None if make is None else make()

    @property
    def input_size(self) -> tuple[int, int] | None:
        """(width, height) the extractor works at; None without one."""
        return None if self._extractor is None else self._extractor.input_size

    @property
    def encoding_dim(self) -> int | None:
        """Length of the extractor's encodings; None (any one length) without one."""
        return None if self._extractor is None else self._extractor.encoding_dim

    def encode(self, observations: Sequence[Observation]) -> NDArray[np.float32]:
        """See `Evaluator.encode`."""
        if self._extractor is None:
            raise UnsupportedMediaTypeError(
                "this domain has no extractor and takes ready encodings alone", allowed=["application/json"]
            )
        encodings = np.empty((len(observations), self._extractor.encoding_dim), np.float32)
        for row, image in zip(encodings, observations, strict=True):
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
                raise InvalidImageError(f"an image is [height, width, 3] uint8, not {list(image.shape)} {image.dtype}")
            row[:] = self._extractor(image)
        return encodings

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
        """See `Evaluator.check_model`."""
        prototypes = model.get("prototypes")
        if prototypes is None or prototypes.ndim != 2 or len(prototypes) != n_landmarks:
            has = "none" if prototypes is None else list(prototypes.shape)
            raise InvalidEncodingError(f"{n_landmarks} landmarks have prototypes [{n_landmarks}, d], not {has}")
        self.fit_landmarks(np.asarray(prototypes, np.float32))

    def dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """See `Evaluator.dissimilarities`: [n, r] squared L2.

        Computed in float64, because |a|² + |b|² - 2ab cancels badly in float32 and its rounding depends on how
        many rows are multiplied at once: an image must get the same ranks alone and in a batch.
        """
        prototypes = np.asarray(model["prototypes"], np.float64)
        if encodings.ndim != 2 or encodings.shape[1] != prototypes.shape[1]:
            raise InvalidEncodingError(
                f"an encoding of {encodings.shape[-1]} numbers cannot be compared with landmarks of "
                f"{prototypes.shape[1]}: they come from another encoder",
                encoding_dim=prototypes.shape[1],
            )
        squared = np.einsum("ij,ij->i", prototypes, prototypes)
        answer = np.empty((len(encodings), len(prototypes)), np.float32)
        for first in range(0, len(encodings), _BLOCK_ROWS):
            rows = encodings[first : first + _BLOCK_ROWS].astype(np.float64)
            with np.errstate(over="ignore", invalid="ignore"):
                block = rows @ prototypes.T
                block *= -2.0
                block += squared
                block += np.einsum("ij,ij->i", rows, rows)[:, None]
                answer[first : first + _BLOCK_ROWS] = np.maximum(block, 0.0)
        if not np.isfinite(answer).all():
            raise InvalidEncodingError("an encoding holds NaN, infinity or numbers too large to compare")
        return answer
