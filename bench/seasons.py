"""Two seasons of one long route, as ready encodings."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.drive import Drive
from deepsimbad.store.traverses import Traverse

SPACING_M = 0.2
_BLOCK = 1024


def write_seasons(data_dir: Path, domain: str, n_frames: int, n_candidates: int, dim: int) -> None:
    """Two drives of one wandering route, straight into their files: an upload is not what is measured here.

    Args:
        data_dir: Where the domain is.
        domain: It has no traverses yet.
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
            chosen = np.flatnonzero((frames_of >= start) & (frames_of < start + len(places)))
            landmarks.put_frames(_season(places[frames_of[chosen] - start], chosen, frames_of[chosen], rng))


def _season(
    places: NDArray[np.float32], index: NDArray[np.int64], frame: NDArray[np.int64], rng: np.random.Generator
) -> Drive:
    """The places as one season shows them: unit vectors, as NetVLAD's are."""
    seen = places + np.float32(0.7) * rng.standard_normal(places.shape, np.float32)
    seen = (seen / np.linalg.norm(seen, axis=1, keepdims=True)).astype(np.float32)
    return Drive(index=index, position_m=frame * SPACING_M, encodings=seen)
