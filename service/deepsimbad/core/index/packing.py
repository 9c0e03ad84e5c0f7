"""The stored form of the inverted index: the map images' lists in route order, coded without loss.

Neighbours see the same landmarks, and a list holds landmarks that are alike. So each place of a list repeats a place of
the list before, likelier the more often such places did, or names another landmark: the likelier, the more it is like
those of the list before and those already in its own (by the landmark model, which is in the same file), and if it was
listed a moment ago. An arithmetic coder turns these likelihoods into bits.

Every block of 8,192 images is a stream of its own, and counts go on from block to block: appending images changes none
but the last. All arithmetic is of integers, or rounded as IEEE 754 says, so every machine reads the same.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.composed import list_weights

BLOCK = 8192  # images

# The coder works on an interval of `_STATE_BITS`; likelihoods are whole numbers that sum up to less than 2^28.
_STATE_BITS, _TOTAL_BITS = 34, 28
_LOW, _HIGH, _VALUE, _PENDING, _AT = range(5)  # of the coder's state

# Limits of the counts of how often a place of a list repeats place k of the list before, or none (k = h): given what
# the place before it repeated, and in all. Counts are halved at the limit, so that they follow the route.
_MOST_AFTER, _MOST_EVER = 1 << 10, 1 << 13
_PRIOR = 5  # what every count in all begins at, and their weight beside the others

# Weight of a landmark's likeness to the list before and to its own list so far, by place, in 1/1024 of 1/16 bit.
_TO_BEFORE, _TO_OWN = np.array([55, 32, 26, 16]), np.array([0, 110, 45, 32])
_RECENT, _RECENT_PARTS = 32, 16  # a landmark listed in the last so many images is so many 1/16 bits likelier
_MOST_ALIKE = 4096  # landmarks; for more no table of likeness is made
_DIMENSIONS = 256  # numbers of a prototype, evenly spread, that are compared
_PARTS = 16  # of a bit
_POWERS = np.array(  # 2^(15 + i/16), rounded
    [32768, 34219, 35734, 37316, 38968, 40693, 42495, 44376, 46341, 48393, 50535, 52773, 55109, 57549, 60097, 62757]
)


def pack_lists(lists: NDArray[np.uint16], n_landmarks: int, prototypes: NDArray[Any] | None) -> list[bytes]:
    """The coded blocks of landmark lists [h, n].

    Args:
        lists: Landmarks below `n_landmarks`.
        n_landmarks: r.
        prototypes: [r, ...] of the landmark model; None where it has none.
    """
    model = _Model(len(lists), n_landmarks, prototypes)
    return [model.write(lists[:, start : start + BLOCK].copy()) for start in range(0, lists.shape[1], BLOCK)]


def unpack_lists(
    blocks: Sequence[bytes], list_length: int, n_images: int, n_landmarks: int, prototypes: NDArray[Any] | None
) -> NDArray[np.uint16]:
    """[h, n] the lists from the blocks of `pack_lists`.

    Raises:
        ValueError: The blocks are not those of so many lists and of these landmarks.
    """
    if not 1 <= list_length <= n_landmarks or n_images < 1 or len(blocks) != -(-n_images // BLOCK):
        raise ValueError(f"{len(blocks)} blocks are not those of {n_images} lists of {list_length} landmarks")
    model = _Model(list_length, n_landmarks, prototypes)
    sizes = (min(BLOCK, n_images - start) for start in range(0, n_images, BLOCK))
    return np.concatenate([model.read(block, size) for block, size in zip(blocks, sizes, strict=True)], axis=1)


class _Model:
    """The likelihoods of landmarks at every place of a list, learnt from the images before."""

    def __init__(self, list_length: int, n_landmarks: int, prototypes: NDArray[Any] | None) -> None:
        h = list_length
        places = np.minimum(np.arange(h), len(_TO_OWN) - 1)
        shares = np.stack([np.rint(10 * list_weights(h)), _TO_BEFORE[places], _TO_OWN[places]])
        self._likeness = _likeness(n_landmarks, prototypes), shares.astype(np.int32)
        counts_after, counts = np.zeros((h, h + 1, h + 1), np.int64), np.full((h, h + 1), _PRIOR, np.int64)
        last_images = np.full(n_landmarks, -_RECENT - 1, np.int64)  # the last image that listed a landmark
        # The list before, and which place of the one before that its first place repeated
        previous = np.full(h + 1, -1, np.int64)
        self._learnt = counts_after, counts, last_images, previous
        self._n_images = 0

    def write(self, lists: NDArray[np.uint16]) -> bytes:
        """The coded block of the next lists [h, b]."""
        stream = np.zeros(8 * lists.size + 8, np.uint8)
        return stream[: self._coded(lists, stream, False)].tobytes()

    def read(self, block: bytes, n_images: int) -> NDArray[np.uint16]:
        """[h, b] the next lists from their block; raises ValueError where they take another number of bytes."""
        lists = np.zeros((self._learnt[0].shape[0], n_images), np.uint16)
        if self._coded(lists, np.frombuffer(block, np.uint8).copy(), True) != len(block):
            raise ValueError("a block of the index is damaged")
        return lists

    def _coded(self, lists: NDArray[np.uint16], stream: NDArray[np.uint8], is_read: bool) -> int:
        n_bytes = _code(lists, stream, is_read, self._n_images, *self._likeness, *self._learnt)
        self._n_images += lists.shape[1]
        return int(n_bytes)


def _likeness(n_landmarks: int, prototypes: NDArray[Any] | None) -> NDArray[np.int8]:
    """[r, r] cosines of the landmarks' prototypes less their mean, in 1/127; [0, 0] where there are no usable ones.

    Products of whole numbers this small are exact in float64, in whatever order they are summed.
    """
    if prototypes is None or prototypes.shape[:1] != (n_landmarks,) or not prototypes.size or n_landmarks > _MOST_ALIKE:
        return np.zeros((0, 0), np.int8)
    rows = prototypes.reshape(n_landmarks, -1)
    rows = np.nan_to_num(rows[:, :: -(-rows.shape[1] // _DIMENSIONS)].astype(np.float64))
    greatest = np.abs(rows).max(axis=1, keepdims=True)
    numbers = np.rint(rows * (1023 / np.where(greatest > 0, greatest, 1.0)))
    numbers -= np.rint(numbers.sum(axis=0) / n_landmarks)
    products = numbers @ numbers.T
    lengths = np.sqrt(np.maximum(np.diag(products), 1.0))
    return np.rint(127 * (products / lengths / lengths[:, np.newaxis])).astype(np.int8)


@njit(cache=True, nogil=True)
def _code(
    lists: NDArray[np.uint16],
    stream: NDArray[np.uint8],
    is_read: bool,
    first_image: int,
    likeness: NDArray[np.int8],
    shares: NDArray[np.int32],
    counts_after: NDArray[np.int64],
    counts: NDArray[np.int64],
    last_images: NDArray[np.int64],
    previous: NDArray[np.int64],
) -> int:
    """Write lists from image `first` on into the zeroed stream, or read them from it; returns their number of bytes.

    A number beyond the stream's size says that the stream holds no such lists.
    """
    (h, n), r = lists.shape, last_images.size
    powers, coder = _powers(r), _coder(stream, is_read)
    previous_likeness, own_likeness, likelihoods = np.zeros(r, np.int32), np.zeros(r, np.int32), np.zeros(r, np.int32)
    choice = np.zeros(h + 1, np.int32)
    for image in range(first_image, first_image + n):
        if coder[_AT] > 8 * stream.size + _STATE_BITS:
            return stream.size + 1
        row = lists[:, image - first_image]
        earlier = previous[:h] if previous[0] >= 0 else previous[:0]
        _sum_alike(previous_likeness, likeness, earlier, shares[0])
        place_before = int(previous[h])
        previous[h] = h
        for j in range(h):
            place = h
            if earlier.size:
                _weigh_places(choice, row[:j], earlier, counts_after[j, place_before], counts[j], r)
                place = _symbol(choice, _place_of(row[j], earlier), coder, stream, is_read)
                _count(counts_after[j, place_before], place, _MOST_AFTER)
                _count(counts[j], place, _MOST_EVER)
                place_before = place
                if j == 0:
                    previous[h] = place
            if place < h:
                row[j] = earlier[place]
            else:
                _sum_alike(own_likeness, likeness, row[:j], shares[0])
                worth = shares[1, j] * previous_likeness + shares[2, j] * own_likeness
                _weigh_others(likelihoods, worth, last_images, image - _RECENT, powers)
                for landmark in row[:j]:
                    likelihoods[landmark] = 1  # a landmark twice in a list is all but impossible
                likelihoods[earlier] = 0
                row[j] = _symbol(likelihoods, int(row[j]), coder, stream, is_read)
        for j in range(h):
            previous[j] = row[j]
        last_images[row] = image
    if is_read:
        return int(coder[_AT] - _STATE_BITS + 2 + 7) // 8
    coder[_PENDING] += 1
    _write_bit(coder, stream, int(coder[_LOW] >= 1 << (_STATE_BITS - 2)))
    return int(coder[_AT] + 7) // 8


@njit(cache=True, nogil=True)
def _powers(n_landmarks: int) -> NDArray[np.int32]:
    """2^(i/16) as whole numbers, up to the greatest that each of so many landmarks may have."""
    n_bits = _TOTAL_BITS - 1
    while n_landmarks << n_bits >= 1 << _TOTAL_BITS:
        n_bits -= 1
    powers = np.empty(_PARTS * n_bits + 1, np.int32)
    for part in range(powers.size):
        powers[part] = (_POWERS[part % _PARTS] << (part // _PARTS)) >> 15
    return powers


@njit(cache=True, nogil=True)
def _place_of(landmark: int, earlier: NDArray[np.int64]) -> int:
    """The first place of the list `earlier` that holds a landmark; its length where none does."""
    for place in range(earlier.size):
        if earlier[place] == landmark:
            return place
    return int(earlier.size)


@njit(cache=True, nogil=True)
def _sum_alike(sums: NDArray[np.int32], likeness: NDArray[np.int8], landmarks: Any, weights: NDArray[np.int32]) -> None:
    """Write how much every landmark [r] is like the weighted sum of `landmarks`."""
    sums[:] = 0
    for place in range(landmarks.size if likeness.size else 0):
        weight, of_landmark = weights[place], likeness[landmarks[place]]
        for landmark in range(sums.size):
            sums[landmark] += weight * np.int32(of_landmark[landmark])


@njit(cache=True, nogil=True)
def _weigh_others(likelihoods: Any, worth: Any, last_images: Any, recent: int, powers: Any) -> None:
    """Write how likely each landmark [r] is, by its worth and whether it was listed since image `recent`."""
    for landmark in range(likelihoods.size):
        likelihoods[landmark] = (worth[landmark] >> 10) + (_RECENT_PARTS if last_images[landmark] >= recent else 0)
    lowest = likelihoods.max() - powers.size + 1
    for landmark in range(likelihoods.size):
        likelihoods[landmark] = powers[max(0, likelihoods[landmark] - lowest)]


@njit(cache=True, nogil=True)
def _weigh_places(choice: Any, row: Any, earlier: Any, counts_after: Any, counts: Any, n_landmarks: int) -> None:
    """Write how likely the next place of a list repeats each place of the list before, or, in the last number, none."""
    n_distinct, n_counted = 0, counts.sum()
    for place in range(choice.size):
        choice[place] = counts_after[place] * n_counted + _PRIOR * counts[place]
    for place in range(earlier.size):
        if _place_of(earlier[place], earlier) < place:
            choice[place] = 0
            continue
        n_distinct += 1
        for landmark in row:
            if landmark == earlier[place]:
                choice[place] = 1
    if n_distinct == n_landmarks:
        choice[-1] = 0


@njit(cache=True, nogil=True)
def _count(counts: NDArray[np.int64], place: int, limit: int) -> None:
    """Count one more; at the limit all counts are halved, none of them to 0."""
    counts[place] += 1
    if counts.sum() >= limit:
        for k in range(counts.size):
            counts[k] = (counts[k] + 1) >> 1


@njit(cache=True, nogil=True)
def _symbol(
    shares: NDArray[np.int32], symbol: int, coder: NDArray[np.int64], stream: NDArray[np.uint8], is_read: bool
) -> int:
    """Write a symbol, or read one, by the shares of all symbols' likelihoods; returns it."""
    total, low = shares.sum(), coder[_LOW]
    span = coder[_HIGH] - low + 1
    below = np.int64(0)
    if is_read:
        aim = ((coder[_VALUE] - low + 1) * total - 1) // span
        symbol = 0
        while below + shares[symbol] <= aim:
            below += shares[symbol]
            symbol += 1
    else:
        below = shares[:symbol].sum()
    coder[_HIGH] = low + span * (below + shares[symbol]) // total - 1
    coder[_LOW] = low + span * below // total
    half = np.int64(1) << (_STATE_BITS - 1)
    quarter = half >> 1
    while True:
        if coder[_HIGH] < half:
            offset = np.int64(0)
        elif coder[_LOW] >= half:
            offset = half
        elif coder[_LOW] >= quarter and coder[_HIGH] < half + quarter:
            offset = quarter
        else:
            return symbol
        for bound in (_LOW, _HIGH, _VALUE):
            coder[bound] = (coder[bound] - offset) << 1
        coder[_HIGH] |= 1
        if is_read:
            coder[_VALUE] |= _next_bit(coder, stream)
        elif offset == quarter:
            coder[_PENDING] += 1
        else:
            _write_bit(coder, stream, int(offset > 0))


@njit(cache=True, nogil=True)
def _coder(stream: NDArray[np.uint8], is_read: bool) -> NDArray[np.int64]:
    """The coder's state at the beginning of a stream."""
    coder = np.zeros(5, np.int64)
    coder[_HIGH] = (1 << _STATE_BITS) - 1
    for _ in range(_STATE_BITS if is_read else 0):
        coder[_VALUE] = coder[_VALUE] << 1 | _next_bit(coder, stream)
    return coder


@njit(cache=True, nogil=True)
def _next_bit(coder: NDArray[np.int64], stream: NDArray[np.uint8]) -> int:
    """The next bit of the stream; 0 behind its end."""
    position = coder[_AT]
    coder[_AT] += 1
    return (stream[position >> 3] >> (7 - (position & 7))) & 1 if position >> 3 < stream.size else 0


@njit(cache=True, nogil=True)
def _write_bit(coder: NDArray[np.int64], stream: NDArray[np.uint8], bit: int) -> None:
    """Write a bit, then its opposite as often as bits are pending."""
    for i in range(coder[_PENDING] + 1):
        position = coder[_AT]
        if bit != (i > 0):
            stream[position >> 3] |= np.uint8(0x80 >> (position & 7))
        coder[_AT] += 1
    coder[_PENDING] = 0
