"""Whether the write-ahead log beside a SQLite file is whole.

After a crash SQLite takes from the log what it can verify and silently forgets the rest. That is right for a
transaction that was being written, and wrong for one that was acknowledged and then damaged on the disk: it would be
lost without a word. So the log is looked through before SQLite sees it; only its last transaction can be one that was
never acknowledged, since every commit waits for the disk (synchronous FULL). Its format is described at
https://sqlite.org/fileformat2.html#walformat.
"""

import functools
import struct
import time
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import DamagedFileError
from deepsimbad.store.faults import storage_faults

_MAGIC = {0x377F0682: "<u4", 0x377F0683: ">u4"}  # the order of the bytes that the checksums add up
_HEADER_BYTES, _FRAME_HEADER_BYTES = 32, 24
_BYTES_AT_ONCE = 8 * 1024 * 1024
_LOOKS, _PAUSE_S = 3, 0.02  # a writer that is at work looks like damage for a moment


def check_log(database: Path) -> None:
    """Check the log of a SQLite file, if it has one; call it before the file is opened.

    Raises:
        DamagedFileError: Transactions in the log were committed and cannot be read any more. Nothing is changed.
        UnavailableError: The log cannot be read.
    """
    log = database.with_name(f"{database.name}-wal")
    with storage_faults(log):
        places = set()
        for _ in range(_LOOKS):
            place = _first_damage(log)
            if place is None:
                return
            places.add(place)
            time.sleep(_PAUSE_S)
        if len(places) > 1:  # it moves: somebody writes
            return
    raise DamagedFileError(
        f"{log.name} is damaged at byte {place}: changes that were acknowledged can no longer be read. Restore a "
        f"backup, or go on with what lies before it: sqlite3 {database.name} 'PRAGMA wal_checkpoint(TRUNCATE)'",
        file=log.name,
        byte=place,
    )


@dataclass(frozen=True)
class _Frames:
    """Some frames of a log: [n, 6] their headers, and [n, 2] what each adds to the checksum of the one before."""

    fields: NDArray[np.uint32]
    added: NDArray[np.uint32]


def _first_damage(log: Path) -> int | None:
    """Where a whole log ends too early, as an offset in the file; None where nothing committed is behind it."""
    try:
        stream = log.open("rb")
    except FileNotFoundError:
        return None
    with stream:
        header = stream.read(_HEADER_BYTES)
        stream.seek(0, 2)
        n_bytes = stream.tell()
        if n_bytes <= _HEADER_BYTES:
            return None  # nothing was written yet, or the header is being written
        magic, _, page_size, generation, *_ = struct.unpack(">8I", header)
        if magic not in _MAGIC or page_size not in {2**power for power in range(9, 17)} or not _is_whole(header):
            return 0
        return _damaged_frame(stream, header, page_size, is_first=generation == 0, n_bytes=n_bytes)


def _damaged_frame(stream: BinaryIO, header: bytes, page_size: int, *, is_first: bool, n_bytes: int) -> int | None:
    frame_bytes = _FRAME_HEADER_BYTES + page_size
    salts, before = np.frombuffer(header, ">u4")[4:6], np.frombuffer(header, ">u4")[6:8].astype(np.uint32)
    power, _, _ = _weights(page_size)
    stream.seek(_HEADER_BYTES)
    n_at_once = max(1, _BYTES_AT_ONCE // frame_bytes)
    n_seen, first_bad, n_lost = 0, None, 0
    is_torn = False
    while block := stream.read(n_at_once * frame_bytes):
        n = len(block) // frame_bytes
        if n == 0:
            break
        frames = _frames(block, header, page_size)
        is_current = (frames.fields[:, 2:4] == salts).all(axis=1)
        is_commit = is_current & (frames.fields[:, 1] != 0)
        is_stale = (frames.fields[:, 2:4] != salts).all(axis=1)  # a flipped byte changes one of the two salts
        stored = frames.fields[:, 4:6]
        n_commits = int(is_commit.sum())
        if first_bad is None:
            follows = np.concatenate([before[np.newaxis], stored[:-1]]) @ power.T + frames.added
            is_good = is_current & (follows == stored).all(axis=1)
            if not is_good.all():
                bad = int(np.argmin(is_good))
                first_bad = n_seen + bad
                ends_the_file = _HEADER_BYTES + (first_bad + 1) * frame_bytes == n_bytes
                # A slot that was used before may hold a new header over an old page after a kill; a fresh one cannot.
                if is_first and ends_the_file and frames.fields[bad, 1] != 0:
                    return _HEADER_BYTES + first_bad * frame_bytes
                is_torn = bool(is_stale[bad : bad + 2].any())
                n_commits = int(is_commit[bad + 1 :].sum())
            else:
                n_commits = 0
            before = stored[-1]
        elif first_bad == n_seen - 1:  # the last of the block before
            is_torn = is_torn or bool(is_stale[0])
        n_lost += n_commits
        n_seen += n
    # A power cut while one transaction is being written leaves pages of it out in any order: the slot of one that is
    # missing, or the one behind it, is as the log's generation before left it. It was the last, and not acknowledged.
    is_damaged = n_lost > 1 or (n_lost == 1 and not is_torn)
    return _HEADER_BYTES + first_bad * frame_bytes if is_damaged and first_bad is not None else None


def _frames(block: bytes, header: bytes, page_size: int) -> _Frames:
    """The whole frames of a block; one that is cut short at the end is left out."""
    frame_bytes = _FRAME_HEADER_BYTES + page_size
    n = len(block) // frame_bytes
    raw = np.frombuffer(block, np.uint8, n * frame_bytes).reshape(n, frame_bytes)
    fields = np.ascontiguousarray(raw[:, :_FRAME_HEADER_BYTES]).view(">u4").astype(np.uint32)
    order = _MAGIC[struct.unpack(">I", header[:4])[0]]
    numbers = np.concatenate([raw[:, :8], raw[:, _FRAME_HEADER_BYTES:]], axis=1)
    _, even, odd = _weights(page_size)
    words = np.ascontiguousarray(numbers).view(order).astype(np.uint32).reshape(n, -1, 2)
    added = words[:, :, 0] @ even + words[:, :, 1] @ odd
    return _Frames(fields, added.astype(np.uint32))


def _is_whole(header: bytes) -> bool:
    """Whether the log's own header matches its checksum."""
    first = second = 0
    words = np.frombuffer(header, _MAGIC[struct.unpack(">I", header[:4])[0]], 6).tolist()
    for even, odd in zip(words[::2], words[1::2], strict=True):
        first = (first + even + second) % 2**32
        second = (second + odd + first) % 2**32
    return (first, second) == struct.unpack(">2I", header[24:])


@functools.lru_cache
def _weights(page_size: int) -> tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32]]:
    """The checksum of a frame as one linear map modulo 2^32.

    SQLite adds two words at a time: first += even + second, then second += odd + first.

    Returns:
        [2, 2] what the checksum before contributes, [m, 2] what every even word does, [m, 2] what every odd one does.
    """
    n_pairs = (8 + page_size) // 8
    even, odd = np.empty((n_pairs, 2), np.uint32), np.empty((n_pairs, 2), np.uint32)
    a, b, c, d = 1, 0, 0, 1  # the map of all pairs behind this one
    for pair in range(n_pairs - 1, -1, -1):
        even[pair] = (a + b) % 2**32, (c + d) % 2**32
        odd[pair] = b, d
        a, b, c, d = ((a + b) % 2**32, (a + 2 * b) % 2**32, (c + d) % 2**32, (c + 2 * d) % 2**32)
    return np.array([[a, b], [c, d]], np.uint32), even, odd
