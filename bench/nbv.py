"""The paper's active experiment on real NetVLAD encodings of Nordland: all six landmark-training-test triplets.

    python -m bench.nbv [--episodes 2000]

Each triplet is what `deepsimbad experiment nbv` runs; here the episodes of all six are compared start by start.
"""

import argparse
import itertools
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.common import machine, markdown, real_recordings, write_page
from bench.netvlad import DRIVES
from deepsimbad.core.planners import CONSTANT, DEFAULT_PLANNER, RANDOM
from deepsimbad.core.relevance import Query
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.build import encode_recording
from deepsimbad.jobs.episodes import Episode, TestDrive
from deepsimbad.jobs.nbv import CLAIRVOYANT, NbvConfig, NbvReport, nbv_stages, run_nbv
from deepsimbad.jobs.progress import Progress
from deepsimbad_client.recordings.sources import open_source


@dataclass(frozen=True)
class Triplet:
    """Episodes of one landmarks-training-test permutation, and the test frame that each began on, [episodes]."""

    name: str
    report: NbvReport
    starts: NDArray[np.int64]


def measure(folder: Path, config: NbvConfig, names: tuple[str, ...]) -> Triplet:
    """Run one landmark-training-test triplet."""
    evaluator = make_evaluator(evaluator_config({"kind": "feature_l2", "extractor": "none"}))
    landmarks, training, test = (
        encode_recording(open_source(str(folder / f"{name}.npy")), evaluator, 1, lambda _: None).drive for name in names
    )
    report = run_nbv(config, evaluator, landmarks, training, test, Progress(nbv_stages(config)))
    drive = TestDrive(Query.uninformative(1), test.route(), np.empty(0, np.int64))
    starts = drive.starts(config.n_steps * max(config.actions_m), config.episodes, config.seed)
    return Triplet("-".join(names), report, starts)


def shares(episodes: list[Episode]) -> NDArray[np.float64]:
    """[episodes, steps] rank of the true image in percent."""
    return 100 * np.array([episode.rank_share for episode in episodes])


def mean_anr(triplets: list[Triplet], name: str) -> float:
    """ANR in percent, averaged over the triplets."""
    return float(np.mean([shares(triplet.report.ours[name]).mean() for triplet in triplets]))


def anr_table(triplets: list[Triplet], names: list[str]) -> Iterator[str]:
    """ANR by planner: of every triplet and on average, and on average in the paper's set-up."""
    rows = []
    for name in names:
        ours = [f"{shares(triplet.report.ours[name]).mean():.3f}" for triplet in triplets]
        paper = np.mean([shares(triplet.report.paper[name]).mean() for triplet in triplets])
        shown = f"**{name}** (default)" if name == DEFAULT_PLANNER else name
        rows.append([shown, f"**{mean_anr(triplets, name):.3f}**", *ours, f"{paper:.3f}"])
    return markdown(["planner", "mean", *(triplet.name for triplet in triplets), "mean, as in the paper"], rows)


def difference_table(triplets: list[Triplet], names: list[str]) -> Iterator[str]:
    """The default planner less every rival, episode by episode over all triplets."""
    groups = np.concatenate([1_000_000 * place + triplet.starts for place, triplet in enumerate(triplets)])
    rows = []
    for rival in [name for name in names if name not in {DEFAULT_PLANNER, CLAIRVOYANT}]:
        difference = np.concatenate(
            [
                (shares(triplet.report.ours[DEFAULT_PLANNER]) - shares(triplet.report.ours[rival])).mean(axis=1)
                for triplet in triplets
            ]
        )
        intervals = (interval(difference, np.arange(difference.size)), interval(difference, groups))
        rows.append([rival, f"{difference.mean():+.3f}", *(f"{low:+.3f} .. {high:+.3f}" for low, high in intervals)])
    return markdown(("default less", "difference", "95 %, episodes drawn", "95 %, starts drawn"), rows)


def interval(values: NDArray[np.float64], groups: NDArray[np.int64]) -> tuple[float, float]:
    """95 % bootstrap interval of the mean, drawing whole groups of values."""
    _, group = np.unique(groups, return_inverse=True)
    totals, counts = np.bincount(group, values), np.bincount(group)
    rng = np.random.default_rng(0)
    draws = (rng.integers(0, totals.size, totals.size) for _ in range(2000))
    low, high = np.percentile([totals[drawn].sum() / counts[drawn].sum() for drawn in draws], (2.5, 97.5))
    return float(low), float(high)


def distance_table(triplets: list[Triplet], names: list[str]) -> Iterator[str]:
    """ANR of the last view before a distance is exceeded, over the episodes that went so far, averaged."""
    documents = [triplet.report.as_dict({})["anr_at_distance_m"] for triplet in triplets]
    distances = list(documents[0][RANDOM])

    def cell(name: str, metres: str) -> str:
        figures = [document[name][metres] for document in documents]
        return "-" if None in figures else f"{np.mean(figures):.2f}"

    rows = [[name, *(cell(name, metres) for metres in distances)] for name in names]
    return markdown(["planner", *(f"{metres} m" for metres in distances)], rows)


def step_table(triplets: list[Triplet], names: list[str]) -> Iterator[str]:
    """ANR after every move, averaged over the triplets."""
    rows = []
    for name in (DEFAULT_PLANNER, next(name for name in names if name.startswith(CONSTANT)), RANDOM, CLAIRVOYANT):
        by_step = np.mean([shares(triplet.report.ours[name]).mean(axis=0) for triplet in triplets], axis=0)
        rows.append([name, *(f"{anr:.2f}" for anr in by_step)])
    return markdown(["planner", *map(str, range(1, triplets[0].report.config.n_steps + 1))], rows)


def page(triplets: list[Triplet], command: str, seconds: float) -> Iterator[str]:
    """All of the page."""
    config = triplets[0].report.config
    names = sorted(triplets[0].report.ours, key=partial(mean_anr, triplets))
    distinct = sorted({np.unique(triplet.starts).size for triplet in triplets})
    yield from ("# Next-best-view planners on real NetVLAD encodings", "")
    yield (
        f"Three drives of the Nordland route, 600 places a metre apart, 64 numbers each; r = {config.n_landmarks}, "
        f"h = {config.list_length}, {config.episodes or distinct[-1]} episodes of {config.n_steps} moves a planner "
        f"and triplet, moves of {min(config.actions_m):g} to {max(config.actions_m):g} m, {config.training_episodes} "
        "training episodes of NNQL at most. The robot moves exactly as far as it is told; the belief of the one map "
        "image nearest to the truth is ranked after every move (ANR in percent: 0 is perfect, 50 chance; the first "
        "view does not count)."
    )
    yield ""
    yield f"Made by `{command}` in {seconds:.0f} s; `deepsimbad experiment nbv` gives each triplet alone."
    yield from ("", machine(), "")
    yield (
        f"Relevance `{config.relevance.value}`, update `{config.update.value}`, the grid filter; the last column has "
        "the paper's, `rrf` and `additive_relevance`, with a motion error of 0.7 m. `clairvoyant` tries every move on "
        "the test drive itself, which nobody can."
    )
    yield from ("", *anr_table(triplets, names), "", "## The default against the others", "")
    yield (
        f"Paired: the same starts, all six triplets together. There are {'/'.join(map(str, distinct))} distinct starts "
        "a triplet, and where nothing is drawn equal starts have equal episodes. Drawing episodes answers for these "
        "starts; drawing starts with all their episodes is the wider and more honest interval, and still takes "
        "neighbouring starts as independent."
    )
    yield from ("", *difference_table(triplets, names), "", "## By move", "", *step_table(triplets, names))
    yield from ("", "## At equal distance", "")
    yield (
        "ANR of the last view before so many metres were exceeded, over the episodes that went so far: short moves "
        "have seen more views by then. `-`: some triplet has no such episode."
    )
    yield from ("", *distance_table(triplets, names))


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
    write_page("nbv-netvlad64.md", page(triplets, command, time.perf_counter() - began))


if __name__ == "__main__":
    main()
