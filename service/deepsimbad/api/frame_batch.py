"""A batch of frames as an npz file, read with distrust: what it declares is judged before anything is unpacked."""

import struct
import zipfile
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import DeepSimbadError, InvalidInputError, TooLargeError
from deepsimbad.store.frames import UNKNOWN_TIMESTAMP, TraverseFrames

MEMBERS = {"encodings": 2, "index": 1, "position_m": 1, "timestamp_us": 1, "x_m": 1, "y_m": 1}
REQUIRED = ("encodings", "index", "position_m")

_END_OF_DIRECTORY = b"PK\x05\x06"
_LARGE_DIRECTORY = b"PK\x06\x07"
_MAX_HEADER_BYTES = 4096
_MAX_RATIO = 100  # of unpacked to packed; encodings shrink by a tenth, only noughts by more than a hundred
_ANY_RATIO_BYTES = 1 << 24


class InvalidBatchError(InvalidInputError):
    """A batch of frames that is not an npz file of the arrays asked for."""

    code = "invalid_batch"


def read_batch(file: IO[bytes], max_bytes: int) -> TraverseFrames:
    """Read the arrays of a batch.

    Args:
        file: The npz file, at any position.
        max_bytes: The most its arrays may hold together, unpacked.

    Returns:
        The frames, their values not yet judged; `encodings` may still be of another float type.

    Raises:
        InvalidBatchError: Not such a file; pickled objects are never read.
        TooLargeError: The arrays are larger than `max_bytes`.
    """
    try:
        _check_directory(file)
        with zipfile.ZipFile(file) as archive:
            arrays = _read_members(archive, max_bytes)
    except DeepSimbadError:
        raise
    except Exception as error:  # zipfile and numpy raise some ten kinds over a file that was meddled with
        raise InvalidBatchError("the batch is not a whole npz file as numpy.savez writes it") from error
    return _arranged(arrays)


def _check_directory(file: IO[bytes]) -> None:
    """Refuse a table of contents that could be long: zipfile would read all of it into memory."""
    size = file.seek(0, 2)
    file.seek(max(0, size - (1 << 16) - 22))
    tail = file.read()
    end = tail.rfind(_END_OF_DIRECTORY)
    if end < 0 or len(tail) - end < 22:
        raise InvalidBatchError("the batch is not a whole npz file (numpy.savez)")
    n_members, directory_bytes = struct.unpack_from("<HL", tail, end + 10)
    large = tail[max(0, end - 20) : end].startswith(_LARGE_DIRECTORY)
    if n_members > len(MEMBERS) or directory_bytes > 1 << 14 or large:
        raise InvalidBatchError(f"the batch holds more than the arrays {', '.join(MEMBERS)}", allowed=list(MEMBERS))


def _read_members(archive: zipfile.ZipFile, max_bytes: int) -> dict[str, NDArray[Any]]:
    names = [member.filename.removesuffix(".npy") for member in archive.infolist()]
    unknown = sorted(set(names) - set(MEMBERS))
    if unknown or len(names) != len(set(names)):
        raise InvalidBatchError(
            f"the batch holds arrays that are not known or stand twice; known are {', '.join(MEMBERS)}",
            allowed=list(MEMBERS),
        )
    missing = [name for name in REQUIRED if name not in names]
    if missing:
        raise InvalidBatchError(f"the batch lacks {', '.join(missing)}", missing=missing)
    declared = sum(member.file_size for member in archive.infolist())
    if declared > max_bytes:
        raise TooLargeError(
            f"the batch unpacks to {declared} bytes; at most {max_bytes} are taken, send fewer frames at once",
            max_bytes=max_bytes,
        )
    packed = sum(member.compress_size for member in archive.infolist())
    if declared > max(_ANY_RATIO_BYTES, _MAX_RATIO * packed):
        raise InvalidBatchError(f"the batch unpacks to {declared} bytes from {packed}: these are no encodings")
    for name, member in zip(names, archive.infolist(), strict=True):
        with archive.open(member) as stream:
            _check_header(name, stream, member.file_size)
    arrays = {}
    for name, member in zip(names, archive.infolist(), strict=True):
        with archive.open(member) as stream:
            arrays[name] = np.lib.format.read_array(stream, allow_pickle=False, max_header_size=_MAX_HEADER_BYTES)
            if stream.read(1):  # reading to the end is also what checks the member's checksum
                raise InvalidBatchError(f"{name} is longer than its header says")
    return arrays


def _check_header(name: str, stream: IO[bytes], member_bytes: int) -> None:
    """Refuse a shape or type that is not the array's own, before its numbers are touched."""
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise InvalidBatchError(f"{name} has npy version {version}; 1.0 and 2.0 are read")
    shape, _, dtype = readers[version](stream, max_header_size=_MAX_HEADER_BYTES)
    kinds = "fiu" if name in {"position_m", "x_m", "y_m"} else "f" if name == "encodings" else "iu"
    if dtype.kind not in kinds or dtype.itemsize > 8:
        raise InvalidBatchError(f"{name} holds {dtype}; it must hold {'floats' if 'f' in kinds else 'integers'}")
    if len(shape) != MEMBERS[name]:
        raise InvalidBatchError(f"{name} has shape {list(shape)}; it must have {MEMBERS[name]} dimensions")
    n_values = 1
    for length in shape:
        n_values *= length
    if stream.tell() + n_values * dtype.itemsize != member_bytes:
        raise InvalidBatchError(f"{name} does not hold the {n_values} numbers its header says")


def _arranged(arrays: dict[str, NDArray[Any]]) -> TraverseFrames:
    """The store's form; it judges the values."""
    n_frames = len(arrays["encodings"])
    unknown = np.full(n_frames, np.nan)
    return TraverseFrames(
        index=arrays["index"],
        position_m=arrays["position_m"],
        timestamp_us=arrays.get("timestamp_us", np.full(n_frames, UNKNOWN_TIMESTAMP)),
        x_m=arrays.get("x_m", unknown),
        y_m=arrays.get("y_m", unknown),
        encodings=arrays["encodings"],
    )
