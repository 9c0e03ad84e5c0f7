"""Named arrays in the array tables of a map file, which all have one layout; one of them may be packed."""

import math
import zlib
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.errors import InvalidInputError
from deepsimbad.store.records import from_json, to_json

PART_BYTES = 16 * 2**20  # far below SQLite's limit for a value, and all that is held beside the array itself
_CODES = np.dtype("<u2")
_TEXT_BYTES = 4 * 256  # most that one text takes


def save_arrays(db: Database, table: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays into an array table; raises InvalidInputError where one does not hold plain numbers."""
    for name, array in sorted(arrays.items()):
        if array.dtype.kind not in "fiu":
            raise InvalidInputError(f"array {name} of {table} holds {array.dtype}, not numbers")
        dtype = np.dtype("<f2") if is_halvable(array) else array.dtype.newbyteorder("<")
        shape, numbers = to_json(list(array.shape)), np.ascontiguousarray(array).reshape(-1)
        a_part = PART_BYTES // dtype.itemsize
        for part, start in enumerate(range(0, max(numbers.size, 1), a_part)):
            body = numbers[start : start + a_part].astype(dtype).tobytes()
            db.table(table).insert({"name": name, "part": part, "dtype": dtype.str, "shape": shape, "body": body})


def load_arrays(db: Database, table: str) -> dict[str, NDArray[Any]]:
    """Read the named arrays of an array table, frozen; float16 comes back as float32.

    Raises ValueError: the rows do not make up arrays.
    """
    arrays: dict[str, NDArray[Any]] = {}
    n_filled: dict[str, int] = {}
    sizes: Counter[str] = Counter()
    for row in db.table(table).rows_where(select="name, length(body) AS n_bytes"):
        sizes[row["name"]] += row["n_bytes"]
    for row in db.table(table).rows_where(order_by="name, part"):
        name, dtype, body = row["name"], np.dtype(row["dtype"]), row["body"]
        if name not in arrays:
            dimensions = tuple(from_json(row["shape"]))
            if dtype.kind not in "fiu" or math.prod(dimensions) * dtype.itemsize != sizes[name]:  # before room is made
                raise ValueError(f"array {name} of {table} is not whole, or holds no numbers")
            arrays[name], n_filled[name] = np.empty(dimensions, dtype), 0
        octets = arrays[name].reshape(-1).view(np.uint8)
        octets[n_filled[name] : n_filled[name] + len(body)] = np.frombuffer(body, np.uint8)
        n_filled[name] += len(body)
    for name, array in arrays.items():
        if array.dtype == np.float16:
            arrays[name] = array.astype(np.float32)
        arrays[name].setflags(write=False)
    return arrays


def is_halvable(numbers: NDArray[Any]) -> bool:
    """Whether float32 lose nothing as float16: our networks' encodings are rounded to that."""
    if numbers.dtype != np.float32:
        return False
    numbers_1d = numbers.reshape(-1)
    with np.errstate(over="ignore"):
        parts = (numbers_1d[start : start + PART_BYTES // 4] for start in range(0, numbers_1d.size, PART_BYTES // 4))
        return all(np.array_equal(part.astype(np.float16), part) for part in parts)


def save_packed(db: Database, table: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write at most one array at two bytes a number: the nearest of 65,536 equal steps from its lowest to its highest.

    High bytes lie before low ones, so that values which are alike compress. Raises InvalidInputError on NaN.
    """
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise InvalidInputError(f"{name} holds NaN or infinity; every one must be finite")
        lowest, highest = (float(array.min()), float(array.max())) if array.size else (0.0, 0.0)
        step = (highest - lowest) / np.iinfo(_CODES).max
        steps = (array.astype(np.float64) - lowest) / step if step > 0 else np.zeros(array.shape)
        codes = np.ascontiguousarray(np.rint(steps), _CODES)
        body = zlib.compress(codes.reshape(-1, 1).view(np.uint8)[:, ::-1].T.tobytes(), 6)
        shape = to_json(list(array.shape))
        row = {"part": 0, "name": name, "dtype": _CODES.str, "shape": shape, "lowest": lowest, "step": step}
        db.table(table).insert({**row, "body": body})


def load_packed(db: Database, table: str) -> dict[str, NDArray[Any]]:
    """Read what `save_packed` wrote; nothing where the map never learnt.

    Raises ValueError: the row does not make up an array.
    """
    rows = list(db.table(table).rows)
    if not rows:
        return {}
    row = rows[0]
    lowest, step, body = row["lowest"], row["step"], row["body"]
    shape = tuple(from_json(row["shape"]))
    n_bytes = math.prod(shape) * _CODES.itemsize
    try:
        planes = zlib.decompressobj().decompress(body, n_bytes + 1)
    except zlib.error as error:
        raise ValueError(f"{table} is damaged: {error}") from error
    if len(rows) > 1 or row["dtype"] != _CODES.str or len(planes) != n_bytes:
        raise ValueError(f"{table} holds what no release wrote")
    codes = np.frombuffer(planes, np.uint8).reshape(_CODES.itemsize, -1)[::-1].T.copy().view(_CODES).reshape(shape)
    return {row["name"]: (lowest + step * codes).astype(np.float32)}


def pack_texts(texts: NDArray[np.str_]) -> NDArray[np.uint8]:
    """Texts [n] without line breaks as bytes, which an older release keeps without understanding them."""
    return np.frombuffer(zlib.compress("\n".join(texts.tolist()).encode(), 6), np.uint8).copy()


def unpack_texts(packed: NDArray[np.uint8], n_texts: int) -> NDArray[np.str_]:
    """Read what `pack_texts` made; raises ValueError where they are not `n_texts` texts."""
    try:
        body = zlib.decompressobj().decompress(packed.tobytes(), n_texts * _TEXT_BYTES)
    except zlib.error as error:
        raise ValueError(f"texts are damaged: {error}") from error
    texts = body.decode().split("\n")
    if len(texts) != n_texts:
        raise ValueError(f"{len(texts)} texts of {n_texts}")
    return np.array(texts)
