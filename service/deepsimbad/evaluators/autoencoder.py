"""The deep autoencoder of the paper (II-A, 2): one small anomaly model a landmark, d(x|p) how far x deviates from it.

x' = p + tanh((x - p) I + b) O, learnt on views of the landmark: what makes these differ, another light or a step
aside, is restored and counts no more; what no view of it ever showed is not. d = |x - x'|^2 over its spread: the mean
of what it is on the landmark's own views and on the landmark drive's scenes. Of the few own views alone a landmark that
one season has shown would be far from everything (docs/results/evaluators.md). It begins as squared L2, with O = 0; all
landmarks are trained at once, as batched tensors.
"""

import time
from typing import Any, ClassVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.evaluators.base import Fitted, LandmarkModel, Lesson
from deepsimbad.evaluators.trunk import Axes, Split, Trunk, UnitLesson, Verdict, no_better

_BOTTLENECK = 4
_EPOCHS, _RATE, _DECAY = 150, 3e-3, 3e-3
_SAMPLES = 16  # views of a landmark in an epoch
_NOISE = 0.15  # length of what is added to a view
_MOST_SCENES = 1024  # of the drive, that a landmark's spread is measured on
_TRAINED = ("landmarks", "into", "bias", "out")


class Autoencoder(Trunk):
    """Dissimilarity = the normalised reconstruction error of every landmark's own model."""

    kind = "autoencoder"
    axes: ClassVar[Axes] = {
        "usual": ("two", "d"), "projection": ("d", "k"), "landmarks": ("r", "k"), "into": ("r", "b", "k"),
        "bias": ("r", "b"), "out": ("r", "b", "k"), "deviation": ("r",), "beside": ("one",),
    }  # fmt: skip

    def fit(self, lesson: Lesson) -> Fitted:
        """See `Evaluator.fit`: trained twice, the first time without the queries that it is judged on."""
        began = time.monotonic()
        arrays, units = self.unit_lesson(lesson)
        split = Split.of(units, lesson.seed)
        every = np.arange(len(units.queries))
        # What another season shows of some stretches; of one season, relit views: a landmark keeps its others.
        unseen = split.test if units.has_second else np.flatnonzero(units.is_judge)[:: 4 if units.is_judge.all() else 1]
        part, curve = _train(units, np.setdiff1d(every, unseen), lesson, 0.0)
        verdict = Verdict.of(self.kind, units, unseen, lambda x: _deviations(x, part))
        # A model without a landmark's second season says little of one that has it: there it warns, and stays.
        is_l2 = not units.has_second and not verdict.is_better
        trained, curve = (_plain(units), curve) if is_l2 else _train(units, every, lesson, 0.5)
        lesson.on_progress(1.0)
        warnings: tuple[str, ...] = (no_better(self.kind, verdict),) if is_l2 else ()
        if not is_l2 and not verdict.is_better:
            warnings = (
                f"{self.kind}_no_better: {verdict.shown}, lacking these pairs, which the map's has: measure it beside "
                "feature_l2, which costs less",
            )
        arrays |= {f"{self.kind}_{name}": array for name, array in trained.items()}
        arrays[f"{self.kind}_beside"] = np.zeros(1, np.float32) if is_l2 else self.beside(lesson, arrays)
        n_bytes = sum(array[0].size for array in trained.values()) * 2
        metrics = {
            "n_dissimilarities": 2 * len(units.landmarks) * (_EPOCHS * _SAMPLES + min(len(units.own), _MOST_SCENES)),
            "bytes_per_landmark": n_bytes,
            "curve": curve,
            **verdict.scores,
            "is_l2": is_l2,
            "seed": lesson.seed,
            "seconds": time.monotonic() - began,
        }
        return Fitted(arrays, metrics, warnings)

    def own_dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        names = (*_TRAINED, "deviation")
        trained = {name: np.ascontiguousarray(model[f"{self.kind}_{name}"], np.float32) for name in names}
        return _deviations(self.units(encodings, model), trained)


def _deviations(x: NDArray[np.float32], trained: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    """[n, r] of unit vectors [n, k]."""
    errors = _errors(np.ascontiguousarray(x), *(trained[name] for name in _TRAINED))
    return np.asarray(errors / trained["deviation"], np.float32)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _errors(
    x: NDArray[np.float32],
    landmarks: NDArray[np.float32],
    into: NDArray[np.float32],
    bias: NDArray[np.float32],
    out: NDArray[np.float32],
) -> NDArray[np.float32]:
    """[n, r] squared lengths of what the landmarks' models leave of scenes [n, k]."""
    (n, k), (r, b) = x.shape, bias.shape
    errors = np.empty((n, r), np.float32)
    apart, rest = np.empty(k, np.float32), np.empty(k, np.float32)
    for j in range(r):
        for i in range(n):
            for c in range(k):
                apart[c] = x[i, c] - landmarks[j, c]
                rest[c] = apart[c]
            for a in range(b):
                total = bias[j, a]
                for c in range(k):
                    total += into[j, a, c] * apart[c]
                hidden = np.tanh(total)
                for c in range(k):
                    rest[c] -= hidden * out[j, a, c]
            square = np.float32(0)
            for c in range(k):
                square += rest[c] * rest[c]
            errors[i, j] = square
    return errors


def _views(units: UnitLesson, queries: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.float32]:
    """[r, 16, k] of every landmark's place: it, its nearest neighbours and queries, some more than once."""
    views = np.empty((len(units.landmarks), _SAMPLES, units.own.shape[1]), np.float32)
    of_place = units.position_m[units.true[queries]]
    for row, at_m in enumerate(units.position_m[units.landmarks].tolist()):
        frames = np.flatnonzero(np.abs(units.position_m - at_m) <= units.step_m)
        seen = queries[np.abs(of_place - at_m) <= units.step_m]
        every = np.concatenate([units.own[frames], units.queries[seen]])[rng.permutation(frames.size + seen.size)]
        views[row] = every[np.arange(_SAMPLES) % len(every)]
    return views


def _plain(units: UnitLesson) -> dict[str, NDArray[np.float32]]:
    """The model that restores nothing: squared L2."""
    p = units.prototypes.astype(np.float16).astype(np.float32)
    nothing = np.zeros((len(p), 1, p.shape[1]), np.float32)
    return {
        "landmarks": p,
        "into": nothing,
        "bias": np.zeros((len(p), 1), np.float32),
        "out": nothing,
        "deviation": np.ones(len(p), np.float32),
    }


def _train(
    units: UnitLesson, queries: NDArray[np.int64], lesson: Lesson, done: float
) -> tuple[dict[str, NDArray[np.float32]], list[dict[str, float]]]:
    """Every landmark's model, by names, and the mean error by epoch; a half of the progress, from `done` on."""
    import torch

    p = units.prototypes.astype(np.float16).astype(np.float32)
    (r, k), random = p.shape, torch.Generator().manual_seed(lesson.seed)
    apart = torch.from_numpy(_views(units, queries, np.random.default_rng(lesson.seed)) - p[:, np.newaxis])
    into = (torch.randn(r, _BOTTLENECK, k, generator=random) * 2 * k**-0.5).requires_grad_()
    bias, out = torch.zeros(r, _BOTTLENECK, requires_grad=True), torch.zeros(r, _BOTTLENECK, k, requires_grad=True)
    optimiser = torch.optim.AdamW([into, bias, out], _RATE, weight_decay=_DECAY)

    def left_of(views: torch.Tensor) -> torch.Tensor:
        """[r] mean squared lengths of what is not restored of views that are shown so."""
        hidden = torch.tanh(torch.baddbmm(bias[:, None], views, into.transpose(1, 2)))
        return (apart - torch.bmm(hidden, out)).square().sum(2).mean(1)

    curve = []
    for epoch in range(_EPOCHS):
        lesson.on_progress(done + epoch / _EPOCHS / 2)
        noisy = apart + torch.randn(apart.shape, generator=random) * (_NOISE * k**-0.5)
        errors = left_of(noisy)  # [r]; no landmark's model moves another's
        optimiser.zero_grad()
        errors.sum().backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        curve.append({"epoch": epoch, "error": float(errors.detach().mean())})
    layers: dict[str, Any] = {"into": into, "bias": bias, "out": out}
    trained = {name: layer.detach().numpy().astype(np.float16).astype(np.float32) for name, layer in layers.items()}
    trained["landmarks"] = p
    scenes = units.own[np.linspace(0, len(units.own) - 1, min(len(units.own), _MOST_SCENES)).astype(np.intp)]
    of_scenes = _errors(scenes, *(trained[name] for name in _TRAINED)).mean(axis=0)
    deviation = (left_of(apart).detach().numpy() + of_scenes) / 2
    trained["deviation"] = np.maximum(deviation, 1e-6).astype(np.float32)
    return trained, curve[:: _EPOCHS // 15]
