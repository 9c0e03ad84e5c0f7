"""Composed lists beside product and residual quantisation of the same unit vectors, at the same bits a place.

    python -m bench.quantised

Codebooks are learnt on the map's own places, which is the best they can be. A view is compared with what was restored.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.measurement import RESULTS, Command, figures, machine, markdown, print_page, scored
from bench.recordings import netvlad_drives
from deepsimbad.core import composed
from deepsimbad.core.building import Built, MapPlan, compose_map
from deepsimbad.core.composed import unit
from deepsimbad.core.drive import Drive
from deepsimbad.core.metrics import RetrievalScores
from deepsimbad.core.relevance import Relevance
from deepsimbad.core.route import true_images_of
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.jobs.build import measure_drive, views_of
from deepsimbad.jobs.experiments.vpr import moves_between, relevances_by_all

_ROUNDS = 25  # of k-means
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
    return unit(np.tensordot(composed.list_weights(len(lists)), landmarks[lists], axes=1))


def restorations(builds: Sequence[Built]) -> Iterator[tuple[str, str, int, NDArray[np.float32]]]:
    """Name, bits and numbers of every description of the places of a map, and what it restores of them.

    Args:
        builds: The map with few landmarks and with more; its places are the same.
    """
    places = builds[-1].places
    d = places.shape[1]
    for built_map in builds:
        prototypes = built_map.map.landmark_model["prototypes"]
        r, bits = len(prototypes), f"{LIST_LENGTH * np.log2(len(prototypes)):.0f}"
        yield "composed", bits, r * d, composed_places(built_map.map.lists, prototypes)
        yield "product quantisation, 4 parts", bits, r * d, product_quantised(places, 4, r)
        yield "residual quantisation, 4 parts", bits, 4 * r * d, residual_quantised(places, 4, r)
    yield "product quantisation, 6 parts", "36", 64 * d, product_quantised(places, 6, 64)
    yield "residual quantisation, 6 parts", "36", 6 * 64 * d, residual_quantised(places, 6, 64)
    yield "nothing left out", f"{32 * d:,}", 0, places


def session_scores(built_map: Built, places: NDArray[np.float32], test: Drive) -> RetrievalScores:
    """Scores of one session over the test drive against restored places [n, k]."""
    views = views_of(measure_drive(test, built_map.map.landmark_model, FeatureL2("none")))
    rows = relevances_by_all(replace(built_map, places=places), views, moves_between(test), stateless=False)
    return scored(rows, true_images_of(test.route(), built_map.map.route, TOLERANCE))


def report() -> Iterator[str]:
    """The lines of the page."""
    drives = netvlad_drives()
    yield from ("# Composed beside product and residual quantisation", "")
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
        for landmarks, training, test in itertools.permutations(drives):
            second = landmarks if has_two else None
            plan = MapPlan(Relevance.COMPOSED, LIST_LENGTH, (1.0,), same_route=True)
            builds = [compose_map(plan, training, second, second, r) for r in N_LANDMARKS]
            for name, bits, n_numbers, restored in restorations(builds):
                scores.setdefault((name, bits, f"{n_numbers:,}"), []).append(session_scores(builds[-1], restored, test))
        rows = [(*description, *figures(rows_scores)) for description, rows_scores in scores.items()]
        yield from markdown(("description", "bits", "numbers", "ANR %", "R@1 %", "worst ANR %"), rows)


if __name__ == "__main__":
    Command(__doc__).run(lambda _: print_page(report(), RESULTS / "quantised.md"))
