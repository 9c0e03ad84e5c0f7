"""The forms in which a view reaches the engine, and what each can tell."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.evaluators.base import Image


@dataclass(frozen=True)
class RankedLandmarks:
    """Landmark ids, nearest first, from a robot that encodes on board: the descriptor itself."""

    landmark_ids: tuple[int, ...]


@dataclass(frozen=True)
class Dissimilarities:
    """Dissimilarities to all landmarks, in landmark order.

    Attributes:
        values: [r] float64, smaller is nearer.
    """

    values: NDArray[np.float64]


@dataclass(frozen=True)
class ReadyEncoding:
    """An encoding that was computed elsewhere.

    Attributes:
        values: [d] float64 as it was sent.
    """

    values: NDArray[np.float64]


View: TypeAlias = Image | ReadyEncoding | Dissimilarities | RankedLandmarks
"""One observation: an image [height, width, 3] uint8 BGR, or what a robot made of one."""
