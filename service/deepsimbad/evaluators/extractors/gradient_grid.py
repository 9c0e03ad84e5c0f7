"""Gradient grid: which edge directions are where in the picture, coarsely sideways, finely in height.

A relative of HOG (Dalal and Triggs, 2005), chosen by measurement: docs/decisions/0004-embedded-extractor.md. It
differs from HOG in three ways that matter across seasons and drives:

- edge energy is spread over cells wider than high, because a drive is offset sideways and turned, hardly ever lifted;
- a cell's energy is divided by that of a neighbourhood, so snow-flat and leafy places count alike;
- directions enter twice: signed (dark below bright) and unsigned (any edge), because a season may reverse a contrast.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad.evaluators.base import Image
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.image import resized

_SIDE = 128  # pixels
_POOL = 4  # pixels averaged before blurring: nothing finer survives the blur anyway
_ROWS, _COLUMNS = 16, 8
_DIRECTIONS = 12  # signed; opposite ones fold to half as many unsigned
_SHARPNESS = 4  # squarings: a direction's weight is cos^(1 + 2^4) of the angle to it, down to half at 16 degrees
_BLUR = (1.5, 0.5)  # sigma along x and y, in pooled pixels; a cell is 4 x 2 of them
_NEIGHBOURHOOD = (2.5, 2.0)  # sigma along x and y, in cells
_CONTRAST = 32.0  # standard deviation of grey levels an image is brought to
_LEAST_CONTRAST = 4.0  # grey levels; added to the deviation, so that the noise of a dark image stays small
_FLOOR = 4.0  # added to the neighbourhood's energy, so that bland stretches stay small
_POWER = 0.6  # below 1: one strong edge does not drown the others

_ANGLES = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
_TOWARDS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)]).astype(np.float32)  # [2, directions]


class GradientGrid:
    """An extractor of no weights: no download, no training, about a millisecond an image."""

    input_size = (_SIDE, _SIDE)
    encoding_dim = _ROWS * _COLUMNS * (_DIRECTIONS + _DIRECTIONS // 2)
    weights_sha256 = None
    largest_batch = 1

    def prepare(self, image: Image) -> Image:
        """See `Extractor`; the image becomes grey, since colours are not encoded."""
        grey = cv2.cvtColor(resized(image, self.input_size), cv2.COLOR_BGR2GRAY)
        return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)

    def encode(self, images: Sequence[Image]) -> NDArray[np.float32]:
        """See `Extractor`; the same bits for the same pixels."""
        encodings = np.empty((len(images), self.encoding_dim), np.float32)
        for row, image in zip(encodings, images, strict=True):
            row[:] = _encoding(np.asarray(cv2.cvtColor(self.prepare(image), cv2.COLOR_BGR2GRAY), np.uint8))
        return encodings


def gradient_grid(_argument: str, _compute: Compute) -> GradientGrid:
    """Make the extractor for the registry."""
    return GradientGrid()


def _encoding(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    energy = _cells(_directional_energy(_normalised(grey)))
    folded = energy[..., : _DIRECTIONS // 2] + energy[..., _DIRECTIONS // 2 :]
    strength = np.sqrt(np.square(folded).sum(axis=2))
    surroundings = cv2.GaussianBlur(strength, (0, 0), sigmaX=_NEIGHBOURHOOD[0], sigmaY=_NEIGHBOURHOOD[1])
    shares = 1.0 / (surroundings[..., None] + _FLOOR)
    signed, unsigned = _unit((energy * shares) ** _POWER), _unit((folded * shares) ** _POWER)
    return _unit(np.concatenate([signed, unsigned]))


def _normalised(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """[side, side] grey levels of fixed contrast."""
    levels = grey.astype(np.float32)
    _, deviation = cv2.meanStdDev(levels)
    return np.asarray(levels * (_CONTRAST / (float(deviation[0, 0]) + _LEAST_CONTRAST)), np.float32)


def _directional_energy(levels: NDArray[np.float32]) -> NDArray[np.float32]:
    """[side, side, directions]: gradient magnitude, shared among the directions nearest its own."""
    gradient = np.empty((levels.size, 2), np.float32)
    gradient[:, 0] = cv2.Sobel(levels, cv2.CV_32F, 1, 0, ksize=1).ravel()
    gradient[:, 1] = cv2.Sobel(levels, cv2.CV_32F, 0, 1, ksize=1).ravel()
    magnitude = np.sqrt(np.square(gradient).sum(axis=1, keepdims=True))
    energy = np.maximum(gradient @ _TOWARDS, 0)
    weight = energy / np.maximum(magnitude, 1e-6)
    for _ in range(_SHARPNESS):
        weight *= weight
    energy *= weight
    return np.asarray(energy.reshape(_SIDE, _SIDE, _DIRECTIONS), np.float32)


def _cells(energy: NDArray[np.float32]) -> NDArray[np.float32]:
    """[rows, columns, directions]: blurred, then averaged in each cell."""
    pooled = cv2.resize(energy, (_SIDE // _POOL, _SIDE // _POOL), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(pooled, (0, 0), sigmaX=_BLUR[0], sigmaY=_BLUR[1])
    return np.asarray(cv2.resize(blurred, (_COLUMNS, _ROWS), interpolation=cv2.INTER_AREA), np.float32)


def _unit(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Flat and of length 1; for zeros (a uniform image), the vector of equal elements."""
    flat = values.ravel()
    length = float(np.linalg.norm(flat))
    if length < 1e-6:
        return np.full(flat.size, flat.size**-0.5, np.float32)
    return np.asarray(flat / length, np.float32)
