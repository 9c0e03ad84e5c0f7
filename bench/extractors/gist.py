"""Gist: energy of a Gabor bank in a coarse grid (Oliva and Torralba, 2001)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.extractors.candidate import Candidate, resized_grey, unit
from deepsimbad.evaluators.base import Image

_SIZE = (64, 64)
_CELLS = (8, 8)
_WAVELENGTHS_PX = (4.0, 8.0, 16.0)
_DIRECTIONS = 8


def _bank() -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    pairs = []
    for wavelength in _WAVELENGTHS_PX:
        side = 2 * int(wavelength) + 1
        for k in range(_DIRECTIONS):
            even, odd = (
                cv2.getGaborKernel(
                    (side, side), wavelength / 2, np.pi * k / _DIRECTIONS, wavelength, 1.0, phase, cv2.CV_32F
                )
                for phase in (0.0, np.pi / 2)
            )
            pairs.append((np.asarray(even - even.mean(), np.float32), np.asarray(odd, np.float32)))
    return pairs


_BANK = _bank()


def _encode(image: Image) -> NDArray[np.float32]:
    pixels = resized_grey(image, _SIZE).astype(np.float32)
    centred = pixels - cv2.GaussianBlur(pixels, (0, 0), 12)
    flat = centred / (np.sqrt(cv2.GaussianBlur(centred * centred, (0, 0), 12)) + 4.0)
    energies = [np.hypot(cv2.filter2D(flat, -1, even), cv2.filter2D(flat, -1, odd)) for even, odd in _BANK]
    return unit(np.stack([cv2.resize(e, _CELLS, interpolation=cv2.INTER_AREA) for e in energies]))


GIST = Candidate.unfitted("gist (Gabor energy grid)", _SIZE, _encode)
