"""One query against maps of growing size, and one step of the active localizer with its planners."""

from collections.abc import Callable, Iterator
from statistics import median
from time import perf_counter

import faiss
import numpy as np

from bench.common import Timing, duration, interleaved
from bench.worlds import (
    ENCODING_DIM,
    LIST_LENGTH,
    N_LANDMARKS,
    NCLT_IMAGES,
    dense_lists,
    rrf_map,
    scattered_lists,
    standardised_map,
)
from deepsimbad.core.belief import FilterKind
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.map import Map
from deepsimbad.core.planners import NNQL, TELLING
from deepsimbad.core.relevance import Query
from deepsimbad.core.retrieval import relevances, shortlist

SIZES = (NCLT_IMAGES, 1_000_000, 10_000_000)


def retrieval_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## Retrieval: rank {N_LANDMARKS} dissimilarities, relevance of all map images (h = {LIST_LENGTH})"
    yield ""
    yield "| map images | relevance | rank + relevance | shortlist of 10 | index in memory | brute-force L2 | ratio |"
    yield "|---|---|---|---|---|---|---|"
    rng = np.random.default_rng(1)
    dissimilarities = rng.random(N_LANDMARKS, dtype=np.float32)
    for n_images in SIZES:
        standardised = standardised_map(scattered_lists(n_images).lists)
        maps = [standardised, rrf_map(standardised.lists)]
        brute_force = _faiss_index(n_images, rng) if n_images == NCLT_IMAGES else None
        for built in maps:
            yield _retrieval_row(built, dissimilarities, brute_force, rng)
    yield ""
    yield (
        f"Brute force is `faiss.IndexFlatL2` over {ENCODING_DIM:,}-d float32 encodings, timed in turn with our query; "
        "at the larger sizes it would need the memory given."
    )


def _retrieval_row(
    built: Map,
    dissimilarities: np.ndarray,
    brute_force: "faiss.IndexFlatL2 | None",
    rng: np.random.Generator,
) -> str:
    n_images = built.n_images
    relevance = relevances(built, Query(rank_landmarks(dissimilarities)))
    runs = [
        lambda: relevances(built, Query(rank_landmarks(dissimilarities))),
        lambda: shortlist(relevance, 10),
    ]
    # Many of our queries for each of brute force: else its half gigabyte evicts ours, which real use would not do.
    ours = interleaved(runs, repeats=1000 if n_images < 100_000 else 30, warm_up=5)
    cells = [f"{n_images:,}", built.relevance.value, str(ours[0]), duration(ours[1].median_s)]
    cells.append(f"{built.lists.nbytes / 1e6:.1f} MB")
    if brute_force is None:
        cells += [f"needs {n_images * ENCODING_DIM * 4 / 1e9:.1f} GB", ""]
    else:
        query = rng.normal(size=(1, ENCODING_DIM)).astype(np.float32)
        pair = interleaved([_times(runs[0], 50), lambda: brute_force.search(query, 10)], repeats=15)
        slow, fast = pair[1].median_s, pair[0].median_s / 50
        cells += [duration(slow), f"{slow / fast:,.0f}"]
    return f"| {' | '.join(cells)} |"


def _times(run: Callable[[], object], count: int) -> Callable[[], None]:
    def repeated() -> None:
        for _ in range(count):
            run()

    return repeated


def _faiss_index(n_images: int, rng: np.random.Generator) -> "faiss.IndexFlatL2":
    index = faiss.IndexFlatL2(ENCODING_DIM)
    for start in range(0, n_images, 4096):
        index.add(rng.normal(size=(min(4096, n_images - start), ENCODING_DIM)).astype(np.float32))
    return index


_STEPS = 300
_ACTIONS_M = tuple(float(metres) for metres in range(1, 11))


def step_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## One step of the active localizer: {NCLT_IMAGES:,} map images, r = {N_LANDMARKS}, h = {LIST_LENGTH}"
    yield ""
    yield "| filter | planner | step, encoding apart | planner alone |"
    yield "|---|---|---|---|"
    snapshot = _snapshot()
    rng = np.random.default_rng(0)
    views = [Query(rng.permutation(N_LANDMARKS).astype(np.float32) + 1) for _ in range(32)]
    for kind in FilterKind:
        for planner in (NNQL, TELLING):
            localizer = ActiveLocalizer(snapshot, LocalizerConfig(filter=kind, planner=planner), perf_counter)
            yield _step_row(kind, planner, localizer, views)
    yield ""
    yield f"{_STEPS} steps of 1 m with a random view each, so that the belief stays wide; 1,000 particles."


def _step_row(kind: FilterKind, planner: str, localizer: ActiveLocalizer, views: list[Query]) -> str:
    state = localizer.start()
    seconds, planning_ms = [], []
    for number in range(_STEPS + 10):
        began = perf_counter()
        step = localizer.step(state, views[number % len(views)], 1.0)
        if number >= 10:
            seconds.append(perf_counter() - began)
            planning_ms.append(step.timings_ms["plan"])
        state = step.state
    return f"| {kind.value} | `{planner}` | {Timing(tuple(seconds))} | {duration(median(planning_ms) / 1000)} |"


def _snapshot() -> Map:
    """A map whose lists drift, with an experience database and telling places of random values."""
    rng = np.random.default_rng(1)
    return standardised_map(
        dense_lists(NCLT_IMAGES).lists,
        actions_m=np.array(_ACTIONS_M),
        telling_bits=rng.random(NCLT_IMAGES).astype(np.float32),
        q_values=rng.random((NCLT_IMAGES, len(_ACTIONS_M))).astype(np.float32),
    )
