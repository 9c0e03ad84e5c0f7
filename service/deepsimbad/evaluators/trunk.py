"""What fitted evaluators of images share: a frozen extractor gives one encoding a frame, as for `feature_l2`.

They compare unit vectors of its encodings, standardised and projected (`core.composed`): landmarks by the mean and
deviation of their own drive, views by those of all drives that are known.

A fitted dissimilarity is judged against plain L2 of the same unit vectors, on stretches of the route held out of
training: on views of the second season or, where one alone is known, on relit views. Training then has warped views
only, so that another light, which it did not see, stands for the season to come.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.composed import Moments, described, is_composed, principal_directions
from deepsimbad.core.metrics import mean_interval, rank_of_truth
from deepsimbad.errors import InvalidEncodingError, TooFewToFitError
from deepsimbad.evaluators.base import Fitting, LandmarkModel, Lesson
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.feature_l2 import FeatureL2, checked_encodings
from deepsimbad.evaluators.space import OwnDissimilarities, check_units, squared_between, units_by

_BESIDE = 0.3  # variance of dissimilarities where `composed` compares, as a share of that of the encodings beside them
LEAST_FRAMES = 10  # of the drive that landmarks are chosen from: ten stretches of route

_BLOCKS, _VALIDATION, _TEST = 10, (2, 7), (4, 9)  # neighbouring frames are alike, so whole stretches are held out
_MOST_SCORED = 256  # queries
_NEAR_STEPS = 3.0

Axes: TypeAlias = Mapping[str, tuple[str, ...]]
"""The axes of fitted arrays by name: r, d, k, or another length that is the same everywhere; `two` is 2, `one` 1."""

Measure = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Dissimilarities [q, r] of unit vectors [q, k] to the landmarks."""


@dataclass(frozen=True)
class UnitLesson:
    """A lesson in unit vectors [..., k]."""

    drive: NDArray[np.float32]  # [m, k] the drive that landmarks were chosen from, by its own statistics
    landmarks: NDArray[np.int64]  # [r] the landmarks' rows in `drive`
    queries: NDArray[np.float32]  # [q, k] views whose place is known, as they would be seen live
    true_frames: NDArray[np.int64]  # [q] the row in `drive` that sees a query's place
    weight: NDArray[np.float32]  # [q] of a query in the loss, so that augmented views do not outweigh a second season
    is_judge: NDArray[np.bool_]  # [q] views that alone tell how good a model is: another season's, or else relit ones
    has_second: bool  # whether another season is known
    position_m: NDArray[np.float64]  # [m]
    step_m: float  # median distance of neighbouring frames

    @property
    def is_lesson(self) -> NDArray[np.bool_]:
        """[q] views to learn from: all; with one season, only those that do not judge, where there are such."""
        return np.full(len(self.queries), True) if self.has_second or self.is_judge.all() else ~self.is_judge

    @property
    def near_m(self) -> float:
        """Distance within which frames may see the same place."""
        return _NEAR_STEPS * self.step_m

    @property
    def prototypes(self) -> NDArray[np.float32]:
        """[r, k] the landmarks' unit vectors."""
        return self.drive[self.landmarks]

    def is_near(self, frames: NDArray[np.int64], other_frames: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether frames of `drive` may see the same place as other frames of it; the shapes are broadcast."""
        return np.asarray(np.abs(self.position_m[frames] - self.position_m[other_frames]) <= self.near_m)


@dataclass(frozen=True)
class Split:
    """Queries of training, validation and test, and the frames that training may take for wrong answers."""

    train: NDArray[np.int64]
    validation: NDArray[np.int64]  # choose the epoch
    test: NDArray[np.int64]  # judge the model
    wrong_frames: NDArray[np.int64]  # frames of `drive` outside the stretches of the test

    @classmethod
    def of(cls, units: UnitLesson, seed: int) -> Self:
        """Split a lesson by the stretches of route that its queries' places lie in."""
        rng, m = np.random.default_rng(seed), len(units.drive)
        block = np.arange(m) * _BLOCKS // m
        of_query = block[units.true_frames]
        validation, test = (
            np.sort(rng.permutation(np.flatnonzero(np.isin(of_query, blocks) & units.is_judge))[:_MOST_SCORED])
            for blocks in (_VALIDATION, _TEST)
        )
        train = np.flatnonzero(~np.isin(of_query, (*_VALIDATION, *_TEST)) & units.is_lesson)
        return cls(train, validation, test, np.flatnonzero(~np.isin(block, _TEST)))


@dataclass(frozen=True)
class PairScores:
    """How well a dissimilarity tells the landmarks of a query's place from all others."""

    anr: float  # %, mean share of other places' landmarks that come before the best-placed one of the query's place
    auc: float  # chance that a pair of one place is nearer than a pair of two
    ranks: NDArray[np.float64]  # %, [queries whose place has a landmark]; the mean is `anr`

    @classmethod
    def of(cls, units: UnitLesson, rows: NDArray[np.int64], measure: Measure) -> Self:
        """Score a dissimilarity on queries `rows`; NaN where none of their places, or all, have a landmark."""
        near = units.is_near(units.true_frames[rows][:, np.newaxis], units.landmarks)
        is_scored = near.any(axis=1) & ~near.all(axis=1)
        if not is_scored.any():
            return cls(float("nan"), float("nan"), np.empty(0))
        near, d = near[is_scored], measure(units.queries[rows[is_scored]])
        far_d = np.sort(d[~near])
        n_smaller = np.searchsorted(far_d, d[near], "left") + np.searchsorted(far_d, d[near], "right")
        ranks = 100 * np.array([_share_before(*row) for row in zip(d, near, strict=True)])
        return cls(float(ranks.mean()), 1 - float(n_smaller.mean()) / (2 * far_d.size), ranks)

    def as_dict(self) -> dict[str, Any]:
        """The JSON form; null where nothing was scored."""
        figures = {"anr": self.anr, "auc": self.auc}
        return {
            **{name: value if np.isfinite(value) else None for name, value in figures.items()},
            "n_queries": self.ranks.size,
        }


def _share_before(dissimilarities: NDArray[np.float32], near: NDArray[np.bool_]) -> float:
    """Share of landmarks of other places ranked before the best-placed one of the query's, which are `near` [r]."""
    other_values = dissimilarities[~near]
    relevance = -np.append(other_values, dissimilarities[near].min())
    return rank_of_truth(relevance, np.array([other_values.size])) / other_values.size


@dataclass(frozen=True)
class Verdict:
    """Whether a fitted model does better than plain L2 on queries that training did not see."""

    is_better: bool  # with one season known, by more than chance explains
    scores: dict[str, Any]  # of the fitted model and of plain L2, for metrics
    summary: str

    @classmethod
    def of(cls, kind: str, units: UnitLesson, rows: NDArray[np.int64], measure: Measure) -> Self:
        """Judge a dissimilarity on queries `rows`."""
        fitted = PairScores.of(units, rows, measure)
        plain = PairScores.of(units, rows, lambda x: squared_between(x, units.prototypes))
        is_better = fitted.anr < plain.anr
        if is_better and not units.has_second:
            is_better = mean_interval(fitted.ranks - plain.ranks, 0)[1] < 0
        pairs = "held-out pairs" if units.has_second else "held-out pairs of one season"
        summary = (
            f"on {plain.ranks.size} {pairs} the fitted model ranks the right landmark at {fitted.anr:.2f} % and plain "
            f"L2 at {plain.anr:.2f} %"
        )
        return cls(is_better, {"held_out": {kind: fitted.as_dict(), "l2": plain.as_dict()}}, summary)


def no_better(kind: str, verdict: Verdict) -> str:
    """The warning of a model that went back to plain L2."""
    return f"{kind}_no_better: {verdict.summary}: it stays at plain L2, and feature_l2 does as well and costs less"


class Trunk(OwnDissimilarities, FeatureL2):
    """An evaluator that encodes as `FeatureL2` and compares by fitted arrays, whose names begin with `kind`."""

    kind: ClassVar[str]
    axes: ClassVar[Axes]

    def __init__(self, extractor: str, compute: Compute | None = None) -> None:
        super().__init__(extractor, compute)
        self.fitting = Fitting.IMAGES if self.takes_images else Fitting.ENCODINGS  # ready encodings have no images

    def units(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """[n, k] unit vectors of scenes; raises InvalidEncodingError."""
        arrays = model[f"{self.kind}_usual"], model.get(f"{self.kind}_projection")
        return units_by(encodings, *arrays, comparison="by a model fitted to")

    def comparison_vectors(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """See `Evaluator.comparison_vectors`: encodings, and scaled dissimilarities unless these are plain L2."""
        stored_factor = model.get(f"{self.kind}_beside")
        if stored_factor is None:  # a map made before the factor was stored: dissimilarities alone
            return self.own_dissimilarities(encodings, model)
        factor = float(np.asarray(stored_factor, np.float32)[0])
        if factor == 0:
            return encodings
        return np.hstack([encodings, np.float32(factor) * self.own_dissimilarities(encodings, model)])

    def dissimilarity_factor(self, lesson: Lesson, model: LandmarkModel) -> NDArray[np.float32]:
        """[1] factor of the dissimilarities beside encodings, which have the larger share of the variance."""
        dissimilarities = self.own_dissimilarities(checked_encodings(lesson.encodings), model)
        variance = [
            float(vectors.var(axis=0, dtype=np.float64).sum()) for vectors in (lesson.encodings, dissimilarities)
        ]
        return np.array([np.sqrt(_BESIDE * variance[0] / max(variance[1], 1e-12))], np.float32)

    def unit_lesson(self, lesson: Lesson) -> tuple[dict[str, NDArray[Any]], UnitLesson]:
        """The arrays that make unit vectors of encodings, and the lesson in such vectors.

        Queries are the second drive's frames where there are any, and augmented views of landmarks; without either,
        each frame's neighbours.

        Raises:
            TooFewToFitError: There are fewer frames than anything could be learnt from.
        """
        encodings = checked_encodings(lesson.encodings)
        if len(encodings) < LEAST_FRAMES or len(lesson.landmarks) < 2:
            raise TooFewToFitError(
                f"{self.kind} is fitted to {LEAST_FRAMES} frames and 2 landmarks at least, not to {len(encodings)} and "
                f"{len(lesson.landmarks)}: give a longer landmark drive, or use feature_l2",
                n_frames=len(encodings),
                minimum=LEAST_FRAMES,
            )
        drives = (encodings,) if lesson.other is None else (encodings, lesson.other)
        projection, moments = principal_directions(*drives), Moments.of(*drives)
        model: dict[str, NDArray[Any]] = {f"{self.kind}_usual": moments.mean_std()}
        if projection is not None:
            model[f"{self.kind}_projection"] = projection
        u = described(encodings, Moments.of(encodings), projection)
        position_m = np.arange(len(encodings), dtype=np.float64) if lesson.position_m is None else lesson.position_m
        step_m = float(np.median(np.abs(np.diff(position_m)))) + 1e-9
        queries, true_frames, weight, is_relit = [], [], [], []
        if lesson.other is not None and lesson.places.size:
            queries.append(described(lesson.other[lesson.places[:, 1]], moments, projection))
            true_frames.append(lesson.places[:, 0])
            weight.append(np.ones(len(lesson.places), np.float32))
            is_relit.append(np.zeros(len(lesson.places), np.bool_))
        if lesson.views is not None:
            r, a, d = lesson.views.shape
            queries.append(described(lesson.views.reshape(r * a, d), moments, projection))
            true_frames.append(np.repeat(lesson.landmarks, a))
            weight.append(np.full(r * a, 1 / a, np.float32))
            is_relit.append(np.tile(np.arange(a) >= a // 2, r))
        if not queries:
            frames = np.arange(1, len(encodings))
            queries += [u[frames], u[frames - 1]]
            true_frames += [frames - 1, frames]
            weight += [np.ones(len(frames), np.float32)] * 2
            is_relit += [np.ones(len(frames), np.bool_)] * 2
        n_queries, n_second = sum(map(len, queries)), len(lesson.places) if lesson.other is not None else 0
        is_judge = np.arange(n_queries) < n_second if n_second else np.concatenate(is_relit)
        views = np.concatenate(queries), np.concatenate(true_frames).astype(np.int64), np.concatenate(weight)
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
