"""A recording as experiments and map building need it: encodings beside positions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.route import Route
from deepsimbad.errors import InvalidSourceError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.image import decode_image


class SourceFrame(Protocol):
    """What is read of a recording's frame."""

    index: int
    position_m: float
    timestamp_us: int | None
    x_m: float | None
    y_m: float | None


@dataclass(frozen=True)
class EncodedTraverse:
    """One recorded drive, encoded.

    Attributes:
        frame_index: [n] int64, every frame's place in its whole recording.
        encodings: [n, d] float32.
        route: The frames' positions, n of them.
        timestamp_us: [n] int64, -1 where unknown.
        left_out: Reason -> number of frames that could not be used.
    """

    frame_index: NDArray[np.int64]
    encodings: NDArray[np.float32]
    route: Route
    timestamp_us: NDArray[np.int64]
    left_out: dict[str, int] = field(default_factory=dict)


def encode_images(
    frames: Sequence[SourceFrame],
    read_image: Callable[[int], bytes | None],
    evaluator: Evaluator,
    max_pixels: int,
    on_progress: Callable[[float], None],
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Encode a recording's images one by one, so that memory holds one image and all encodings.

    Args:
        frames: The frames, in order.
        read_image: Gives the image file of the i-th frame, or None where it is broken.
        evaluator: Encodes.
        max_pixels: Limit on an image.
        on_progress: Called with the share done; may raise to cancel.

    Returns:
        The places [m] of the frames that could be read, and their encodings [m, d].

    Raises:
        InvalidSourceError: No frame could be read.
    """
    if evaluator.encoding_dim is None:
        raise InvalidSourceError("this evaluator takes ready encodings alone; give a .npy or .csv file")
    encodings = np.empty((len(frames), evaluator.encoding_dim), np.float32)
    kept: list[int] = []
    for place in range(len(frames)):
        body = read_image(place)
        if body is not None:
            encodings[len(kept)] = evaluator.encode([decode_image(body, max_pixels)])[0]
            kept.append(place)
        on_progress((place + 1) / len(frames))
    if not kept:
        raise InvalidSourceError("none of the recording's images could be read")
    return np.array(kept, np.int64), encodings[: len(kept)]


def route_of(frames: Sequence[SourceFrame], closed: bool = False) -> Route:
    """The frames' positions as a route; x, y only where some frame knows them."""
    x_m = np.array([np.nan if frame.x_m is None else frame.x_m for frame in frames])
    y_m = np.array([np.nan if frame.y_m is None else frame.y_m for frame in frames])
    known = bool(np.isfinite(x_m).any() and np.isfinite(y_m).any())
    position_m = np.array([frame.position_m for frame in frames])
    return Route(position_m, closed, x_m if known else None, y_m if known else None)
