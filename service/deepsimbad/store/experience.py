"""The experience database in a map file: at most two bytes a Q-value (II-D)."""

import math
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.errors import InvalidInputError
from deepsimbad.store.arrays import Checksum, load_arrays
from deepsimbad.store.records import from_json, to_json

EXPERIENCE_TABLE = "q_value"
_NAME = "q_values"
_CODES = np.dtype("<u2")


def save_experience(db: Database, q_values: NDArray[np.float32] | None, checksum: Checksum) -> None:
    """Write Q-values [n, a] to the nearest of 65,536 equal steps between the lowest and the highest.

    High bytes lie before low ones, so that values which are alike compress.

    Raises:
        InvalidInputError: A value is NaN or infinite.
    """
    if q_values is None:
        return
    if not np.isfinite(q_values).all():
        raise InvalidInputError("Q-values hold NaN or infinity; every one must be finite")
    lowest = float(q_values.min()) if q_values.size else 0.0
    highest = float(q_values.max()) if q_values.size else 0.0
    step = (highest - lowest) / np.iinfo(_CODES).max
    scaled = (q_values.astype(np.float64) - lowest) / step if step > 0 else np.zeros(q_values.shape)
    codes = np.ascontiguousarray(np.rint(scaled), _CODES)
    body = zlib.compress(codes.reshape(-1, 1).view(np.uint8)[:, ::-1].T.tobytes(), 6)
    shape = to_json(list(q_values.shape))
    checksum.add(EXPERIENCE_TABLE, _NAME, 0, _CODES.str, shape, repr(lowest), repr(step), body)
    db.table(EXPERIENCE_TABLE).insert(
        {
            "part": 0,
            "name": _NAME,
            "dtype": _CODES.str,
            "shape": shape,
            "lowest": lowest,
            "step": step,
            "body": body,
        }
    )


def load_experience(db: Database, table: str, checksum: Checksum) -> dict[str, NDArray[Any]]:
    """Read what `save_experience` or the first schema wrote, frozen; nothing where the map never learnt.

    Raises:
        ValueError: The row does not make up Q-values.
    """
    rows = list(db.table(table).rows_where("step IS NOT NULL"))
    if not rows:
        return load_arrays(db, table, checksum)
    row = rows[0]
    lowest, step, body = row["lowest"], row["step"], row["body"]
    checksum.add(table, row["name"], row["part"], row["dtype"], row["shape"], repr(lowest), repr(step), body)
    shape = tuple(from_json(row["shape"]))
    if len(rows) > 1 or row["name"] != _NAME or row["dtype"] != _CODES.str:
        raise ValueError(f"{table} holds what no release wrote")
    n_bytes = math.prod(shape) * _CODES.itemsize
    try:
        planes = zlib.decompressobj().decompress(body, n_bytes + 1)
    except zlib.error as error:
        raise ValueError(f"{table} is damaged: {error}") from error
    if len(planes) != n_bytes:
        raise ValueError(f"{table} is not whole")
    codes = np.frombuffer(planes, np.uint8).reshape(_CODES.itemsize, -1)[::-1].T.copy().view(_CODES).reshape(shape)
    q_values = (lowest + step * codes).astype(np.float32)
    q_values.setflags(write=False)
    return {_NAME: q_values}
