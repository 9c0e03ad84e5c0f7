"""What fitted evaluators of images share: a frozen extractor gives one encoding a frame, as for `feature_l2`.

They compare unit vectors of its encodings, standardised and projected (`core.composed`): landmarks by what is usual on
their own drive, views by what is usual on every drive that is known.

A fitted dissimilarity is judged on places along the route that training did not see, beside plain L2 of the same unit
vectors: on views of the second season, or where one alone is known on relit views, having learnt from views that were
moved: another light, which training did not see, stands for the season to come.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.composed import Moments, described, is_composed, principal_directions
from deepsimbad.core.metrics import mean_interval
from deepsimbad.errors import InvalidEncodingError, TooFewToFitError
from deepsimbad.evaluators.base import Fitting, LandmarkModel, Lesson
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.feature_l2 import FeatureL2, checked_encodings
from deepsimbad.evaluators.space import OwnDissimilarities, check_units, squared_between, units_by

_BESIDE = 0.3  # of the variance of encodings: what dissimilarities count beside them where `composed` compares
LEAST_FRAMES = 10  # of the drive that landmarks are chosen from: ten stretches of route

_BLOCKS, _VALIDATION, _TEST = 10, (2, 7), (4, 9)  # neighbouring frames are alike, so whole stretches are held out
_MOST_SCORED = 256  # queries
_NEAR_STEPS = 3.0

Axes: TypeAlias = Mapping[str, tuple[str, ...]]
"""Of fitted arrays by name: r, d, k, or another length that is the same everywhere; `two` is 2, `one` 1."""

Measure = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Dissimilarities [q, r] of unit vectors [q, k] to the landmarks."""


@dataclass(frozen=True)
class UnitLesson:
    """A lesson in unit vectors [..., k]."""

    own: NDArray[np.float32]  # [m, k] of the drive that landmarks were chosen from, by its own statistics
    landmarks: NDArray[np.int64]  # [r] which of them they are
    queries: NDArray[np.float32]  # [q, k] views whose place is known, as they would be seen live
    true: NDArray[np.int64]  # [q] which of `own` sees that place
    weight: NDArray[np.float32]  # [q] what a query counts, so that many augmented views do not outweigh a second season
    is_judge: NDArray[np.bool_]  # [q] views that alone tell how good a model is: another season's, or else relit ones
    has_second: bool  # whether another season is known
    position_m: NDArray[np.float64]  # [m]
    step_m: float  # how far neighbouring frames are apart, usually

    @property
    def is_lesson(self) -> NDArray[np.bool_]:
        """[q] views that may be learnt from: all, but of one season none that judges, where there are others."""
        return np.full(len(self.queries), True) if self.has_second or self.is_judge.all() else ~self.is_judge

    @property
    def near_m(self) -> float:
        """Frames within it may see the same place."""
        return _NEAR_STEPS * self.step_m

    @property
    def prototypes(self) -> NDArray[np.float32]:
        """[r, k] the landmarks."""
        return self.own[self.landmarks]

    def is_near(self, frames: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether frames of `own` may see the same place as others, of shapes that go together."""
        return np.asarray(np.abs(self.position_m[frames] - self.position_m[others]) <= self.near_m)


@dataclass(frozen=True)
class Split:
    """Queries by what they are for, and the frames that training may take for wrong answers."""

    train: NDArray[np.int64]
    validation: NDArray[np.int64]  # tells when to stop
    test: NDArray[np.int64]  # tells how good it is
    wrong: NDArray[np.int64]  # frames of `own` outside the stretches of the test

    @classmethod
    def of(cls, units: UnitLesson, seed: int) -> Self:
        """By the stretch of route that a query's place lies in."""
        rng, m = np.random.default_rng(seed), len(units.own)
        block = np.arange(m) * _BLOCKS // m
        of_query = block[units.true]
        validation, test = (
            np.sort(rng.permutation(np.flatnonzero(np.isin(of_query, blocks) & units.is_judge))[:_MOST_SCORED])
            for blocks in (_VALIDATION, _TEST)
        )
        train = np.flatnonzero(~np.isin(of_query, (*_VALIDATION, *_TEST)) & units.is_lesson)
        return cls(train, validation, test, np.flatnonzero(~np.isin(block, _TEST)))


@dataclass(frozen=True)
class PairScores:
    """How well a dissimilarity tells the landmarks of a query's place from all others."""

    anr: float  # %: of the others, how many come before the best-placed landmark of the place
    auc: float  # chance that a pair of one place is nearer than a pair of two
    ranks: NDArray[np.float64]  # [queries whose place has a landmark] %, whose mean is `anr`

    @classmethod
    def of(cls, units: UnitLesson, rows: NDArray[np.int64], measure: Measure) -> Self:
        """Of some queries; NaN where no place of them has a landmark, or all have."""
        near = units.is_near(units.true[rows][:, np.newaxis], units.landmarks)
        asked = near.any(axis=1) & ~near.all(axis=1)
        if not asked.any():
            return cls(float("nan"), float("nan"), np.empty(0))
        near, apart = near[asked], measure(units.queries[rows[asked]])
        best = np.where(near, apart, np.inf).min(axis=1, keepdims=True)
        before = ((apart < best) & ~near).sum(axis=1) + 0.5 * ((apart == best) & ~near).sum(axis=1)
        far = np.sort(apart[~near])
        places = np.searchsorted(far, apart[near], "left") + np.searchsorted(far, apart[near], "right")
        ranks = 100 * before / (~near).sum(axis=1)
        return cls(float(ranks.mean()), 1 - float(places.mean()) / (2 * far.size), ranks)

    def as_dict(self) -> dict[str, Any]:
        """The JSON form; null where nothing was scored."""
        figures = {"anr": self.anr, "auc": self.auc}
        return {
            **{name: value if np.isfinite(value) else None for name, value in figures.items()},
            "n_queries": self.ranks.size,
        }


@dataclass(frozen=True)
class Verdict:
    """Whether a fitted model does better than plain L2 on queries that training did not see."""

    is_better: bool  # with one season known, by more than chance explains
    scores: dict[str, Any]  # both, for metrics
    shown: str

    @classmethod
    def of(cls, kind: str, units: UnitLesson, rows: NDArray[np.int64], measure: Measure) -> Self:
        """Of some queries."""
        fitted = PairScores.of(units, rows, measure)
        plain = PairScores.of(units, rows, lambda x: squared_between(x, units.prototypes))
        is_better = fitted.anr < plain.anr
        if is_better and not units.has_second:
            is_better = mean_interval(fitted.ranks - plain.ranks, 0)[1] < 0
        pairs = "held-out pairs" if units.has_second else "held-out pairs of one season"
        shown = (
            f"on {plain.ranks.size} {pairs} the fitted model ranks the right landmark at {fitted.anr:.2f} % and plain "
            f"L2 at {plain.anr:.2f} %"
        )
        return cls(is_better, {"held_out": {kind: fitted.as_dict(), "l2": plain.as_dict()}}, shown)


def no_better(kind: str, verdict: Verdict) -> str:
    """The warning of a model that went back to plain L2."""
    return f"{kind}_no_better: {verdict.shown}: it stays at plain L2, and feature_l2 does as well and costs less"


class Trunk(OwnDissimilarities, FeatureL2):
    """Images and their encodings as of a `FeatureL2`; `kind` is the prefix of the arrays that are fitted."""

    kind: ClassVar[str]
    axes: ClassVar[Axes]

    def __init__(self, extractor: str, compute: Compute | None = None) -> None:
        super().__init__(extractor, compute)
        self.fitting = Fitting.IMAGES if self.takes_images else Fitting.ENCODINGS  # ready encodings have no images

    def units(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """[n, k] unit vectors of scenes; raises InvalidEncodingError."""
        arrays = model[f"{self.kind}_usual"], model.get(f"{self.kind}_projection")
        return units_by(encodings, *arrays, compared="by a model fitted to")

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
        views = np.concatenate(queries), np.concatenate(true).astype(np.int64), np.concatenate(weight)
        return model, UnitLesson(u, lesson.landmarks, *views, is_judge, n_second > 0, position_m, step_m)

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
