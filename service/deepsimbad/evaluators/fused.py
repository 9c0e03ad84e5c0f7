"""Two evaluators of one domain: an encoding is both of theirs, side by side, and a view may bring one half alone.

A dissimilarity is the weighted mean of the halves' squared L2. Their weight is learnt with the landmarks, by how well
either half alone and both together find the places that the other drive saw; a half that a view lacks is all zeros, and
left out. Where `composed` compares, each half has directions of its own, of equal strength, and within-place whitening
weighs them; a half that a view lacks is taken as the mean, and does not enter live statistics.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.composed import is_composed
from deepsimbad.core.metrics import RetrievalScorer
from deepsimbad.errors import InvalidEncodingError
from deepsimbad.evaluators.base import Evaluator, Fitted, Fitting, Image, LandmarkModel, Lesson
from deepsimbad.evaluators.feature_l2 import FeatureL2, checked_encodings
from deepsimbad.evaluators.scenes import Form, Scene
from deepsimbad.evaluators.space import as_usual, between_units, squared_between

_WEIGHT = "fused_weight"
_TRIED = np.linspace(0, 1, 11)  # weights of the first half
_EVEN = 0.5
_NEAR_FRAMES = 2  # frames of a drive at most so far apart count as one place
_MOST_ASKED = 512  # frames of the other drive that the weight is learnt from


class Fused(FeatureL2):
    """Dissimilarity = weighted mean of the squared L2 of two halves, whose encodings are of unit length."""

    fitting = Fitting.ENCODINGS

    def __init__(self, halves: Sequence[Evaluator]) -> None:
        super().__init__("none")
        self._halves = tuple(halves)
        self.forms = frozenset[Form]().union(*(half.forms for half in self._halves))

    @property
    def input_size(self) -> tuple[int, int] | None:
        return next((half.input_size for half in self._halves if half.takes_images), None)

    @property
    def encoding_dim(self) -> int:
        return sum(self.halves)

    @property
    def halves(self) -> tuple[int, ...]:
        return tuple(half.encoding_dim or 0 for half in self._halves)

    @property
    def weights_sha256(self) -> str | None:
        digests = [half.weights_sha256 for half in self._halves if half.weights_sha256]
        return "+".join(digests) or None

    @property
    def largest_batch(self) -> int:
        return max(half.largest_batch for half in self._halves)

    def load(self) -> None:
        for half in self._halves:
            half.load()

    def prepare(self, image: Image) -> Image:
        image_half = next((half for half in self._halves if half.takes_images), self._halves[0])
        return image_half.prepare(image)

    def lacking(self, forms: frozenset[Form]) -> frozenset[Form]:
        return frozenset().union(*(half.forms for half in self._halves if not half.forms & forms))

    def encode(self, images: Sequence[Image | Scene]) -> NDArray[np.float32]:
        """See `Evaluator`; zeros take the place of a half that a view does not bring."""
        scenes = [observation if isinstance(observation, Scene) else Scene(image=observation) for observation in images]
        encodings, column = np.zeros((len(scenes), self.encoding_dim), np.float32), 0
        for half, width in zip(self._halves, self.halves, strict=True):
            rows = [row for row, scene in enumerate(scenes) if half.forms & scene.informative_forms]
            if rows:
                encodings[rows, column : column + width] = half.encode([scenes[row] for row in rows])
            column += width
        return encodings

    def fit(self, lesson: Lesson) -> Fitted:
        """See `Evaluator.fit`; the model is the landmarks and the weight of the first half."""
        encodings = checked_encodings(lesson.encodings)
        model = dict(self.fit_landmarks(encodings[lesson.landmarks]))
        weight, metrics = _EVEN, dict[str, Any]()
        if lesson.other is not None and len(lesson.places):
            rows = np.linspace(0, len(lesson.places) - 1, min(len(lesson.places), _MOST_ASKED)).astype(np.intp)
            true_frames, frames = lesson.places[rows].T
            halves = self._half_dissimilarities(lesson.other[frames], encodings)
            scores = {share: _anr(share * halves[0] + (1 - share) * halves[1], true_frames) for share in _TRIED}
            weight = float(min(scores, key=lambda share: scores[share]))
            metrics = {"weight": weight, "anr": {f"{share:.1f}": score for share, score in scores.items()}}
        return Fitted({**model, _WEIGHT: np.array([weight], np.float32)}, metrics)

    def check_model(self, model: LandmarkModel, n_landmarks: int) -> None:
        super().check_model(model, n_landmarks)
        weight = np.asarray(model.get(_WEIGHT, [_EVEN]), np.float32)
        if weight.shape != (1,) or not 0 <= weight[0] <= 1:
            raise InvalidEncodingError("the weight of a fused landmark model is one number within 0 and 1")

    def dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        if is_composed(model):
            return between_units(as_usual(self.comparison_vectors(encodings, model), model), model)
        super().dissimilarities(encodings, model)  # which refuses what cannot be compared
        share = float(np.asarray(model.get(_WEIGHT, [_EVEN]), np.float32)[0])
        first, second = self._half_dissimilarities(encodings, np.asarray(model["prototypes"], np.float32))
        has_first, has_second = (np.any(half, axis=1, keepdims=True) for half in self._split(encodings))
        mean = share * first + (1 - share) * second
        return np.asarray(np.where(has_first & has_second, mean, np.where(has_first, first, second)), np.float32)

    def comparison_vectors(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """See `Evaluator.comparison_vectors`; a half that a view lacks is NaN."""
        if not is_composed(model) or encodings.ndim != 2 or encodings.shape[1] != model["usual"].shape[1]:
            return encodings
        vectors = checked_encodings(encodings).copy()
        for half in self._split(vectors):
            half[~np.any(half, axis=1)] = np.nan
        return vectors

    def _split(self, encodings: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        column = self.halves[0]
        return encodings[:, :column], encodings[:, column:]

    def _half_dissimilarities(
        self, scenes: NDArray[np.float32], landmarks: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """[n, r] squared L2 of the first half, and of the second."""
        first, second = map(squared_between, self._split(scenes), self._split(landmarks))
        return first, second


def _anr(dissimilarities: NDArray[np.float32], true_frames: NDArray[np.int64]) -> float:
    """ANR in percent of queries by dissimilarities [n, m] to frames; `true_frames` [n] and neighbours are right."""
    scorer, frames = RetrievalScorer(), np.arange(dissimilarities.shape[1])
    for row, true_frame in zip(dissimilarities, true_frames.tolist(), strict=True):
        scorer.add(-row, np.flatnonzero(np.abs(frames - true_frame) <= _NEAR_FRAMES))
    return scorer.result().anr
