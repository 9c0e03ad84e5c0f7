"""Pictures of surfaces in their own colours, without light: walls, trees, the ground and the sky of a season."""

from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_campus.camera import Array, Colour, Image, ink
from deepsimbad_campus.route import stream
from deepsimbad_campus.season import Season
from deepsimbad_campus.world import BUSH, FIRST_CONIFER, Style

PIXELS_PER_M, LONGEST_PX = 24.0, 1000
WALLS: dict[str, Colour] = {
    "brick": (62, 78, 142), "sandstone": (132, 172, 200), "concrete": (158, 160, 160), "plaster": (196, 208, 216),
    "glass": (128, 118, 104), "wall": (168, 172, 174),
}  # fmt: skip
PAVING: dict[str, Colour] = {"concrete": (164, 170, 172), "asphalt": (92, 92, 92), "paving": (118, 136, 158)}
TREE_WIDTH, TREE_HEIGHT, LEAVES = 320, 400, 3000
TILE_PX, TILE_M = 1024, 12.8
SKY_PX_PER_DEG, SKY_TOP_DEG = 4, 68

Floats = NDArray[np.float32]
Levels = tuple[Image, ...]  # a picture and its halvings, largest first


def tile_noise(rng: np.random.Generator, shape: tuple[int, int], cells: tuple[int, int], octaves: int) -> Floats:
    """[height, width, 1] fractal noise of mean 0 and standard deviation 1 that repeats without a seam.

    The coarsest grid has `cells` (rows, columns); each octave doubles it and has half the amplitude of the one before.
    """
    (height, width), total = shape, np.zeros(shape, np.float32)
    for octave in range(octaves):
        rows, columns = cells[0] << octave, cells[1] << octave
        if rows > height or columns > width:
            break
        grid = np.pad(rng.standard_normal((rows, columns)).astype(np.float32), 2, mode="wrap")
        y, x = round(2 * height / rows), round(2 * width / columns)
        fine = cv2.resize(grid, (width + 2 * x, height + 2 * y), interpolation=cv2.INTER_CUBIC)
        total += fine[y : y + height, x : x + width] * np.float32(0.5**octave)
    total -= total.mean()
    return (total / max(float(total.std()), 1e-6))[:, :, None]


def _halvings(picture: NDArray[Any], border: int = cv2.BORDER_DEFAULT) -> Levels:
    levels = [picture.astype(np.uint8)]
    while min(levels[-1].shape[:2]) >= 12 and len(levels) < 6:
        levels.append(np.asarray(cv2.pyrDown(levels[-1], borderType=border), np.uint8))
    return tuple(levels)


def draw_facade(style: Style, season: Season, drive: int) -> Levels:
    """A wall; the drive's number decides which blinds are down and rooms are lit."""
    rng = np.random.default_rng([style.seed, 1])
    scale, is_wall = min(PIXELS_PER_M, LONGEST_PX / style.width_m), style.material == "wall"
    width, height = max(8, round(style.width_m * scale)), max(8, round(style.height_m * scale))
    base = np.array(WALLS[style.material]) * rng.uniform(0.78, 1.15) + rng.uniform(-16, 16, 3)
    grey = np.zeros((height, width, 1), np.float32)
    if style.material in ("brick", "sandstone"):
        course, contrast = (0.16, 9) if style.material == "brick" else (0.4, 7)
        rows, columns = max(1, int(style.height_m / course)), max(1, int(style.width_m / (3 * course)))
        stones = rng.normal(0, contrast, (rows, columns)).astype(np.float32)
        grey[:, :, 0] = cv2.resize(stones, (width, height), interpolation=cv2.INTER_NEAREST)
    grey += tile_noise(rng, (height, width), (1, 2), 5) * np.float32(3 if is_wall else 7)
    if style.material in ("concrete", "wall"):
        grey[:, :: max(2, round((2.5 if is_wall else 3.2) * scale))] -= 22
        grey[:: max(2, round(3.0 * scale))] -= 18
    picture = np.ascontiguousarray(np.clip(base + grey, 0, 255).astype(np.uint8))
    if not is_wall:
        _draw_windows(picture, style, season, rng, drive, scale)
    band, plinth = max(1, round((0.2 if is_wall else rng.uniform(0.3, 0.8)) * scale)), max(1, round(0.5 * scale))
    picture[:band] = np.clip(picture[:band] * rng.uniform(0.75, 1.25), 0, 255)
    picture[-plinth:] = picture[-plinth:] * 0.78
    if season.snow > 0.3:
        picture[: max(2, round(0.22 * scale))] = (238, 236, 234)
        drift = np.abs(tile_noise(rng, (8, width), (1, max(2, width // 60)), 3)[0, :, 0]) * 0.2 * scale
        picture[np.arange(height)[:, None] >= height - 1 - drift.astype(int)] = (232, 230, 228)
    picture[:, [0, -1]] = picture[:, [0, -1]] * 0.7
    # Branches and roofs around throw their shadows on it, more near the ground and elsewhere in every drive.
    rng = np.random.default_rng([style.seed, drive, 1])
    cells = (max(1, round(height / (5 * scale))), max(1, round(width / (5 * scale))))
    depth = tile_noise(rng, (height, width), cells, 5)
    slope = np.linspace(-1, 1, width)[:, None] * rng.uniform(-0.8, 0.8)
    low = np.linspace(-1.2, 1.2, height)[:, None, None] + slope
    shade = np.clip((depth + 0.9 * low - rng.uniform(-0.6, 1.0)) / 0.25, 0, 1)
    return _halvings(picture * (1 - 0.6 * season.sun_strength * shade))


def _draw_windows(
    picture: Image, style: Style, season: Season, rng: np.random.Generator, drive: int, scale: float
) -> None:
    height, width = picture.shape[:2]
    details, today = np.random.default_rng([style.seed, 7]), np.random.default_rng([style.seed, drive])
    floors = max(1, int(style.height_m / details.uniform(3.1, 3.9)))
    bays, is_glass = max(1, int(style.width_m / details.uniform(2.2, 4.2))), style.material == "glass"
    bay, floor = width / bays, height / floors
    share_x, share_y = (0.92, 0.84) if is_glass else (rng.uniform(0.35, 0.72), rng.uniform(0.42, 0.64))
    frame = ink(rng.uniform(30, 80, 3) if rng.random() < 0.5 else rng.uniform(190, 235, 3))
    panes, blank = int(rng.integers(1, 4)), rng.random((floors, bays)) < (0.0 if is_glass else 0.07)
    door_bay, dark = rng.integers(0, bays), np.array([58.0, 50, 44]) * rng.uniform(0.7, 1.3)
    mirror = np.array(season.horizon) * 0.42 + dark * 0.4
    sill = ink([235] * 3 if season.snow > 0.3 else np.multiply(frame, 0.6))
    lit_share = 0.10 + 0.14 * (season.sun_elevation_deg < 25)
    for f, b in np.ndindex(floors, bays):
        x0, x1 = round(bay * (b + 0.5 - share_x / 2)), round(bay * (b + 0.5 + share_x / 2))
        top = floor * f + floor * 0.2
        y0, y1 = round(top), round(top + floor * share_y)
        if style.door and (f, b) == (floors - 1, door_bay):
            middle, half = (x0 + x1) // 2, round(rng.uniform(0.7, 1.3) * scale)
            lintel, reach, thick = height - round(2.4 * scale), round(half * 1.6), max(2, round(0.3 * scale))
            cv2.rectangle(picture, (middle - half, lintel), (middle + half, height), ink(rng.uniform(25, 150, 3)), -1)
            cv2.rectangle(picture, (middle - half, lintel), (middle + half, height), (210, 210, 210), 2)
            cv2.line(picture, (middle, lintel), (middle, height), (60, 60, 60), 1)
            canopy = ink(rng.uniform(60, 220, 3))
            cv2.rectangle(picture, (middle - reach, lintel - 2 * thick), (middle + reach, lintel - thick), canopy, -1)
        elif not blank[f, b]:
            mood = today.random()  # somebody has the light on, or the blinds down
            glass = [120, 190, 225] if mood < lit_share else [165, 172, 176] if mood < 0.34 else dark
            split = y0 + round((y1 - y0) * today.uniform(0.25, 0.8))
            cv2.rectangle(picture, (x0, y0), (x1, y1), ink(glass), -1)
            cv2.rectangle(picture, (x0, y0), (x1, split), ink(0.5 * mirror + np.multiply(glass, 0.5)), -1)
            cv2.rectangle(picture, (x0, y0), (x1, y1), frame, max(1, round(0.07 * scale)))
            for pane in range(1, panes):
                x = x0 + (x1 - x0) * pane // panes
                cv2.line(picture, (x, y0), (x, y1), frame, 1)
            cv2.rectangle(picture, (x0 - 1, y1), (x1 + 1, y1 + max(1, round(0.1 * scale))), sill, -1)


def draw_trees(season: Season, seed: int) -> tuple[Levels, ...]:
    """Every species, and a bush, as a season has it; branches stay where they are from season to season.

    Cut-out pictures, BGRA with colours already multiplied by their opacity; the foot is the middle of the lower edge.
    """
    trees = []
    for species in range(BUSH + 1):
        colour, alpha = np.zeros((TREE_HEIGHT, TREE_WIDTH, 3), np.uint8), np.zeros((TREE_HEIGHT, TREE_WIDTH), np.uint8)
        draw = _bush if species == BUSH else _conifer if species >= FIRST_CONIFER else _broadleaf
        draw(colour, alpha, stream(seed, "tree", species), season)
        alpha = np.asarray(cv2.GaussianBlur(alpha, (3, 3), 0.7), np.uint8)
        trees.append(_halvings(np.dstack([colour * (alpha[:, :, None] / 255.0), alpha])))
    return tuple(trees)


def _broadleaf(colour: Image, alpha: Image, rng: np.random.Generator, season: Season) -> None:
    bark, (ends, widths, depths) = rng.uniform(0.7, 1.2) * np.array([62.0, 74, 86]), _branches(rng)
    for (x0, y0, x1, y1), width, depth in zip(ends, widths, depths, strict=True):
        start, end, thick = (int(x0), int(y0)), (int(x1), int(y1)), max(1, round(width))
        cv2.line(colour, start, end, ink(bark * (0.8 + 0.08 * depth)), thick, cv2.LINE_AA)
        cv2.line(alpha, start, end, 255, thick, cv2.LINE_AA)
        if season.snow > 0.3 and depth < 5 and abs(x1 - x0) > 0.35 * abs(y1 - y0):
            above = [(x, y - thick // 2) for x, y in (start, end)]
            cv2.line(colour, above[0], above[1], (225, 225, 225), 1, cv2.LINE_AA)
    tips = ends[depths < 3, 2:]
    # Drawn whatever the season, so that the numbers after it are the same in every season.
    places = tips[rng.integers(0, len(tips), LEAVES)] + rng.normal(0, 9, (LEAVES, 2))
    size, tone, pick = rng.uniform(1.6, 4.8, LEAVES), rng.uniform(0.68, 1.25, LEAVES), rng.random(LEAVES)
    count = int(LEAVES * min(1.0, season.leaf_share * rng.uniform(0.75, 1.25)))
    favourite = rng.random()
    for k in np.argsort(places[:count, 1])[::-1]:  # upper leaves lie over lower ones
        x, y = places[k, 0], min(places[k, 1], TREE_HEIGHT * 0.8)
        leaf = season.leaves[int((favourite + 0.35 * pick[k]) * len(season.leaves)) % len(season.leaves)]
        lit, radius = tone[k] * (1.22 - 0.6 * y / TREE_HEIGHT), max(1, round(size[k] * (0.6 + 0.4 * season.leaf_share)))
        cv2.circle(colour, (int(x), int(y)), radius, ink(np.array(leaf) * lit), -1, cv2.LINE_AA)
        cv2.circle(alpha, (int(x), int(y)), radius, 255, -1, cv2.LINE_AA)


def _branches(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """[n, 4] both ends in pixels, [n] widths and [n] depths of a tree's branches: 6 is the trunk, 0 a twig."""
    spread, slender = rng.uniform(0.3, 0.62), rng.uniform(0.70, 0.80)
    branches: list[tuple[float, ...]] = []

    def grow(x: float, y: float, angle: float, length: float, width: float, depth: int) -> None:
        x1, y1 = x + length * np.sin(angle), y + length * np.cos(angle)
        branches.append((x, y, x1, y1, width, depth))
        for side in (-1, 1, 0)[: 2 + int(rng.random() < 0.45)] if depth else ():
            turn = side * spread + rng.normal(0, 0.13)
            grow(x1, y1, angle * 0.9 + turn, length * slender * rng.uniform(0.85, 1.1), width * 0.66, depth - 1)

    grow(0.0, 0.0, rng.normal(0, 0.04), 1.0, 13 * rng.uniform(0.7, 1.1), 6)
    limbs, margin = np.array(branches), 18
    fit_y = (TREE_HEIGHT - margin) / limbs[:, 3].max()
    fit_x = min((TREE_WIDTH / 2 - margin) / max(np.abs(limbs[:, 2]).max(), 1e-6), fit_y)
    ends = np.tile([TREE_WIDTH / 2, TREE_HEIGHT - 1], 2) + limbs[:, :4] * np.tile([fit_x, -fit_y], 2)
    return ends, limbs[:, 4], limbs[:, 5]


def _conifer(colour: Image, alpha: Image, rng: np.random.Generator, season: Season) -> None:
    middle, base = TREE_WIDTH // 2, TREE_HEIGHT - 18
    for picture, bark in ((colour, (50, 62, 74)), (alpha, (255,))):
        cv2.rectangle(picture, (middle - 5, base - 20), (middle + 5, TREE_HEIGHT), bark, -1)
    reach, needles = rng.uniform(62, 96), np.array([52.0, 82, 52]) * rng.uniform(0.75, 1.15)
    for k in range(2600):
        down = np.sqrt(rng.random())
        x, y = rng.uniform(-1, 1) * reach * down * (0.8 + 0.2 * np.sin(down * 40)), 12 + (base - 12) * down
        tone, drop = rng.uniform(0.6, 1.3), rng.uniform(4, 9)
        white = season.snow > 0.3 and rng.random() < 0.35
        needle = (228, 228, 226) if white else ink(needles * tone * (1.1 - 0.3 * abs(x) / reach))
        start = (int(middle + x), int(y))
        end = (int(middle + x * 1.08), int(y + drop * (0.4 if white else 1)))
        cv2.line(colour, start, end, needle, 2, cv2.LINE_AA)
        cv2.line(alpha, start, end, 255, 2 + k % 2, cv2.LINE_AA)


def _bush(colour: Image, alpha: Image, rng: np.random.Generator, season: Season) -> None:
    leaves = season.leaves if season.leaf_share > 0.1 else ((84.0, 104.0, 120.0),)
    spots = rng.normal(0, 1, (900, 2)) * (TREE_WIDTH * 0.16, TREE_HEIGHT * 0.2)
    for right, up in spots[np.argsort(spots[:, 1])]:
        x = int(np.clip(TREE_WIDTH / 2 + right, 10, TREE_WIDTH - 10))
        y = int(np.clip(TREE_HEIGHT * 0.55 - up, 10, TREE_HEIGHT - 6))
        tone = rng.uniform(0.6, 1.2) * (1.2 - 0.5 * y / TREE_HEIGHT)
        leaf = ink(np.array(leaves[rng.integers(0, len(leaves))]) * tone)
        radius = int(rng.integers(5, 12))
        snowy = season.snow > 0.3 and y < TREE_HEIGHT * 0.42
        cv2.circle(colour, (x, y), radius, (226, 226, 226) if snowy else leaf, -1, cv2.LINE_AA)
        cv2.circle(alpha, (x, y), radius, 255, -1, cv2.LINE_AA)


def draw_ground(season: Season, drive: str, seed: int) -> list[Levels]:
    """Grass, concrete, asphalt and paving for one drive, with leaves and snow: tiles that repeat without a seam."""
    tiles = []
    for name in ("grass", *PAVING):
        rng = stream(seed, f"ground {name} {drive}")
        noise, is_grass = partial(tile_noise, rng, (TILE_PX, TILE_PX)), name == "grass"
        if is_grass:
            tile = np.array(season.grass, np.float32) + (noise((128, 256), 3) * 13 + noise((6, 6), 5) * 12)
            dry = np.clip(noise((5, 5), 4) * 0.35, 0, 0.7)
            tile = tile * (1 - dry) + np.array([92, 130, 142], np.float32) * dry
        else:
            grain, stains = noise((256, 256), 2) * (9 if name == "asphalt" else 5), noise((4, 4), 5) * 7
            tile = np.array(PAVING[name], np.float32) * (1 - 0.3 * season.wet) + (grain + stains)
        if name == "paving":
            rows, columns = TILE_PX // 32, TILE_PX // 64
            tile += np.kron(rng.normal(0, 10, (32, 64)).astype(np.float32), np.ones((rows, columns)))[:, :, None]
            tile[::rows] *= 0.75
            tile[:, ::columns] *= 0.75
        for _ in range(5 if name == "asphalt" else 0):
            crack = np.cumsum(rng.normal(0, 9, (14, 2)), axis=0) * 3 + rng.uniform(200, 800, 2)
            cv2.polylines(tile, [crack.astype(np.int32)], False, (52, 52, 52), 3, cv2.LINE_AA)
        if season.litter:
            count = int(season.litter * (9000 if is_grass else 2500))
            places, picks = rng.integers(0, TILE_PX, (count, 2)), rng.integers(0, len(season.leaves), count)
            sizes, leaves = rng.integers(1, 5, count), np.array(season.leaves)[picks]
            leaves = leaves * rng.uniform(0.7, 1.15, (count, 1))
            for place, size, leaf in zip(places.tolist(), sizes.tolist(), leaves.tolist(), strict=True):
                cv2.circle(tile, place, size, leaf, -1)
        if season.snow:
            depth = noise((3, 3), 6)
            bar = float(np.quantile(depth, 1 - season.snow * (1.0 if is_grass else 0.22)))
            opacity = np.clip((depth - bar) / 0.35, 0, 1)
            white = np.array([236, 232, 228], np.float32) + noise((32, 32), 4) * 5
            tile = tile * (1 - opacity) + white * opacity
        tiles.append(_halvings(np.clip(tile, 0, 255), cv2.BORDER_WRAP))
    return tiles


def draw_sky(season: Season, rng: np.random.Generator) -> Image:
    """The whole sky of one drive without its sun: 4 pixels a degree, from 68 degrees down to the horizon."""
    height, width = SKY_TOP_DEG * SKY_PX_PER_DEG, 360 * SKY_PX_PER_DEG
    climb = np.linspace(1, 0, height, dtype=np.float32)[:, None, None] ** 0.7
    blue = np.array(season.zenith) * climb + np.array(season.horizon) * (1 - climb)
    noise = tile_noise(rng, (height, width), (3, 9), 6)
    opacity = np.clip((noise - float(np.quantile(noise, 1 - season.cloud_share))) / 0.9, 0, 1)
    tone = np.clip(1.0 - 0.14 * np.roll(noise, -6, axis=0), 0.62, 1.02)
    white = np.array([246.0, 246, 246]) * tone * (1 - 0.12 * (season.name in ("winter", "autumn")))
    return np.asarray(np.clip(blue * (1 - opacity) + white * opacity, 0, 255), np.uint8)
