"""What a frame of a traverse is known by, and in what two of one index differ."""

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_POSITION_M = 1e9  # either way; 25 times round the earth, and squares and spans are far from overflow
UNKNOWN_TIMESTAMP = -1
UNKNOWN_CONTENT = 0
_DIGEST_BYTES = 8
_IN_WORDS = {"position_m": "position", "timestamp_us": "time", "x_m": "x", "y_m": "y", "content_digest": "content"}
IDENTITY = tuple(_IN_WORDS)
"""The arrays [n] that a frame is known by: where unknown NaN, a time -1, a digest 0."""


def content_digest(body: bytes) -> int:
    """Of a picture as it was posted, or of an encoding's little-endian float32; stored, so it stays as it is."""
    return int.from_bytes(hashlib.blake2b(body, digest_size=_DIGEST_BYTES).digest(), "little")


def differences(some: Mapping[str, NDArray[Any]], others: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.bool_]]:
    """Which of twice n frames, given by the arrays of `IDENTITY`, differ: a word for in what -> [n], where any does.

    An unknown content differs from none.
    """
    found = {}
    for name, word in _IN_WORDS.items():
        ours, theirs = some[name], others[name]
        differ = ours != theirs
        if name == "content_digest":
            differ &= (ours != UNKNOWN_CONTENT) & (theirs != UNKNOWN_CONTENT)
        elif ours.dtype.kind == "f":
            differ &= ~(np.isnan(ours) & np.isnan(theirs))
        if differ.any():
            found[word] = differ
    return found
