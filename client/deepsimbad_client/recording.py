"""A recording: what every reader gives, and how its frames are picked by slice and by metre."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import SourceError


@dataclass(frozen=True, slots=True)
class Frame:
    """One moment of a recording.

    Attributes:
        index: Place in the whole recording, from 0; kept when the recording is sliced.
        name: The file's name, or the row's for ready encodings.
        position_m: Metres along the route.
        timestamp_us: Unix microseconds; None where unknown.
        x_m: First ground coordinate (NCLT: north); None where unknown.
        y_m: Second ground coordinate (NCLT: east); None where unknown.
        heading_rad: Direction in (-pi, pi], turning from x towards y; None where unknown.
    """

    index: int
    name: str
    position_m: float
    timestamp_us: int | None = None
    x_m: float | None = None
    y_m: float | None = None
    heading_rad: float | None = None


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """An image ready to be posted: the bytes of the file and what they are."""

    body: bytes
    content_type: str


class Recording(Protocol):
    """Frames in travel order, with either images or ready encodings."""

    @property
    def name(self) -> str:
        """A short name for people: the date, the folder or the file."""
        ...

    @property
    def frames(self) -> Sequence[Frame]:
        """The frames that can be used, in travel order."""
        ...

    @property
    def left_out(self) -> Mapping[str, int]:
        """Reason -> number of frames that are not in `frames`; reasons that never occurred are absent."""
        ...

    @property
    def encodings(self) -> NDArray[np.float32] | None:
        """Ready encodings [n, d] float32, row i of frame i of `frames`; None where the frames are images."""
        ...

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read one frame's image, ready to post.

        Args:
            frame: One of `frames`.
            input_size: (width, height) the domain asks for; a larger image is resized to exactly this. None:
                never resized.

        Raises:
            BrokenFrameError: this file cannot be used; the others can. Its `reason` is the word to count it
                under, beside `left_out`.
            SourceError: the recording holds no images.
        """
        ...


@dataclass(frozen=True, eq=False)
class SlicedRecording:
    """Some frames of another recording, keeping their indices and positions.

    Attributes:
        whole: The recording sliced.
        part: Python's slice of its frames. What `whole` left out stays counted.
    """

    whole: Recording
    part: slice

    @property
    def name(self) -> str:
        """The whole recording's name."""
        return self.whole.name

    @cached_property
    def frames(self) -> Sequence[Frame]:
        """The frames the slice picks, in the slice's order."""
        return self.whole.frames[self.part]

    @property
    def left_out(self) -> Mapping[str, int]:
        """What the whole recording left out; frames outside the slice were not asked for and do not count."""
        return self.whole.left_out

    @property
    def encodings(self) -> NDArray[np.float32] | None:
        """The rows the slice picks [n, d] float32, a view; None where the frames are images."""
        return None if self.whole.encodings is None else self.whole.encodings[self.part]

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """Read one frame's image; see `Recording.image`."""
        return self.whole.image(frame, input_size)


def sliced(recording: Recording, part: slice) -> Recording:
    """Take Python's slice of a recording's frames.

    Raises:
        SourceError: the slice leaves nothing, or its step is 0.
    """
    if part.step == 0:
        raise SourceError(f"the slice of {recording.name} has step 0: use 1 for every frame")
    picked = SlicedRecording(recording, part)
    if not picked.frames:
        raise SourceError(
            f"the slice {_slice_text(part)} leaves none of the {len(recording.frames)} frames of {recording.name}"
        )
    return picked


def positions_m(recording: Recording) -> NDArray[np.float64]:
    """Route positions [n] float64 of a recording's frames, in metres."""
    return np.array([frame.position_m for frame in recording.frames], dtype=np.float64)


def nearest_frame(route_position_m: NDArray[np.float64], commanded_m: float) -> int | None:
    """Find the frame recorded nearest to a commanded route position: a robot that moves by metres looks here.

    Args:
        route_position_m: [n] float64, non-decreasing (see `positions_m`).
        commanded_m: Where the robot was sent, in the same metres.

    Returns:
        The place in the array, not `Frame.index`; of two equally near the earlier, of frames taken standing
        still the first. None where the recording does not reach: before its first or past its last position.
    """
    n_frames = len(route_position_m)
    if n_frames == 0 or not route_position_m[0] <= commanded_m <= route_position_m[-1]:
        return None
    after = int(np.searchsorted(route_position_m, commanded_m, side="left"))
    if after == 0:
        return 0
    before_m = float(route_position_m[after - 1])
    if commanded_m - before_m > float(route_position_m[after]) - commanded_m:
        return after
    return int(np.searchsorted(route_position_m, before_m, side="left"))


def _slice_text(part: slice) -> str:
    ends = [part.start, part.stop] + ([] if part.step is None else [part.step])
    return "#" + ":".join("" if end is None else str(end) for end in ends)
