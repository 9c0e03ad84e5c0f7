"""Appending a new drive to a copy of a map: no frame that is in the map is encoded or described again.

The new frames are described by the map's own landmarks and merged by route position. What was learnt of a place stays
with it, and a new image knows of its place what the nearest old one does; how landmarks are to be trusted, and how a
robot off the route is known, stay as two seasons taught them.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.appending import append_images, nearest_known
from deepsimbad.core.nnql import NnqlConfig
from deepsimbad.core.relevance import DEFAULT_RELEVANCE
from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.jobs.build_map import dissimilarities_to
from deepsimbad.jobs.encoded_traverse import route_of
from deepsimbad.jobs.known_frames import (
    UNKNOWN_FRAME,
    frame_digests,
    refuse_known_frames,
    refuse_known_traverse,
)
from deepsimbad.jobs.map_config import DEFAULT_LIST_LENGTH, RemapConfig
from deepsimbad.store.frames import UNKNOWN_TIMESTAMP, TraverseFrames
from deepsimbad.store.map_contents import MapContents, weights_of, with_weights
from deepsimbad.store.records import MapRecord


def append_frames(
    before: MapContents,
    record: MapRecord,
    config: RemapConfig,
    frames: TraverseFrames,
    evaluator: Evaluator,
    on_progress: Callable[[float], None],
) -> MapContents:
    """Append a traverse to a map; the version of what comes out is not known yet.

    Args:
        before: The map; it stays as it is.
        record: What the catalog knows of it.
        config: What is asked for; its `training_traverse` names the frames.
        frames: The new frames.
        evaluator: The domain's.
        on_progress: Called with the share done; may raise to cancel.

    Raises:
        InvalidMapConfigError: Something is asked for that the map has otherwise, or it holds the traverse already.
        InvalidRouteError: The new frames go backwards.
        InvalidEncodingError: They come from another encoder.
    """
    refuse_known_traverse(record.config, record.version, config.training_traverse)
    refuse_known_frames(before, record.version, config.training_traverse, frames)
    check_same(before, config)
    known = MapSnapshot.from_contents(before, index_bytes=0)
    driven = route_of(frames, before.closed)
    found = dissimilarities_to(frames.encodings, evaluator, before.landmark_model, on_progress)
    merged = append_images(known.retrieval, known.route, found, driven.position_m, frames.encodings)
    statistics, source, n_old = merged.built.statistics, merged.source, before.n_map_images
    nearest, is_near = nearest_known(known.route, driven.position_m, max(before.actions_m))
    contents = replace(
        before,
        config=appended_config(before, record, config, frames),
        lists=merged.built.index.lists,
        position_m=merged.position_m,
        values=merged.built.index.values,
        encodings=merged.built.encodings,
        statistics=None if statistics is None else np.stack([statistics.mean, statistics.std]),
        timestamp_us=_merged(before.timestamp_us, _known_times(frames), n_old, source, UNKNOWN_TIMESTAMP),
        frame_digest=_merged(before.frame_digest, frame_digests(frames.encodings), n_old, source, UNKNOWN_FRAME),
        x_m=_merged(before.x_m, driven.x_m, n_old, source, np.nan),
        y_m=_merged(before.y_m, driven.y_m, n_old, source, np.nan),
    )
    if before.q_values is not None:
        initial = np.float32(NnqlConfig().initial_q)
        new_values = np.where(is_near[:, np.newaxis], before.q_values[nearest], initial)
        contents = replace(contents, q_values=np.concatenate([before.q_values, new_values])[source])
    if before.telling_bits is not None:
        new_bits = np.where(is_near, before.telling_bits[nearest], before.telling_bits.mean(dtype=np.float32))
        contents = replace(contents, telling_bits=np.concatenate([before.telling_bits, new_bits])[source])
    return contents


def check_same(before: MapContents, config: RemapConfig) -> None:
    """What describes the images of one map is the same for all of them.

    What is left at its default is taken from the map.

    Raises:
        InvalidMapConfigError: Something else is asked for than the map has.
    """
    asked = {
        "n_landmarks": (config.n_landmarks, None, before.n_landmarks),
        "list_length": (config.list_length, DEFAULT_LIST_LENGTH, before.list_length),
        "relevance": (config.relevance.value, DEFAULT_RELEVANCE.value, before.config["relevance"]),
    }
    for name, (wanted, default, has) in asked.items():
        if wanted not in {default, has}:
            raise InvalidMapConfigError(
                f"the active map has {name} {has}, not {wanted}; what is appended to it must be alike", **{name: has}
            )


def appended_config(
    before: MapContents, record: MapRecord, config: RemapConfig, frames: TraverseFrames
) -> dict[str, Any]:
    """The configuration of a map with an appended drive: the map's own, and what was appended to it, in order.

    It is the catalog's: the file of an imported map names traverses of another server.
    """
    asked = config.as_dict()
    added = {"traverse": config.training_traverse, "n_frames": frames.n_frames, "to_version": record.version}
    return {
        **with_weights(record.config, frames.weights_sha256 or weights_of(before.config)),
        "n_landmarks": before.n_landmarks,
        **{name: asked[name] for name in ("append", "check_traverse", "gate_margin", "activate")},
        "appended": [*record.config.get("appended", ()), added],
    }


def _known_times(frames: TraverseFrames) -> NDArray[np.int64] | None:
    return frames.timestamp_us if (frames.timestamp_us != UNKNOWN_TIMESTAMP).any() else None


def _merged(
    old: NDArray[Any] | None, new: NDArray[Any] | None, n_old: int, source: NDArray[np.int64], unknown: float
) -> NDArray[Any] | None:
    """What is known of the old images and of the new ones, in route order; None where neither is."""
    known = new if old is None else old
    if known is None:
        return None
    both = np.full(source.size, unknown, known.dtype)
    if old is not None:
        both[:n_old] = old
    if new is not None:
        both[n_old:] = new
    return both[source]
