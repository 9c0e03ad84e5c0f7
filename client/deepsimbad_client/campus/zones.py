"""What each kind of stretch holds: courts, streets, avenues, car parks, and the bland and repeated ones."""

from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np

from deepsimbad_client.campus.plot import Plot
from deepsimbad_client.campus.scenery import Bay, Material, Post

Zone = Literal["court", "street", "avenue", "twins", "field", "wall", "parking"]

DECK: tuple[Zone, ...] = ("court", "street", "avenue", "twins", "field", "wall", "parking", "twins")
"""Every eight stretches hold these, shuffled."""

MATERIALS: tuple[Material, ...] = ("brick", "sandstone", "concrete", "plaster", "glass", "brick")
SIGN_COLOURS = ((40, 40, 190), (150, 70, 20), (40, 130, 40), (30, 170, 220), (200, 200, 200))
BAY_NUMBERS = 64


def furnish(plot: Plot, zone: Zone) -> None:
    """Fill a stretch with what its zone holds, and every stretch with distant buildings, bushes and a bend."""
    rng = plot.rng
    plot.scene.path_half_width_m = float(rng.uniform(1.3, 2.2))
    plot.scene.path_surface = ("concrete", "asphalt", "paving")[int(rng.integers(0, 3))]
    _ZONES[zone](plot)
    if zone not in ("field", "wall"):
        _row(plot, -1 if rng.random() < 0.5 else 1, (45, 70), 0.5, (9, 26))
        for _ in range(int(rng.integers(1, 5))):
            _post(plot, "bush")
    end = plot.length_m
    for _ in range(int(rng.integers(2, 6))):
        along = float(rng.uniform(end, end + plot.stretch.bend_m))
        plot.tree(along, float(rng.uniform(-25, 25)), clearance_m=4.5)
    if rng.random() < 0.6:
        along = float(rng.uniform(0.2, 0.8) * end)
        plot.pave((along, along + float(rng.uniform(1.6, 4))), (-40, 40), "concrete")


def _building(plot: Plot, along: float, setback: float, heights: tuple[float, float]) -> float:
    rng = plot.rng
    width = float(rng.uniform(9, 24))
    size = (width, float(rng.uniform(9, 18)), float(rng.uniform(*heights)))
    material = MATERIALS[int(rng.integers(0, len(MATERIALS)))]
    plot.building(along, setback, size, material, int(rng.integers(0, 1 << 31)))
    return width


def _row(plot: Plot, side: int, setbacks: tuple[float, float], share: float, heights: tuple[float, float]) -> None:
    along = float(plot.rng.uniform(0, 6))
    while along < plot.length_m - 4:
        if plot.rng.random() < share:
            along += _building(plot, along, side * float(plot.rng.uniform(*setbacks)), heights)
        else:
            along += 8
        along += float(plot.rng.uniform(2, 9))


def _post(plot: Plot, kind: Literal["lamp", "sign", "bollard", "bench", "bush"], along: float = -1) -> None:
    rng = plot.rng
    along = float(rng.uniform(0, plot.length_m)) if along < 0 else along
    place = plot.point(along, float(rng.choice([-1, 1]) * rng.uniform(2.8, 6)))
    size = {"lamp": 5.0, "sign": 2.3, "bollard": 0.9, "bench": 1.6, "bush": 1.3}[kind]
    colour = SIGN_COLOURS[int(rng.integers(0, len(SIGN_COLOURS)))]
    size *= float(rng.uniform(0.8, 1.3))
    if plot.free(place, 2.5):
        plot.scene.posts.append(Post(place, kind, size, colour))


def _court(plot: Plot) -> None:
    rng = plot.rng
    for side in (-1, 1):
        _row(plot, side, (7, 14), 0.85, (5, 17))
    for _ in range(int(rng.integers(9, 17))):
        plot.tree(float(rng.uniform(0, plot.length_m)), float(rng.choice([-1, 1]) * rng.uniform(3.8, 7)))
    for kind in ("lamp", "sign", "bench", "bollard"):
        for _ in range(int(rng.integers(1, 4))):
            _post(plot, kind)


def _street(plot: Plot) -> None:
    rng = plot.rng
    side = int(rng.choice([-1, 1]))
    middle = side * 7.5
    plot.scene.road_right_m = middle
    plot.pave((-3, plot.length_m + 3), (middle - 3.6, middle + 3.6), "asphalt")
    for row, setback in ((side, (14.0, 18.0)), (-side, (6.0, 9.0))):
        _row(plot, row, setback, 0.9, (6, 18))
    for along in np.arange(4.0, plot.length_m, 22):
        _post(plot, "lamp", float(along))
    for along in np.arange(2.0, plot.length_m - 4, 6.2):
        place = plot.point(float(along), middle - side * 2.6)
        _bay(plot, place, plot.heading_rad)
        if rng.random() < 0.6:
            plot.tree(float(along + 4), -side * float(rng.uniform(3.8, 5)))
    for _ in range(3):
        _post(plot, "sign")


def _avenue(plot: Plot) -> None:
    rng = plot.rng
    species = int(rng.integers(0, 10))
    for along in np.arange(2.0, plot.length_m, float(rng.uniform(7, 10))):
        for side in (-1, 1):
            tall = float(rng.uniform(9, 11))
            plot.tree(float(along), side * float(rng.uniform(4.2, 4.8)), species, height_m=tall)
    for side in (-1, 1):
        _row(plot, side, (18, 30), 0.35, (6, 15))
    for _ in range(2):
        _post(plot, "bench")


def _twins(plot: Plot) -> None:
    rng = plot.rng
    seed, width, gap = int(rng.integers(0, 1 << 31)), float(rng.uniform(10, 13)), float(rng.uniform(2, 4))
    size = (round(width, 2), 11.0, float(rng.uniform(7, 11)))
    material = MATERIALS[int(rng.integers(0, len(MATERIALS)))]
    for side in (-1, 1):
        for along in np.arange(1.0, plot.length_m - width + 2, width + gap):
            plot.building(float(along), side * 8.5, size, material, seed)
            plot.tree(float(along + width + gap / 2), side * 5.5, seed % 10, height_m=6.5)


def _field(plot: Plot) -> None:
    rng = plot.rng
    for _ in range(14):
        side = float(rng.choice([-1, 1]))
        plot.tree(float(rng.uniform(-10, plot.length_m + 30)), side * float(rng.uniform(45, 90)))
    if rng.random() < 0.7:
        plot.tree(float(rng.uniform(10, plot.length_m)), float(rng.uniform(8, 25)))
    _post(plot, "bench")


def _wall(plot: Plot) -> None:
    rng = plot.rng
    side = int(rng.choice([-1, 1]))
    size = (plot.length_m - 1, 0.4, float(rng.uniform(2.4, 3.4)))
    plot.building(0.5, side * 4.2, size, "wall", int(rng.integers(0, 1 << 31)), clearance_m=3.0)
    for along in np.arange(0.0, plot.length_m, float(rng.uniform(8, 14))):
        plot.tree(float(along), side * float(rng.uniform(8, 20)))
    for _ in range(3):
        plot.tree(float(rng.uniform(0, plot.length_m)), -side * float(rng.uniform(14, 50)))


def _parking(plot: Plot) -> None:
    rng = plot.rng
    side = int(rng.choice([-1, 1]))
    plot.pave((0, plot.length_m), (side * 4, side * 24), "asphalt")
    for row, turn in ((6.5, np.pi / 2), (20.5, -np.pi / 2)):
        for along in np.arange(2.0, plot.length_m - 2, 2.8):
            _bay(plot, plot.point(float(along), side * row), plot.heading_rad + turn)
    _row(plot, side, (27, 33), 0.8, (6, 15))
    _row(plot, -side, (7, 12), 0.7, (5, 14))
    for _ in range(6):
        plot.tree(float(rng.uniform(0, plot.length_m)), -side * float(rng.uniform(3.8, 6)))
    for _ in range(2):
        _post(plot, "lamp")


def _bay(plot: Plot, place: np.ndarray[tuple[int, ...], np.dtype[np.float64]], heading: float) -> None:
    if plot.free(place, 3.2):
        number = plot.stretch.index * BAY_NUMBERS + len(plot.scene.bays)
        plot.scene.bays.append(Bay(place, heading, number))


_ZONES: Mapping[Zone, Callable[[Plot], None]] = {
    "court": _court,
    "street": _street,
    "avenue": _avenue,
    "twins": _twins,
    "field": _field,
    "wall": _wall,
    "parking": _parking,
}
