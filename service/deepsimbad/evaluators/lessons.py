"""What fitted evaluators of images learn from, in unit vectors, and how a fitted dissimilarity is judged.

It is judged on places along the route that training did not see, beside plain L2 of the same unit vectors.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

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
    n_second: int  # of the queries, how many are another season's, which come first
    position_m: NDArray[np.float64]  # [m]
    step_m: float  # how far neighbouring frames are apart, usually

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
            np.sort(rng.permutation(np.flatnonzero(np.isin(of_query, blocks)))[:_MOST_SCORED])
            for blocks in (_VALIDATION, _TEST)
        )
        train = np.flatnonzero(~np.isin(of_query, (*_VALIDATION, *_TEST)))
        return cls(train, validation, test, np.flatnonzero(~np.isin(block, _TEST)))


@dataclass(frozen=True)
class PairScores:
    """How well a dissimilarity tells the landmarks of a query's place from all others."""

    anr: float  # %: of the others, how many come before the best-placed landmark of the place
    auc: float  # chance that a pair of one place is nearer than a pair of two
    n_queries: int  # whose place has a landmark

    @classmethod
    def of(cls, units: UnitLesson, rows: NDArray[np.int64], measure: Measure) -> Self:
        """Of some queries; NaN where no place of them has a landmark, or all have."""
        near = units.is_near(units.true[rows][:, np.newaxis], units.landmarks)
        asked = near.any(axis=1) & ~near.all(axis=1)
        if not asked.any():
            return cls(float("nan"), float("nan"), 0)
        near, apart = near[asked], measure(units.queries[rows[asked]])
        best = np.where(near, apart, np.inf).min(axis=1, keepdims=True)
        before = ((apart < best) & ~near).sum(axis=1) + 0.5 * ((apart == best) & ~near).sum(axis=1)
        far = np.sort(apart[~near])
        places = np.searchsorted(far, apart[near], "left") + np.searchsorted(far, apart[near], "right")
        auc = 1 - float(places.mean()) / (2 * far.size)
        return cls(100 * float((before / (~near).sum(axis=1)).mean()), auc, int(asked.sum()))

    def as_dict(self) -> dict[str, Any]:
        """The JSON form; null where nothing was scored."""
        return {name: value if np.isfinite(value) else None for name, value in asdict(self).items()}


def squared_l2(x: NDArray[np.float32], p: NDArray[np.float32]) -> NDArray[np.float32]:
    """[n, r] of unit vectors [n, k] and [r, k]."""
    return np.asarray(np.clip(2 - 2 * (x @ p.T), 0, 4), np.float32)


def judged(
    kind: str, units: UnitLesson, rows: NDArray[np.int64], measure: Measure
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Scores on queries that training did not see beside plain L2's, for metrics; and a warning if no better."""
    fitted = PairScores.of(units, rows, measure)
    plain = PairScores.of(units, rows, lambda x: squared_l2(x, units.prototypes))
    warnings: tuple[str, ...] = ()
    if not fitted.anr < plain.anr:
        shown = f"ranks the right landmark at {fitted.anr:.2f} % and plain L2 at {plain.anr:.2f} %"
        warnings = (
            f"{kind}_no_better: on {plain.n_queries} held-out pairs the fitted model {shown}: feature_l2 does as well "
            "here, and costs less",
        )
    return {"held_out": {kind: fitted.as_dict(), "l2": plain.as_dict()}}, warnings
