"""Synthetic maps of any size, in the two extremes that matter for size and speed, and two seasons of one long route."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.composed import unit
from deepsimbad.core.descriptor import LandmarkStatistics, rank_landmarks
from deepsimbad.core.drive import Drive
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Relevance
from deepsimbad.store.traverses import Traverse

NCLT_IMAGES = 26_208  # one traverse of the paper
N_CANDIDATES, N_LANDMARKS, LIST_LENGTH, ENCODING_DIM = 26_000, 500, 4, 4096
SPACING_M = 0.2  # of NCLT's frames at walking speed


def scattered_lists(n_images: int) -> NDArray[np.uint16]:
    """[h, n] every image's landmarks drawn anew: nothing to gain from neighbours, the worst case for size."""
    rng = np.random.default_rng(0)
    lists = np.empty((LIST_LENGTH, n_images), np.uint16)
    lists[0] = rng.integers(0, N_LANDMARKS, n_images)
    for row in range(1, LIST_LENGTH):
        lists[row] = rng.integers(0, N_LANDMARKS, n_images)
        while (clash := (lists[:row] == lists[row]).any(axis=0)).any():
            lists[row, clash] = rng.integers(0, N_LANDMARKS, int(clash.sum()))
    return lists


def dense_lists(n_images: int, smoothness: float = 0.99) -> NDArray[np.uint16]:
    """[h, n] of dissimilarities that drift, as in a recording at 5 Hz: neighbours share landmarks."""
    rng = np.random.default_rng(0)
    lists = np.empty((LIST_LENGTH, n_images), np.uint16)
    level = rng.normal(size=N_LANDMARKS).astype(np.float32)
    fresh = np.float32(np.sqrt(1 - smoothness**2))
    for image in range(n_images):
        level = np.float32(smoothness) * level + fresh * rng.normal(size=N_LANDMARKS).astype(np.float32)
        nearest = np.argpartition(level, LIST_LENGTH)[:LIST_LENGTH]
        lists[:, image] = nearest[np.argsort(level[nearest])]
    return lists


def standardised_map(lists: NDArray[np.uint16], **fields: Any) -> Map:
    """A map of these lists, five images a metre, for a relevance of ours; `fields` are further ones of `Map`."""
    dissimilarities = np.random.default_rng(0).random((2000, N_LANDMARKS))
    statistics = LandmarkStatistics.of_map(rank_landmarks(dissimilarities))
    return Map(
        config={"relevance": Relevance.STANDARDISED.value, "n_landmarks": N_LANDMARKS},
        lists=lists,
        position_m=np.arange(lists.shape[1]) * SPACING_M,
        statistics=np.stack([statistics.mean, statistics.std]),
        **fields,
    )


def composed_map(lists: NDArray[np.uint16], **fields: Any) -> Map:
    """A map of these lists for the default relevance; its landmarks are drawn at random."""
    rng = np.random.default_rng(0)
    moments = {name: np.stack([np.zeros(n), np.ones(n)]) for name, n in (("encoding", 96), ("product", N_LANDMARKS))}
    return Map(
        config={"relevance": Relevance.COMPOSED.value, "n_landmarks": N_LANDMARKS},
        lists=lists,
        position_m=np.arange(lists.shape[1]) * SPACING_M,
        statistics=np.stack([np.zeros(N_LANDMARKS), np.ones(N_LANDMARKS)]),
        usual_encoding=moments["encoding"].astype(np.float32),
        usual_product=moments["product"].astype(np.float32),
        landmark_model={"prototypes": unit(rng.normal(size=(N_LANDMARKS, 96)))},
        **fields,
    )


def rrf_map(lists: NDArray[np.uint16], **fields: Any) -> Map:
    """A map of these lists for the paper's relevance."""
    config = {"relevance": Relevance.RRF.value, "n_landmarks": N_LANDMARKS}
    return Map(config=config, lists=lists, position_m=np.arange(lists.shape[1]) * SPACING_M, **fields)


_BLOCK = 1024


def write_seasons(data_dir: Path, domain: str, n_frames: int, n_candidates: int, dim: int) -> None:
    """Two drives of one wandering route, straight into their files: an upload is not what is measured here.

    Args:
        data_dir: Data directory of the domain.
        domain: Name of the domain, which has no traverses yet.
        n_frames: Of the traverse `training`.
        n_candidates: Of the traverse `landmarks`, spread over the same route.
        dim: Of an encoding.
    """
    frames_of = np.linspace(0, n_frames - 1, n_candidates).round().astype(np.int64)
    with (
        Traverse.create(data_dir, domain, "training") as training,
        Traverse.create(data_dir, domain, "landmarks") as landmarks,
    ):
        rng = np.random.default_rng(0)
        level = rng.standard_normal(dim, dtype=np.float32)
        for start in range(0, n_frames, _BLOCK):
            places = np.empty((min(_BLOCK, n_frames - start), dim), np.float32)
            for place in places:
                level = np.float32(0.98) * level + np.float32(0.2) * rng.standard_normal(dim, np.float32)
                place[:] = level
            index = np.arange(start, start + len(places))
            training.put_frames(_season(places, index, index, rng))
            rows = np.flatnonzero((frames_of >= start) & (frames_of < start + len(places)))
            landmarks.put_frames(_season(places[frames_of[rows] - start], rows, frames_of[rows], rng))


def _season(
    places: NDArray[np.float32], index: NDArray[np.int64], frame: NDArray[np.int64], rng: np.random.Generator
) -> Drive:
    """The places as one season shows them: unit vectors, as NetVLAD's are."""
    encodings = places + np.float32(0.7) * rng.standard_normal(places.shape, np.float32)
    encodings = (encodings / np.linalg.norm(encodings, axis=1, keepdims=True)).astype(np.float32)
    return Drive(index=index, position_m=frame * SPACING_M, encodings=encodings)
