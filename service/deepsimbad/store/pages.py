"""How many bytes of pages each table takes, and which page size suits a map."""

import sqlite3
from collections.abc import Sequence

_PAGE_SIZES = (4096, 8192, 16384, 32768, 65536)
_ROW_OVERHEAD = 12  # cell pointer, cell and record headers, landmark and rank of one posting row


def fitting_page_size(blob_lengths: Sequence[int]) -> int:
    """The page size that stores posting lists of these lengths in the fewest bytes.

    A row of more than about a quarter page spills into pages of its own, the last of which stays part empty; on large
    maps that would double the index.
    """

    def cost(page_size: int) -> int:
        local = spilled = 0
        for length in blob_lengths:
            n_local, n_pages = _spill(length + _ROW_OVERHEAD, page_size)
            local += n_local
            spilled += n_pages * page_size
        return spilled + -(-local // (page_size - 12)) * page_size

    return min(_PAGE_SIZES, key=cost)


def bytes_by_table(connection: sqlite3.Connection) -> dict[str, int]:
    """Page bytes by table, its indexes included, as SQLite's `dbstat` counts them."""
    rows = connection.execute(
        """
        SELECT coalesce(tbl_name, dbstat.name), sum(pgsize)
        FROM dbstat LEFT JOIN sqlite_schema USING (name) GROUP BY 1
        """
    )
    return dict(rows.fetchall())


def _spill(payload: int, page_size: int) -> tuple[int, int]:
    """The bytes of an index leaf's payload that stay in its page, and its overflow pages (SQLite file format, 1.6)."""
    most, least = ((page_size - 12) * share // 255 - 23 for share in (64, 32))
    if payload <= most:
        return payload, 0
    local = least + (payload - least) % (page_size - 4)
    if local > most:
        local = least
    return local, -(-(payload - local) // (page_size - 4))
