"""What is learnt from in unit vectors, and how a fitted dissimilarity is judged.

On places along the route that training did not see, beside plain L2 of the same unit vectors: on views of the second
season, or where one alone is known on relit views, having learnt from views that were moved: another light, which
training did not see, stands for the season to come.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.metrics import mean_interval

_BLOCKS, _VALIDATION, _TEST = 10, (2, 7), (4, 9)  # neighbouring frames are alike, so whole stretches are held out
_MOST_SCORED = 256  # queries
_NEAR_STEPS = 3.0
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


def squared_l2(x: NDArray[np.float32], p: NDArray[np.float32]) -> NDArray[np.float32]:
    """[n, r] of unit vectors [n, k] and [r, k]."""
    return np.asarray(np.clip(2 - 2 * (x @ p.T), 0, 4), np.float32)


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
        plain = PairScores.of(units, rows, lambda x: squared_l2(x, units.prototypes))
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
