"""What fitted evaluators of images share: a frozen extractor gives one encoding a frame, as for `feature_l2`.

They compare unit vectors of its encodings, standardised and projected (`core.composed`): landmarks by what is usual on
their own drive, views by what is usual on every drive that is known.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.composed import Moments, described, is_composed, principal_directions
from deepsimbad.errors import InvalidEncodingError, TooFewToFitError
from deepsimbad.evaluators.base import Fitting, LandmarkModel, Lesson
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.feature_l2 import FeatureL2, checked_encodings
from deepsimbad.evaluators.lessons import UnitLesson
from deepsimbad.evaluators.space import OwnDissimilarities, check_units, check_usable

_BESIDE = 0.3  # of the variance of encodings: what dissimilarities count beside them where `composed` compares
LEAST_FRAMES = 10  # of the drive that landmarks are chosen from: ten stretches of route

Axes: TypeAlias = Mapping[str, tuple[str, ...]]
"""Of fitted arrays by name: r, d, k, or another length that is the same everywhere; `two` is 2, `one` 1."""


class Trunk(OwnDissimilarities, FeatureL2):
    """Images and their encodings as of a `FeatureL2`; `kind` is the prefix of the arrays that are fitted."""

    kind: ClassVar[str]
    axes: ClassVar[Axes]

    def __init__(self, extractor: str, compute: Compute | None = None) -> None:
        super().__init__(extractor, compute)
        self.fitting = Fitting.IMAGES if self.takes_images else Fitting.ENCODINGS  # ready encodings have no images

    def units(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """[n, k] unit vectors of scenes; raises InvalidEncodingError."""
        usual = np.asarray(model[f"{self.kind}_usual"], np.float32)
        if encodings.ndim != 2 or encodings.shape[1] != usual.shape[1]:
            raise InvalidEncodingError(
                f"an encoding of {encodings.shape[-1]} numbers cannot be compared by a model fitted to "
                f"{usual.shape[1]}: they come from another encoder",
                encoding_dim=usual.shape[1],
            )
        moments = Moments.from_mean_std(usual)
        check_usable(encodings, moments)
        projection = model.get(f"{self.kind}_projection")
        return described(encodings, moments, None if projection is None else np.asarray(projection, np.float32))

    def compared(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """See `Evaluator.compared`: encodings, and beside them what was fitted, where that is more than plain L2."""
        beside = model.get(f"{self.kind}_beside")
        if beside is None:  # a map of before: dissimilarities alone
            return self.own_dissimilarities(encodings, model)
        factor = float(np.asarray(beside, np.float32)[0])
        if factor == 0:
            return encodings
        return np.hstack([encodings, np.float32(factor) * self.own_dissimilarities(encodings, model)])

    def beside(self, lesson: Lesson, model: LandmarkModel) -> NDArray[np.float32]:
        """[1] what dissimilarities are multiplied by beside encodings, which count for more."""
        own = self.own_dissimilarities(checked_encodings(lesson.encodings), model)
        variance = [float(each.var(axis=0, dtype=np.float64).sum()) for each in (lesson.encodings, own)]
        return np.array([np.sqrt(_BESIDE * variance[0] / max(variance[1], 1e-12))], np.float32)

    def unit_lesson(self, lesson: Lesson) -> tuple[dict[str, NDArray[Any]], UnitLesson]:
        """The arrays that make unit vectors, and all of a lesson in such.

        Queries are the second drive's frames where there are any, and augmented views of landmarks; without either,
        each frame's neighbours.

        Raises:
            TooFewToFitError: There are fewer frames than anything could be learnt from.
        """
        own = checked_encodings(lesson.encodings)
        if len(own) < LEAST_FRAMES or len(lesson.landmarks) < 2:
            raise TooFewToFitError(
                f"{self.kind} is fitted to {LEAST_FRAMES} frames and 2 landmarks at least, not to {len(own)} and "
                f"{len(lesson.landmarks)}: give a longer landmark drive, or use feature_l2",
                n_frames=len(own),
                minimum=LEAST_FRAMES,
            )
        drives = (own,) if lesson.other is None else (own, lesson.other)
        projection, usual = principal_directions(*drives), Moments.of(*drives)
        model: dict[str, NDArray[Any]] = {f"{self.kind}_usual": usual.mean_std()}
        if projection is not None:
            model[f"{self.kind}_projection"] = projection
        u = described(own, Moments.of(own), projection)
        position_m = np.arange(len(own), dtype=np.float64) if lesson.position_m is None else lesson.position_m
        step_m = float(np.median(np.abs(np.diff(position_m)))) + 1e-9
        queries, true, weight, lit = [], [], [], []
        if lesson.other is not None and lesson.places.size:
            queries.append(described(lesson.other[lesson.places[:, 1]], usual, projection))
            true.append(lesson.places[:, 0])
            weight.append(np.ones(len(lesson.places), np.float32))
            lit.append(np.zeros(len(lesson.places), np.bool_))
        if lesson.views is not None:
            r, a, d = lesson.views.shape
            queries.append(described(lesson.views.reshape(r * a, d), usual, projection))
            true.append(np.repeat(lesson.landmarks, a))
            weight.append(np.full(r * a, 1 / a, np.float32))
            lit.append(np.tile(np.arange(a) >= a // 2, r))
        if not queries:
            frames = np.arange(1, len(own))
            queries += [u[frames], u[frames - 1]]
            true += [frames - 1, frames]
            weight += [np.ones(len(frames), np.float32)] * 2
            lit += [np.ones(len(frames), np.bool_)] * 2
        n_queries, n_second = sum(map(len, queries)), len(lesson.places) if lesson.other is not None else 0
        is_judge = np.arange(n_queries) < n_second if n_second else np.concatenate(lit)
        return model, UnitLesson(
            u,
            lesson.landmarks,
            np.concatenate(queries),
            np.concatenate(true).astype(np.int64),
            np.concatenate(weight),
            is_judge,
            n_second > 0,
            position_m,
            step_m,
        )

    def check_model(self, model: LandmarkModel, n_landmarks: int) -> None:
        """See `Evaluator.check_model`: every array is there, finite, and its axes agree."""
        lengths = {"r": n_landmarks, "two": 2, "one": 1}
        for name, axes in self.axes.items():
            array = model.get(f"{self.kind}_{name}")
            if array is None and name == "projection":
                lengths["k"] = lengths["d"]
                continue
            if array is None and name == "beside":
                continue
            if array is None:
                has = ", ".join(sorted(model)) or "none"
                raise InvalidEncodingError(
                    f"this is no landmark model of {self.kind}, which has {self.kind}_{name}: it has {has}; map anew"
                )
            fits = array.ndim == len(axes) and all(
                lengths.setdefault(axis, length) == length for axis, length in zip(axes, array.shape, strict=True)
            )
            if not fits or not np.isfinite(array).all():
                raise InvalidEncodingError(f"{self.kind}_{name} {list(array.shape)} does not fit the landmark model")
        if is_composed(model):
            check_units(model, n_landmarks)
