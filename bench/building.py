"""What a map takes: selecting its landmarks, its file, learning where to look next."""

import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time

import numpy as np

from bench.measurement import ACTIONS_M, Command, duration, markdown, timed, work_folder
from bench.worlds import (
    ENCODING_DIM,
    N_CANDIDATES,
    N_LANDMARKS,
    NCLT_IMAGES,
    SPACING_M,
    dense_lists,
    rrf_map,
    scattered_lists,
    standardised_map,
)
from deepsimbad.core.building import MapPlan
from deepsimbad.core.composed import MOST_DIMENSIONS, compose, unit
from deepsimbad.core.drive import Drive
from deepsimbad.core.experience.nnql import NnqlConfig
from deepsimbad.core.experience.training import TrainingWorld, train
from deepsimbad.core.landmark_model import select_landmarks
from deepsimbad.core.map import Map
from deepsimbad.core.planners import PlanningView, information_ahead, plan_by_experience
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.jobs.build import build, measure_drive, views_of
from deepsimbad.store.map_file import index_bytes, read_map, seal, table_bytes, write_map

_DIM = 64  # of encodings whose number is all that counts


def landmark_table() -> Iterator[str]:
    """Markdown lines."""
    yield from ("## Landmark selection", "")
    spent = _in_own_process("landmarks")
    shape = [f"{N_CANDIDATES:,}", f"{ENCODING_DIM:,}", N_LANDMARKS]
    head = ("candidates", "dimensions", "landmarks", "seconds", "peak memory, candidates included")
    yield from markdown(head, [[*shape, f"{spent['seconds']:.1f}", f"{spent['peak_mb'] / 1e3:.2f} GB"]])


def _in_own_process(task: str) -> dict[str, float]:
    """The figures that `measure` prints for a task, in a process of its own, whose peak of memory is the task's."""
    command = [sys.executable, "-m", "bench.building", task]
    output = subprocess.check_output(command)  # noqa: S603 - our own interpreter
    return dict(json.loads(output))


def map_file_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## Map file: {NCLT_IMAGES:,} map images, r = {N_LANDMARKS}, h = 4, {ENCODING_DIM:,}-d landmark model"
    yield ""
    head = ("map images' lists", "index, bits a map image", "whole file", "write", "seal", "load into memory")
    kinds = {
        "every image's landmarks drawn at random": _with_model(standardised_map(scattered_lists(NCLT_IMAGES))),
        "landmarks that drift from image to image": _with_model(standardised_map(dense_lists(NCLT_IMAGES))),
    }
    with work_folder() as folder:
        building, sealed = folder / "1.building", folder / "1.sqlite"
        yield from markdown(head, (_map_file_row(name, map_, building, sealed) for name, map_ in kinds.items()))
        sizes = sorted(table_bytes(sealed).items(), key=lambda item: -item[1])
    yield ""
    yield "Bits are the `dbstat` pages of the posting table. Tables of the last file, bytes: " + ", ".join(
        f"{name} {n_bytes:,}" for name, n_bytes in sizes if n_bytes
    )


def _map_file_row(name: str, map_: Map, building: Path, sealed: Path) -> list[str]:
    writing = timed(lambda: write_map(building, map_), repeats=3)

    def write_and_seal() -> None:
        sealed.unlink(missing_ok=True)
        write_map(building, map_)
        seal(building, sealed)

    sealing_s = timed(write_and_seal, repeats=3).median_s - writing.median_s
    loading = timed(lambda: read_map(sealed), repeats=9)
    bits, megabytes = 8 * index_bytes(sealed) / NCLT_IMAGES, sealed.stat().st_size / 1e6
    times = (duration(writing.median_s), duration(sealing_s), str(loading))
    return [name, f"{bits:.1f}", f"{megabytes:.1f} MB", *times]


def _with_model(map_: Map) -> Map:
    """A map with a landmark model of the paper's size."""
    prototypes = np.random.default_rng(0).normal(size=(N_LANDMARKS, ENCODING_DIM)).astype(np.float32)
    actions_m = np.ones(1) if map_.q_values is None else map_.actions_m
    evaluator = {"kind": "feature_l2"}
    return replace(map_, evaluator=evaluator, actions_m=actions_m, landmark_model={"prototypes": prototypes})


def composed_table() -> Iterator[str]:
    """Markdown lines."""
    yield from (f"## Lists and the planner's table: {NCLT_IMAGES:,} map images, r = {N_LANDMARKS}, h = 4", "")
    rng = np.random.default_rng(0)
    places, landmarks = (unit(rng.normal(size=(count, MOST_DIMENSIONS))) for count in (NCLT_IMAGES, N_LANDMARKS))
    listing = timed(lambda: compose(places, landmarks, 4), repeats=3, warm_up=1)
    view_bits = rng.random(NCLT_IMAGES).astype(np.float32)
    map_ = rrf_map(dense_lists(NCLT_IMAGES), actions_m=np.array(ACTIONS_M), view_bits=view_bits)
    prices = iter(np.arange(1, 100) / 1000)  # a price that was asked before is kept
    planning = timed(lambda: information_ahead(map_, float(next(prices))), repeats=9)
    yield f"Lists of `composed`: {listing}. The table of `informed`, once a map and price: {planning}."


def nnql_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## NNQL: {NCLT_IMAGES:,} map images {SPACING_M:g} m apart, 10 actions, r = {N_LANDMARKS}, h = 4"
    yield ""
    yield "Training: 10,000 episodes of 10 actions in two threads, every belief over all map images."
    yield ""
    head = ("relevance, update", "time", "processor time", "peak memory of the whole process")
    rows = []
    for relevance in (Relevance.RRF, Relevance.STANDARDISED, Relevance.COMPOSED):
        spent = _in_own_process(relevance.value)
        times = (f"{spent['seconds']:.1f} s", f"{spent['processor_seconds']:.1f} s", f"{spent['peak_mb']:.0f} MB")
        rows.append((f"{relevance.value}, {relevance.traits.update.value}", *times))
    yield from markdown(head, rows)
    yield ""
    rng = np.random.default_rng(0)  # values as training leaves them: about 950, hardly two alike
    q_values = (900 + 50 * rng.normal(size=(NCLT_IMAGES, len(ACTIONS_M)))).astype(np.float32)
    lists, learnt = dense_lists(NCLT_IMAGES), {"actions_m": np.array(ACTIONS_M), "q_values": q_values}
    view = PlanningView(rrf_map(lists, **learnt), np.empty(0), rng.normal(size=NCLT_IMAGES).astype(np.float32), 0, 1)
    planning = timed(lambda: plan_by_experience(view), repeats=201, warm_up=20)
    yield f"Values of a view's 10 actions, the four nearest of {NCLT_IMAGES:,} map images included: {planning}."
    yield ""
    with work_folder() as folder:
        path = folder / "map"
        write_map(path, _with_model(standardised_map(lists, **learnt)))
        n_bytes = table_bytes(path)["q_value"] / NCLT_IMAGES
    yield f"The experience database takes {n_bytes:.1f} bytes a map image (`dbstat` pages)."


def measure(task: str) -> None:
    """Print what one selection or one training takes, as JSON."""
    spent = _selection() if task == "landmarks" else _training(Relevance(task))
    print(json.dumps({**spent, "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6}))


def _selection() -> dict[str, float]:
    candidates = np.empty((N_CANDIDATES, ENCODING_DIM), np.float32)
    rng = np.random.default_rng(0)
    for start in range(0, N_CANDIDATES, 1000):  # in blocks: the measured peak is the selection's, not the generator's
        block = rng.standard_normal((1000, ENCODING_DIM), dtype=np.float32)
        candidates[start : start + 1000] = block / np.linalg.norm(block, axis=1, keepdims=True)
    select_landmarks(candidates[:2000], 10)  # compiles
    start_s = perf_counter()
    select_landmarks(candidates, N_LANDMARKS)
    return {"seconds": perf_counter() - start_s}


def _training(relevance: Relevance) -> dict[str, float]:
    """Seconds of training on a live drive that resembles the places it passes."""
    config = NnqlConfig()
    map_, views = _composed_map() if relevance is Relevance.COMPOSED else _map_of_lists(relevance)
    world = TrainingWorld.on(map_, views, map_.route, np.arange(NCLT_IMAGES), config)
    with ThreadPoolExecutor(2) as pool:
        train(world, replace(config, n_episodes=100), lambda _: None, pool)  # compiles
        start_s, start_processor_s = perf_counter(), process_time()
        train(world, config, lambda _: None, pool)
        return {"seconds": perf_counter() - start_s, "processor_seconds": process_time() - start_processor_s}


def _map_of_lists(relevance: Relevance) -> tuple[Map, Query]:
    lists = dense_lists(NCLT_IMAGES)
    level = np.random.default_rng(0).random((NCLT_IMAGES, N_LANDMARKS), np.float32)
    level[np.arange(NCLT_IMAGES), lists] *= 0.2
    ranks = np.empty_like(level)
    np.put_along_axis(ranks, level.argsort(axis=1), np.arange(1, N_LANDMARKS + 1, dtype=np.float32)[np.newaxis], axis=1)
    make = rrf_map if relevance is Relevance.RRF else standardised_map
    return make(lists, actions_m=np.array(ACTIONS_M)), Query(ranks)


def _composed_map() -> tuple[Map, Query]:
    """A map of a drive with landmarks of its own, and the views of another drive that passes the same places."""
    rng, evaluator = np.random.default_rng(0), FeatureL2("none")
    places = np.cumsum(rng.normal(size=(NCLT_IMAGES, _DIM)), axis=0)
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    seasons = (places + 0.5 / np.sqrt(_DIM) * rng.normal(size=places.shape) for _ in range(2))
    drive, live_drive = (
        Drive(position_m=np.arange(NCLT_IMAGES) * SPACING_M, encodings=season.astype(np.float32)) for season in seasons
    )
    map_ = build(MapPlan(Relevance.COMPOSED, 4, ACTIONS_M), drive, None, drive, N_LANDMARKS, evaluator).map
    return map_, views_of(measure_drive(live_drive, map_.landmark_model, evaluator))


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("task", choices=("landmarks", *Relevance))
    command.run(lambda arguments: measure(arguments.task))
