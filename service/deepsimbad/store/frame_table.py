"""A traverse's statements on frames. Every function stands inside a transaction of its caller."""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.core.drive import UNKNOWN_TIMESTAMP, Drive
from deepsimbad.errors import DamagedFileError, InvalidEncodingError, WeightsDifferError
from deepsimbad.store.arrays import is_halvable

_DTYPE_OF_BYTES = {2.0: "<f2", 4.0: "<f4"}  # by the bytes of one number
_Place = tuple[float, int | None, float | None, float | None]  # position_m, timestamp_us, x_m, y_m


def count(db: Database) -> int:
    """How many frames there are; reads no encodings."""
    (n_frames,) = db.execute("SELECT count(*) FROM frame").fetchone()
    return int(n_frames)


def encoding_dim(db: Database) -> int | None:
    """The length of the encodings; None before the first frame."""
    row = db.execute("SELECT encoding_dim FROM traverse").fetchone()
    if row is None:
        raise _damaged("it does not describe itself")
    return None if row[0] is None else int(row[0])


def weights_sha256(db: Database) -> str | None:
    """By which weights images were encoded; None where none were, or nobody knows."""
    row = db.execute("SELECT weights_sha256 FROM traverse").fetchone()
    return None if row is None else row[0]


def missing(db: Database) -> list[tuple[int, int]]:
    """The ranges [first, last] of indices below the greatest that have no frame."""
    rows = db.execute(
        """
        SELECT previous + 1, frame_index - 1 FROM (
            SELECT lag(frame_index, 1, -1) OVER (ORDER BY frame_index) AS previous, frame_index FROM frame
        ) WHERE frame_index > previous + 1 ORDER BY frame_index
        """
    )
    return [(first, last) for first, last in rows]


def upsert(db: Database, frames: Drive) -> None:
    """Store checked frames, replacing those of the same index; one row at a time, never a second copy of the batch.

    Raises:
        InvalidEncodingError: The encodings have another length than those of the traverse.
        WeightsDifferError: They were made by other weights.
    """
    dim = frames.encodings.shape[1]
    db.execute("UPDATE traverse SET encoding_dim = ? WHERE encoding_dim IS NULL", [dim])
    present_dim = encoding_dim(db)
    if dim != present_dim:
        raise InvalidEncodingError(
            f"encodings of this traverse hold {present_dim} numbers, these {dim}", encoding_dim=present_dim
        )
    _check_weights(db, frames.weights_sha256)
    db.conn.executemany(
        """
        INSERT INTO frame (frame_index, position_m, timestamp_us, x_m, y_m) VALUES (?, ?, ?, ?, ?)
        ON CONFLICT (frame_index) DO UPDATE SET position_m = excluded.position_m,
            timestamp_us = excluded.timestamp_us, x_m = excluded.x_m, y_m = excluded.y_m
        """,
        ((int(index), *_place(frames, row)) for row, index in enumerate(frames.index)),
    )
    db.conn.executemany(
        """
        INSERT INTO encoding (frame_index, checksum, body) VALUES (?, ?, ?)
        ON CONFLICT (frame_index) DO UPDATE SET checksum = excluded.checksum, body = excluded.body
        """,
        _bodies(frames),
    )


def read(db: Database) -> Drive:
    """All frames in index order, every checksum checked; one array of encodings, no copy beside it.

    Raises:
        DamagedFileError: A frame is not what was stored.
    """
    n, dim = count(db), encoding_dim(db) or 0
    frames = Drive(
        index=np.empty(n, np.int64),
        position_m=np.empty(n, np.float64),
        timestamp_us=np.empty(n, np.int64),
        x_m=np.empty(n, np.float64),
        y_m=np.empty(n, np.float64),
        encodings=np.empty((n, dim), np.float32),
        weights_sha256=weights_sha256(db),
    )
    n_read = 0
    for index, position_m, timestamp_us, x_m, y_m, encoding in _checked_rows(db, dim):
        if n_read == n:
            break
        frames.encodings[n_read] = encoding
        frames.index[n_read] = index
        frames.position_m[n_read] = position_m
        frames.timestamp_us[n_read] = UNKNOWN_TIMESTAMP if timestamp_us is None else timestamp_us
        frames.x_m[n_read] = np.nan if x_m is None else x_m
        frames.y_m[n_read] = np.nan if y_m is None else y_m
        n_read += 1
    if n_read != n:
        raise _damaged(f"it holds {n_read} frames of {n}")
    return frames


def verify(db: Database, path: Path) -> int:
    """Check every frame's checksum, holding one at a time; returns how many there are.

    Raises:
        DamagedFileError: A frame is not what was stored; names the file.
    """
    try:
        return sum(1 for _ in _checked_rows(db, encoding_dim(db) or 0))
    except DamagedFileError as error:
        raise DamagedFileError(f"{path.name}: {error.message}", file=path.name) from error


def _checked_rows(db: Database, dim: int) -> Iterator[tuple[Any, ...]]:
    """Index, place and encoding of every frame in index order; raises DamagedFileError."""
    rows = db.execute(
        """
        SELECT frame.frame_index, position_m, timestamp_us, x_m, y_m, checksum, body
        FROM frame LEFT JOIN encoding ON encoding.frame_index = frame.frame_index
        ORDER BY frame.frame_index
        """
    )
    for index, position_m, timestamp_us, x_m, y_m, checksum, body in rows:
        try:
            if _checksum((position_m, timestamp_us, x_m, y_m), body) != checksum:
                raise ValueError("the checksum differs")
            dtype = _DTYPE_OF_BYTES.get(len(body) / dim)  # a single number would be broadcast
            if dtype is None:
                raise ValueError("the encoding has another length")
            encoding = np.frombuffer(body, dtype)
        except (TypeError, ValueError, ZeroDivisionError, struct.error) as error:
            raise _damaged(f"frame {index} is not what was stored") from error
        yield index, position_m, timestamp_us, x_m, y_m, encoding


def _place(frames: Drive, row: int) -> _Place:
    timestamp_us = int(frames.timestamp_us[row])
    x_m, y_m = float(frames.x_m[row]), float(frames.y_m[row])
    return (
        float(frames.position_m[row]),
        None if timestamp_us == UNKNOWN_TIMESTAMP else timestamp_us,
        None if np.isnan(x_m) else x_m,
        None if np.isnan(y_m) else y_m,
    )


def _bodies(frames: Drive) -> Iterator[tuple[int, int, bytes]]:
    for row, index in enumerate(frames.index):
        body = _body(frames.encodings[row])
        yield int(index), _checksum(_place(frames, row), body), body


def _body(encoding: NDArray[np.float32]) -> bytes:
    return encoding.astype("<f2" if is_halvable(encoding) else "<f4").tobytes()


def _check_weights(db: Database, given: str | None) -> None:
    WeightsDifferError.check("the traverse", weights_sha256(db), "a frame", given)
    if given is not None:
        db.execute("UPDATE traverse SET weights_sha256 = ?", [given])


def _checksum(place: _Place, body: bytes) -> int:
    """CRC-32 of everything a frame holds, so that a flipped bit on the disk is seen."""
    position_m, timestamp_us, x_m, y_m = place
    packed = struct.pack(
        "<dqdd",
        position_m,
        UNKNOWN_TIMESTAMP if timestamp_us is None else timestamp_us,
        np.nan if x_m is None else x_m,
        np.nan if y_m is None else y_m,
    )
    return zlib.crc32(body, zlib.crc32(packed))


def _damaged(why: str) -> DamagedFileError:
    return DamagedFileError(f"it is damaged: {why}; delete it and upload it again")
