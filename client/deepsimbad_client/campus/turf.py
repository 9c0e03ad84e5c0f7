"""Pictures of the ground that repeat without a seam: grass, concrete, asphalt and paving, under the season."""

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.noise import stream, tile_noise
from deepsimbad_client.campus.season import Season

Image = NDArray[np.uint8]

TILE_PX = 1024
TILE_M = 12.8
SURFACES = ("grass", "concrete", "asphalt", "paving")
LEVELS = 5

_BASE = {"concrete": (164, 170, 172), "asphalt": (92, 92, 92), "paving": (118, 136, 158)}


def draw_ground(season: Season, drive: str, seed: int) -> dict[str, tuple[Image, ...]]:
    """Draw every surface's own colours for one drive: [1024, 1024, 3] and its halvings, largest first."""
    surfaces: dict[str, tuple[Image, ...]] = {}
    for name in SURFACES:
        rng = stream(seed, f"ground {name} {drive}")
        tile = _grass(season, rng) if name == "grass" else _paved(name, season, rng)
        tile = _cover(tile, season, rng, bare=name != "grass")
        levels = [np.clip(tile, 0, 255).astype(np.uint8)]
        while len(levels) < LEVELS:
            # A tile wraps around, so it is halved with its neighbours beside it.
            wide = np.pad(levels[-1], ((8, 8), (8, 8), (0, 0)), mode="wrap")
            levels.append(np.ascontiguousarray(cv2.pyrDown(wide)[4:-4, 4:-4]))
        surfaces[name] = tuple(levels)
    return surfaces


def _grass(season: Season, rng: np.random.Generator) -> NDArray[np.float32]:
    blades = tile_noise(rng, (TILE_PX, TILE_PX), (128, 256), 3) * 13
    clumps = tile_noise(rng, (TILE_PX, TILE_PX), (6, 6), 5) * 12
    tile = np.array(season.grass, np.float32) + (blades + clumps)[:, :, None]
    dry = np.clip(tile_noise(rng, (TILE_PX, TILE_PX), (5, 5), 4) * 0.35, 0, 0.7)[:, :, None]
    return np.asarray(tile * (1 - dry) + np.array([92, 130, 142], np.float32) * dry, np.float32)


def _paved(name: str, season: Season, rng: np.random.Generator) -> NDArray[np.float32]:
    grain = tile_noise(rng, (TILE_PX, TILE_PX), (256, 256), 2) * (9 if name == "asphalt" else 5)
    stains = tile_noise(rng, (TILE_PX, TILE_PX), (4, 4), 5) * 7
    tile = np.array(_BASE[name], np.float32) * (1 - 0.3 * season.wet) + (grain + stains)[:, :, None]
    if name == "paving":
        rows, columns = 32, 64
        bricks = rng.normal(0, 10, (rows, columns)).astype(np.float32)
        tile += np.kron(bricks, np.ones((TILE_PX // rows, TILE_PX // columns), np.float32))[:, :, None]
        tile[:: TILE_PX // rows] *= 0.75
        tile[:, :: TILE_PX // columns] *= 0.75
    if name == "asphalt":
        for _ in range(5):
            walk = np.cumsum(rng.normal(0, 9, (14, 2)), axis=0) * 3 + rng.uniform(200, 800, 2)
            cv2.polylines(tile, [walk.astype(np.int32)], False, (52, 52, 52), 3, cv2.LINE_AA)
    return tile


def _cover(tile: NDArray[np.float32], season: Season, rng: np.random.Generator, bare: bool) -> NDArray[np.float32]:
    shape = (TILE_PX, TILE_PX)
    if season.litter:
        count = int(season.litter * (2500 if bare else 9000))
        places, picks = rng.integers(0, TILE_PX, (count, 2)), rng.integers(0, len(season.leaves), count)
        sizes, tones = rng.integers(1, 5, count), rng.uniform(0.7, 1.15, count)
        for place, pick, size, tone in zip(places, picks, sizes, tones, strict=True):
            ink = tuple(float(v * tone) for v in season.leaves[pick])
            cv2.circle(tile, (int(place[0]), int(place[1])), int(size), ink, -1)
    if season.snow:
        depth = tile_noise(rng, shape, (3, 3), 6)
        share = season.snow * (0.22 if bare else 1.0)
        bar = float(np.quantile(depth, 1 - share))
        opacity = np.clip((depth - bar) / 0.35, 0, 1)[:, :, None]
        white = np.array([236, 232, 228], np.float32) + (tile_noise(rng, shape, (32, 32), 4) * 5)[:, :, None]
        tile = np.asarray(tile * (1 - opacity) + white * opacity, np.float32)
    return tile
