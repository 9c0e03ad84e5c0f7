"""Composed lists beside product and residual quantisation of the same unit vectors, at the same bits a place.

    python -m bench.quantised

Codebooks are learnt on the map's own places, which is the best they can be. A view is compared with what was restored.
"""

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.measurement import machine, markdown, real_recordings, write_page
from deepsimbad.core.building import Built, MapPlan, compose_map
from deepsimbad.core.composed import list_weights, unit
from deepsimbad.core.drive import Drive
from deepsimbad.core.metrics import RetrievalScorer, RetrievalScores
from deepsimbad.core.relevance import Relevance
from deepsimbad.core.route import true_images_of
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.jobs.build import measure_drive, views_of
from deepsimbad.jobs.experiments.vpr import moves_between, relevances_by_all

_ROUNDS = 25  # of k-means
DRIVES = ("nr", "nq", "nq2")
LIST_LENGTH, TOLERANCE = 4, 2
N_LANDMARKS = (300, 512)
SEASONS = {"two seasons (f)": True, "one season (u)": False}


def k_means(rows: NDArray[np.float32], k: int) -> NDArray[np.float32]:
    """[k, d] centres, by Lloyd's algorithm from rows drawn with seed 0."""
    centres = rows[np.random.default_rng(0).permutation(len(rows))[:k]].copy()
    for _ in range(_ROUNDS):
        nearest = nearest_centre(rows, centres)
        count, total = np.bincount(nearest, minlength=len(centres)), np.zeros_like(centres)
        np.add.at(total, nearest, rows)
        centres = np.where(count[:, np.newaxis] > 0, total / np.maximum(count, 1)[:, np.newaxis], centres)
    return np.asarray(centres, np.float32)


def nearest_centre(rows: NDArray[np.float32], centres: NDArray[np.float32]) -> NDArray[np.int64]:
    """[n] index of the centre [k, d] nearest to every row [n, d] by L2."""
    return np.asarray((rows @ centres.T - 0.5 * np.square(centres).sum(axis=1)).argmax(axis=1), np.int64)


def product_quantised(rows: NDArray[np.float32], parts: int, k: int) -> NDArray[np.float32]:
    """[n, d] restored: each of some parts of a row is the nearest of k centres."""
    pieces = []
    for part in np.array_split(rows, parts, axis=1):
        centres = k_means(part, k)
        pieces.append(centres[nearest_centre(part, centres)])
    return unit(np.concatenate(pieces, axis=1))


def residual_quantised(rows: NDArray[np.float32], parts: int, k: int) -> NDArray[np.float32]:
    """[n, d] restored: each part is the nearest of k centres to what those before it left over."""
    left_over = rows.copy()
    for _ in range(parts):
        centres = k_means(left_over, k)
        left_over = left_over - centres[nearest_centre(left_over, centres)]
    return unit(rows - left_over)


def composed_places(lists: NDArray[np.uint16], landmarks: NDArray[np.float32]) -> NDArray[np.float32]:
    """[n, k] what lists [h, n] restore: the direction of the weighted sum of their landmarks [r, k]."""
    weights = list_weights(len(lists))
    return unit(sum(weight * landmarks[ids] for weight, ids in zip(weights, lists, strict=True)))


def netvlad_drives() -> dict[str, Drive]:
    """The three drives of `nordland_netvlad64`, a place a metre."""
    folder = real_recordings() / "nordland_netvlad64"
    rows = {name: np.load(folder / f"{name}.npy").astype(np.float32) for name in DRIVES}
    return {
        name: Drive(position_m=np.arange(float(len(encodings))), encodings=encodings)
        for name, encodings in rows.items()
    }


def scored(built_map: Built, places: NDArray[np.float32], test: Drive) -> RetrievalScores:
    """Scores of one session over the test drive against restored places [n, k]."""
    truth = true_images_of(test.route(), built_map.map.route, TOLERANCE)
    views = views_of(measure_drive(test, built_map.map.landmark_model, FeatureL2("none")))
    rows = relevances_by_all(replace(built_map, places=places), views, moves_between(test), stateless=False)
    scorer = RetrievalScorer()
    for row, true_images in zip(rows, truth, strict=True):
        scorer.add(row, true_images)
    return scorer.result()


def row_of(scores: list[RetrievalScores]) -> list[str]:
    """Mean ANR and R@1, and the worst ANR, in percent."""
    anr = [score.anr for score in scores]
    return [f"{np.mean(anr):.2f}", f"{np.mean([score.recall_at[1] for score in scores]):.1f}", f"{max(anr):.2f}"]


def report() -> Iterator[str]:
    """The lines of the page."""
    drives = netvlad_drives()
    yield "# Composed beside product and residual quantisation"
    yield ""
    yield (
        "Three drives of the Nordland railway (`nordland_netvlad64`), all six orders, h = 4, one session, percent. "
        "`f`, `u`: the unit vectors of places that composed lists stand for, of two seasons and of one. Quantisers' "
        "codebooks are learnt on the map's places by k-means. Bits are of one place; `numbers` are those of codebooks "
        "or landmarks, which come on top. A map of 600 places has 38,400 itself: codebooks of as many entries as "
        "places are no compression here, and would be on a long route."
    )
    yield from ("", "Made by `python -m bench.quantised`.", "", machine())
    for title, has_two in SEASONS.items():
        yield from ("", f"## {title}", "")
        scores: dict[tuple[str, str, str], list[RetrievalScores]] = {}
        for landmarks, training, test in itertools.permutations(drives.values()):
            second = landmarks if has_two else None
            plan = MapPlan(Relevance.COMPOSED, LIST_LENGTH, (1.0,), same_route=True)
            for r in N_LANDMARKS:
                built_map = compose_map(plan, training, second, second, r)
                places, d = built_map.places, built_map.places.shape[1]
                bits = f"{4 * np.log2(r):.0f}"
                for name, numbers, restored in (
                    (
                        "composed",
                        r * d,
                        composed_places(built_map.map.lists, built_map.map.landmark_model["prototypes"]),
                    ),
                    ("product quantisation, 4 parts", r * d, product_quantised(places, 4, r)),
                    ("residual quantisation, 4 parts", 4 * r * d, residual_quantised(places, 4, r)),
                ):
                    scores.setdefault((name, bits, f"{numbers:,}"), []).append(scored(built_map, restored, test))
            for name, numbers, restored in (
                ("product quantisation, 6 parts", 64 * d, product_quantised(places, 6, 64)),
                ("residual quantisation, 6 parts", 6 * 64 * d, residual_quantised(places, 6, 64)),
                ("nothing left out", 0, places),
            ):
                bits = "36" if numbers else f"{32 * d:,}"
                scores.setdefault((name, bits, f"{numbers:,}"), []).append(scored(built_map, restored, test))
        rows = [(*description, *row_of(rows_scores)) for description, rows_scores in scores.items()]
        yield from markdown(("description", "bits", "numbers", "ANR %", "R@1 %", "worst ANR %"), rows)


def main() -> None:
    """Measure, print, write `docs/results/quantised.md`."""
    write_page("quantised.md", report())


if __name__ == "__main__":
    main()
