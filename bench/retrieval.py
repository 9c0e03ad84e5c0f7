"""One query against maps of growing size, beside brute-force L2 of the encodings it replaces."""

from collections.abc import Callable, Iterator

import faiss
import numpy as np

from bench.timing import duration, interleaved
from bench.worlds import ENCODING_DIM, LIST_LENGTH, N_LANDMARKS, NCLT_IMAGES, rrf_map, scattered_lists, standardised_map
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.map import Map
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
            yield _row(built, dissimilarities, brute_force, rng)
    yield ""
    yield (
        f"Brute force is `faiss.IndexFlatL2` over {ENCODING_DIM:,}-d float32 encodings, timed in turn with our query; "
        "at the larger sizes it would need the memory given."
    )


def _row(
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
