"""The ground along one stretch: places things in the stretch's own frame and refuses what is in the way."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.route import Route, Stretch
from deepsimbad_client.campus.scenery import Block, Facade, FacadeStyle, Material, Patch, Scene, Surface, Tree

NEIGHBOURS = 24
"""How many of the buildings before are looked at when a new one is placed."""


@dataclass(frozen=True)
class _Footprint:
    centre: NDArray[np.float64]
    forward: NDArray[np.float64]
    half: tuple[float, float]

    def contains(self, points: NDArray[np.float64], margin: float) -> NDArray[np.bool_]:
        offset = points - self.centre
        along = offset @ self.forward
        across = offset @ np.array([-self.forward[1], self.forward[0]])
        within = (np.abs(along) < self.half[0] + margin) & (np.abs(across) < self.half[1] + margin)
        return np.asarray(within, np.bool_)

    def corners(self) -> NDArray[np.float64]:
        side = np.array([-self.forward[1], self.forward[0]])
        a, b = self.half
        # Counter-clockwise with forward up and right to the right: each edge runs left to right seen from outside.
        signs = ((a, -b), (-a, -b), (-a, b), (a, b))
        return np.stack([self.centre + x * self.forward + y * side for x, y in signs])

    def meets(self, other: "_Footprint") -> bool:
        mine, theirs = self.corners(), other.corners()
        for axis in (self.forward, other.forward):
            for direction in (axis, np.array([-axis[1], axis[0]])):
                a, b = mine @ direction, theirs @ direction
                if a.max() + 1.0 < b.min() or b.max() + 1.0 < a.min():
                    return False
        return True


class Plot:
    """One stretch being furnished; `scene` is the result.

    Args:
        route: The centre line nothing may stand on.
        stretch: The part of it to furnish.
        rng: The stretch's own randomness.
        earlier: Footprints of the buildings placed before; grows.
    """

    def __init__(self, route: Route, stretch: Stretch, rng: np.random.Generator, earlier: list[_Footprint]) -> None:
        self.rng = rng
        self.stretch = stretch
        self.length_m = stretch.straight_m
        self.scene = Scene()
        start = np.array([stretch.start_m + 0.25])
        heading = float(route.heading(start)[0])
        self.heading_rad = heading
        self._origin = route.place(start)[0]
        self._forward = np.array([np.cos(heading), np.sin(heading)])
        self._right = np.array([-np.sin(heading), np.cos(heading)])
        end = stretch.start_m + stretch.straight_m + stretch.bend_m
        self._line = route.between(stretch.start_m - 160, end + 160)
        self._earlier = earlier

    def point(self, along_m: float, right_m: float) -> NDArray[np.float64]:
        """[2] north and east of a point given in metres along and right of the stretch."""
        return np.asarray(self._origin + along_m * self._forward + right_m * self._right, np.float64)

    def free(self, place: NDArray[np.float64], clearance_m: float) -> bool:
        """Whether a point is so far from the route and outside every building."""
        if np.hypot(*(self._line - place).T).min() < clearance_m:
            return False
        return not any(f.contains(place[None], 1.0)[0] for f in self._earlier[-NEIGHBOURS:])

    def building(
        self,
        along_m: float,
        setback_m: float,
        size_m: tuple[float, float, float],
        material: Material,
        style_seed: int,
        clearance_m: float = 4.0,
    ) -> bool:
        """Put up a building, if it fits.

        Args:
            along_m: Where its near end begins.
            setback_m: Distance of its near face from the centre line; negative is left.
            size_m: Width along the route, depth and height.
            material: What it is made of.
            style_seed: Equal seeds and sizes look equal.
            clearance_m: Least distance from the route to any of its walls.

        Returns:
            Whether it was put up.
        """
        width, depth, height = size_m
        centre = self.point(along_m + width / 2, setback_m + np.copysign(depth / 2, setback_m))
        footprint = _Footprint(centre, self._forward, (width / 2, depth / 2))
        if footprint.contains(self._line, clearance_m).any():
            return False
        if any(footprint.meets(other) for other in self._earlier[-NEIGHBOURS:]):
            return False
        self._earlier.append(footprint)
        corners = footprint.corners()
        details = np.random.default_rng([style_seed, 7])
        floors = 0 if material == "wall" else max(1, int(height / details.uniform(3.1, 3.9)))
        bay = float(details.uniform(2.2, 4.2))
        for edge in range(4):
            left, right = corners[edge], corners[(edge + 1) % 4]
            wide = float(np.hypot(*(right - left)))
            faces_route = edge == (0 if setback_m > 0 else 2)
            style = FacadeStyle(style_seed, material, round(wide, 2), height, floors, bay, faces_route)
            self.scene.facades.append(Facade(left, right, style))
        self.scene.blocks.append(Block(corners, height))
        return True

    def tree(
        self,
        along_m: float,
        right_m: float,
        species: int | None = None,
        clearance_m: float = 3.0,
        height_m: float | None = None,
    ) -> None:
        """Plant a tree, if there is room."""
        place = self.point(along_m, right_m)
        kind = int(self.rng.integers(0, 14)) if species is None else species
        tall = float(self.rng.uniform(6, 13)) if height_m is None else height_m
        mirrored = bool(self.rng.random() < 0.5)
        if self.free(place, clearance_m):
            self.scene.trees.append(Tree(place, tall, kind, mirrored))

    def pave(self, along_m: tuple[float, float], right_m: tuple[float, float], surface: Surface) -> None:
        """Pave a rectangle given by its ends along and right of the stretch."""
        corners = [(along_m[0], right_m[0]), (along_m[1], right_m[0])]
        corners += [(along_m[1], right_m[1]), (along_m[0], right_m[1])]
        self.scene.patches.append(Patch(np.stack([self.point(a, r) for a, r in corners]), surface))
