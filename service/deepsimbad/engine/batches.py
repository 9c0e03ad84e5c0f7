"""Batches of frames, read with distrust: what one declares is judged before anything of it is unpacked."""

import math
import struct
import zipfile
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.drive import MAX_NAME_LENGTH, Drive
from deepsimbad.core.frames import UNKNOWN_TIMESTAMP
from deepsimbad.errors import DeepSimbadError, InvalidBatchError, TooLargeError

MEMBERS = {"encodings": 2, "index": 1, "position_m": 1, "timestamp_us": 1, "x_m": 1, "y_m": 1, "name": 1}
"""Arrays that a batch may hold, and how many dimensions each has."""
REQUIRED = ("encodings", "index", "position_m")
_KINDS = {"encodings": "f", "position_m": "fiu", "x_m": "fiu", "y_m": "fiu", "name": "U"}  # numpy's; else "iu"
_KIND_WORDS = {"f": "floats", "U": "texts"}
_END_OF_DIRECTORY, _LARGE_DIRECTORY = b"PK\x05\x06", b"PK\x06\x07"
_MAX_HEADER_BYTES = 4096


def read_batch(file: IO[bytes], max_bytes: int) -> Drive:
    """Read the arrays of an npz file, whose values are not yet judged; `encodings` may still be of another float type.

    Raises:
        InvalidBatchError: Not such a file; pickled objects are never read.
        TooLargeError: The arrays are larger than `max_bytes`, unpacked.
    """
    try:
        _check_directory(file)
        with zipfile.ZipFile(file) as archive:
            arrays = _arrays(archive, max_bytes)
    except DeepSimbadError:
        raise
    except Exception as error:  # zipfile and numpy raise some ten kinds over a file that was meddled with
        raise InvalidBatchError("the batch is not a whole npz file as numpy.savez writes it") from error
    n_frames = len(arrays["encodings"])
    unknown = np.full(n_frames, np.nan)
    return Drive(
        index=arrays["index"],
        position_m=arrays["position_m"],
        timestamp_us=arrays.get("timestamp_us", np.full(n_frames, UNKNOWN_TIMESTAMP)),
        x_m=arrays.get("x_m", unknown),
        y_m=arrays.get("y_m", unknown),
        frame_name=arrays.get("name", np.full(n_frames, "")),
        encodings=arrays["encodings"],
    )


def _check_directory(file: IO[bytes]) -> None:
    """Refuse a table of contents that could be long: zipfile would read all of it into memory."""
    size = file.seek(0, 2)
    file.seek(max(0, size - (1 << 16) - 22))
    tail = file.read()
    end = tail.rfind(_END_OF_DIRECTORY)
    if end < 0 or len(tail) - end < 22:
        raise InvalidBatchError("the batch is not a whole npz file (numpy.savez)")
    n_members, directory_bytes = struct.unpack_from("<HL", tail, end + 10)
    is_large = tail[max(0, end - 20) : end].startswith(_LARGE_DIRECTORY)
    if n_members > len(MEMBERS) or directory_bytes > 1 << 14 or is_large:
        raise InvalidBatchError(f"the batch holds more than the arrays {', '.join(MEMBERS)}", allowed=list(MEMBERS))


def _arrays(archive: zipfile.ZipFile, max_bytes: int) -> dict[str, NDArray[Any]]:
    members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
    if not set(members) <= set(MEMBERS) or len(members) != len(archive.infolist()):
        what = f"the batch holds arrays that are not known or stand twice; known are {', '.join(MEMBERS)}"
        raise InvalidBatchError(what, allowed=list(MEMBERS))
    if missing := [name for name in REQUIRED if name not in members]:
        raise InvalidBatchError(f"the batch lacks {', '.join(missing)}", missing=missing)
    n_bytes = sum(member.file_size for member in members.values())
    if n_bytes > max_bytes:
        what = f"the batch unpacks to {n_bytes} bytes; at most {max_bytes} are taken, send fewer frames at once"
        raise TooLargeError(what, max_bytes=max_bytes)
    arrays = {}
    for name, member in members.items():
        with archive.open(member) as stream:
            _check_header(name, stream, member.file_size)
        with archive.open(member) as stream:  # from its beginning; a piece at a time, into the array's own memory
            arrays[name] = np.lib.format.read_array(stream, allow_pickle=False, max_header_size=_MAX_HEADER_BYTES)
            if stream.read(1):  # reading to the end is also what checks the member's checksum
                raise InvalidBatchError(f"{name} is longer than its header says")
    return arrays


def _check_header(name: str, stream: IO[bytes], n_bytes: int) -> None:
    """Refuse a shape or type that is not the array's own, before room is made for its numbers."""
    version = np.lib.format.read_magic(stream)
    if version not in {(1, 0), (2, 0)}:
        raise InvalidBatchError(f"{name} has npy version {version}; 1.0 and 2.0 are read")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream, max_header_size=_MAX_HEADER_BYTES)
    kinds = _KINDS.get(name, "iu")
    if dtype.kind not in kinds or dtype.itemsize > (4 * MAX_NAME_LENGTH if dtype.kind == "U" else 8):
        raise InvalidBatchError(f"{name} holds {dtype}; it must hold {_KIND_WORDS.get(kinds[0], 'integers')}")
    if len(shape) != MEMBERS[name]:
        raise InvalidBatchError(f"{name} has shape {list(shape)}; it must have {MEMBERS[name]} dimensions")
    if stream.tell() + math.prod(shape) * dtype.itemsize != n_bytes:
        raise InvalidBatchError(f"{name} does not hold the {math.prod(shape)} numbers its header says")
