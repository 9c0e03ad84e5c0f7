"""Where `composed` compares: unit vectors of encodings, or of dissimilarities to all landmarks (II-A)."""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.composed import Moments, described, is_composed
from deepsimbad.errors import InvalidEncodingError
from deepsimbad.evaluators.base import Evaluator, LandmarkModel

_MOST_DEVIATIONS = 1e12  # from what is usual; the square of more has no place in float32


class OwnDissimilarities(ABC):
    """An evaluator whose dissimilarity is no squared L2 of encodings; the composed arrays lie beside its own ones."""

    is_squared_l2 = False

    @abstractmethod
    def own_dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """[n, r] float32 to the fitted landmarks, at least 0 and finite; raises as `Evaluator.dissimilarities`."""

    def dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """See `Evaluator.dissimilarities`; of a composed model between unit vectors in the space of its own."""
        if is_composed(model):
            return between_units(self.compared(encodings, model), model)
        return self.own_dissimilarities(encodings, model)

    def compared(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        return self.own_dissimilarities(encodings, model)


def seen(
    evaluator: Evaluator, encodings: NDArray[np.float32], model: LandmarkModel
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Dissimilarities [n, r] of scenes, and what stands for their encodings where the map compares them."""
    if not is_composed(model):
        return evaluator.dissimilarities(encodings, model), encodings
    u, vectors = compared_units(evaluator, encodings, model)
    return squared_between(u, np.asarray(model["prototypes"], np.float32)), vectors


def compared_units(
    evaluator: Evaluator, encodings: NDArray[np.float32], model: LandmarkModel
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """u [n, k] of scenes by what is usual on a composed map, and what stands for their encodings there."""
    vectors = evaluator.compared(encodings, model)
    return unit_vectors(vectors if vectors is encodings else as_usual(vectors, model), model), vectors


def as_usual(vectors: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
    """Vectors [n, k] to compare, with what is usual where a number was not told (NaN)."""
    return np.where(np.isnan(vectors), np.asarray(model["usual"], np.float32)[0], vectors)


def between_units(vectors: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
    """[n, r] squared distances between unit vectors of what is compared, [n, k], and a composed model's landmarks."""
    return squared_between(unit_vectors(vectors, model), np.asarray(model["prototypes"], np.float32))


def unit_vectors(vectors: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
    """[n, k] u of what is compared, by what is usual on the map; raises InvalidEncodingError."""
    return units_by(vectors, model["usual"], model.get("projection"))


def units_by(
    vectors: NDArray[np.float32],
    usual: NDArray[np.generic],
    projection: NDArray[np.generic] | None,
    compared: str = "with landmarks of",
) -> NDArray[np.float32]:
    """[n, k] u of vectors [n, d], by what is usual [2, d]; raises InvalidEncodingError as `check_length`."""
    check_length(vectors, usual.shape[1], compared)
    moments = Moments.from_mean_std(np.asarray(usual, np.float32))
    check_usable(vectors, moments)
    return described(vectors, moments, None if projection is None else np.asarray(projection, np.float32))


def check_length(encodings: NDArray[np.float32], d: int, compared: str = "with landmarks of") -> None:
    """Raise InvalidEncodingError where encodings are not [n, d], which says how they are `compared`."""
    if encodings.ndim != 2 or encodings.shape[1] != d:
        raise InvalidEncodingError(
            f"an encoding of {encodings.shape[-1]} numbers cannot be compared {compared} {d}: they come from another "
            "encoder",
            encoding_dim=d,
        )


def squared_between(u: NDArray[np.float32], prototypes: NDArray[np.float32]) -> NDArray[np.float32]:
    """[..., r] squared distances between unit vectors [..., k] and landmarks [r, k], by their products."""
    return np.asarray(np.clip(2 - 2 * (u @ prototypes.T), 0, 4), np.float32)


def check_usable(vectors: NDArray[np.float32], usual: Moments) -> None:
    """Raise InvalidEncodingError where vectors [n, k] hold NaN, infinity or what has no square in float32."""
    farthest = np.maximum(vectors.max(axis=0) - usual.mean, usual.mean - vectors.min(axis=0))
    if not (farthest <= _MOST_DEVIATIONS * usual.std).all():
        raise InvalidEncodingError("an encoding holds NaN, infinity or numbers too large to compare")


def check_units(model: LandmarkModel, n_landmarks: int) -> None:
    """Raise InvalidEncodingError where the composed arrays of a model do not belong together."""
    prototypes, usual, projection = model["prototypes"], model["usual"], model.get("projection")
    k, d = prototypes.shape[-1], usual.shape[-1]
    fits = prototypes.shape == (n_landmarks, k) and usual.shape == (2, d)
    if not fits or (projection.shape if projection is not None else (k, k)) != (d, k):
        raise InvalidEncodingError(f"landmarks [{n_landmarks}, {k}] with usual {usual.shape} fit no projection")
    if not all(np.isfinite(array).all() for array in (prototypes, usual, projection) if array is not None):
        raise InvalidEncodingError("a landmark model holds NaN or infinity")
