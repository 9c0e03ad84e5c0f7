"""Measure every candidate for the embedded extractor and write docs/results/extractors.md.

Needs the real recordings named by DEEPSIMBAD_REAL_DATA (default ../shared/data beside the project).
"""

import os
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from bench import machine
from bench.extractors.candidate import Candidate
from bench.extractors.census import CENSUS
from bench.extractors.entrant import LANDMARKS, LIST_LENGTH, Entrant
from bench.extractors.gist import GIST
from bench.extractors.hog import HOG
from bench.extractors.root_sift_vlad import ROOT_SIFT_VLAD
from bench.extractors.thumbnail import CONTRAST_THUMBNAIL, PATCH_THUMBNAIL
from bench.extractors.trials import Recordings, all_recordings, groups
from deepsimbad.evaluators.extractors.gradient_grid import GradientGrid

PROJECT = Path(__file__).resolve().parents[2]
RESULTS = PROJECT / "docs" / "results" / "extractors.md"
SHIPPED = Candidate.unfitted("**gradient grid** (shipped)", GradientGrid.input_size, GradientGrid())
CANDIDATES = (SHIPPED, HOG, CONTRAST_THUMBNAIL, PATCH_THUMBNAIL, ROOT_SIFT_VLAD, GIST, CENSUS)


def main() -> None:
    """Print the report as it is measured, then write it."""
    cv2.setNumThreads(1)
    data = Path(os.environ.get("DEEPSIMBAD_REAL_DATA", PROJECT.parent / "shared" / "data"))
    if not data.is_dir():
        sys.exit(f"no real recordings at {data}: set DEEPSIMBAD_REAL_DATA to their folder")
    lines = []
    for line in report(all_recordings(data)):
        print(line, flush=True)
        lines.append(line)
    RESULTS.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"written to {RESULTS}", file=sys.stderr)


def report(recordings: Recordings) -> Iterator[str]:
    """The lines of the markdown report."""
    grouped = groups(recordings.trials)
    yield from (
        "# Embedded extractors",
        "",
        "Made by `DEEPSIMBAD_REAL_DATA=... python -m bench.extractors`.",
        "",
        f"Machine: {machine.describe()}",
        "",
        "ANR in percent (smaller is better, 50 is chance) as brute force / rrf / standardised. Stateless queries, "
        f"at most {LANDMARKS} landmarks,",
        f"lists of {LIST_LENGTH}; d: numbers an encoding; ms: median time to encode one image on one thread at its "
        "input size.",
        "",
        "| candidate | input | d | ms | " + " | ".join(grouped) + " |",
        "|---|---|---|---|" + "---|" * len(grouped),
    )
    for candidate in CANDIDATES:
        entrant = Entrant(candidate, recordings)
        cells = []
        for trials in grouped.values():
            scores = np.mean([entrant.anr(trial) for trial in trials], axis=0)
            cells.append(" / ".join(f"{score:.2f}" for score in scores))
        milliseconds = statistics.median(entrant.seconds) * 1e3
        width, height = candidate.input_size
        yield (
            f"| {candidate.name} | {width} x {height} | {entrant.encoding_dim} | {milliseconds:.2f} | "
            + " | ".join(cells)
            + " |"
        )
    yield from ("", "Trials:", "")
    for group, trials in grouped.items():
        first = trials[0]
        n_scored = sum(truth.size > 0 for truth in first.truth)
        yield (
            f"- {group}: landmarks {first.landmarks}, map {first.mapped}, live {first.live}, "
            f"{len(recordings[first.mapped])} map images, {n_scored} queries"
            + (f"; mean over {len(trials)} permutations of the drives" if len(trials) > 1 else "")
            + "."
        )
    yield from (f"- {note}." for note in recordings.notes)


if __name__ == "__main__":
    main()
