"""The inverted index in memory: which landmarks every map image lists, laid out for one fused pass (II-C)."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepsimbad.core.descriptor import MAX_LANDMARKS
from deepsimbad.errors import InvalidMapConfigError

_BLOCK = 4096  # images whose sums stay in the first-level cache
_IMAGES_WORTH_A_THREAD = 250_000  # below, waking a second core costs more than it saves


@njit(cache=True, nogil=True, fastmath={"contract"})
def _sum_listed(lists: NDArray[np.uint16], tables: NDArray[np.float32], sums: NDArray[np.float32]) -> None:
    """`sums[m] = sum over j of tables[j, lists[j, m]]`, block by block."""
    list_length, n_images = lists.shape
    for start in range(0, n_images, _BLOCK):
        stop = min(start + _BLOCK, n_images)
        block = sums[start:stop]
        table, row = tables[0], lists[0, start:stop]
        for m in range(block.size):
            block[m] = table[row[m]]
        for j in range(1, list_length):
            table, row = tables[j], lists[j, start:stop]
            for m in range(block.size):
                block[m] += table[row[m]]


@njit(cache=True, nogil=True)
def _sum_listed_many(lists: NDArray[np.uint16], tables: NDArray[np.float32], sums: NDArray[np.float32]) -> None:
    for query in range(len(tables)):
        _sum_listed(lists, tables[query], sums[query])


@cache
def _second_core() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix="index")


@dataclass(frozen=True)
class InvertedIndex:
    """The landmark lists of all map images.

    The durable form is posting lists by (landmark, rank) (`deepsimbad.core.packing`). Since a query keeps all r
    ranks, every posting takes part in every query, so memory holds the same postings sorted by map image.

    Attributes:
        lists: [h, n] uint16, row j holds every map image's landmark of rank j + 1.
        n_landmarks: r.
        values: [h, n] float32, the listed landmarks' dissimilarities; for `simbad` alone, else None.
    """

    lists: NDArray[np.uint16]
    n_landmarks: int
    values: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        if self.lists.ndim != 2 or 0 in self.lists.shape:
            raise InvalidMapConfigError(f"landmark lists have shape {self.lists.shape}; a map needs an image")
        if not self.lists.shape[0] <= self.n_landmarks <= MAX_LANDMARKS:
            raise InvalidMapConfigError(
                f"lists of {self.lists.shape[0]} among {self.n_landmarks} landmarks: the list length is at most "
                f"the number of landmarks, and that at most {MAX_LANDMARKS}"
            )
        if self.lists.max() >= self.n_landmarks:  # the scoring loop does not check again
            raise InvalidMapConfigError(f"a list names a landmark that is not one of the {self.n_landmarks}")
        if self.values is not None and self.values.shape != self.lists.shape:
            raise InvalidMapConfigError("one dissimilarity a listed landmark is needed")
        for array in (self.lists, self.values):
            if array is not None:
                array.setflags(write=False)

    @property
    def list_length(self) -> int:
        """h."""
        return int(self.lists.shape[0])

    @property
    def n_images(self) -> int:
        """n."""
        return int(self.lists.shape[1])

    def sum_listed(self, tables: NDArray[np.floating]) -> NDArray[np.float32]:
        """Sum over every map image's list what a query gives each landmark at each rank.

        Args:
            tables: [h, r]; `tables[j, i]` is what landmark i is worth at rank j + 1.

        Returns:
            [n] float32.
        """
        if tables.shape != (self.list_length, self.n_landmarks):
            raise InvalidMapConfigError(f"tables have shape {tables.shape}, not [h, r]")
        worth = np.ascontiguousarray(tables, np.float32)
        sums = np.empty(self.n_images, np.float32)
        if self.n_images < 2 * _IMAGES_WORTH_A_THREAD:
            _sum_listed(self.lists, worth, sums)
        else:
            half = self.n_images // 2
            other = _second_core().submit(_sum_listed, self.lists[:, half:], worth, sums[half:])
            _sum_listed(self.lists[:, :half], worth, sums[:half])
            other.result()
        return sums

    def sum_listed_many(self, tables: NDArray[np.float32]) -> NDArray[np.float32]:
        """`sum_listed` of many queries in this thread.

        Args:
            tables: [e, h, r].

        Returns:
            [e, n] float32.
        """
        if tables.shape[1:] != (self.list_length, self.n_landmarks):
            raise InvalidMapConfigError(f"tables have shape {tables.shape}, not [e, h, r]")
        sums = np.empty((len(tables), self.n_images), np.float32)
        _sum_listed_many(self.lists, np.ascontiguousarray(tables, np.float32), sums)
        return sums

    def append(self, lists: NDArray[np.uint16], values: NDArray[np.float32] | None = None) -> Self:
        """The index with further map images [h, m] behind the present ones; this one is unchanged."""
        if (values is None) != (self.values is None):
            raise InvalidMapConfigError("appended images must hold dissimilarities exactly where the index does")
        longer = None
        if values is not None and self.values is not None:
            longer = np.hstack([self.values, values])
        return type(self)(np.hstack([self.lists, lists]), self.n_landmarks, longer)
