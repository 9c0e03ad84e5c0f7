"""The forms in which a view reaches the engine."""

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
class PackedRanks:
    """Ranked landmarks as `core.descriptor.pack_ranked_landmarks` makes them; how many bits an id has the map tells."""

    body: bytes


@dataclass(frozen=True)
class Dissimilarities:
    """Dissimilarities to all landmarks: [r] float64 in landmark order, smaller is nearer."""

    values: NDArray[np.float64]


@dataclass(frozen=True)
class ReadyEncoding:
    """An encoding that was computed elsewhere: [d] float64 as it was sent."""

    values: NDArray[np.float64]


@dataclass(frozen=True)
class EncodedImage:
    """An image that the domain's evaluator has encoded.

    Attributes:
        values: [d] float32.
        weights_sha256: Of the network that did; None where none did.
        encode_ms: How long it took, with those that were encoded in the same batch.
    """

    values: NDArray[np.float32]
    weights_sha256: str | None
    encode_ms: float


@dataclass(frozen=True)
class NothingSeen:
    """An image that shows nothing: one grey wall, the dark."""


View: TypeAlias = NothingSeen | Image | EncodedImage | ReadyEncoding | Dissimilarities | RankedLandmarks | PackedRanks
"""One observation: an image [height, width, 3] uint8 BGR, or what was made of one here or on board."""
