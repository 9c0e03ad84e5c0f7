"""The paper's active experiment on real NetVLAD encodings of Nordland: all six landmark-training-test triplets.

    python -m bench.nbv [--episodes 2000]

Each triplet is what `deepsimbad experiment nbv` runs; here the episodes of all six are compared start by start.
"""

import argparse
import itertools
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.common import RESULTS, describe, real_recordings
from bench.netvlad import DRIVES
from deepsimbad.core.episodes import TestDrive
from deepsimbad.core.planners import CONSTANT, DEFAULT_PLANNER, RANDOM
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.experiments import CLAIRVOYANT, NbvConfig, NbvReport, nbv_stages, run_nbv
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.recordings import encode_recording
from deepsimbad_client.recordings.sources import open_source

Shares = NDArray[np.float64]
_RESAMPLES = 2000
_LEVELS = (2.5, 97.5)
_PAGE = "nbv-netvlad64.md"


@dataclass(frozen=True)
class Triplet:
    """One permutation's episodes.

    Attributes:
        name: landmarks-training-test.
        report: What every planner scored.
        starts: [episodes] the test frame every episode began on.
    """

    name: str
    report: NbvReport
    starts: NDArray[np.int64]


def measure(folder: Path, config: NbvConfig, names: tuple[str, ...]) -> Triplet:
    """Run one landmark-training-test triplet."""
    evaluator = make_evaluator(evaluator_config({"kind": "feature_l2", "extractor": "none"}))
    landmarks, training, test = (
        encode_recording(open_source(str(folder / f"{name}.npy")), evaluator, 1, lambda _: None) for name in names
    )
    report = run_nbv(config, evaluator, landmarks, training, test, Progress(nbv_stages(config)))
    drive = TestDrive([], test.route, np.empty(0, np.int64))
    starts = drive.starts(config.n_steps * max(config.actions_m), config.episodes, config.seed)
    return Triplet("-".join(names), report, starts)


def anr_table(triplets: list[Triplet]) -> list[str]:
    """ANR by planner: of every triplet and on average, and on average in the paper's set-up."""
    lines = [f"| planner | mean | {' | '.join(each.name for each in triplets)} | mean, as in the paper |"]
    lines += ["|---|" + "---|" * (len(triplets) + 2)]
    for name in sorted(triplets[0].report.ours, key=partial(mean_anr, triplets)):
        each = [100 * triplet.report.ours[name].mean() for triplet in triplets]
        paper = np.mean([100 * triplet.report.paper[name].mean() for triplet in triplets])
        shown = f"**{name}** (default)" if name == DEFAULT_PLANNER else name
        lines.append(f"| {shown} | **{np.mean(each):.3f}** | {_cells(each, 3)} | {paper:.3f} |")
    return lines


def mean_anr(triplets: list[Triplet], name: str, paper: bool = False) -> float:
    """ANR in percent, averaged over the triplets."""
    return float(np.mean([100 * (each.report.paper if paper else each.report.ours)[name].mean() for each in triplets]))


def difference_table(triplets: list[Triplet]) -> list[str]:
    """The default planner less every rival, episode by episode over all triplets."""
    rivals = [name for name in triplets[0].report.ours if name not in {DEFAULT_PLANNER, CLAIRVOYANT}]
    lines = ["| default less | difference | 95 %, episodes drawn | 95 %, starts drawn |", "|---|---|---|---|"]
    for rival in sorted(rivals, key=partial(mean_anr, triplets)):
        difference = np.concatenate(
            [100 * (each.report.ours[DEFAULT_PLANNER] - each.report.ours[rival]).mean(axis=1) for each in triplets]
        )
        groups = np.concatenate([1_000_000 * place + each.starts for place, each in enumerate(triplets)])
        by_episode = interval(difference, np.arange(difference.size))
        by_start = interval(difference, groups)
        shown = (f"{low:+.3f} .. {high:+.3f}" for low, high in (by_episode, by_start))
        lines.append(f"| {rival} | {difference.mean():+.3f} | {' | '.join(shown)} |")
    return lines


def interval(values: Shares, groups: NDArray[np.int64]) -> tuple[float, float]:
    """95 % bootstrap interval of the mean, drawing whole groups of values."""
    _, group = np.unique(groups, return_inverse=True)
    totals, counts = np.bincount(group, values), np.bincount(group)
    rng = np.random.default_rng(0)
    means = []
    for _ in range(_RESAMPLES):
        drawn = rng.integers(0, totals.size, totals.size)
        means.append(totals[drawn].sum() / counts[drawn].sum())
    low, high = np.percentile(means, _LEVELS)
    return float(low), float(high)


def distance_table(triplets: list[Triplet]) -> list[str]:
    """ANR of the last view before a distance is exceeded, over the episodes that went so far, averaged."""
    documents = [each.report.as_dict({})["anr_at_distance_m"] for each in triplets]
    distances = list(documents[0][RANDOM])
    lines = [
        "| planner | " + " | ".join(f"{metres} m" for metres in distances) + " |",
        "|---|" + "---|" * len(distances),
    ]
    for name in sorted(triplets[0].report.ours, key=partial(mean_anr, triplets)):
        cells = []
        for metres in distances:
            known = [document[name][metres] for document in documents if document[name][metres] is not None]
            cells.append(f"{np.mean(known):.2f}" if len(known) == len(documents) else "-")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def step_table(triplets: list[Triplet]) -> list[str]:
    """ANR after every move, averaged over the triplets."""
    n_steps = triplets[0].report.config.n_steps
    lines = [f"| planner | {' | '.join(str(step + 1) for step in range(n_steps))} |", "|---|" + "---|" * n_steps]
    best = min((name for name in triplets[0].report.ours if name.startswith(CONSTANT)), key=partial(mean_anr, triplets))
    for name in (DEFAULT_PLANNER, best, RANDOM, CLAIRVOYANT):
        by_step = np.mean([100 * each.report.ours[name].mean(axis=0) for each in triplets], axis=0)
        lines.append(f"| {name} | {_cells(by_step.tolist(), 2)} |")
    return lines


def _cells(values: list[float], digits: int) -> str:
    return " | ".join(f"{value:.{digits}f}" for value in values)


def page(triplets: list[Triplet], command: str, seconds: float) -> list[str]:
    """All of the page."""
    config = triplets[0].report.config
    distinct = {np.unique(each.starts).size for each in triplets}
    return [
        "# Next-best-view planners on real NetVLAD encodings",
        "",
        f"Three drives of the Nordland route, 600 places a metre apart, 64 numbers each; r = {config.n_landmarks}, "
        f"h = {config.list_length}, {config.episodes} episodes of {config.n_steps} moves a planner and triplet, "
        f"moves of {min(config.actions_m):g} to {max(config.actions_m):g} m, {config.training_episodes} training "
        "episodes of NNQL at most. The robot moves exactly as far as it is told; the belief of the one map image "
        "nearest to the truth is ranked after every move (ANR in percent: 0 is perfect, 50 chance; the first view does "
        "not count).",
        "",
        f"Made by `{command}` in {seconds:.0f} s; `deepsimbad experiment nbv` gives each triplet alone.",
        "",
        f"Machine: {describe()}",
        "",
        f"Relevance `{config.relevance.value}`, update `{config.update.value}`, the grid filter; the last column has "
        "the paper's, `rrf` and `additive_relevance`, with a motion error of 0.7 m. `clairvoyant` tries every move on "
        "the test drive itself, which nobody can.",
        "",
        *anr_table(triplets),
        "",
        "## The default against the others",
        "",
        "Paired: the same starts, all six triplets together. There are "
        f"{'/'.join(map(str, sorted(distinct)))} distinct starts a triplet, and where nothing is drawn equal starts "
        "have equal episodes. Drawing episodes answers for these starts; drawing starts with all their episodes is "
        "the wider and more honest interval, and still takes neighbouring starts as independent.",
        "",
        *difference_table(triplets),
        "",
        "## By move",
        "",
        *step_table(triplets),
        "",
        "## At equal distance",
        "",
        "ANR of the last view before so many metres were exceeded, over the episodes that went so far: short moves "
        "have seen more views by then. `-`: some triplet has no such episode.",
        "",
        *distance_table(triplets),
    ]


def main() -> None:
    """Measure, print, write `docs/results/nbv-netvlad64.md`."""
    parser = argparse.ArgumentParser(description="Next-best-view planners on real NetVLAD encodings.")
    parser.add_argument("--episodes", type=int, default=NbvConfig().episodes)
    config = NbvConfig(episodes=parser.parse_args().episodes)
    began = time.perf_counter()
    run = partial(measure, real_recordings() / "nordland_netvlad64", config)
    with ProcessPoolExecutor(2) as pool:
        triplets = list(pool.map(run, itertools.permutations(DRIVES)))
    command = " ".join(["python -m bench.nbv", *sys.argv[1:]])
    lines = page(triplets, command, time.perf_counter() - began)
    print("\n".join(lines))
    (RESULTS / _PAGE).write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"\nwritten to {RESULTS / _PAGE}", file=sys.stderr)


if __name__ == "__main__":
    main()
