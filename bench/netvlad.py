"""The paper's single-view experiment on real NetVLAD encodings of Nordland: all six landmark-training-test triplets.

    python -m bench.netvlad

The figures of a session come from the command `deepsimbad experiment vpr`. Those of views on their own are what the
service answers to single localizations: the map's statistics are never moved on.
"""

import itertools
import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import machine, markdown, real_recordings, write_page
from deepsimbad.cli import run
from deepsimbad.core.building import MapPlan
from deepsimbad.core.drive import Drive
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import RetrievalScorer
from deepsimbad.core.relevance import Relevance
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.jobs.build import build, measured, views_of

DRIVES = ("nr", "nq", "nq2")
RELEVANCES = ("composed", "brute_force_u", "standardised", "rrf", "bag_of_landmarks", "simbad", "brute_force")
N_LANDMARKS, LIST_LENGTH, TOLERANCE = 300, 4, 2


def experiment(folder: Path, triplet: tuple[str, ...]) -> dict[str, Any]:
    """The JSON document of one landmark-training-test triplet."""
    landmarks, training, test = (str(folder / f"{name}.npy") for name in triplet)
    with tempfile.TemporaryDirectory() as work:
        document = Path(work) / "vpr.json"
        sources = ["--landmarks", landmarks, "--training", training, "--test", test]
        evaluator = ["--evaluator", "feature_l2:none"]
        code = run(["experiment", "vpr", *sources, *evaluator, "--json", str(document)])
        if code:
            raise RuntimeError(f"the experiment on {'-'.join(triplet)} ended with exit code {code}")
        return dict(json.loads(document.read_text(encoding="utf-8")))


def alone(folder: Path, triplet: tuple[str, ...]) -> Mapping[str, float]:
    """ANR in percent of every test frame localized on its own."""
    encodings = (np.load(folder / f"{name}.npy").astype(np.float32) for name in triplet)
    landmarks, training, test = (Drive(position_m=np.arange(float(len(rows))), encodings=rows) for rows in encodings)
    evaluator, frames = FeatureL2("none"), np.arange(training.n_frames)

    def mapped(relevance: Relevance, second: Drive | None) -> Map:
        plan = MapPlan(relevance, LIST_LENGTH, (1.0,), same_route=True)
        return build(plan, training, second, landmarks, N_LANDMARKS, evaluator).map

    maps = {
        "composed": mapped(Relevance.COMPOSED, landmarks),
        "composed, one season": mapped(Relevance.COMPOSED, None),
        "standardised": mapped(Relevance.STANDARDISED, None),
    }
    anr = {}
    for name, built in maps.items():
        scorer, views = RetrievalScorer(), views_of(measured(test, built.landmark_model, evaluator))
        for frame in frames:
            scorer.add(relevances(built, views.at(int(frame))), np.flatnonzero(np.abs(frames - frame) <= TOLERANCE))
        anr[name] = scorer.result().anr
    return anr


def mean_table(names: Sequence[str], figures: dict[str, Mapping[str, float]], digits: int) -> Iterator[str]:
    """Markdown lines: a row a triplet, with the means in the last."""
    rows = [[triplet, *(f"{figure[name]:.{digits}f}" for name in names)] for triplet, figure in figures.items()]
    means = [sum(figure[name] for figure in figures.values()) / len(figures) for name in names]
    rows.append(["**mean**", *(f"**{mean:.{digits}f}**" for mean in means)])
    return markdown(("landmarks-training-test", *names), rows)


def report(folder: Path) -> Iterator[str]:
    """The lines of the page; `folder` holds the three drives."""
    triplets = {"-".join(triplet): triplet for triplet in itertools.permutations(DRIVES)}
    documents = {name: experiment(folder, triplet) for name, triplet in triplets.items()}
    single = {name: alone(folder, triplet) for name, triplet in triplets.items()}
    first = next(iter(documents.values()))
    bits = max(document["index_bits_per_map_image"] for document in documents.values())
    yield "# Single-view place recognition on real NetVLAD encodings"
    yield ""
    yield (
        f"Three drives of the Nordland route, 600 places, 64 numbers each; r = {first['config']['n_landmarks']}, "
        f"h = {first['config']['list_length']}, tolerance {first['config']['tolerance_m']:g} places, "
        f"{first['n_queries']} queries a triplet in the order they were driven, as one session. ANR: 0 is perfect, 50 "
        "chance."
    )
    yield ""
    yield (
        "Made by `python -m bench.netvlad`, which runs `deepsimbad experiment vpr` six times. `composed` also learns "
        "from the landmark traverse, here another season of the same route; `brute_force_u` compares whole what its "
        "lists stand for."
    )
    yield from ("", machine(), "", "ANR in percent:", "")
    yield from mean_table(RELEVANCES, {name: document["anr"] for name, document in documents.items()}, 2)
    yield from ("", "Recall at 1 in percent:", "")
    yield from mean_table(RELEVANCES, {name: document["recall_at_1"] for name, document in documents.items()}, 1)
    yield ""
    yield (
        f"The index takes {bits:.0f} bits a map image, counted as whole database pages: a map of 600 images "
        "hardly fills its first ones (see [bench.md](bench.md) for maps of a usual size). `brute_force` compares the "
        "encodings themselves: 2,048 bits a map image."
    )
    yield from ("", "## Every view on its own", "")
    yield (
        "ANR in percent without live statistics, as single localizations are answered. `one season`: the landmark "
        "traverse is of elsewhere, so that there is nothing to learn from."
    )
    yield ""
    yield from mean_table(list(next(iter(single.values()))), single, 2)


def main() -> None:
    """Measure, print, write `docs/results/netvlad64.md`."""
    write_page("netvlad64.md", report(real_recordings() / "nordland_netvlad64"))


if __name__ == "__main__":
    main()
