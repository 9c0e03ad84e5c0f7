"""The deep autoencoder of the paper (II-A, 2): one small anomaly model a landmark, d(x|p) how far x deviates from it.

x' = p + tanh((x - p) I + b) O, learnt on views of the landmark: differences that these show, of light or of a step
aside, are restored and count no more; others are not. d = |x - x'|^2 divided by its mean over the landmark's own views
and over the landmark drive's scenes. By its own few views alone a landmark known in one season would be far from
everything (docs/results/evaluators.md). Training begins at squared L2, with O = 0, for all landmarks at once, as
batched tensors.
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
_NOISE = 0.15  # length of the noise added to a view
_MOST_SCENES = 1024  # scenes of the drive that a landmark's deviation is measured on
_TRAINED = ("landmarks", "into", "bias", "out")


class Autoencoder(Trunk):
    """Dissimilarity = the normalised reconstruction error of every landmark's own model."""

    kind = "autoencoder"
    axes: ClassVar[Axes] = {
        "usual": ("two", "d"), "projection": ("d", "k"), "landmarks": ("r", "k"), "into": ("r", "b", "k"),
        "bias": ("r", "b"), "out": ("r", "b", "k"), "deviation": ("r",), "beside": ("one",),
    }  # fmt: skip

    def fit(self, lesson: Lesson) -> Fitted:
        """See `Evaluator.fit`; trained twice, the first time without the queries that the model is judged on."""
        start_s = time.monotonic()
        arrays, units = self.unit_lesson(lesson)
        split = Split.of(units, lesson.seed)
        all_queries = np.arange(len(units.queries))
        # The second season's views of the test stretches; with one season relit views, a landmark keeping the others.
        held_out = (
            split.test if units.has_second else np.flatnonzero(units.is_judge)[:: 4 if units.is_judge.all() else 1]
        )
        judged, curve = _train(units, np.setdiff1d(all_queries, held_out), lesson, 0.0)
        verdict = Verdict.of(self.kind, units, held_out, lambda x: _deviations(x, judged))
        # With two seasons the judged model lacks pairs that the map's model has, so a bad verdict only warns.
        is_l2 = not units.has_second and not verdict.is_better
        trained, curve = (_plain(units), curve) if is_l2 else _train(units, all_queries, lesson, 0.5)
        lesson.on_progress(1.0)
        warnings: tuple[str, ...] = (no_better(self.kind, verdict),) if is_l2 else ()
        if not is_l2 and not verdict.is_better:
            warnings = (
                f"{self.kind}_no_better: {verdict.summary}, lacking these pairs, which the map's has: measure it "
                "beside feature_l2, which costs less",
            )
        arrays |= {f"{self.kind}_{name}": array for name, array in trained.items()}
        arrays[f"{self.kind}_beside"] = np.zeros(1, np.float32) if is_l2 else self.dissimilarity_factor(lesson, arrays)
        n_bytes = sum(array[0].size for array in trained.values()) * 2
        metrics = {
            "n_dissimilarities": 2 * len(units.landmarks) * (_EPOCHS * _SAMPLES + min(len(units.drive), _MOST_SCENES)),
            "bytes_per_landmark": n_bytes,
            "curve": curve,
            **verdict.scores,
            "is_l2": is_l2,
            "seed": lesson.seed,
            "seconds": time.monotonic() - start_s,
        }
        return Fitted(arrays, metrics, warnings)

    def own_dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        names = (*_TRAINED, "deviation")
        trained = {name: np.ascontiguousarray(model[f"{self.kind}_{name}"], np.float32) for name in names}
        return _deviations(self.units(encodings, model), trained)


def _deviations(x: NDArray[np.float32], trained: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    """[n, r] dissimilarities of unit vectors [n, k] to the landmarks of a trained model."""
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
    """[n, r] squared lengths of what the landmarks' models do not restore of scenes [n, k]."""
    (n, k), (r, b) = x.shape, bias.shape
    errors = np.empty((n, r), np.float32)
    offset, residual = np.empty(k, np.float32), np.empty(k, np.float32)
    for j in range(r):
        for i in range(n):
            for c in range(k):
                offset[c] = x[i, c] - landmarks[j, c]
                residual[c] = offset[c]
            for a in range(b):
                total = bias[j, a]
                for c in range(k):
                    total += into[j, a, c] * offset[c]
                hidden = np.tanh(total)
                for c in range(k):
                    residual[c] -= hidden * out[j, a, c]
            square = np.float32(0)
            for c in range(k):
                square += residual[c] * residual[c]
            errors[i, j] = square
    return errors


def _views(units: UnitLesson, queries: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.float32]:
    """[r, 16, k] views of every landmark's place: the frames and queries nearest to it, some more than once."""
    views = np.empty((len(units.landmarks), _SAMPLES, units.drive.shape[1]), np.float32)
    query_m = units.position_m[units.true_frames[queries]]
    for row, landmark_m in enumerate(units.position_m[units.landmarks].tolist()):
        frames = np.flatnonzero(np.abs(units.position_m - landmark_m) <= units.step_m)
        nearby = queries[np.abs(query_m - landmark_m) <= units.step_m]
        place = np.concatenate([units.drive[frames], units.queries[nearby]])[rng.permutation(frames.size + nearby.size)]
        views[row] = place[np.arange(_SAMPLES) % len(place)]
    return views


def _plain(units: UnitLesson) -> dict[str, NDArray[np.float32]]:
    """The arrays of the model that restores nothing, whose dissimilarity is squared L2."""
    p = units.prototypes.astype(np.float16).astype(np.float32)
    zeros = np.zeros((len(p), 1, p.shape[1]), np.float32)
    return {
        "landmarks": p,
        "into": zeros,
        "bias": np.zeros((len(p), 1), np.float32),
        "out": zeros,
        "deviation": np.ones(len(p), np.float32),
    }


def _train(
    units: UnitLesson, queries: NDArray[np.int64], lesson: Lesson, first_progress: float
) -> tuple[dict[str, NDArray[np.float32]], list[dict[str, float]]]:
    """The arrays of all landmarks' models by name, and the mean error by epoch.

    Reports half of the progress, from `first_progress` on.
    """
    import torch

    p = units.prototypes.astype(np.float16).astype(np.float32)
    (r, k), random = p.shape, torch.Generator().manual_seed(lesson.seed)
    offsets = torch.from_numpy(_views(units, queries, np.random.default_rng(lesson.seed)) - p[:, np.newaxis])
    into = (torch.randn(r, _BOTTLENECK, k, generator=random) * 2 * k**-0.5).requires_grad_()
    bias, out = torch.zeros(r, _BOTTLENECK, requires_grad=True), torch.zeros(r, _BOTTLENECK, k, requires_grad=True)
    optimiser = torch.optim.AdamW([into, bias, out], _RATE, weight_decay=_DECAY)

    def residual_errors(views: torch.Tensor) -> torch.Tensor:
        """[r] mean squared lengths of what is not restored of the landmarks' views, given these, noisy or not."""
        hidden = torch.tanh(torch.baddbmm(bias[:, None], views, into.transpose(1, 2)))
        return (offsets - torch.bmm(hidden, out)).square().sum(2).mean(1)

    curve = []
    for epoch in range(_EPOCHS):
        lesson.on_progress(first_progress + epoch / _EPOCHS / 2)
        noisy = offsets + torch.randn(offsets.shape, generator=random) * (_NOISE * k**-0.5)
        errors = residual_errors(noisy)  # [r]; no landmark's model moves another's
        optimiser.zero_grad()
        errors.sum().backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        curve.append({"epoch": epoch, "error": float(errors.detach().mean())})
    layers: dict[str, Any] = {"into": into, "bias": bias, "out": out}
    trained = {name: layer.detach().numpy().astype(np.float16).astype(np.float32) for name, layer in layers.items()}
    trained["landmarks"] = p
    scenes = units.drive[np.linspace(0, len(units.drive) - 1, min(len(units.drive), _MOST_SCENES)).astype(np.intp)]
    scene_errors = _errors(scenes, *(trained[name] for name in _TRAINED)).mean(axis=0)
    deviation = (residual_errors(offsets).detach().numpy() + scene_errors) / 2
    trained["deviation"] = np.maximum(deviation, 1e-6).astype(np.float32)
    return trained, curve[:: _EPOCHS // 15]
