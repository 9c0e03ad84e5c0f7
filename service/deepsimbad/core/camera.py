"""What took the pictures of a drive, as far as pictures show it: a name and the shape of its images."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

SAME_SHAPE = 0.05  # of an aspect ratio, up to which two are one: 4:3 and NCLT's 1616 x 1232
NCLT_STORED_SIZE = (1616, 1232)  # (width, height) of NCLT's images, which lie on their side
NCLT_SHAPE = 0.01  # of an aspect ratio, by which copies of them are told from other cameras' 4:3
UPRIGHT_TURN = 90  # degrees clockwise that NCLT's images are turned by


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
