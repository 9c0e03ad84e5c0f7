"""What identifies a frame of a traverse, in what two frames of one index differ, and which camera took them.

A camera is identified as far as pictures show it: by a name and the shape of its images.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

MAX_POSITION_M = 1e9  # either way; 25 times round the earth, and far from the overflow of squares and spans
UNKNOWN_TIMESTAMP = -1
UNKNOWN_CONTENT = 0
_DIGEST_BYTES = 8
_IN_WORDS = {"position_m": "position", "timestamp_us": "time", "x_m": "x", "y_m": "y", "content_digest": "content"}
IDENTITY = tuple(_IN_WORDS)
"""The arrays [n] that identify frames; an unknown position is NaN, an unknown time -1, an unknown digest 0."""

SAME_SHAPE = 0.05  # difference of aspect ratios up to which shapes are the same: 4:3 and NCLT's 1616 x 1232 are
NCLT_STORED_SIZE = (1616, 1232)  # (width, height) of NCLT's images, which lie on their side
NCLT_SHAPE = 0.01  # difference of aspect ratios up to which a shape is NCLT's, and not the 4:3 of other cameras
UPRIGHT_TURN = 90  # degrees clockwise that NCLT's images are turned by


def content_digest(body: bytes) -> int:
    """64-bit digest of a picture as posted, or of an encoding's little-endian float32; stored, so it never changes."""
    return int.from_bytes(hashlib.blake2b(body, digest_size=_DIGEST_BYTES).digest(), "little")


def differences(
    frames: Mapping[str, NDArray[Any]], other_frames: Mapping[str, NDArray[Any]]
) -> dict[str, NDArray[np.bool_]]:
    """Which of n frames differ from other n, both given by the arrays of `IDENTITY`: word for the array -> [n] mask.

    Arrays in which no frame differs are left out; an unknown content differs from none.
    """
    masks = {}
    for name, word in _IN_WORDS.items():
        values, other_values = frames[name], other_frames[name]
        differ = values != other_values
        if name == "content_digest":
            differ &= (values != UNKNOWN_CONTENT) & (other_values != UNKNOWN_CONTENT)
        elif values.dtype.kind == "f":
            differ &= ~(np.isnan(values) & np.isnan(other_values))
        if differ.any():
            masks[word] = differ
    return masks


@dataclass(frozen=True)
class Camera:
    """A camera; width and height are those of its images when upright."""

    width: int
    height: int
    name: str | None = None

    @property
    def aspect_ratio(self) -> float:
        """Width by height."""
        return self.width / self.height

    @property
    def orientation(self) -> str:
        """`landscape`, `portrait` or `square`."""
        if self.width == self.height:
            return "square"
        return "landscape" if self.width > self.height else "portrait"

    @property
    def lies_like_nclt(self) -> bool:
        """Whether its images have the shape of NCLT's stored ones, which lie on their side."""
        return _is_alike(self.aspect_ratio, NCLT_STORED_SIZE[0] / NCLT_STORED_SIZE[1], NCLT_SHAPE)

    def turn_to(self, cameras: Iterable["Camera"]) -> int:
        """Degrees clockwise that turn its pictures as those of other cameras lie; 0 where nobody can tell which way.

        Only NCLT's files tell by their shape: others of a transposed shape may lie on either side.
        """
        cameras = tuple(cameras)
        upright = any(Camera(camera.height, camera.width).lies_like_nclt for camera in cameras)
        lying = any(_is_alike(self.aspect_ratio, camera.aspect_ratio) for camera in cameras)
        return UPRIGHT_TURN if self.lies_like_nclt and upright and not lying else 0

    def as_dict(self) -> dict[str, Any]:
        """The JSON form."""
        return asdict(self)

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> Self:
        """Back from the JSON form."""
        return cls(**stored)

    def unlike(self, cameras: Iterable["Camera"], owner: str) -> str | None:
        """In a sentence, why its pictures compare badly with those of other cameras; None where nothing says so.

        Args:
            owner: Whose the other cameras' pictures are, as `the map's`.
        """
        cameras = tuple(cameras)
        if not cameras or any(_is_alike(self.aspect_ratio, camera.aspect_ratio) for camera in cameras):
            names = {camera.name for camera in cameras} - {None}
            if self.name is None or not names or self.name in names:
                return None
            return f"they are of camera {self.name}, {owner} of {', '.join(sorted(map(str, names)))}"
        first = cameras[0]
        shapes = f"{self.width} x {self.height}, {owner} {first.width} x {first.height}"
        if any(_is_alike(self.aspect_ratio, 1 / camera.aspect_ratio) for camera in cameras):
            return f"they lie on their side: they are {shapes}; turn them by 90 degrees"
        return f"they are of another shape, and so perhaps of another camera: {shapes}"


def _is_alike(ratio: float, other_ratio: float, tolerance: float = SAME_SHAPE) -> bool:
    return abs(math.log(ratio / other_ratio)) <= math.log1p(tolerance)
