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
class PackedRanks:
    """Ranked landmarks in the fewest bytes; how many bits an id has only the map tells.

    Attributes:
        body: As `core.descriptor.pack_ranked_landmarks` makes it.
    """

    body: bytes


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


def encoding_ms(view: "View") -> dict[str, float]:
    """The stage `encode` of a view, in milliseconds; of one that needed no encoding there is none."""
    return {"encode": view.encode_ms} if isinstance(view, EncodedImage) else {}


@dataclass(frozen=True)
class NothingSeen:
    """An image that shows nothing: one grey wall, the dark."""


View: TypeAlias = NothingSeen | Image | EncodedImage | ReadyEncoding | Dissimilarities | RankedLandmarks | PackedRanks
"""One observation: an image [height, width, 3] uint8 BGR, or what was made of one here or on board."""
