"""What stands on the campus: plain records with places in metres (north, east) and heights above the ground."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Material = Literal["brick", "sandstone", "concrete", "plaster", "glass", "wall"]
Surface = Literal["concrete", "asphalt", "paving"]


@dataclass(frozen=True)
class FacadeStyle:
    """Everything a facade's picture depends on; equal styles look alike (and are drawn once).

    Attributes:
        seed: Decides colours and details.
        material: What the wall is made of.
        width_m: Width of the wall.
        height_m: Height of the wall.
        floors: Storeys; 0 for a plain wall without windows.
        bay_m: Distance between two windows.
        door: Whether the ground floor has an entrance.
    """

    seed: int
    material: Material
    width_m: float
    height_m: float
    floors: int
    bay_m: float
    door: bool


@dataclass(frozen=True)
class Facade:
    """An upright wall seen from one side only.

    Attributes:
        left: [2] the foot of its left edge, as seen from outside.
        right: [2] the foot of its right edge.
        style: How it looks.
    """

    left: NDArray[np.float64]
    right: NDArray[np.float64]
    style: FacadeStyle


@dataclass(frozen=True)
class Block:
    """A solid that throws a shadow.

    Attributes:
        corners: [4, 2] its footprint.
        height_m: Its height.
    """

    corners: NDArray[np.float64]
    height_m: float


@dataclass(frozen=True)
class Tree:
    """A tree, drawn as an upright picture that turns towards the camera."""

    place: NDArray[np.float64]
    height_m: float
    species: int
    mirrored: bool


@dataclass(frozen=True)
class Post:
    """Something slender: a lamp, a sign, a bollard, a bench or a bush."""

    place: NDArray[np.float64]
    kind: Literal["lamp", "sign", "bollard", "bench", "bush"]
    size_m: float
    colour: tuple[int, int, int]


@dataclass(frozen=True)
class Bay:
    """A place where a car may be parked; which ones are taken differs between drives."""

    place: NDArray[np.float64]
    heading_rad: float
    number: int


@dataclass(frozen=True)
class Patch:
    """A paved piece of ground: a road, a crossing path, a car park."""

    outline: NDArray[np.float64]  # [n, 2], convex
    surface: Surface


@dataclass
class Scene:
    """All that stands along one stretch of the route."""

    facades: list[Facade] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)
    trees: list[Tree] = field(default_factory=list)
    posts: list[Post] = field(default_factory=list)
    bays: list[Bay] = field(default_factory=list)
    patches: list[Patch] = field(default_factory=list)
    road_right_m: float | None = None
    path_half_width_m: float = 1.6
    path_surface: Surface = "concrete"
