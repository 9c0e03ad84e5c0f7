"""What a frame of a traverse is known by, in what two of one index differ, and what took their pictures.

A camera is known as far as pictures show it: by a name and the shape of its images.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

MAX_POSITION_M = 1e9  # either way; 25 times round the earth, and squares and spans are far from overflow
UNKNOWN_TIMESTAMP = -1
UNKNOWN_CONTENT = 0
_DIGEST_BYTES = 8
_IN_WORDS = {"position_m": "position", "timestamp_us": "time", "x_m": "x", "y_m": "y", "content_digest": "content"}
IDENTITY = tuple(_IN_WORDS)
"""The arrays [n] that a frame is known by: where unknown NaN, a time -1, a digest 0."""

SAME_SHAPE = 0.05  # of an aspect ratio, up to which two are one: 4:3 and NCLT's 1616 x 1232
NCLT_STORED_SIZE = (1616, 1232)  # (width, height) of NCLT's images, which lie on their side
NCLT_SHAPE = 0.01  # of an aspect ratio, by which copies of them are told from other cameras' 4:3
UPRIGHT_TURN = 90  # degrees clockwise that NCLT's images are turned by


def content_digest(body: bytes) -> int:
    """Of a picture as it was posted, or of an encoding's little-endian float32; stored, so it stays as it is."""
    return int.from_bytes(hashlib.blake2b(body, digest_size=_DIGEST_BYTES).digest(), "little")


def differences(some: Mapping[str, NDArray[Any]], others: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.bool_]]:
    """Which of twice n frames, given by the arrays of `IDENTITY`, differ: a word for in what -> [n], where any does.

    An unknown content differs from none.
    """
    found = {}
    for name, word in _IN_WORDS.items():
        ours, theirs = some[name], others[name]
        differ = ours != theirs
        if name == "content_digest":
            differ &= (ours != UNKNOWN_CONTENT) & (theirs != UNKNOWN_CONTENT)
        elif ours.dtype.kind == "f":
            differ &= ~(np.isnan(ours) & np.isnan(theirs))
        if differ.any():
            found[word] = differ
    return found


@dataclass(frozen=True)
class Camera:
    """A camera; its images are upright, and so wide and high as they are shown."""

    width: int
    height: int
    name: str | None = None

    @property
    def aspect_ratio(self) -> float:
        """Width by height."""
        return self.width / self.height

    @property
    def orientation(self) -> str:
        """Which side is the longer one."""
        if self.width == self.height:
            return "square"
        return "landscape" if self.width > self.height else "portrait"

    @property
    def lies_like_nclt(self) -> bool:
        """Whether its images have the shape of NCLT's as stored."""
        return _is_alike(self.aspect_ratio, NCLT_STORED_SIZE[0] / NCLT_STORED_SIZE[1], NCLT_SHAPE)

    def turn_to(self, others: Iterable["Camera"]) -> int:
        """Degrees clockwise that bring its pictures to lie as those of others do; 0 where nobody can tell which way.

        Only NCLT's files tell by their shape: others of the transposed shape may lie on either side.
        """
        others = tuple(others)
        upright = any(Camera(other.height, other.width).lies_like_nclt for other in others)
        lying = any(_is_alike(self.aspect_ratio, other.aspect_ratio) for other in others)
        return UPRIGHT_TURN if self.lies_like_nclt and upright and not lying else 0

    def as_dict(self) -> dict[str, Any]:
        """The JSON form."""
        return asdict(self)

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> Self:
        """Back from the JSON form."""
        return cls(**stored)

    def unlike(self, others: Iterable["Camera"], whose: str) -> str | None:
        """In a sentence, why its pictures are compared badly with those of others; None where nothing says so.

        Args:
            whose: Whose the others' pictures are, as `the map's`.
        """
        others = tuple(others)
        if not others or any(_is_alike(self.aspect_ratio, other.aspect_ratio) for other in others):
            names = {other.name for other in others} - {None}
            if self.name is None or not names or self.name in names:
                return None
            return f"they are of camera {self.name}, {whose} of {', '.join(sorted(map(str, names)))}"
        first = others[0]
        shapes = f"{self.width} x {self.height}, {whose} {first.width} x {first.height}"
        if any(_is_alike(self.aspect_ratio, 1 / other.aspect_ratio) for other in others):
            return f"they lie on their side: they are {shapes}; turn them by 90 degrees"
        return f"they are of another shape, and so perhaps of another camera: {shapes}"


def _is_alike(ratio: float, other: float, within: float = SAME_SHAPE) -> bool:
    return abs(math.log(ratio / other)) <= math.log1p(within)
