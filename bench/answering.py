"""One query against maps of growing size, and one step of the active localizer with its planners."""

from collections.abc import Iterator
from statistics import median
from time import perf_counter

import numpy as np

from bench.measurement import ACTIONS_M, Timing, duration, interleaved, markdown
from bench.worlds import (
    ENCODING_DIM,
    LIST_LENGTH,
    N_LANDMARKS,
    NCLT_IMAGES,
    composed_map,
    dense_lists,
    rrf_map,
    scattered_lists,
    standardised_map,
)
from deepsimbad.core.belief.particles import FilterKind
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.index.retrieval import relevances, shortlist
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.map import Map
from deepsimbad.core.planners import INFORMED, NNQL
from deepsimbad.core.relevance import Query

SIZES = (NCLT_IMAGES, 1_000_000, 10_000_000)
N_STEPS = 300


def retrieval_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## Retrieval: relevance of all map images to {N_LANDMARKS} ranked dissimilarities (h = {LIST_LENGTH})"
    yield ""
    columns = ("relevance of all", "shortlist of 10", "index in memory", "brute-force L2", "ratio")
    yield from markdown(("map images", "relevance", *columns), _retrieval_rows())
    yield ""
    yield (
        f"Brute force is `faiss.IndexFlatL2` over {ENCODING_DIM:,}-d float32 encodings, timed in turn with our query; "
        "at the larger sizes it would need the memory given."
    )


def _retrieval_rows() -> Iterator[list[str]]:
    import faiss  # noqa: PLC0415 - the other tables go without

    rng = np.random.default_rng(1)
    dissimilarities = rng.random(N_LANDMARKS, dtype=np.float32)
    for n_images in SIZES:
        lists = scattered_lists(n_images)
        for map_ in (composed_map(lists), standardised_map(lists), rrf_map(lists)):
            query = Query(rank_landmarks(dissimilarities), dissimilarities)
            relevance = relevances(map_, query)

            def rank(map_: Map = map_, query: Query = query) -> None:
                relevances(map_, query)

            # Many of our queries for each of brute force: its half gigabyte evicts ours, which real use would not do.
            repeats = 1000 if n_images < 100_000 else 30
            ranking, listing = interleaved([rank, lambda: shortlist(relevance, 10)], repeats, warm_up=5)  # noqa: B023
            row = [f"{n_images:,}", map_.relevance.value, str(ranking), duration(listing.median_s)]
            row.append(f"{map_.lists.nbytes / 1e6:.1f} MB")
            if n_images == NCLT_IMAGES:
                index = faiss.IndexFlatL2(ENCODING_DIM)
                for start in range(0, n_images, 4096):
                    index.add(rng.normal(size=(min(4096, n_images - start), ENCODING_DIM)).astype(np.float32))
                query = rng.normal(size=(1, ENCODING_DIM)).astype(np.float32)
                calls = [lambda: [rank() for _ in range(50)], lambda: index.search(query, 10)]  # noqa: B023
                our_timing, faiss_timing = interleaved(calls, 15)
                ratio = 50 * faiss_timing.median_s / our_timing.median_s
                yield [*row, duration(faiss_timing.median_s), f"{ratio:,.0f}"]
            else:
                yield [*row, f"needs {n_images * ENCODING_DIM * 4 / 1e9:.1f} GB", ""]


def step_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## One step of the active localizer: {NCLT_IMAGES:,} map images, r = {N_LANDMARKS}, h = {LIST_LENGTH}"
    yield ""
    yield from markdown(("filter", "planner", "step, encoding apart", "planner alone"), _step_rows())
    yield ""
    yield f"{N_STEPS} steps of 1 m with a random view each, so that the belief stays wide; 1,000 particles."


def _step_rows() -> Iterator[list[str]]:
    rng = np.random.default_rng(1)
    map_ = composed_map(  # its lists drift; what it learnt is random
        dense_lists(NCLT_IMAGES),
        actions_m=np.array(ACTIONS_M),
        view_bits=rng.random(NCLT_IMAGES).astype(np.float32),
        q_values=rng.random((NCLT_IMAGES, len(ACTIONS_M))).astype(np.float32),
    )
    views = [Query(rng.permutation(N_LANDMARKS).astype(np.float32) + 1) for _ in range(32)]
    for kind in FilterKind:
        for planner in (INFORMED, NNQL):
            localizer = ActiveLocalizer(map_, LocalizerConfig(filter=kind, planner=planner), perf_counter)
            state = localizer.start()
            seconds, planning_ms = [], []
            for number in range(N_STEPS + 10):
                start_s = perf_counter()
                step = localizer.step(state, views[number % len(views)], 1.0)
                if number >= 10:
                    seconds.append(perf_counter() - start_s)
                    planning_ms.append(step.timings_ms["plan"])
                state = step.state
            yield [kind.value, f"`{planner}`", str(Timing(seconds)), duration(median(planning_ms) / 1000)]
