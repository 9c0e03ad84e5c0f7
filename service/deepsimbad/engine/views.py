"""The forms in which a view reaches the engine, and where the time of its answer goes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from time import perf_counter
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


@dataclass
class Stopwatch:
    """Where the time of one answer goes, from its making on: each lap names what was done since the one before.

    An answer is in the hands of one thread at a time: laps follow each other, and their sum is never above the total.
    """

    _began: float = field(default_factory=perf_counter)
    _last: float = field(default_factory=perf_counter)
    _spent_ms: dict[str, float] = field(default_factory=dict)

    def lap(self, stage: str, view: View | None = None) -> None:
        """Count the time since the last lap to a stage; what an image's encoding took within it, to `encode`."""
        now = perf_counter()
        encode_ms = view.encode_ms if isinstance(view, EncodedImage) else 0.0
        spent_ms = max(0.0, 1000 * (now - self._last) - encode_ms)
        self._spent_ms[stage] = round(self._spent_ms.get(stage, 0.0) + spent_ms, 3)
        if encode_ms:
            self._spent_ms["encode"] = round(encode_ms, 3)
        self._last = now

    def take(self, timings_ms: Mapping[str, float]) -> None:
        """Take over stages that were measured since the last lap, by whoever did the work."""
        for stage, spent_ms in timings_ms.items():
            self._spent_ms[stage] = round(spent_ms, 3)
        self._last = perf_counter()

    def timings_ms(self) -> dict[str, float]:
        """Milliseconds by stage, and their `total` up to now."""
        return {**self._spent_ms, "total": round(1000 * (perf_counter() - self._began), 3)}
