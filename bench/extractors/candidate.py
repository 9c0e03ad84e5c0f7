"""What takes part in the contest."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad.evaluators.base import Image

Encode: TypeAlias = Callable[[Image], NDArray[np.float32]]
Fit: TypeAlias = Callable[[Sequence[Image]], Encode]


@dataclass(frozen=True)
class Candidate:
    """One way to encode an image.

    Attributes:
        name: Row of the table.
        input_size: (width, height) a client resizes to.
        fit: Landmark traverse's images -> the extractor.
        learns: Whether `fit` looks at them.
    """

    name: str
    input_size: tuple[int, int]
    fit: Fit
    learns: bool = True

    @classmethod
    def unfitted(cls, name: str, input_size: tuple[int, int], encode: Encode) -> "Candidate":
        """A candidate that learns nothing."""
        return cls(name, input_size, lambda _: encode, learns=False)


def resized_grey(image: Image, size: tuple[int, int]) -> NDArray[np.uint8]:
    """[height, width] grey levels of `size` (width, height)."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if grey.shape != size[::-1]:
        shrinks = grey.shape[1] >= size[0] and grey.shape[0] >= size[1]
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.asarray(grey, np.uint8)


def as_sent(image: Image, size: tuple[int, int]) -> Image:
    """What the client sends for an input size: anything larger is shrunk to exactly it."""
    if image.shape[1] <= size[0] and image.shape[0] <= size[1]:
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def unit(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Flat and of length 1; of nothing, the vector that favours no element."""
    flat = values.ravel()
    length = float(np.linalg.norm(flat))
    if length < 1e-6:
        return np.full(flat.size, flat.size**-0.5, np.float32)
    return np.asarray(flat / length, np.float32)
