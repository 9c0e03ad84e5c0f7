"""The durable form of the inverted index: posting lists packed below the byte (II-C, "15h bits per map image").

A posting list is the increasing ids of the map images that hold one landmark at one rank. It is written either as
gaps or, where neighbouring map images share the landmark, as runs (gap, length); whichever is shorter. All numbers
are Rice codes: the quotient in unary (zeros, then a one), then the low bits. The zeros that pad the last byte can
never end a quotient, so a list needs no stored length.

Blob: one header byte, then the bit stream, most significant bit first. The header's low five bits are the Rice
parameter of the gaps; its high three bits are 0 for plain gaps, else 1 + the Rice parameter of the run lengths.
"""

from collections.abc import Iterable, Iterator

import numpy as np
from numba import njit
from numpy.typing import NDArray

_MAX_GAP_PARAMETER = 31
_MAX_RUN_PARAMETER = 6


@njit(cache=True, nogil=True)
def _best_parameter(numbers: NDArray[np.int64], limit: int) -> tuple[int, int]:
    """The Rice parameter in 0..limit that writes the numbers in the fewest bits, and those bits."""
    best, best_bits = 0, 1 << 62
    for parameter in range(limit + 1):
        bits = numbers.size * (parameter + 1)
        for place in range(numbers.size):
            bits += int(numbers[place]) >> parameter
        if bits < best_bits:
            best, best_bits = parameter, bits
    return best, best_bits


@njit(cache=True, nogil=True)
def _write_rice(stream: NDArray[np.uint8], at: int, number: int, parameter: int) -> int:
    """Write one number into the zeroed stream from bit `at`; returns the next free bit."""
    at += number >> parameter
    stream[at >> 3] |= np.uint8(0x80 >> (at & 7))
    at += 1
    for shift in range(parameter - 1, -1, -1):
        if (number >> shift) & 1:
            stream[at >> 3] |= np.uint8(0x80 >> (at & 7))
        at += 1
    return at


@njit(cache=True, nogil=True)
def _read_rice(stream: NDArray[np.uint8], at: int, parameter: int) -> tuple[int, int]:
    """Read one number from bit `at`; returns it and the next bit, or -1 where the stream holds no more."""
    n_bits = stream.size * 8
    number = 0
    while at < n_bits and not (stream[at >> 3] >> (7 - (at & 7))) & 1:
        number += 1
        at += 1
    at += 1
    if at + parameter > n_bits:
        return -1, n_bits
    for _ in range(parameter):
        number = (number << 1) | ((stream[at >> 3] >> (7 - (at & 7))) & 1)
        at += 1
    return number, at


@njit(cache=True, nogil=True)
def _runs(image_ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split increasing ids into runs: gaps before each (the least possible counts as 0), and lengths less 1."""
    gaps = np.empty(image_ids.size, np.int64)
    lengths = np.empty(image_ids.size, np.int64)
    n_runs = 0
    previous = np.int64(-2)
    for image in image_ids:
        if image == previous + 1:
            lengths[n_runs - 1] += 1
        else:
            gaps[n_runs] = image - previous - 2
            lengths[n_runs] = 0
            n_runs += 1
        previous = image
    return gaps[:n_runs], lengths[:n_runs]


@njit(cache=True, nogil=True)
def _pack(image_ids: NDArray[np.int64]) -> NDArray[np.uint8]:
    plain = np.empty_like(image_ids)
    previous = np.int64(-1)
    for place, image in enumerate(image_ids):
        plain[place] = image - previous - 1
        previous = image
    parameter, bits = _best_parameter(plain, _MAX_GAP_PARAMETER)
    run_gaps, run_lengths = _runs(image_ids)
    gap_parameter, gap_bits = _best_parameter(run_gaps, _MAX_GAP_PARAMETER)
    run_parameter, run_bits = _best_parameter(run_lengths, _MAX_RUN_PARAMETER)

    as_runs = gap_bits + run_bits < bits
    if as_runs:
        bits = gap_bits + run_bits
    blob = np.zeros(1 + (bits + 7) // 8, np.uint8)
    stream = blob[1:]
    at = 0
    if as_runs:
        blob[0] = np.uint8(gap_parameter | (run_parameter + 1) << 5)
        for place in range(run_gaps.size):
            at = _write_rice(stream, at, int(run_gaps[place]), gap_parameter)
            at = _write_rice(stream, at, int(run_lengths[place]), run_parameter)
    else:
        blob[0] = np.uint8(parameter)
        for place in range(plain.size):
            at = _write_rice(stream, at, int(plain[place]), parameter)
    return blob


@njit(cache=True, nogil=True)
def _place(blob: NDArray[np.uint8], column: NDArray[np.uint16], landmark: int, empty: int) -> int:
    """Write the landmark at every image of the blob; returns how many, or -1 - image at a bad one."""
    parameter = int(blob[0]) & 31
    run_parameter = (int(blob[0]) >> 5) - 1
    stream = blob[1:]
    at, image, n_placed = 0, -1, 0
    if run_parameter >= 0:
        image = -2
    while True:
        gap, at = _read_rice(stream, at, parameter)
        if gap < 0:
            return n_placed
        length = 0
        if run_parameter >= 0:
            length, at = _read_rice(stream, at, run_parameter)
            if length < 0:
                return -1 - column.size
            image += 1
        for _ in range(length + 1):
            image += 1 + gap
            gap = 0
            if image >= column.size or column[image] != empty:
                return -1 - image
            column[image] = landmark
            n_placed += 1


_EMPTY = np.uint16(0xFFFF)  # no landmark: ids stay below it (see Map)


def pack_postings(image_ids: NDArray[np.int64]) -> bytes:
    """Pack one posting list, [m] image ids; the blob of an empty one is empty.

    Raises:
        ValueError: The ids do not increase strictly from 0.
    """
    image_ids = np.ascontiguousarray(image_ids, np.int64)
    if image_ids.size == 0:
        return b""
    if image_ids[0] < 0 or (np.diff(image_ids) <= 0).any():
        raise ValueError("image ids of a posting list must increase strictly from 0")
    return _pack(image_ids).tobytes()


def unpack_postings(blob: bytes, n_images: int) -> NDArray[np.int64]:
    """Unpack one posting list of a map with `n_images` images into its increasing ids.

    Raises:
        ValueError: The blob names an image the map does not have.
    """
    column = np.full(n_images, _EMPTY)
    _place_blob(blob, column, 0)
    return np.flatnonzero(column == 0)


def pack_index(lists: NDArray[np.uint16], n_landmarks: int) -> Iterator[tuple[int, int, bytes]]:
    """(landmark from 0, rank from 1, blob) of every posting list of landmark lists [h, n], in order; empty ones not."""
    grouped = []
    for row in lists:
        order = np.argsort(row, kind="stable")
        starts = np.searchsorted(row[order], np.arange(n_landmarks + 1))
        grouped.append((order.astype(np.int64), starts))
    for landmark in range(n_landmarks):
        for rank, (order, starts) in enumerate(grouped, start=1):
            image_ids = order[starts[landmark] : starts[landmark + 1]]
            if image_ids.size:
                yield landmark, rank, pack_postings(image_ids)


def unpack_index(postings: Iterable[tuple[int, int, bytes]], list_length: int, n_images: int) -> NDArray[np.uint16]:
    """Rebuild the landmark lists, [h, n] uint16, from the posting lists.

    Raises:
        ValueError: A map image is listed twice at a rank, missing from one, or out of range.
    """
    lists = np.full((list_length, n_images), _EMPTY)
    n_placed = 0
    for landmark, rank, blob in postings:
        if not 1 <= rank <= list_length or not 0 <= landmark < _EMPTY:
            raise ValueError(f"posting of landmark {landmark} at rank {rank} is out of range")
        n_placed += _place_blob(blob, lists[rank - 1], landmark)
    if n_placed != lists.size:
        raise ValueError(f"the postings fill {n_placed} of {lists.size} places of the map images' lists")
    return lists


def _place_blob(blob: bytes, column: NDArray[np.uint16], landmark: int) -> int:
    if not blob:
        return 0
    n_placed = int(_place(np.frombuffer(blob, np.uint8), column, landmark, int(_EMPTY)))
    if n_placed < 0:
        raise ValueError(f"a posting of landmark {landmark} is damaged at image {-1 - n_placed}")
    return n_placed
