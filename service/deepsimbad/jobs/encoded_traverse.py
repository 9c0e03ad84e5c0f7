"""A recording as experiments and map building need it: encodings beside positions.

Recordings are read by the client's own readers (decision 0003): an image encodes to the same numbers whether it is
uploaded or read here, because the same reader prepared it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import median
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.route import Route
from deepsimbad.errors import InvalidSourceError
from deepsimbad.evaluators.base import Evaluator, Image
from deepsimbad.evaluators.image import decode_image
from deepsimbad.store.frames import UNKNOWN_TIMESTAMP, TraverseFrames
from deepsimbad_client.errors import BrokenFrameError
from deepsimbad_client.recordings.recording import Recording


@dataclass(frozen=True)
class EncodedTraverse:
    """One recorded drive, encoded.

    Attributes:
        frames: Encodings and places, n of them, in the order they were driven.
        route: The frames' positions.
        left_out: Reason -> number of frames that could not be used.
        encode_ms: Median from reading an image to its encoding; None where encodings came ready.
    """

    frames: TraverseFrames
    route: Route
    left_out: dict[str, int] = field(default_factory=dict)
    encode_ms: float | None = None

    @property
    def encodings(self) -> NDArray[np.float32]:
        """[n, d] float32."""
        return self.frames.encodings


def encode_recording(
    recording: Recording, evaluator: Evaluator, max_pixels: int, on_progress: Callable[[float], None]
) -> EncodedTraverse:
    """Encode a recording's images one by one, or take its ready encodings.

    Args:
        recording: What was driven.
        evaluator: Encodes the images.
        max_pixels: Limit on an image.
        on_progress: Called with the share done; may raise to cancel.

    Raises:
        InvalidSourceError: No frame can be used.
        InvalidRouteError: The positions go backwards or are NaN.
    """
    left_out = dict(recording.left_out)
    if recording.encodings is not None:
        kept, encodings, encode_ms = list(range(len(recording.frames))), recording.encodings, None
    else:
        kept, encodings, encode_ms = _encode_images(recording, evaluator, max_pixels, left_out, on_progress)
    if not kept:
        raise InvalidSourceError(f"{recording.name} has no frame that can be used: {left_out}")
    used = [recording.frames[place] for place in kept]
    frames = TraverseFrames(
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
    return EncodedTraverse(frames, route_of(frames), left_out, encode_ms)


def route_of(frames: TraverseFrames, closed: bool = False) -> Route:
    """The frames' positions as a route; x, y only where some frame knows them.

    Raises:
        InvalidRouteError: The positions go backwards or are NaN.
    """
    known = bool(np.isfinite(frames.x_m).any() and np.isfinite(frames.y_m).any())
    return Route(frames.position_m, closed, frames.x_m if known else None, frames.y_m if known else None)


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
    kept: list[int] = []
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
            kept.append(place)
        if waiting and (len(waiting) >= evaluator.largest_batch or place == len(recording.frames) - 1):
            encodings[len(kept) - len(waiting) : len(kept)] = evaluator.encode(waiting)
            took_ms += [1000 * (perf_counter() - began) / len(waiting)] * len(waiting)
            waiting.clear()
        on_progress((place + 1) / len(recording.frames))
    return kept, encodings[: len(kept)], median(took_ms) if took_ms else None
