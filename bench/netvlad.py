"""The paper's single-view experiment on real NetVLAD encodings of Nordland: all six landmark-training-test triplets.

    python -m bench.netvlad

Every figure comes from the command `deepsimbad experiment vpr`.
"""

import itertools
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from bench import machine
from bench.recordings import RESULTS, real_recordings
from deepsimbad.cli import run

DRIVES = ("nr", "nq", "nq2")
RELEVANCES = ("standardised", "rrf", "bag_of_landmarks", "simbad", "brute_force")


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
    documents = measure(real_recordings() / "nordland_netvlad64")
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
        "Made by `python -m bench.netvlad`, which runs `deepsimbad experiment vpr` six times.",
        "",
        f"Machine: {machine.describe()}",
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
    ]
    print("\n".join(lines))
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "netvlad64.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"\nwritten to {RESULTS / 'netvlad64.md'}", file=sys.stderr)


if __name__ == "__main__":
    main()
