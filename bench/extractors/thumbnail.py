"""Thumbnails: grey levels themselves, normalised in patches (as in SeqSLAM) or by a sliding local contrast."""

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.extractors.candidate import Candidate, resized_grey, unit
from deepsimbad.evaluators.base import Image

_SIZE = (64, 32)
_PATCH = 8
_SIGMA = 4.0


def _patches(image: Image) -> NDArray[np.float32]:
    pixels = resized_grey(image, _SIZE).astype(np.float32)
    patches = pixels.reshape(_SIZE[1] // _PATCH, _PATCH, _SIZE[0] // _PATCH, _PATCH)
    centred = patches - patches.mean(axis=(1, 3), keepdims=True)
    return unit(centred / (patches.std(axis=(1, 3), keepdims=True) + 1e-3))


def _sliding(image: Image) -> NDArray[np.float32]:
    pixels = resized_grey(image, _SIZE).astype(np.float32)
    centred = pixels - cv2.GaussianBlur(pixels, (0, 0), _SIGMA)
    deviation = np.sqrt(cv2.GaussianBlur(centred * centred, (0, 0), _SIGMA))
    return unit(centred / (deviation + 3.0))


PATCH_THUMBNAIL = Candidate.unfitted("thumbnail, normalised in patches", _SIZE, _patches)
CONTRAST_THUMBNAIL = Candidate.unfitted("thumbnail, sliding local contrast", _SIZE, _sliding)
