"""What a map takes: selecting its landmarks, its file, learning where to look next."""

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
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.common import duration, timed
from bench.worlds import (
    ENCODING_DIM,
    N_LANDMARKS,
    NCLT_IMAGES,
    Lists,
    dense_lists,
    rrf_map,
    scattered_lists,
    standardised_map,
)
from deepsimbad.core.landmark_model import select_landmarks
from deepsimbad.core.map import Map
from deepsimbad.core.nnql import NnqlConfig
from deepsimbad.core.planners import PlanningView, plan_by_experience
from deepsimbad.core.relevance import DEFAULT_UPDATE, Query, Relevance
from deepsimbad.core.training import TrainingWorld, train
from deepsimbad.store.map_file import index_bytes, read_map, table_bytes, write_map
from deepsimbad.store.sealing import seal

N_CANDIDATES = 26_000


def landmark_table() -> Iterator[str]:
    """Markdown lines."""
    yield "## Landmark selection"
    yield ""
    yield "| candidates | dimensions | landmarks | seconds | peak memory, candidates included |"
    yield "|---|---|---|---|---|"
    run = subprocess.run(
        [sys.executable, "-m", "bench.building", "landmarks"], check=True, capture_output=True, text=True
    )
    measured = json.loads(run.stdout)
    yield (
        f"| {N_CANDIDATES:,} | {ENCODING_DIM:,} | {N_LANDMARKS} | {measured['seconds']:.1f} "
        f"| {measured['peak_bytes'] / 1e9:.2f} GB |"
    )


def _select_once() -> None:
    """Print seconds and peak memory of one selection as JSON."""
    candidates = np.empty((N_CANDIDATES, ENCODING_DIM), np.float32)
    rng = np.random.default_rng(0)
    for start in range(0, N_CANDIDATES, 1000):  # in blocks: the measured peak is the selection's, not the generator's
        block = rng.standard_normal((1000, ENCODING_DIM), dtype=np.float32)
        candidates[start : start + 1000] = block / np.linalg.norm(block, axis=1, keepdims=True)
    select_landmarks(candidates[:2000], 10)  # compile
    began = perf_counter()
    select_landmarks(candidates, N_LANDMARKS)
    seconds = perf_counter() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    sys.stdout.write(json.dumps({"seconds": seconds, "peak_bytes": peak}))


def map_file_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## Map file: {NCLT_IMAGES:,} map images, r = {N_LANDMARKS}, h = 4, {ENCODING_DIM:,}-d landmark model"
    yield ""
    yield "| map images' lists | index, bits a map image | whole file | write | seal | load into memory |"
    yield "|---|---|---|---|---|---|"
    sizes: dict[str, int] = {}
    for lists in (scattered_lists(NCLT_IMAGES), dense_lists(NCLT_IMAGES)):
        row, sizes = _row(lists)
        yield row
    yield ""
    yield "Bits are the `dbstat` pages of the posting table. Tables of the last file, bytes: " + ", ".join(
        f"{name} {n_bytes:,}" for name, n_bytes in sorted(sizes.items(), key=lambda item: -item[1]) if n_bytes
    )


def _row(lists: Lists) -> tuple[str, dict[str, int]]:
    contents = contents_of(lists)
    with tempfile.TemporaryDirectory() as folder:
        building, sealed = Path(folder) / "1.building", Path(folder) / "1.sqlite"
        writing = timed(lambda: write_map(building, contents), repeats=3)

        def seal_again() -> None:
            sealed.unlink(missing_ok=True)
            write_map(building, contents)
            seal(building, sealed)

        sealing_s = timed(seal_again, repeats=3).median_s - writing.median_s
        loading = timed(lambda: read_map(sealed), repeats=9)
        bits = 8 * index_bytes(sealed) / NCLT_IMAGES
        row = (
            f"| {lists.name} | {bits:.1f} | {sealed.stat().st_size / 1e6:.1f} MB | {duration(writing.median_s)} "
            f"| {duration(sealing_s)} | {loading} |"
        )
        return row, table_bytes(sealed)


def contents_of(lists: Lists, **more: Any) -> Map:
    """A map of these lists, with a landmark model of the paper's size."""
    prototypes = np.random.default_rng(0).normal(size=(N_LANDMARKS, ENCODING_DIM)).astype(np.float32)
    known = {"evaluator": {"kind": "feature_l2"}, "actions_m": np.ones(1), "landmark_model": {"prototypes": prototypes}}
    return standardised_map(lists.lists, **{**known, **more})


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
        command = [sys.executable, "-m", "bench.building", relevance.value]
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


def _train_once(relevance: Relevance) -> None:
    """Print seconds and peak memory of one training as JSON."""
    config = NnqlConfig()
    world = _world(relevance, config)
    with ThreadPoolExecutor(2) as pool:
        train(world, replace(config, n_episodes=100), lambda _: None, pool)  # compiles
        began, began_processor = time.perf_counter(), time.process_time()
        _, curve = train(world, config, lambda _: None, pool)
        seconds, processor_seconds = time.perf_counter() - began, time.process_time() - began_processor
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    spent = {"seconds": seconds, "processor_seconds": processor_seconds, "peak_mb": peak_mb}
    print(json.dumps({**spent, **curve.as_dict()}))


def main() -> None:
    """Measure once, in a process of its own so that its memory can be read off."""
    if sys.argv[1] == "landmarks":
        _select_once()
    else:
        _train_once(Relevance(sys.argv[1]))


if __name__ == "__main__":
    main()
