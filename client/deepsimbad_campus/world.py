"""What stands along the route, the same in every season: buildings, things and paving, by kind of stretch."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepsimbad_campus.camera import Array, Colour
from deepsimbad_campus.route import STEP_M, Route, Stretch, stream

SIGHT_M, BEHIND_M = 130.0, 25.0  # nothing farther along the route than this is drawn
NEIGHBOURS = 24  # the buildings last placed, which a new one must not meet
# Every eight stretches are of these zones, shuffled.
DECK = ("court", "street", "avenue", "twins", "field", "wall", "parking", "twins")
BAY_NUMBERS = 64
FIRST_CONIFER, BUSH = 11, 14
MATERIALS = ("brick", "sandstone", "concrete", "plaster", "glass", "brick")
SIGNS: dict[str, Colour] = {
    "red sign": (40, 40, 190), "blue sign": (150, 70, 20), "green sign": (40, 130, 40),
    "yellow sign": (30, 170, 220), "white sign": (200, 200, 200),
}  # fmt: skip
SIZES_M = {"lamp": 5.0, "sign": 2.3, "bollard": 0.9, "bench": 1.6, "bush": 1.3}  # on average


class Thing(NamedTuple):
    """Something on the ground that shows the camera one face, wherever it is seen from."""

    place: Array
    kind: str
    size_m: float  # height; of a bench its length
    look: int  # a tree's species, a car's paint, seed of a walker's clothes, number of a bay where a car may stand
    turn: float  # heading of a car or a bay, a walker's stride; -1 of a mirrored tree


class Style(NamedTuple):
    """Everything a wall's picture depends on; equal styles look alike and are drawn once."""

    seed: int
    material: str
    width_m: float
    height_m: float
    door: bool = False


class Block(NamedTuple):
    """A building: a solid with a wall on every side."""

    centre: Array
    axes: Array  # [2, 2] unit vectors along and to the right of it
    half: tuple[float, float]
    height_m: float

    def corners(self) -> Array:
        """[4, 2] its footprint; each edge runs left to right as seen from outside."""
        (a, b), (forward, side) = self.half, self.axes
        return np.stack([self.centre + x * forward + y * side for x, y in ((a, -b), (-a, -b), (-a, b), (a, b))])

    def contains(self, points: Array, margin_m: float) -> NDArray[np.bool_]:
        """[n] whether [n, 2] points lie within the building or less than a margin from it."""
        forward_m, right_m = ((points - self.centre) @ axis for axis in self.axes)
        near = (np.abs(forward_m) < self.half[0] + margin_m) & (np.abs(right_m) < self.half[1] + margin_m)
        return np.asarray(near, np.bool_)

    def meets(self, other: "Block") -> bool:
        """Whether another building is less than a metre away: no axis of either separates them."""
        axes = np.concatenate([self.axes, other.axes]).T
        a, b = self.corners() @ axes, other.corners() @ axes
        return not bool(((a.max(0) + 1.0 < b.min(0)) | (b.max(0) + 1.0 < a.min(0))).any())


class Section:
    """One stretch and all that stands along it; things are placed by metres along and right of its straight part.

    Nothing may stand on the route, nor on `placed_blocks`, all buildings so far, to which it adds its own.
    """

    def __init__(self, seed: int, route: Route, stretch: Stretch, placed_blocks: list[Block]) -> None:
        self.stretch, self._placed_blocks = stretch, placed_blocks
        self.blocks: list[Block] = []
        self.facades: list[tuple[Array, Style]] = []  # [2, 2] feet of a wall's left and right edge, seen from outside
        self.things: list[Thing] = []
        self.patches: list[tuple[Array, str]] = []  # [4, 2] a paved piece of ground, and with what
        self.road_right_m: float | None = None
        self._origin, self._heading_rad = route.place(stretch.start_m + 0.25), route.heading(stretch.start_m + 0.25)
        cos, sin = np.cos(self._heading_rad), np.sin(self._heading_rad)
        self._axes = np.array([[cos, sin], [-sin, cos]])
        self._line = route.place(np.arange(stretch.start_m - 160, stretch.end_m + 160 + STEP_M, STEP_M))
        self._rng = rng = stream(seed, "stretch", stretch.number)
        self.path_half_width_m = rng.uniform(1.3, 2.2)
        self.path_surface = ("concrete", "asphalt", "paving")[rng.integers(0, 3)]
        deck, card = divmod(stretch.number, len(DECK))
        zone, length = stream(seed, "deck", deck).permutation(DECK)[card], stretch.straight_m
        getattr(self, f"_{zone}")(rng, length)
        # What every stretch has: distant buildings and bushes, trees at its bend, perhaps a crossing path.
        if zone not in ("field", "wall"):
            self._row(-1 if rng.random() < 0.5 else 1, (45, 70), 0.5, (9, 26))
            self._posts("bush", int(rng.integers(1, 5)))
        for _ in range(rng.integers(2, 6)):
            self._tree(rng.uniform(length, stretch.end_m - stretch.start_m), rng.uniform(-25, 25), room=4.5)
        if rng.random() < 0.6:
            along_m = rng.uniform(0.2, 0.8) * length
            self._pave(along_m, along_m + rng.uniform(1.6, 4), -40, 40, "concrete")

    def _point(self, along_m: float, right_m: float) -> Array:
        return np.asarray(self._origin + along_m * self._axes[0] + right_m * self._axes[1], np.float64)

    def _put(self, thing: Thing, clearance: float) -> None:
        """Add a thing where it stands free of the route and of buildings."""
        on_route = np.hypot(*(self._line - thing.place).T).min() < clearance
        near = self._placed_blocks[-NEIGHBOURS:]
        if not (on_route or any(block.contains(thing.place[None], 1.0)[0] for block in near)):
            self.things.append(thing)

    def _build(self, along_m: float, setback: float, depth: float, style: Style, clearance: float = 4.0) -> None:
        """Put up a building with such a front, if it fits, by its near end and near face (negative is left)."""
        centre = self._point(along_m + style.width_m / 2, setback + np.copysign(depth / 2, setback))
        block = Block(centre, self._axes, (style.width_m / 2, depth / 2), style.height_m)
        if block.contains(self._line, clearance).any() or any(map(block.meets, self._placed_blocks[-NEIGHBOURS:])):
            return
        self._placed_blocks.append(block)
        self.blocks.append(block)
        corners, front = block.corners(), 0 if setback > 0 else 2
        for edge, feet in enumerate(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)):
            wide = round(float(np.hypot(*(feet[1] - feet[0]))), 2)
            self.facades.append((feet, style._replace(width_m=wide, door=edge == front)))

    def _row(self, side: float, setbacks: tuple[float, float], share: float, heights: tuple[float, float]) -> None:
        """Line one side with buildings and gaps."""
        rng, along_m = self._rng, self._rng.uniform(0, 6)
        while along_m < self.stretch.straight_m - 4:
            width = 8.0
            if rng.random() < share:
                setback = side * rng.uniform(*setbacks)
                width, depth, height = rng.uniform(9, 24), rng.uniform(9, 18), rng.uniform(*heights)
                material = MATERIALS[rng.integers(0, len(MATERIALS))]
                self._build(along_m, setback, depth, Style(int(rng.integers(0, 1 << 31)), material, width, height))
            along_m = along_m + width + rng.uniform(2, 9)

    def _tree(self, along_m: float, right_m: float, species: int = -1, height: float = 0.0, room: float = 3.0) -> None:
        """Plant a tree, if there is room, of any species and height where none is given."""
        rng = self._rng
        species = int(rng.integers(0, BUSH)) if species < 0 else species
        kind, height = "conifer" if species >= FIRST_CONIFER else "tree", height or rng.uniform(6, 13)
        mirror = -1.0 if rng.random() < 0.5 else 1.0
        self._put(Thing(self._point(along_m, right_m), kind, height, species, mirror), room)

    def _posts(self, kind: str, count: int = 1, at_m: float | None = None) -> None:
        """Put posts or bushes beside the path, where there is room, anywhere along it where no place is given."""
        rng = self._rng
        for _ in range(count):
            along_m = rng.uniform(0, self.stretch.straight_m) if at_m is None else at_m
            place = self._point(along_m, rng.choice([-1, 1]) * rng.uniform(2.8, 6))
            sign, size = list(SIGNS)[rng.integers(0, len(SIGNS))], SIZES_M[kind] * rng.uniform(0.8, 1.3)
            self._put(Thing(place, sign if kind == "sign" else kind, size, BUSH, 1.0), 2.5)

    def _bay(self, along_m: float, right_m: float, turn: float = 0.0) -> None:
        number = self.stretch.number * BAY_NUMBERS + sum(thing.kind == "bay" for thing in self.things)
        self._put(Thing(self._point(along_m, right_m), "bay", 0.0, number, float(self._heading_rad) + turn), 3.2)

    def _pave(self, first: float, last: float, left: float, right: float, surface: str) -> None:
        corners = ((first, left), (last, left), (last, right), (first, right))
        self.patches.append((np.stack([self._point(*corner) for corner in corners]), surface))

    def _court(self, rng: np.random.Generator, length: float) -> None:
        for side in (-1, 1):
            self._row(side, (7, 14), 0.85, (5, 17))
        for _ in range(rng.integers(9, 17)):
            self._tree(rng.uniform(0, length), rng.choice([-1, 1]) * rng.uniform(3.8, 7))
        for kind in ("lamp", "sign", "bench", "bollard"):
            self._posts(kind, int(rng.integers(1, 4)))

    def _street(self, rng: np.random.Generator, length: float) -> None:
        side = int(rng.choice([-1, 1]))
        self.road_right_m = middle = side * 7.5
        self._pave(-3, length + 3, middle - 3.6, middle + 3.6, "asphalt")
        self._row(side, (14, 18), 0.9, (6, 18))
        self._row(-side, (6, 9), 0.9, (6, 18))
        for along_m in np.arange(4.0, length, 22):
            self._posts("lamp", at_m=along_m)
        for along_m in np.arange(2.0, length - 4, 6.2):
            self._bay(along_m, middle - side * 2.6)
            if rng.random() < 0.6:
                self._tree(along_m + 4, -side * rng.uniform(3.8, 5))
        self._posts("sign", 3)

    def _avenue(self, rng: np.random.Generator, length: float) -> None:
        species = int(rng.integers(0, 10))
        for along_m in np.arange(2.0, length, rng.uniform(7, 10)):
            for side in (-1, 1):
                height = rng.uniform(9, 11)
                self._tree(along_m, side * rng.uniform(4.2, 4.8), species, height)
        for side in (-1, 1):
            self._row(side, (18, 30), 0.35, (6, 15))
        self._posts("bench", 2)

    def _twins(self, rng: np.random.Generator, length: float) -> None:
        """Buildings that look alike: places that are hard to tell apart."""
        seed, width, gap = int(rng.integers(0, 1 << 31)), rng.uniform(10, 13), rng.uniform(2, 4)
        height, material = rng.uniform(7, 11), MATERIALS[rng.integers(0, len(MATERIALS))]
        for side in (-1, 1):
            for along_m in np.arange(1.0, length - width + 2, width + gap):
                self._build(along_m, side * 8.5, 11.0, Style(seed, material, round(width, 2), height))
                self._tree(along_m + width + gap / 2, side * 5.5, seed % 10, 6.5)

    def _field(self, rng: np.random.Generator, length: float) -> None:
        """Hardly anything: places without a landmark."""
        for _ in range(14):
            side = rng.choice([-1, 1])
            self._tree(rng.uniform(-10, length + 30), side * rng.uniform(45, 90))
        if rng.random() < 0.7:
            self._tree(rng.uniform(10, length), rng.uniform(8, 25))
        self._posts("bench")

    def _wall(self, rng: np.random.Generator, length: float) -> None:
        side, height = rng.choice([-1, 1]), rng.uniform(2.4, 3.4)
        self._build(0.5, side * 4.2, 0.4, Style(int(rng.integers(0, 1 << 31)), "wall", length - 1, height), 3.0)
        for along_m in np.arange(0.0, length, rng.uniform(8, 14)):
            self._tree(along_m, side * rng.uniform(8, 20))
        for _ in range(3):
            self._tree(rng.uniform(0, length), -side * rng.uniform(14, 50))

    def _parking(self, rng: np.random.Generator, length: float) -> None:
        side = int(rng.choice([-1, 1]))
        self._pave(0, length, side * 4, side * 24, "asphalt")
        for right, turn in ((6.5, np.pi / 2), (20.5, -np.pi / 2)):
            for along_m in np.arange(2.0, length - 2, 2.8):
                self._bay(along_m, side * right, turn)
        self._row(side, (27, 33), 0.8, (6, 15))
        self._row(-side, (7, 12), 0.7, (5, 14))
        for _ in range(6):
            self._tree(rng.uniform(0, length), -side * rng.uniform(3.8, 6))
        self._posts("lamp", 2)


class World:
    """Everything that stays where it is; the beginning of a longer world is the shorter world."""

    def __init__(self, seed: int, length_m: float) -> None:
        self.seed = seed
        # A stretch is furnished knowing the route well beyond it, so the route goes on past the last of them.
        self.route = Route(seed, length_m + 2 * SIGHT_M + 400)
        stretches, blocks = self.route.stretches, list[Block]()
        near = [stretch for stretch in stretches if stretch.start_m <= length_m + SIGHT_M]
        self.sections = [Section(seed, self.route, stretch, blocks) for stretch in near]
        self._starts = np.array([section.stretch.start_m for section in self.sections])

    def ahead(self, position_m: float) -> list[Section]:
        """The sections that may be seen from a route position, nearest first."""
        ends = np.searchsorted(self._starts, [position_m - BEHIND_M, position_m + SIGHT_M], "right") - 1
        first, last = np.clip(ends, 0, len(self._starts) - 1)
        return self.sections[first : last + 1]

    def skyline(self) -> Array:
        """[361] elevation in degrees of the far hills and woods, by azimuth in degrees."""
        rng = stream(self.seed, "skyline")
        angles, height = np.deg2rad(np.arange(360.0)), np.full(360, 2.6)
        for waves in range(2, 40):
            phase, amplitude = rng.uniform(0, 2 * np.pi), rng.normal() * 1.6 / waves**0.7
            height += amplitude * np.sin(waves * angles + phase)
        return np.pad(np.clip(height, 0.6, 8), (0, 1), mode="wrap")
