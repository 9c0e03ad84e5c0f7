"""Recordings as experiments and map building need them: encodings beside positions, and ground truth given as a file.

Recordings are read by the client's own readers (decision 0003): an image encodes to the same numbers whether it is
uploaded or read here, because the same reader prepared it.
"""

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.drive import UNKNOWN_TIMESTAMP, Drive
from deepsimbad.errors import InvalidSourceError
from deepsimbad.evaluators.base import Evaluator, Image
from deepsimbad.evaluators.image import decode_image
from deepsimbad_client.errors import BrokenFrameError
from deepsimbad_client.recordings import Recording

_HARMLESS = {
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
}


@dataclass(frozen=True)
class EncodedRecording:
    """One recorded drive, encoded."""

    drive: Drive  # its frames, those that could be used
    left_out: dict[str, int] = field(default_factory=dict)  # reason -> number of frames that could not
    encode_ms: float | None = None  # median from reading an image to its encoding; None where encodings came ready


def encode_recording(
    recording: Recording, evaluator: Evaluator, max_pixels: int, on_progress: Callable[[float], None]
) -> EncodedRecording:
    """Encode a recording's images one by one, or take its ready encodings.

    Raises:
        InvalidSourceError: No frame can be used.
        InvalidRouteError: The positions go backwards or are NaN.
    """
    left_out = dict(recording.left_out)
    if recording.encodings is not None:
        places, encodings, encode_ms = list(range(len(recording.frames))), recording.encodings, None
    else:
        places, encodings, encode_ms = _encode_images(recording, evaluator, max_pixels, left_out, on_progress)
    if not places:
        raise InvalidSourceError(f"{recording.name} has no frame that can be used: {left_out}")
    used = [recording.frames[place] for place in places]
    drive = Drive(
        index=np.array([frame.index for frame in used], np.int64),
        position_m=np.array([frame.position_m for frame in used], np.float64),
        timestamp_us=np.array(
            [UNKNOWN_TIMESTAMP if f.timestamp_us is None else f.timestamp_us for f in used], np.int64
        ),
        x_m=np.array([np.nan if frame.x_m is None else frame.x_m for frame in used], np.float64),
        y_m=np.array([np.nan if frame.y_m is None else frame.y_m for frame in used], np.float64),
        encodings=encodings,
        weights_sha256=None if recording.encodings is not None else evaluator.weights_sha256,
    )
    drive.route()
    return EncodedRecording(drive, left_out, encode_ms)


def _encode_images(
    recording: Recording,
    evaluator: Evaluator,
    max_pixels: int,
    left_out: dict[str, int],
    on_progress: Callable[[float], None],
) -> tuple[list[int], NDArray[np.float32], float | None]:
    """Places of the frames that could be read, their encodings, and the median of milliseconds that each took.

    Broken ones are counted under their reason.
    """
    if not evaluator.takes_images or evaluator.encoding_dim is None:
        raise InvalidSourceError("this evaluator takes ready encodings alone; give a .npy or .csv file")
    encodings = np.empty((len(recording.frames), evaluator.encoding_dim), np.float32)
    places: list[int] = []
    waiting: list[Image] = []  # as many as are best encoded at once
    took_ms: list[float] = []
    began = perf_counter()
    for place, frame in enumerate(recording.frames):
        try:
            body = recording.image(frame, evaluator.input_size).body
        except BrokenFrameError as error:
            left_out[error.reason] = left_out.get(error.reason, 0) + 1
        else:
            began = perf_counter() if not waiting else began
            waiting.append(evaluator.prepare(decode_image(body, max_pixels)))
            places.append(place)
        if waiting and (len(waiting) >= evaluator.largest_batch or place == len(recording.frames) - 1):
            encodings[len(places) - len(waiting) : len(places)] = evaluator.encode(waiting)
            took_ms += [1000 * (perf_counter() - began) / len(waiting)] * len(waiting)
            waiting.clear()
        on_progress((place + 1) / len(recording.frames))
    return places, encodings[: len(places)], median(took_ms) if took_ms else None


class _ArraysOnly(pickle.Unpickler):
    """Unpickles arrays and lists of numbers; a file that names anything else runs nothing."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _HARMLESS:
            raise pickle.UnpicklingError(f"it names {module}.{name}")
        return super().find_class(module, name)


def read_ground_truth(
    path: Path, test_index: NDArray[np.int64], training_index: NDArray[np.int64]
) -> list[NDArray[np.int64]]:
    """Read a `.npy` of accepted matches.

    Args:
        path: An array [q, 2] whose rows are (test frame, list of training frames), as VPR-Bench writes it; or [q]
            of lists, or [q, k] of numbers padded with -1, in test frame order.
        test_index: [m] places of the test frames in their recording.
        training_index: [n] the same of the training frames.

    Returns:
        For every test frame the map images, as places among the training frames; empty where none is accepted.

    Raises:
        InvalidSourceError: Not such a file.
    """
    accepted = _accepted(path)
    place_of = {int(index): place for place, index in enumerate(training_index)}
    return [
        np.array(sorted(place_of[t] for t in accepted.get(int(index), ()) if t in place_of), np.int64)
        for index in test_index
    ]


def _accepted(path: Path) -> dict[int, Sequence[int]]:
    rows = _load(path)
    try:
        if rows.dtype == object and rows.ndim == 2 and rows.shape[1] == 2:
            return {int(query): [int(t) for t in np.atleast_1d(truth)] for query, truth in rows}
        return {query: [int(t) for t in np.atleast_1d(truth) if t >= 0] for query, truth in enumerate(rows)}
    except (TypeError, ValueError) as error:
        raise InvalidSourceError(f"{path} holds no lists of frame numbers: {error}") from error


def _load(path: Path) -> NDArray[Any]:
    try:
        with path.open("rb") as file:
            major, _ = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
            _, _, dtype = header(file)
            if dtype.hasobject:
                return np.asarray(_ArraysOnly(file).load())
            file.seek(0)
            return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
    except OSError as error:
        raise InvalidSourceError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, EOFError, pickle.UnpicklingError, AttributeError, IndexError) as error:
        raise InvalidSourceError(f"{path} is no ground truth file: {error}") from error
