"""Nearest-neighbour Q-learning on a map of one of the paper's traverses: training, planning, size."""

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.map_file import contents_of
from bench.timing import timed
from bench.worlds import N_LANDMARKS, NCLT_IMAGES, dense_lists, rrf_map, standardised_map
from deepsimbad.core.nnql import NnqlConfig
from deepsimbad.core.planners import PlanningView, plan_by_experience
from deepsimbad.core.relevance import DEFAULT_UPDATE, Query, Relevance
from deepsimbad.core.training import TrainingWorld, train
from deepsimbad.store.map_file import table_bytes, write_map

ACTIONS_M = tuple(float(metres) for metres in range(1, 11))
SPACING_M = 0.2  # of NCLT's frames at walking speed


def nnql_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## NNQL: {NCLT_IMAGES:,} map images {SPACING_M:g} m apart, 10 actions, r = {N_LANDMARKS}, h = 4"
    yield ""
    yield "Training: 10,000 episodes of 10 actions in two threads, every belief over all map images."
    yield ""
    yield "| relevance, update | time | processor time | peak memory of the whole process |"
    yield "|---|---|---|---|"
    for relevance in (Relevance.RRF, Relevance.STANDARDISED):
        command = [sys.executable, "-m", "bench.nnql", relevance.value]
        ran = subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603 - our own interpreter
        found = json.loads(ran.stdout)
        yield (
            f"| {relevance.value}, {DEFAULT_UPDATE[relevance].value} | {found['seconds']:.1f} s "
            f"| {found['processor_seconds']:.1f} s "
            f"| {found['peak_mb']:.0f} MB |"
        )
    yield ""
    q_values = _learnt_values()
    relevance_row = np.random.default_rng(0).normal(size=NCLT_IMAGES).astype(np.float32)
    learnt = rrf_map(dense_lists(NCLT_IMAGES).lists, actions_m=np.array(ACTIONS_M), q_values=q_values)
    view = PlanningView(learnt, np.empty(0), relevance_row, 0, 1)
    planning = timed(lambda: plan_by_experience(view), repeats=201, warm_up=20)
    yield f"Values of a view's 10 actions, the four nearest of {NCLT_IMAGES:,} map images included: {planning}."
    yield ""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map"
        write_map(path, contents_of(dense_lists(NCLT_IMAGES), actions_m=np.array(ACTIONS_M), q_values=q_values))
        n_bytes = table_bytes(path)["q_value"] / NCLT_IMAGES
    yield f"The experience database takes {n_bytes:.1f} bytes a map image (`dbstat` pages)."


def _world(relevance: Relevance, config: NnqlConfig) -> TrainingWorld:
    """A live drive whose landmark order resembles the lists of the places it passes."""
    lists = dense_lists(NCLT_IMAGES).lists
    rng = np.random.default_rng(0)
    level = rng.random((NCLT_IMAGES, N_LANDMARKS), np.float32)
    level[np.arange(NCLT_IMAGES), lists] *= 0.2
    ranks = np.empty_like(level)
    np.put_along_axis(ranks, level.argsort(axis=1), np.arange(1, N_LANDMARKS + 1, dtype=np.float32)[np.newaxis], axis=1)
    make = rrf_map if relevance is Relevance.RRF else standardised_map
    built = make(lists, actions_m=np.array(ACTIONS_M))
    return TrainingWorld.on(built, Query(ranks), built.route, np.arange(NCLT_IMAGES), config)


def _learnt_values() -> NDArray[np.float32]:
    """Values as training leaves them: about 950, hardly two alike; drawn, for size and speed alone."""
    return (900 + 50 * np.random.default_rng(0).normal(size=(NCLT_IMAGES, len(ACTIONS_M)))).astype(np.float32)


def main() -> None:
    """Train once in a process of its own; seconds and peak memory as JSON."""
    config = NnqlConfig()
    world = _world(Relevance(sys.argv[1]), config)
    with ThreadPoolExecutor(2) as pool:
        train(world, replace(config, n_episodes=100), lambda _: None, pool)  # compiles
        began, began_processor = time.perf_counter(), time.process_time()
        _, curve = train(world, config, lambda _: None, pool)
        seconds, processor_seconds = time.perf_counter() - began, time.process_time() - began_processor
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    spent = {"seconds": seconds, "processor_seconds": processor_seconds, "peak_mb": peak_mb}
    print(json.dumps({**spent, **curve.as_dict()}))


if __name__ == "__main__":
    main()
