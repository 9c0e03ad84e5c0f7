"""The paper's single-view experiment on real NetVLAD encodings of Nordland: all six landmark-training-test triplets.

    python -m bench.netvlad

The figures of a session come from the command `deepsimbad experiment vpr`. Those of views on their own are what the
service answers to single localizations: the map's statistics are never moved on.
"""

import itertools
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import RESULTS, describe, real_recordings
from deepsimbad.cli import run
from deepsimbad.core.building import build_map
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import Drive, SecondSeason
from deepsimbad.core.landmark_model import select_landmarks
from deepsimbad.core.metrics import RetrievalScorer
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.core.retrieval import relevances
from deepsimbad.evaluators.feature_l2 import FeatureL2

DRIVES = ("nr", "nq", "nq2")
RELEVANCES = ("calibrated", "standardised", "rrf", "bag_of_landmarks", "simbad", "brute_force")
N_LANDMARKS, LIST_LENGTH, TOLERANCE = 300, 4, 2
_FALLEN_BACK = "calibrated, one season"


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


def alone(folder: Path, triplet: tuple[str, ...]) -> dict[str, float]:
    """ANR in percent of every test frame localized on its own."""
    landmarks, training, test = (np.load(folder / f"{name}.npy").astype(np.float32) for name in triplet)
    evaluator = FeatureL2("none")
    model = evaluator.fit_landmarks(landmarks[select_landmarks(landmarks, N_LANDMARKS)])
    seen, other, live = (evaluator.dissimilarities(each, model) for each in (training, landmarks, test))
    frames = np.arange(len(training))
    second = SecondSeason(other, np.stack([frames, frames], axis=1))
    drive = Drive(position_m=frames.astype(float), encodings=training, dissimilarities=seen)
    maps = {
        "calibrated": build_map(Relevance.CALIBRATED, drive, LIST_LENGTH, second_season=second),
        _FALLEN_BACK: build_map(Relevance.CALIBRATED, drive, LIST_LENGTH),
        "standardised": build_map(Relevance.STANDARDISED, drive, LIST_LENGTH),
    }
    anr = {}
    for name, built in maps.items():
        scorer = RetrievalScorer()
        for frame, ranks in enumerate(rank_landmarks(live)):
            scorer.add(relevances(built, Query(ranks)), np.flatnonzero(np.abs(frames - frame) <= TOLERANCE))
        anr[name] = scorer.result().anr
    return anr


def alone_table(measured: dict[str, dict[str, float]]) -> list[str]:
    """Markdown lines of `alone`, with the means in the last row."""
    names = list(next(iter(measured.values())))
    lines = [f"| landmarks-training-test | {' | '.join(names)} |", "|---|" + "---|" * len(names)]
    for triplet, anr in measured.items():
        lines.append(f"| {triplet} | " + " | ".join(f"{anr[name]:.2f}" for name in names) + " |")
    means = [sum(anr[name] for anr in measured.values()) / len(measured) for name in names]
    return [*lines, "| **mean** | " + " | ".join(f"**{mean:.2f}**" for mean in means) + " |"]


def measure(folder: Path) -> dict[str, dict[str, Any]]:
    """Every permutation's document, by its name.

    Args:
        folder: Holds `nr.npy`, `nq.npy` and `nq2.npy`.
    """
    return {"-".join(triplet): experiment(folder, triplet) for triplet in itertools.permutations(DRIVES)}


def table(documents: dict[str, dict[str, Any]], figure: str, digits: int) -> list[str]:
    """Markdown lines of one figure, with the means in the last row."""
    lines = [f"| landmarks-training-test | {' | '.join(RELEVANCES)} |", "|---|" + "---|" * len(RELEVANCES)]
    for name, document in documents.items():
        lines.append(f"| {name} | " + " | ".join(f"{document[figure][each]:.{digits}f}" for each in RELEVANCES) + " |")
    means = [sum(document[figure][each] for document in documents.values()) / len(documents) for each in RELEVANCES]
    return [*lines, "| **mean** | " + " | ".join(f"**{mean:.{digits}f}**" for mean in means) + " |"]


def main() -> None:
    """Measure, print, write `docs/results/netvlad64.md`."""
    folder = real_recordings() / "nordland_netvlad64"
    documents = measure(folder)
    single = {"-".join(triplet): alone(folder, triplet) for triplet in itertools.permutations(DRIVES)}
    config = next(iter(documents.values()))["config"]
    n_queries = next(iter(documents.values()))["n_queries"]
    bits = [document["index_bits_per_map_image"] for document in documents.values()]
    lines = [
        "# Single-view place recognition on real NetVLAD encodings",
        "",
        f"Three drives of the Nordland route, 600 places, 64 numbers each; r = {config['n_landmarks']}, "
        f"h = {config['list_length']}, tolerance {config['tolerance_m']:g} places, {n_queries} queries a triplet in "
        "the order they were driven, as one session. ANR: 0 is perfect, 50 chance.",
        "",
        "Made by `python -m bench.netvlad`, which runs `deepsimbad experiment vpr` six times. `calibrated` also learns "
        "from the landmark traverse, here another season of the same route.",
        "",
        f"Machine: {describe()}",
        "",
        "ANR in percent:",
        "",
        *table(documents, "anr", 2),
        "",
        "Recall at 1 in percent:",
        "",
        *table(documents, "recall_at_1", 1),
        "",
        f"The index takes {max(bits):.0f} bits a map image, counted as whole database pages: a map of 600 images "
        "hardly fills its first ones (see [bench.md](bench.md) for maps of a usual size). `brute_force` compares the "
        "encodings themselves: 2,048 bits a map image.",
        "",
        "## Every view on its own",
        "",
        "ANR in percent without live statistics, as single localizations are answered. `one season`: the landmark "
        "traverse is of elsewhere, so that there is nothing to learn from.",
        "",
        *alone_table(single),
    ]
    print("\n".join(lines))
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "netvlad64.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"\nwritten to {RESULTS / 'netvlad64.md'}", file=sys.stderr)


if __name__ == "__main__":
    main()
