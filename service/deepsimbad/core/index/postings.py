"""The index as releases before wrote it: posting lists packed below the byte. They are read, and no longer written.

A posting list is the increasing ids of the map images that hold one landmark at one rank, written either as gaps or as
runs (gap, length). All numbers are Rice codes: the quotient in unary (zeros, then a one), then the low bits. The zeros
that pad the last byte can never end a quotient, so a list has no stored length.

Blob: one header byte, then the bit stream, most significant bit first. The header's low five bits are the Rice
parameter of the gaps; its high three bits are 0 for plain gaps, else 1 + the Rice parameter of the run lengths.
"""

from collections.abc import Iterable

import numpy as np
from numba import njit
from numpy.typing import NDArray

_EMPTY = np.uint16(0xFFFF)  # no landmark: ids stay below it (see Map)


def unpack_postings(postings: Iterable[tuple[int, int, bytes]], list_length: int, n_images: int) -> NDArray[np.uint16]:
    """The landmark lists, [h, n], from posting lists: landmark from 0, rank from 1, blob.

    Raises:
        ValueError: A map image is listed twice at a rank, missing from one, or out of range.
    """
    lists = np.full((list_length, n_images), _EMPTY)
    n_placed = 0
    for landmark, rank, blob in postings:
        if not 1 <= rank <= list_length or not 0 <= landmark < _EMPTY:
            raise ValueError(f"posting of landmark {landmark} at rank {rank} is out of range")
        n_more = int(_place(np.frombuffer(blob, np.uint8), lists[rank - 1], landmark, int(_EMPTY))) if blob else 0
        if n_more < 0:
            raise ValueError(f"a posting of landmark {landmark} is damaged at image {-1 - n_more}")
        n_placed += n_more
    if n_placed != lists.size:
        raise ValueError(f"the postings fill {n_placed} of {lists.size} places of the map images' lists")
    return lists


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
