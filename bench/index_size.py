"""What the index takes, beside models of the same lists and xz."""

import itertools
import lzma
from collections.abc import Iterator
from time import perf_counter

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bench.measurement import ACTIONS_M, Limit, limit_table, markdown, work_folder
from bench.recordings import encoded, netvlad_drives, real_recordings
from bench.worlds import N_LANDMARKS, NCLT_IMAGES, dense_lists, rrf_map, scattered_lists
from deepsimbad.core.building import MapPlan, compose_map
from deepsimbad.core.drive import Drive
from deepsimbad.core.index.packing import pack_lists, unpack_lists
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Relevance
from deepsimbad.jobs.experiments.vpr import bits_per_map_image
from deepsimbad_campus.writer import write_campus

N_FRAMES, SEED = 400, 1
_MARGIN = 1.1  # of the smaller order-1 model


def index_table() -> Iterator[str]:
    """Markdown lines."""
    yield from ("## Index: bits a map image, h = 4", "")
    head = ("map", "images", "r", "as numbers", "order-1 by place", "order-1 by list", "xz", "code", "in its file")
    limits = []
    rows = []
    for name, maps in _maps():
        figures = np.array([_bits(map_) for map_ in maps])
        means = figures.mean(axis=0)
        rows.append([name, f"{maps[0].n_images:,}", maps[0].n_landmarks, *(f"{mean:.1f}" for mean in means)])
        limits.append(Limit(f"{name}, r = {maps[0].n_landmarks}", means[-1], round(_MARGIN * min(means[1:3]), 1)))
    yield from markdown(head, rows)
    yield ""
    yield (
        "Order-1 models are adaptive, their ideal code lengths: *by place* a landmark by those that followed the one "
        "before at the same place of the list, beside all of that place; *by list* which place of the list before is "
        "repeated, or another landmark by how often it was listed. `xz -9e` of lists packed to whole bits or as "
        "numbers of 16, whichever is less. *In its file*: the `dbstat` pages of the table `posting`, the last of which "
        "are part empty. Limits: 10 % above the smaller order-1 model."
    )
    yield ""
    yield from limit_table(limits)
    yield ""
    lists, prototypes = scattered_lists(NCLT_IMAGES), _random_prototypes()
    start_s = perf_counter()
    blocks = pack_lists(lists, N_LANDMARKS, prototypes)
    written_s = perf_counter()
    unpack_lists(blocks, *lists.shape, N_LANDMARKS, prototypes)
    yield (
        f"The lists drawn at random, which take longest, are written in {written_s - start_s:.2f} s and read in "
        f"{perf_counter() - written_s:.2f} s."
    )


def _random_prototypes() -> NDArray[np.float32]:
    return np.random.default_rng(0).normal(size=(N_LANDMARKS, 96)).astype(np.float32)


def _maps() -> Iterator[tuple[str, list[Map]]]:
    """Maps by name, several of one kind."""
    drives = netvlad_drives()
    for r in (300, 512):
        pairs = itertools.permutations(drives, 2)
        yield "Nordland, NetVLAD, two seasons, mean of six", [_map(drive, other, r) for other, drive in pairs]
    railway = encoded(real_recordings() / "nordland" / "summer#0:1000")
    yield "Nordland, images, its own landmarks", [_map(railway, None, 300)]
    with work_folder() as work:
        winter, spring = map(encoded, write_campus(work, ("winter", "spring"), N_FRAMES, SEED, spacing_m=0.5))
    yield "campus, 0.5 m, two seasons", [_map(spring, winter, 300)]
    yield "campus, 0.5 m, its own landmarks", [_map(spring, None, 300)]
    for name, lists in (("drifting", dense_lists(NCLT_IMAGES)), ("drawn at random", scattered_lists(NCLT_IMAGES))):
        yield f"synthetic, {name}", [rrf_map(lists, landmark_model={"prototypes": _random_prototypes()})]


def _map(drive: Drive, second: Drive | None, n_landmarks: int) -> Map:
    """A map of a drive, with landmarks of the second one where there is one."""
    plan = MapPlan(Relevance.COMPOSED, 4, ACTIONS_M, same_route=second is not None)
    return compose_map(plan, drive, second, second, n_landmarks).map


def _bits(map_: Map) -> list[float]:
    """The cells of a map in the table, in bits a map image."""
    lists, r, n = map_.lists, map_.n_landmarks, map_.n_images
    width = (r - 1).bit_length()
    bits = (lists.T.reshape(-1, 1) >> np.arange(width - 1, -1, -1)) & 1
    packed = (np.packbits(bits.astype(np.uint8)).tobytes(), lists.T.astype("<u2").tobytes())
    xz = min(len(lzma.compress(content, preset=9 | lzma.PRESET_EXTREME)) for content in packed)
    code = sum(map(len, pack_lists(lists, r, map_.landmark_model["prototypes"])))
    wide_lists = lists.astype(np.int64)
    models = (_by_place(wide_lists, r) / n, _by_list(wide_lists, r) / n)
    return [len(lists) * np.log2(r), *models, 8 * xz / n, 8 * code / n, bits_per_map_image(map_)]


@njit(cache=True)
def _by_place(lists: NDArray[np.int64], n_landmarks: int) -> float:
    """Bits of all lists by the adaptive order-1 model of every place, the landmarks of that place beside it."""
    bits = 0.0
    for row in lists:
        successors, counts = np.zeros((n_landmarks, n_landmarks)), np.full(n_landmarks, 0.5)
        for m in range(row.size):
            share = counts[row[m]] / counts.sum()
            if m > 0:
                share = (successors[row[m - 1], row[m]] + 4 * share) / (successors[row[m - 1]].sum() + 4)
                successors[row[m - 1], row[m]] += 1
            bits -= np.log2(share)
            counts[row[m]] += 1
    return bits


@njit(cache=True)
def _by_list(lists: NDArray[np.int64], n_landmarks: int) -> float:
    """Bits of all lists by an adaptive model of which place of the list before repeats, else of landmarks listed."""
    h, n = lists.shape
    bits = 0.0
    repeats, counts = np.full((h, h + 1), 0.5), np.full(n_landmarks, 0.5)
    for m in range(n):
        is_free = np.ones(n_landmarks)
        for j in range(h):
            landmark, place, total = lists[j, m], h, repeats[j, h]
            if m > 0:
                for k in range(h):
                    is_listed = False
                    for earlier in lists[:j, m]:
                        is_listed = is_listed or earlier == lists[k, m - 1]
                    total += 0.0 if is_listed else repeats[j, k]
                    is_free[lists[k, m - 1]] = 0
                    if lists[k, m - 1] == landmark:
                        place = k
                bits -= np.log2(repeats[j, place] / total)
                repeats[j, place] += 1
            if place == h:
                bits -= np.log2(counts[landmark] / (counts * is_free).sum())
            is_free[landmark] = 0
        for j in range(h):
            counts[lists[j, m]] += 1
    return bits
