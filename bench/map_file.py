"""Writing, sealing, loading and size of a map file."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bench.timing import duration, timed
from bench.worlds import ENCODING_DIM, N_LANDMARKS, NCLT_IMAGES, Lists, dense_lists, scattered_lists, standardised_map
from deepsimbad.core.map import Map
from deepsimbad.store.map_file import index_bytes, read_map, table_bytes, write_map
from deepsimbad.store.sealing import seal


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
