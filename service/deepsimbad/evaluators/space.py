"""The space in which `composed` compares: unit vectors of encodings, or of dissimilarities to all landmarks (II-A)."""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.composed import Moments, described, is_composed
from deepsimbad.errors import InvalidEncodingError
from deepsimbad.evaluators.base import Evaluator, LandmarkModel

_MOST_DEVIATIONS = 1e12  # from the mean; the square of more overflows float32


class OwnDissimilarities(ABC):
    """An evaluator whose dissimilarity is no squared L2 of encodings; the composed arrays lie beside its own ones."""

    is_squared_l2 = False

    @abstractmethod
    def own_dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """[n, r] float32 to the fitted landmarks, at least 0 and finite; raises as `Evaluator.dissimilarities`."""

    def dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """See `Evaluator.dissimilarities`; for a composed model, between unit vectors of its comparison vectors."""
        if is_composed(model):
            return between_units(self.comparison_vectors(encodings, model), model)
        return self.own_dissimilarities(encodings, model)

    def comparison_vectors(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        return self.own_dissimilarities(encodings, model)


def dissimilarities_and_vectors(
    evaluator: Evaluator, encodings: NDArray[np.float32], model: LandmarkModel
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Dissimilarities [n, r] of scenes, and the vectors [n, k] by which the map compares them."""
    if not is_composed(model):
        return evaluator.dissimilarities(encodings, model), encodings
    u, vectors = compared_units(evaluator, encodings, model)
    return squared_between(u, np.asarray(model["prototypes"], np.float32)), vectors


def compared_units(
    evaluator: Evaluator, encodings: NDArray[np.float32], model: LandmarkModel
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """u [n, k] of scenes by a composed map's mean and deviation, and the vectors [n, d] that they are made of."""
    vectors = evaluator.comparison_vectors(encodings, model)
    return unit_vectors(vectors if vectors is encodings else as_usual(vectors, model), model), vectors


def as_usual(vectors: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
    """Comparison vectors [n, k], with the map's mean in place of NaN, the numbers of a half that a view lacks."""
    return np.where(np.isnan(vectors), np.asarray(model["usual"], np.float32)[0], vectors)


def between_units(vectors: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
    """[n, r] squared L2 between unit vectors of comparison vectors [n, d] and a composed model's landmarks."""
    return squared_between(unit_vectors(vectors, model), np.asarray(model["prototypes"], np.float32))


def unit_vectors(vectors: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
    """[n, k] u of comparison vectors [n, d], by the map's mean and deviation; raises InvalidEncodingError."""
    return units_by(vectors, model["usual"], model.get("projection"))


def units_by(
    vectors: NDArray[np.float32],
    mean_std: NDArray[np.generic],
    projection: NDArray[np.generic] | None,
    comparison: str = "with landmarks of",
) -> NDArray[np.float32]:
    """[n, k] u of vectors [n, d], by mean and deviation [2, d]; raises InvalidEncodingError as `check_length`."""
    check_length(vectors, mean_std.shape[1], comparison)
    moments = Moments.from_mean_std(np.asarray(mean_std, np.float32))
    check_usable(vectors, moments)
    return described(vectors, moments, None if projection is None else np.asarray(projection, np.float32))


def check_length(encodings: NDArray[np.float32], d: int, comparison: str = "with landmarks of") -> None:
    """Raise InvalidEncodingError where encodings are not [n, d]; `comparison` completes its message."""
    if encodings.ndim != 2 or encodings.shape[1] != d:
        raise InvalidEncodingError(
            f"an encoding of {encodings.shape[-1]} numbers cannot be compared {comparison} {d}: they come from another "
            "encoder",
            encoding_dim=d,
        )


def squared_between(u: NDArray[np.float32], prototypes: NDArray[np.float32]) -> NDArray[np.float32]:
    """[..., r] squared L2 between unit vectors [..., k] and landmarks [r, k], by their products."""
    return np.asarray(np.clip(2 - 2 * (u @ prototypes.T), 0, 4), np.float32)


def check_usable(vectors: NDArray[np.float32], moments: Moments) -> None:
    """Raise InvalidEncodingError where vectors [n, d] hold NaN, infinity or numbers whose square overflows float32."""
    farthest = np.maximum(vectors.max(axis=0) - moments.mean, moments.mean - vectors.min(axis=0))
    if not (farthest <= _MOST_DEVIATIONS * moments.std).all():
        raise InvalidEncodingError("an encoding holds NaN, infinity or numbers too large to compare")


def check_units(model: LandmarkModel, n_landmarks: int) -> None:
    """Raise InvalidEncodingError where the composed arrays of a model do not belong together."""
    prototypes, mean_std, projection = model["prototypes"], model["usual"], model.get("projection")
    k, d = prototypes.shape[-1], mean_std.shape[-1]
    fits = prototypes.shape == (n_landmarks, k) and mean_std.shape == (2, d)
    if not fits or (projection.shape if projection is not None else (k, k)) != (d, k):
        raise InvalidEncodingError(f"landmarks [{n_landmarks}, {k}] with usual {mean_std.shape} fit no projection")
    if not all(np.isfinite(array).all() for array in (prototypes, mean_std, projection) if array is not None):
        raise InvalidEncodingError("a landmark model holds NaN or infinity")
