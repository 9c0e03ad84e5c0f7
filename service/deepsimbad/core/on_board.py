"""A view in few bytes, as a robot that encodes on board sends it: its unit encoding, or its nearest landmarks.

On a `composed` map a unit encoding loses less in fewer bytes: a landmark's id tells which of r directions is near, a
number of the encoding how far it lies along one (docs/results/onboard.md). Every other relevance compares ranks.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.composed import unit
from deepsimbad.core.descriptor import checked_ranking, wrong_number
from deepsimbad.errors import InvalidEncodingError, InvalidInputError, InvalidRankedLandmarksError

RANKS, UNIT_ENCODING = "application/vnd.deepsimbad.ranks", "application/vnd.deepsimbad.unit-encoding"
"""Media types of the two packed forms."""

USUAL_BITS = 5  # a number; more bits gain less than seasons differ by
_LEAST_BITS, _MOST_BITS = 2, 8


def pack_unit_encoding(u: NDArray[np.floating], n_bits: int = USUAL_BITS) -> bytes:
    """A unit encoding [k] in one byte that says `n_bits`, 2..8, and k numbers of so many bits.

    Numbers are rounded to even steps, as many below zero as above, of which the largest number reaches the last: code
    c, from 0 to 2^bits - 2, stands for c - (2^(bits-1) - 1). Most significant bit first; zeros fill the last byte.

    Raises:
        InvalidEncodingError: u holds NaN or infinity, or the bits are not within 2..8.
    """
    steps = _steps(n_bits)
    largest = float(np.abs(u).max())
    if not np.isfinite(largest):
        raise InvalidEncodingError("a unit encoding holds NaN or infinity")
    codes = steps + np.rint(np.asarray(u, np.float64) * (steps / (largest or 1.0))).astype(np.int64)
    return bytes([n_bits]) + _in_bits(codes, n_bits)


def unpack_unit_encoding(body: bytes, n_numbers: int) -> NDArray[np.float32]:
    """[k] float32, the unit encoding from the bytes of `pack_unit_encoding`; zeros for a view that shows nothing.

    Raises:
        InvalidEncodingError: The body is not what packing k numbers gives.
    """
    if not body:
        raise InvalidEncodingError("a packed unit encoding begins with its bits a number, in one byte")
    n_bits = body[0]
    steps = _steps(n_bits)
    codes = _from_bits(body[1:], n_numbers, n_bits, InvalidEncodingError, encoding_dim=n_numbers)
    if codes.max() > 2 * steps:
        raise InvalidEncodingError(f"{codes.max()} is no number of {n_bits} bits: they go from 0 to {2 * steps}")
    return unit((codes - steps).astype(np.float32))


def _steps(n_bits: int) -> int:
    """Number of steps on either side of zero; raises InvalidEncodingError where the bits are out of range."""
    if not _LEAST_BITS <= n_bits <= _MOST_BITS:
        raise InvalidEncodingError(
            f"a unit encoding has {_LEAST_BITS} to {_MOST_BITS} bits a number, not {n_bits}",
            minimum=_LEAST_BITS,
            maximum=_MOST_BITS,
        )
    return int(2 ** (n_bits - 1)) - 1


def pack_ranked_landmarks(landmark_ids: Sequence[int], n_landmarks: int) -> bytes:
    """The nearest landmarks in few bytes: m in two, big-endian, then m ids, nearest first.

    An id takes ceil(log2 r) bits, most significant first; zeros fill the last byte.

    Raises:
        InvalidRankedLandmarksError: There are none or too many, or an id is out of range or listed twice.
    """
    ids = checked_ranking(landmark_ids, n_landmarks)
    return len(ids).to_bytes(2, "big") + _in_bits(ids, _bits_per_id(n_landmarks))


def unpack_ranked_landmarks(body: bytes, n_landmarks: int) -> tuple[int, ...]:
    """The ids, nearest first, from the bytes of `pack_ranked_landmarks`.

    Raises:
        InvalidRankedLandmarksError: The body is not what packing 1..r distinct ids below r gives.
    """
    if len(body) < 2:
        raise InvalidRankedLandmarksError("packed ranked landmarks begin with their number, in two bytes")
    n_sent, n_bits = int.from_bytes(body[:2], "big"), _bits_per_id(n_landmarks)
    if not 1 <= n_sent <= n_landmarks:
        raise wrong_number(n_sent, n_landmarks)
    hints = {"n_landmarks": n_landmarks, "bits_per_id": n_bits}
    ids = _from_bits(body[2:], n_sent, n_bits, InvalidRankedLandmarksError, **hints)
    return tuple(checked_ranking(ids.tolist(), n_landmarks).tolist())


def ranked_landmarks_within(n_bytes: int, n_landmarks: int) -> int:
    """How many ranked landmarks, at most r, `pack_ranked_landmarks` fits into `n_bytes`."""
    n_bits = _bits_per_id(n_landmarks)
    return n_landmarks if n_bits == 0 else min(n_landmarks, 8 * (n_bytes - 2) // n_bits)


def _bits_per_id(n_landmarks: int) -> int:
    return (n_landmarks - 1).bit_length()


def _in_bits(numbers: NDArray[np.int64], n_bits: int) -> bytes:
    """Numbers [m] in `n_bits` each, most significant first; zeros fill the last byte."""
    bits = (numbers[:, np.newaxis] >> np.arange(n_bits - 1, -1, -1)) & 1
    return np.packbits(bits.astype(np.uint8).reshape(-1)).tobytes()


def _from_bits(
    packed: bytes, n_numbers: int, n_bits: int, error: type[InvalidInputError], **hints: int
) -> NDArray[np.int64]:
    """[m] the numbers from the bytes of `_in_bits`; raises `error`, with `hints`, where they are none of that."""
    n_in_all = n_numbers * n_bits
    n_bytes = -(-n_in_all // 8)
    if len(packed) != n_bytes:
        raise error(
            f"{n_numbers} numbers of {n_bits} bits are packed into {n_bytes} bytes, not {len(packed)}: "
            "is it the landmark model of another map?",
            **hints,
        )
    bits = np.unpackbits(np.frombuffer(packed, np.uint8))
    if bits[n_in_all:].any():
        raise error("the bits behind the last number must be zero")
    values = np.left_shift(1, np.arange(n_bits - 1, -1, -1))
    return np.asarray(bits[:n_in_all].reshape(n_numbers, n_bits) @ values, np.int64)
