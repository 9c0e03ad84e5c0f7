"""HOG on a normalised image: 8 x 8 cells, 9 unsigned directions, 2 x 2 cells to a block (Dalal and Triggs, 2005)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.extractors.candidate import Candidate, resized_grey, unit
from deepsimbad.evaluators.base import Image

_SIZE = (128, 64)
_CELL, _DIRECTIONS = 8, 9


def _encode(image: Image) -> NDArray[np.float32]:
    grey = resized_grey(image, _SIZE).astype(np.float32)
    pixels = (grey - grey.mean()) * (32.0 / (grey.std() + 4.0))
    gx = cv2.Sobel(pixels, cv2.CV_32F, 1, 0, ksize=1)
    gy = cv2.Sobel(pixels, cv2.CV_32F, 0, 1, ksize=1)
    magnitude = np.sqrt(gx * gx + gy * gy)
    angle = np.mod(np.arctan2(gy, gx), np.pi) * (_DIRECTIONS / np.pi)
    gap = np.abs(angle - np.arange(_DIRECTIONS, dtype=np.float32)[:, None, None])
    planes = magnitude * np.maximum(0, 1 - np.minimum(gap, _DIRECTIONS - gap))
    rows, columns = _SIZE[1] // _CELL, _SIZE[0] // _CELL
    cells = planes.reshape(_DIRECTIONS, rows, _CELL, columns, _CELL).sum(axis=(2, 4))
    blocks = np.concatenate([cells[:, y : rows - 1 + y, x : columns - 1 + x] for y in (0, 1) for x in (0, 1)])
    return unit(np.sqrt(blocks / np.sqrt(np.square(blocks).sum(axis=0) + 1.0)))


HOG = Candidate.unfitted("HOG, normalised image", _SIZE, _encode)
