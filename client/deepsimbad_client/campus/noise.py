"""Seeded randomness that does not change when more of it is asked for.

A campus grows with its number of frames, so every stream of random numbers here is either drawn for a numbered
block or drawn in order; the first part of a long world is the short world.
"""

import zlib

import cv2
import numpy as np
from numpy.typing import NDArray


def stream(seed: int, name: str, block: int = 0) -> np.random.Generator:
    """A generator of its own for every (seed, name, block); platforms and processes agree on it."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), block])


def smooth_line(rng: np.random.Generator, where: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smooth noise along a line, with one standard normal knot at every whole number.

    Args:
        rng: Consumed in order, so a longer line begins like a shorter one.
        where: [n] places on the line, not negative.

    Returns:
        [n] values, roughly in -2..2.
    """
    if where.size == 0:
        return np.zeros(0)
    knots = rng.standard_normal(int(where.max()) + 2)
    left = where.astype(np.int64)
    t = where - left
    t = t * t * (3 - 2 * t)
    return np.asarray(knots[left] * (1 - t) + knots[left + 1] * t, np.float64)


def tile_noise(
    rng: np.random.Generator, shape: tuple[int, int], cells: tuple[int, int], octaves: int = 4
) -> NDArray[np.float32]:
    """Fractal noise that repeats without a seam.

    Args:
        rng: Where the numbers come from.
        shape: (height, width) of the answer in pixels.
        cells: (rows, columns) of the coarsest grid; each octave doubles it.
        octaves: How many grids are added, each with half the amplitude of the one before.

    Returns:
        [height, width] float32 with mean about 0 and standard deviation 1.
    """
    height, width = shape
    total = np.zeros(shape, np.float32)
    for octave in range(octaves):
        rows, columns = cells[0] << octave, cells[1] << octave
        if rows > height or columns > width:
            break
        grid = rng.standard_normal((rows, columns)).astype(np.float32)
        grid = np.pad(grid, 2, mode="wrap")
        margin_y, margin_x = round(2 * height / rows), round(2 * width / columns)
        size = (width + 2 * margin_x, height + 2 * margin_y)
        fine = np.asarray(cv2.resize(grid, size, interpolation=cv2.INTER_CUBIC), np.float32)
        total += fine[margin_y : margin_y + height, margin_x : margin_x + width] * np.float32(0.5**octave)
    total -= total.mean()
    return total / max(float(total.std()), 1e-6)
