"""Census: histograms of local binary patterns in a grid of cells."""

import numpy as np
from numpy.typing import NDArray

from bench.extractors.candidate import Candidate, resized_grey, unit
from deepsimbad.evaluators.base import Image

_SIZE = (128, 64)
_CELL = 16
_AROUND = ((0, 0), (0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0))


def _bins() -> NDArray[np.intp]:
    """[256] bin of a pattern: its own where it changes at most twice around the circle (58), else one for all."""
    patterns = np.arange(256)
    bits = patterns[:, None] >> np.arange(8) & 1
    uniform = (bits != np.roll(bits, 1, axis=1)).sum(axis=1) <= 2
    return np.where(uniform, np.cumsum(uniform) - 1, 58).astype(np.intp)


_BINS = _bins()


def _encode(image: Image) -> NDArray[np.float32]:
    pixels = resized_grey(image, _SIZE).astype(np.int16)
    height, width = pixels.shape
    padded = np.pad(pixels, 1, mode="edge")
    pattern = np.zeros(pixels.shape, np.intp)
    for bit, (y, x) in enumerate(_AROUND):
        pattern |= (padded[y : y + height, x : x + width] > pixels + 2).astype(np.intp) << bit
    rows, columns = height // _CELL, width // _CELL
    cell = np.arange(height)[:, None] // _CELL * columns + np.arange(width) // _CELL
    counts = np.bincount((cell * 59 + _BINS[pattern]).ravel(), minlength=rows * columns * 59)
    return unit(np.sqrt(counts))


CENSUS = Candidate.unfitted("census (uniform LBP) histograms", _SIZE, _encode)
