"""The scene descriptor: landmarks ranked by dissimilarity (II-C)."""

from collections.abc import Sequence
from functools import lru_cache
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepsimbad.errors import InvalidDissimilaritiesError, InvalidRankedLandmarksError

MAX_LANDMARKS = 0xFFFF  # landmark ids are uint16 and the last value means "none"


def rank_landmarks(dissimilarities: ArrayLike) -> NDArray[np.float32]:
    """Ranks 1..r by ascending dissimilarity, [r] or [n, r] as given, float32; ties by landmark id.

    Raises:
        InvalidDissimilaritiesError: Not one or two dimensions, no landmarks, or NaN or infinity somewhere.
    """
    values = np.asarray(dissimilarities)
    if values.ndim not in {1, 2} or values.shape[-1] == 0:
        raise InvalidDissimilaritiesError(f"dissimilarities have shape {values.shape}; give [r] or [n, r]")
    if not np.isfinite(values).all():
        raise InvalidDissimilaritiesError("dissimilarities hold NaN or infinity; every one must be finite")
    order = np.argsort(values, axis=-1, kind="stable")
    ranks = np.empty(values.shape, np.float32)
    ascending = np.arange(1, values.shape[-1] + 1, dtype=np.float32)
    if values.ndim == 1:
        ranks[order] = ascending
    else:
        np.put_along_axis(ranks, order, np.broadcast_to(ascending, values.shape), axis=-1)
    return ranks


def ranks_from_ranked_landmarks(landmark_ids: Sequence[int], n_landmarks: int) -> NDArray[np.float32]:
    """[r] ranks of all landmarks from the ids that a robot sent, nearest first, 1..r of them.

    Landmarks that were not sent share the mean of the ranks left; `n_ranked` tells them.

    Raises:
        InvalidRankedLandmarksError: None, too many, out of range or listed twice.
    """
    ids = _checked(landmark_ids, n_landmarks)
    n_sent = ids.size
    ranks = np.full(n_landmarks, (n_sent + 1 + n_landmarks) / 2, np.float32)
    ranks[ids] = np.arange(1, n_sent + 1, dtype=np.float32)
    return ranks


def n_ranked(ranks: NDArray[np.float32]) -> int:
    """How many landmarks a view [r] has a rank of its own for: the nearest m, the others share the mean rank left.

    r where all ranks are known, 0 for a view that shows nothing.
    """
    last = float(ranks.max())
    return ranks.size if last == ranks.size else round(2 * last) - 1 - ranks.size


def pack_ranked_landmarks(landmark_ids: Sequence[int], n_landmarks: int) -> bytes:
    """The nearest landmarks in the fewest bytes: m in two, big-endian, then m ids, nearest first.

    An id takes ceil(log2 r) bits, most significant first; the last byte is filled up with zeros.

    Raises:
        InvalidRankedLandmarksError: None, too many, out of range or listed twice.
    """
    ids = _checked(landmark_ids, n_landmarks)
    n_bits = _bits_per_id(n_landmarks)
    bits = (ids[:, np.newaxis] >> np.arange(n_bits - 1, -1, -1)) & 1  # [m, bits]
    return len(ids).to_bytes(2, "big") + np.packbits(bits.astype(np.uint8).reshape(-1)).tobytes()


def unpack_ranked_landmarks(body: bytes, n_landmarks: int) -> tuple[int, ...]:
    """Back from `pack_ranked_landmarks`.

    Raises:
        InvalidRankedLandmarksError: The body is not what packing 1..r distinct ids below r gives.
    """
    if len(body) < 2:
        raise InvalidRankedLandmarksError("packed ranked landmarks begin with their number, in two bytes")
    n_sent, n_bits = int.from_bytes(body[:2], "big"), _bits_per_id(n_landmarks)
    if not 1 <= n_sent <= n_landmarks:
        raise _wrong_number(n_sent, n_landmarks)
    n_bytes = 2 + -(-n_sent * n_bits // 8)
    if len(body) != n_bytes:
        raise InvalidRankedLandmarksError(
            f"{n_sent} ids of {n_bits} bits are packed into {n_bytes} bytes, not {len(body)}: "
            "is it the landmark model of another map?",
            n_landmarks=n_landmarks,
            bits_per_id=n_bits,
        )
    bits = np.unpackbits(np.frombuffer(body, np.uint8, offset=2))
    if bits[n_sent * n_bits :].any():
        raise InvalidRankedLandmarksError("the bits behind the last id must be zero")
    places = np.left_shift(1, np.arange(n_bits - 1, -1, -1))
    ids = bits[: n_sent * n_bits].reshape(n_sent, n_bits) @ places
    return tuple(_checked(ids.tolist(), n_landmarks).tolist())


def ranked_landmarks_within(n_bytes: int, n_landmarks: int) -> int:
    """How many ranked landmarks, r at most, `pack_ranked_landmarks` brings into so many bytes."""
    n_bits = _bits_per_id(n_landmarks)
    return n_landmarks if n_bits == 0 else min(n_landmarks, 8 * (n_bytes - 2) // n_bits)


def _bits_per_id(n_landmarks: int) -> int:
    return (n_landmarks - 1).bit_length()


def _checked(landmark_ids: Sequence[int], n_landmarks: int) -> NDArray[np.int64]:
    """[m] ids that are a ranking's beginning; raises InvalidRankedLandmarksError."""
    n_sent = len(landmark_ids)
    if not 1 <= n_sent <= n_landmarks:
        raise _wrong_number(n_sent, n_landmarks)
    try:
        ids = np.asarray(landmark_ids, dtype=np.int64)
    except (OverflowError, TypeError, ValueError) as error:
        raise InvalidRankedLandmarksError("ranked landmarks must be whole numbers") from error
    if ids.min() < 0 or ids.max() >= n_landmarks:
        raise InvalidRankedLandmarksError(
            f"a landmark id is out of range; ids run from 0 to {n_landmarks - 1}", n_landmarks=n_landmarks
        )
    if np.unique(ids).size != n_sent:
        raise InvalidRankedLandmarksError("a landmark id is listed twice; ids must be distinct")
    return ids


def _wrong_number(n_sent: int, n_landmarks: int) -> InvalidRankedLandmarksError:
    return InvalidRankedLandmarksError(
        f"{n_sent} ranked landmarks sent; send 1 to {n_landmarks}, nearest first", n_landmarks=n_landmarks
    )


def nearest_landmarks(values: ArrayLike, list_length: int) -> NDArray[np.uint16]:
    """[h, n] the landmarks of lowest value (rank, dissimilarity or z, [n, r]) of every image, ties by landmark id."""
    order = np.argsort(np.asarray(values), axis=1, kind="stable")[:, :list_length]
    return np.ascontiguousarray(order.T, dtype=np.uint16)


def normal_scores(ranks: NDArray[np.float32], n_landmarks: int) -> NDArray[np.float64]:
    """Normal scores of whole or half ranks of any shape, `Phi^-1((v - 1/2) / r)`: the nearest landmark's is lowest."""
    half_ranks = np.rint(2 * ranks).astype(np.intp)
    return _scores_of_half_ranks(n_landmarks)[half_ranks]


@lru_cache(maxsize=16)
def _scores_of_half_ranks(n_landmarks: int) -> NDArray[np.float64]:
    """[2r + 1]; entry 2v is the score of rank v. Entries 0 and 1 are no ranks."""
    quantile = NormalDist().inv_cdf
    scores = [np.nan, np.nan]
    scores += [quantile((half_rank / 2 - 0.5) / n_landmarks) for half_rank in range(2, 2 * n_landmarks + 1)]
    table = np.array(scores)
    table.setflags(write=False)
    return table
