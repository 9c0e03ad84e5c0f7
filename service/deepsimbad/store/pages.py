"""How many bytes of pages each table takes, and which page size suits a map."""

import sqlite3
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from deepsimbad.errors import DamagedMapError

_PAGE_SIZES = (4096, 8192, 16384, 32768, 65536)
_ROW_OVERHEAD = 12  # cell pointer, cell and record headers, landmark and rank of one posting row
_INTERIOR_INDEX, _INTERIOR_TABLE, _LEAF_INDEX, _LEAF_TABLE = 2, 5, 10, 13


def fitting_page_size(blob_lengths: Sequence[int]) -> int:
    """The page size that stores posting lists of these lengths in the fewest bytes.

    A row of more than about a quarter page spills into pages of its own, the last of which stays part empty; on large
    maps that would double the index.
    """

    def cost(page_size: int) -> int:
        local = spilled = 0
        for length in blob_lengths:
            n_local, n_pages = _spill(length + _ROW_OVERHEAD, page_size, table_leaf=False)
            local += n_local
            spilled += n_pages * page_size
        return spilled + -(-local // (page_size - 12)) * page_size

    return min(_PAGE_SIZES, key=cost)


def bytes_by_table(connection: sqlite3.Connection, path: Path) -> dict[str, int]:
    """Page bytes by table, its indexes included.

    SQLite's own `dbstat` counts them where it was built in; else the file's b-trees are walked.
    """
    tables = dict(connection.execute("SELECT name, tbl_name FROM sqlite_schema WHERE rootpage > 0").fetchall())
    try:
        sizes = connection.execute("SELECT name, sum(pgsize) FROM dbstat GROUP BY name").fetchall()
    except sqlite3.OperationalError as error:
        if "dbstat" not in str(error):
            raise
        sizes = walked_sizes(connection, path)
    totals: Counter[str] = Counter()
    for name, size in sizes:
        totals[tables.get(name, name)] += size
    return dict(totals)


def walked_sizes(connection: sqlite3.Connection, path: Path) -> list[tuple[str, int]]:
    """Page bytes by b-tree, counted from the file itself as its format is documented.

    Raises:
        DamagedMapError: A page is not what its parent says.
    """
    (page_size,) = connection.execute("PRAGMA page_size").fetchone()
    roots = connection.execute("SELECT name, rootpage FROM sqlite_schema WHERE rootpage > 0").fetchall()
    content = path.read_bytes()
    try:
        return [(name, _n_pages(content, root, page_size) * page_size) for name, root in (("sqlite_schema", 1), *roots)]
    except (IndexError, RecursionError) as error:
        raise DamagedMapError(f"{path.name} is damaged: its pages do not hang together") from error


def _n_pages(content: bytes, number: int, page_size: int) -> int:
    start = (number - 1) * page_size
    header = start + (100 if number == 1 else 0)
    kind = content[header]
    n_cells = _big_endian(content, header + 3, 2)
    is_interior = kind in (_INTERIOR_INDEX, _INTERIOR_TABLE)
    pointers = header + (12 if is_interior else 8)
    n_pages = 1
    for cell in range(n_cells):
        at = start + _big_endian(content, pointers + 2 * cell, 2)
        if is_interior:
            n_pages += _n_pages(content, _big_endian(content, at, 4), page_size)
            at += 4
        if kind != _INTERIOR_TABLE:
            payload = _varint(content, at)
            n_pages += _spill(payload, page_size, table_leaf=kind == _LEAF_TABLE)[1]
    if is_interior:
        n_pages += _n_pages(content, _big_endian(content, header + 8, 4), page_size)
    return n_pages


def _spill(payload: int, page_size: int, *, table_leaf: bool) -> tuple[int, int]:
    """The bytes of a cell's payload that stay in its page, and its overflow pages (SQLite file format, 1.6)."""
    most = page_size - 35 if table_leaf else (page_size - 12) * 64 // 255 - 23
    if payload <= most:
        return payload, 0
    least = (page_size - 12) * 32 // 255 - 23
    local = least + (payload - least) % (page_size - 4)
    if local > most:
        local = least
    return local, -(-(payload - local) // (page_size - 4))


def _big_endian(content: bytes, at: int, n_bytes: int) -> int:
    if at + n_bytes > len(content):
        raise IndexError(at)
    return int.from_bytes(content[at : at + n_bytes], "big")


def _varint(content: bytes, at: int) -> int:
    value = 0
    for place in range(9):
        byte = content[at + place]
        if place == 8:
            return (value << 8) | byte
        value = (value << 7) | (byte & 0x7F)
        if not byte & 0x80:
            break
    return value
