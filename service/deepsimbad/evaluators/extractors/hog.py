"""Histograms of oriented gradients, without OpenCV's HOGDescriptor (gone from the main module in OpenCV 5)."""

from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad.evaluators.base import Image

_N_ORIENTATIONS = 9
_CELL = 8  # pixels


class Hog:
    """Unsigned gradient orientations in 8 x 8 cells, 2 x 2 cells to a block (Dalal and Triggs, 2005)."""

    name: ClassVar[str] = "hog"
    input_size: ClassVar[tuple[int, int]] = (128, 64)
    encoding_dim: ClassVar[int] = 15 * 7 * 4 * _N_ORIENTATIONS

    def __call__(self, image: Image) -> NDArray[np.float32]:
        """See `Extractor`."""
        width, height = self.input_size
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if grey.shape != (height, width):
            smaller = grey.shape[0] >= height and grey.shape[1] >= width
            grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
        pixels = grey.astype(np.float32)
        gx = cv2.Sobel(pixels, cv2.CV_32F, 1, 0, ksize=1)
        gy = cv2.Sobel(pixels, cv2.CV_32F, 0, 1, ksize=1)
        magnitude = np.sqrt(gx * gx + gy * gy)
        angle = np.mod(np.arctan2(gy, gx), np.pi) * (_N_ORIENTATIONS / np.pi)
        low = np.floor(angle)
        share = angle - low
        low_bin = low.astype(np.intp) % _N_ORIENTATIONS
        planes = np.zeros((_N_ORIENTATIONS, height, width), np.float32)
        np.put_along_axis(planes, low_bin[None], (magnitude * (1 - share))[None], 0)
        high = np.zeros_like(planes)
        np.put_along_axis(high, ((low_bin + 1) % _N_ORIENTATIONS)[None], (magnitude * share)[None], 0)
        planes += high
        rows, columns = height // _CELL, width // _CELL
        cells = planes.reshape(_N_ORIENTATIONS, rows, _CELL, columns, _CELL).sum((2, 4))
        blocks = np.concatenate([cells[:, y : y + rows - 1, x : x + columns - 1] for y in (0, 1) for x in (0, 1)])
        blocks = blocks / np.sqrt((blocks * blocks).sum(0) + 1.0)
        encoding = np.sqrt(blocks.ravel())
        length = float(np.linalg.norm(encoding))
        if length == 0.0:
            return np.full(self.encoding_dim, self.encoding_dim**-0.5, np.float32)
        return np.asarray(encoding / length, np.float32)
