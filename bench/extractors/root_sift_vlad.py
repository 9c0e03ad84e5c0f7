"""Dense RootSIFT gathered by VLAD; its vocabulary is fitted on the landmark traverse (Arandjelovic, 2012, 2013)."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.extractors.candidate import Candidate, Encode, resized_grey, unit
from deepsimbad.evaluators.base import Image

_SIZE = (128, 64)
_STEP_PX, _PATCHES_PX = 8, (16.0, 32.0)
_WORDS = 32  # x 128 = 4,096
_FITTED_IMAGES = 100


def _fit(images: Sequence[Image]) -> Encode:
    sift = cv2.SIFT_create()  # type: ignore[attr-defined]  # missing from OpenCV's stubs
    points = [
        cv2.KeyPoint(float(x), float(y), side / 6, 0.0)  # OpenCV describes six sizes; angle 0: upright
        for side in _PATCHES_PX
        for y in range(_STEP_PX // 2, _SIZE[1], _STEP_PX)
        for x in range(_STEP_PX // 2, _SIZE[0], _STEP_PX)
    ]

    def describe(image: Image) -> NDArray[np.float32]:
        _, found = sift.compute(resized_grey(image, _SIZE), points)
        return np.asarray(np.sqrt(found / np.maximum(found.sum(axis=1, keepdims=True), 1e-6)), np.float32)

    step = max(1, len(images) // _FITTED_IMAGES)
    sample = np.concatenate([describe(image) for image in images[::step]])
    cv2.setRNGSeed(0)
    until = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 20, 1e-4)
    _, _, words = cv2.kmeans(sample, _WORDS, np.empty((len(sample), 1), np.int32), until, 1, cv2.KMEANS_PP_CENTERS)

    def encode(image: Image) -> NDArray[np.float32]:
        found = describe(image)
        nearest = np.argmax(found @ words.T - 0.5 * np.square(words).sum(axis=1), axis=1)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, found - words[nearest])
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        return unit(sums / np.maximum(lengths, 1e-6))  # intra-normalised

    return encode


ROOT_SIFT_VLAD = Candidate("dense RootSIFT, VLAD fitted on the landmarks", _SIZE, _fit)
