"""How relevant every stretch of the map is to every query: small enough to draw, kept on disk while a replay runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

MOST_ROWS = 1200
MOST_COLUMNS = 800


@dataclass(frozen=True)
class RelevanceHeat:
    """Rows of queries, columns of map images in route order, thinned to what a screen shows.

    Attributes:
        values: [rows, columns] float16, the best relevance of a column's images in standard deviations above the
            query's mean; NaN where nothing is known.
        every: One query in this many has a row.
        column_of: [n] the column of every map image.
    """

    values: NDArray[np.float16]
    every: int
    column_of: NDArray[np.intp]

    @classmethod
    def open(cls, path: Path, n_queries: int, n_images: int, go_on: bool) -> Self:
        """Open the file of an earlier run that fits, or begin a new one."""
        every = -(-n_queries // MOST_ROWS)
        shape = (-(-n_queries // every), min(n_images, MOST_COLUMNS))
        column_of = np.arange(n_images) * shape[1] // n_images
        if go_on and path.exists():
            try:
                earlier = np.lib.format.open_memmap(path, mode="r+")
            except ValueError:  # torn by a crash: a picture is lost, no figure
                earlier = None
            if earlier is not None and earlier.shape == shape and earlier.dtype == np.float16:
                return cls(earlier, every, column_of)
        values = np.lib.format.open_memmap(path, mode="w+", dtype=np.float16, shape=shape)
        values[:] = np.nan
        return cls(values, every, column_of)

    def add(self, query: int, relevance: NDArray[np.float32]) -> None:
        """Keep a query's relevances [n], if it has a row."""
        if query % self.every:
            return
        spread = float(relevance.std())
        standard = (relevance - relevance.mean()) / (spread if spread > 0 else 1.0)
        row = np.full(self.values.shape[1], -np.inf)
        np.maximum.at(row, self.column_of, standard)
        self.values[query // self.every] = row

    def flush(self) -> None:
        """Bring everything to disk."""
        if isinstance(self.values, np.memmap):
            self.values.flush()
