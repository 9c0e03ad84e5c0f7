"""A recording: what every reader gives."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import SourceError


@dataclass(frozen=True, slots=True)
class Frame:
    """One moment of a recording; None: not known."""

    index: int  # place in the whole recording, from 0; kept when the recording is sliced
    name: str  # the file's name, or the row's for ready encodings
    position_m: float  # along the route
    timestamp_us: int | None = None  # Unix microseconds
    x_m: float | None = None  # first ground coordinate (NCLT: north)
    y_m: float | None = None  # second ground coordinate (NCLT: east)
    heading_rad: float | None = None  # in (-pi, pi], turning from x towards y


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """An image ready to be posted: the bytes of the file and what they are."""

    body: bytes
    content_type: str


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames in travel order, with either ready encodings or, in the readers' own classes, images.

    Attributes:
        name: A short name for people: the date, the folder or the file.
        frames: Those that can be used.
        left_out: Reason -> number of frames that are not in `frames`; reasons that never occurred are absent.
        encodings: Ready encodings [n, d] float32, row i of frame i of `frames`; None where the frames are images.
    """

    name: str
    frames: Sequence[Frame]
    left_out: Mapping[str, int] = field(default_factory=dict)
    encodings: NDArray[np.float32] | None = None

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:  # noqa: ARG002
        """Read one frame's image, ready to post.

        Args:
            frame: One of `frames`.
            input_size: (width, height) the domain asks for; a larger image is resized to exactly this. None: never.

        Raises BrokenFrameError, SourceError.
        """
        raise SourceError(f"{self.name} holds ready encodings, not images")

    def view(self, row: int, input_size: tuple[int, int] | None) -> dict[str, Any]:
        """What is seen from `frames[row]`, as arguments of a client's calls; raises as `image` does."""
        if self.encodings is not None:
            return {"encoding": self.encodings[row]}
        image = self.image(self.frames[row], input_size)
        return {"image": image.body, "content_type": image.content_type}

    def sliced(self, part: slice) -> Self:
        """Python's slice of the frames, which keep their indices and positions; what was left out stays counted.

        Raises SourceError (the slice leaves nothing, or its step is 0).
        """
        if part.step == 0:
            raise SourceError(f"the slice of {self.name} has step 0: use 1 for every frame")
        frames = self.frames[part]
        if not frames:
            ends = [part.start, part.stop] + ([] if part.step is None else [part.step])
            text = "#" + ":".join("" if end is None else str(end) for end in ends)
            raise SourceError(f"the slice {text} leaves none of the {len(self.frames)} frames of {self.name}")
        encodings = None if self.encodings is None else self.encodings[part]
        return dataclasses.replace(self, frames=frames, encodings=encodings)


def finite_number(text: str) -> float | None:
    """The number that a cell of a table holds; None: no finite one."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
