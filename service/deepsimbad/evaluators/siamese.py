"""The deep Siamese of the paper (II-A, 1): a pairwise network d(x, p) on what a frozen extractor gives of both.

d = softplus(a linear layer plus a small MLP) of (|x - p|, x * p), of unit vectors x and p. The linear layer begins as
squared L2 and the MLP as zero, so training begins at plain L2; the arrays of the epoch that validates best are kept, or
those of plain L2 where the former do no better on stretches used for neither training nor validation.
"""

import time
from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.evaluators.base import Fitted, LandmarkModel, Lesson
from deepsimbad.evaluators.space import squared_between
from deepsimbad.evaluators.trunk import Axes, PairScores, Split, Trunk, UnitLesson, Verdict, no_better

_HIDDEN = 32
_EPOCHS, _BATCH, _MOST_QUERIES = 40, 64, 2048  # queries: at once, and an epoch
_HARD, _EASY, _RETRIEVED = 16, 16, 64  # wrong frames a query: drawn from the nearest 64 by L2, and from all
_RATE, _DECAY = 2e-3, 1e-2
_SHARPNESS = 10.0  # factor of squared L2 in the dissimilarity before training
_TRAINED = ("apart", "product", "bias", "out", "linear", "offset")


class Siamese(Trunk):
    """Dissimilarity = the output of a trained network for a scene and a landmark; all r landmarks in one pass."""

    kind = "siamese"
    axes: ClassVar[Axes] = {
        "usual": ("two", "d"), "projection": ("d", "k"), "landmarks": ("r", "k"), "apart": ("k", "hidden"),
        "product": ("k", "hidden"), "bias": ("hidden",), "out": ("hidden",), "linear": ("two", "k"), "offset": ("one",),
        "beside": ("one",),
    }  # fmt: skip

    def fit(self, lesson: Lesson) -> Fitted:
        start_s = time.monotonic()
        arrays, units = self.unit_lesson(lesson)
        split = Split.of(units, lesson.seed)
        trained, plain, metrics = _train(units, split, lesson)
        verdict = Verdict.of(self.kind, units, split.test, lambda x: _dissimilarities(x, units.prototypes, trained))
        arrays_kept = trained if verdict.is_better else plain
        arrays |= {f"{self.kind}_{name}": array for name, array in arrays_kept.items()}
        arrays[f"{self.kind}_landmarks"] = units.prototypes
        arrays[f"{self.kind}_beside"] = (
            self.dissimilarity_factor(lesson, arrays) if verdict.is_better else np.zeros(1, np.float32)
        )
        metrics |= {**verdict.scores, "is_l2": not verdict.is_better}
        metrics |= {"seed": lesson.seed, "seconds": time.monotonic() - start_s}
        return Fitted(arrays, metrics, () if verdict.is_better else (no_better(self.kind, verdict),))

    def own_dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        trained = {name: np.asarray(model[f"{self.kind}_{name}"], np.float32) for name in _TRAINED}
        landmarks = np.asarray(model[f"{self.kind}_landmarks"], np.float32)
        return _dissimilarities(self.units(encodings, model), landmarks, trained)


def _dissimilarities(
    x: NDArray[np.float32], p: NDArray[np.float32], trained: Mapping[str, NDArray[np.float32]]
) -> NDArray[np.float32]:
    """[n, r] dissimilarities of unit vectors [n, k] and [r, k]; a scene at a time, so that none depends on others."""
    dissimilarities = np.empty((len(x), len(p)), np.float32)
    for row, scene in enumerate(x):
        difference, product = np.abs(scene - p), scene * p
        hidden = np.maximum(difference @ trained["apart"] + product @ trained["product"] + trained["bias"], 0)
        out = hidden @ trained["out"] + difference @ trained["linear"][0] + product @ trained["linear"][1]
        dissimilarities[row] = np.logaddexp(0, out + trained["offset"][0])
    return dissimilarities


_Arrays: TypeAlias = dict[str, NDArray[np.float32]]  # by name


def _train(units: UnitLesson, split: Split, lesson: Lesson) -> tuple[_Arrays, _Arrays, dict[str, Any]]:
    """The arrays of the best epoch, those of plain L2, and how training went."""
    import torch

    rng, k = np.random.default_rng(lesson.seed), units.drive.shape[1]
    random = torch.Generator().manual_seed(lesson.seed)
    layers: dict[str, Any] = {
        "apart": torch.randn(k, _HIDDEN, generator=random) * k**-0.5,
        "product": torch.randn(k, _HIDDEN, generator=random) * k**-0.5,
        "bias": torch.zeros(_HIDDEN),
        "out": torch.zeros(_HIDDEN),
        "linear": torch.stack([torch.zeros(k), torch.full((k,), -2 * _SHARPNESS)]),
        "offset": torch.full((1,), 2 * _SHARPNESS),
    }
    start = {name: layer.clone() for name, layer in layers.items()}
    optimiser = torch.optim.Adam([layer.requires_grad_() for layer in layers.values()], _RATE)
    drive, queries, weight = (torch.from_numpy(array) for array in (units.drive, units.queries, units.weight))
    retrieved_frames = _retrieved(units, split)

    def dissimilarities(rows: NDArray[np.int64], frames: NDArray[np.int64]) -> Any:
        """[q, c] of queries `rows` [q] to `frames` [q, c], as `_dissimilarities` computes them."""
        x, p = queries[rows][:, None], drive[frames]
        difference, product = (x - p).abs(), x * p
        hidden = torch.relu(difference @ layers["apart"] + product @ layers["product"] + layers["bias"])
        out = hidden @ layers["out"] + difference @ layers["linear"][0] + product @ layers["linear"][1]
        return torch.nn.functional.softplus(out + layers["offset"])

    def batch_loss(batch: NDArray[np.int64]) -> Any:
        """The weighted mean cross-entropy of a softmax over a query's right frame and wrong ones."""
        rows, n = split.train[batch], len(batch)
        hard = np.take_along_axis(retrieved_frames[batch], rng.integers(0, retrieved_frames.shape[1], (n, _HARD)), 1)
        true_frames, easy = units.true_frames[rows][:, np.newaxis], rng.choice(split.wrong_frames, (n, _EASY))
        wrong_frames = np.concatenate([hard, easy], axis=1)
        is_barred = np.concatenate([np.zeros((n, 1), np.bool_), units.is_near(true_frames, wrong_frames)], axis=1)
        d = dissimilarities(rows, np.concatenate([true_frames, wrong_frames], axis=1)).masked_fill(
            torch.from_numpy(is_barred), torch.inf
        )
        return (-torch.log_softmax(-d, 1)[:, 0] * weight[rows]).mean()

    curve: list[dict[str, Any]] = []
    best: _Arrays = {}
    plain: _Arrays = {}
    n_evaluated = 0
    for epoch in range(_EPOCHS + 1):
        order = rng.permutation(len(split.train))[:_MOST_QUERIES] if epoch else np.empty(0, np.int64)
        losses = []
        for first in range(0, len(order), _BATCH):
            lesson.on_progress((epoch - 1 + first / len(order)) / _EPOCHS)
            loss = batch_loss(order[first : first + _BATCH])
            drift = sum((layer - start[name]).square().sum() for name, layer in layers.items())
            optimiser.zero_grad()
            (loss + _DECAY * drift / len(split.train)).backward()
            optimiser.step()
            losses.append(float(loss.detach()))
        arrays = {name: layer.detach().numpy().astype(np.float16).astype(np.float32) for name, layer in layers.items()}
        scores = PairScores.of(units, split.validation, partial(_dissimilarities, p=units.prototypes, trained=arrays))
        plain = plain or arrays
        if not best or scores.anr < min(point["anr"] for point in curve):
            best = arrays
        curve.append({"epoch": epoch, "loss": float(np.mean(losses)) if losses else None, "anr": scores.anr})
        n_evaluated += len(order) * (1 + _HARD + _EASY) + scores.ranks.size * len(units.landmarks)
    lesson.on_progress(1.0)
    n_train = {"n_queries": len(split.train), "n_dissimilarities": n_evaluated}
    return best, plain, {**n_train, "best_epoch": min(curve, key=lambda point: point["anr"])["epoch"], "curve": curve}


def _retrieved(units: UnitLesson, split: Split) -> NDArray[np.int64]:
    """[q, 64] the frames that plain L2 places nearest to each query of training, without those of its own place."""
    n = min(_RETRIEVED, len(split.wrong_frames))
    nearest = np.empty((len(split.train), n), np.int64)
    for first in range(0, len(split.train), 1024):
        rows = split.train[first : first + 1024]
        dissimilarities = squared_between(units.queries[rows], units.drive[split.wrong_frames])
        dissimilarities[units.is_near(units.true_frames[rows][:, np.newaxis], split.wrong_frames)] = np.inf
        nearest[first : first + 1024] = split.wrong_frames[np.argpartition(dissimilarities, n - 1, axis=1)[:, :n]]
    return nearest
