"""Pictures of walls: brick, stone, plaster, concrete or glass, with windows, doors, sills and snow."""

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.noise import tile_noise
from deepsimbad_client.campus.scenery import FacadeStyle, Material
from deepsimbad_client.campus.season import Season

Image = NDArray[np.uint8]

PIXELS_PER_M = 24.0
LONGEST_PX = 1000

_BASE: dict[Material, tuple[float, float, float]] = {
    "brick": (62, 78, 142),
    "sandstone": (132, 172, 200),
    "concrete": (158, 160, 160),
    "plaster": (196, 208, 216),
    "glass": (128, 118, 104),
    "wall": (168, 172, 174),
}


def draw_facade(style: FacadeStyle, season: Season, drive: int) -> tuple[Image, ...]:
    """Draw a wall's own colours, without light.

    Args:
        style: How the wall looks; the same in every drive.
        season: Decides the snow and what the glass mirrors.
        drive: A number of the drive; decides which blinds are down and which rooms are lit.

    Returns:
        The picture, [height, width, 3] BGR, and its halvings, largest first.
    """
    rng = np.random.default_rng([style.seed, 1])
    scale = min(PIXELS_PER_M, LONGEST_PX / style.width_m)
    width, height = max(8, round(style.width_m * scale)), max(8, round(style.height_m * scale))
    picture = _surface(style, rng, (height, width), scale)
    if style.floors:
        _windows(picture, style, season, rng, np.random.default_rng([style.seed, drive]), scale)
    _edges(picture, style, season, rng, scale)
    _dapple(picture, season, np.random.default_rng([style.seed, drive, 1]), scale)
    levels = [picture]
    while min(levels[-1].shape[:2]) >= 12 and len(levels) < 6:
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.uint8))
    return tuple(levels)


def _surface(style: FacadeStyle, rng: np.random.Generator, shape: tuple[int, int], scale: float) -> Image:
    base = np.array(_BASE[style.material]) * rng.uniform(0.78, 1.15) + rng.uniform(-16, 16, 3)
    grey = np.zeros(shape, np.float32)
    if style.material in ("brick", "sandstone"):
        course = 0.16 if style.material == "brick" else 0.4
        rows, columns = max(1, int(style.height_m / course)), max(1, int(style.width_m / (3 * course)))
        stones = rng.normal(0, 9 if style.material == "brick" else 7, (rows, columns)).astype(np.float32)
        grey += np.asarray(cv2.resize(stones, shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32)
    grey += tile_noise(rng, shape, (1, 2), 5) * np.float32(3 if style.material == "wall" else 7)
    if style.material in ("concrete", "wall"):
        joint = max(2, round((2.5 if style.material == "wall" else 3.2) * scale))
        grey[:, ::joint] -= 22
        grey[:: max(2, round(3.0 * scale)), :] -= 18
    picture = np.clip(base + grey[:, :, None], 0, 255)
    return np.ascontiguousarray(picture.astype(np.uint8))


def _windows(
    picture: Image,
    style: FacadeStyle,
    season: Season,
    rng: np.random.Generator,
    today: np.random.Generator,
    scale: float,
) -> None:
    height, width = picture.shape[:2]
    glassy = style.material == "glass"
    bays = max(1, int(style.width_m / style.bay_m))
    bay, floor = width / bays, height / style.floors
    share_x = 0.92 if glassy else float(rng.uniform(0.35, 0.72))
    share_y = 0.84 if glassy else float(rng.uniform(0.42, 0.64))
    frame = tuple(int(v) for v in (rng.uniform(30, 80, 3) if rng.random() < 0.5 else rng.uniform(190, 235, 3)))
    panes = int(rng.integers(1, 4))
    blank = rng.random((style.floors, bays)) < (0.0 if glassy else 0.07)
    door_bay = int(rng.integers(0, bays))
    dark = np.array([58.0, 50, 44]) * rng.uniform(0.7, 1.3)
    mirror = np.array(season.horizon) * 0.42 + dark * 0.4
    for f in range(style.floors):
        top = floor * f + floor * 0.2
        for b in range(bays):
            x0, x1 = round(bay * (b + 0.5 - share_x / 2)), round(bay * (b + 0.5 + share_x / 2))
            y0, y1 = round(top), round(top + floor * share_y)
            if style.door and f == style.floors - 1 and b == door_bay:
                _door(picture, (x0, x1), rng, scale)
                continue
            if blank[f, b]:
                continue
            mood = today.random()
            glass = dark
            if mood < 0.10 + 0.14 * (season.sun_elevation_deg < 25):
                glass = np.array([120.0, 190, 225])
            elif mood < 0.34:
                glass = np.array([165.0, 172, 176])
            split = y0 + round((y1 - y0) * today.uniform(0.25, 0.8))
            cv2.rectangle(picture, (x0, y0), (x1, y1), _ink(glass), -1)
            cv2.rectangle(picture, (x0, y0), (x1, split), _ink(0.5 * mirror + 0.5 * glass), -1)
            cv2.rectangle(picture, (x0, y0), (x1, y1), frame, max(1, round(0.07 * scale)))
            for p in range(1, panes):
                x = x0 + (x1 - x0) * p // panes
                cv2.line(picture, (x, y0), (x, y1), frame, 1)
            sill = (235, 235, 235) if season.snow > 0.3 else tuple(int(v * 0.6) for v in frame)
            cv2.rectangle(picture, (x0 - 1, y1), (x1 + 1, y1 + max(1, round(0.1 * scale))), sill, -1)


def _door(picture: Image, span: tuple[int, int], rng: np.random.Generator, scale: float) -> None:
    height = picture.shape[0]
    middle, half = (span[0] + span[1]) // 2, round(rng.uniform(0.7, 1.3) * scale)
    top = height - round(2.4 * scale)
    colour = tuple(int(v) for v in rng.uniform(25, 150, 3))
    cv2.rectangle(picture, (middle - half, top), (middle + half, height), colour, -1)
    cv2.rectangle(picture, (middle - half, top), (middle + half, height), (210, 210, 210), 2)
    cv2.line(picture, (middle, top), (middle, height), (60, 60, 60), 1)
    canopy = tuple(int(v) for v in rng.uniform(60, 220, 3))
    reach, thick = round(half * 1.6), max(2, round(0.3 * scale))
    cv2.rectangle(picture, (middle - reach, top - 2 * thick), (middle + reach, top - thick), canopy, -1)


def _edges(picture: Image, style: FacadeStyle, season: Season, rng: np.random.Generator, scale: float) -> None:
    height, width = picture.shape[:2]
    band = max(1, round((0.2 if style.material == "wall" else rng.uniform(0.3, 0.8)) * scale))
    picture[:band] = np.clip(picture[:band] * rng.uniform(0.75, 1.25), 0, 255).astype(np.uint8)
    plinth = max(1, round(0.5 * scale))
    picture[-plinth:] = (picture[-plinth:] * 0.78).astype(np.uint8)
    if season.snow > 0.3:
        picture[: max(2, round(0.22 * scale))] = (238, 236, 234)
        drift = (np.abs(tile_noise(rng, (8, width), (1, max(2, width // 60)), 3)[0]) * 0.2 * scale).astype(int)
        for x in range(width):
            picture[height - 1 - drift[x] :, x] = (232, 230, 228)
    for x in (0, width - 1):
        picture[:, x] = (picture[:, x] * 0.7).astype(np.uint8)


def _dapple(picture: Image, season: Season, today: np.random.Generator, scale: float) -> None:
    """Throw the shadows of what stands around on the wall: branches and roofs, elsewhere in every drive."""
    height, width = picture.shape[:2]
    cells = max(1, round(height / (5 * scale))), max(1, round(width / (5 * scale)))
    depth = tile_noise(today, (height, width), cells, 5)
    slope = np.linspace(-1, 1, width)[None, :] * today.uniform(-0.8, 0.8)
    low = np.linspace(-1.2, 1.2, height)[:, None] + slope  # more shade near the ground
    shade = np.clip((depth + 0.9 * low - today.uniform(-0.6, 1.0)) / 0.25, 0, 1)[:, :, None]
    picture[:] = (picture * (1 - 0.6 * season.sun_strength * shade)).astype(np.uint8)


def _ink(colour: NDArray[np.float64]) -> tuple[int, ...]:
    return tuple(int(value) for value in np.clip(colour, 0, 255))
