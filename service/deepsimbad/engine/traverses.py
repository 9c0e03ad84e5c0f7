"""Traverse files kept open while frames arrive: opening and closing one costs many times what a frame does.

Here too: the room for pictures that wait to be fitted, and the reading of batches of frames, whose declared size is
checked before anything is unpacked.
"""

import threading
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from deepsimbad.core.drive import MAX_NAME_LENGTH, Drive
from deepsimbad.errors import DeepSimbadError, InvalidBatchError, SpoolFullError, TooLargeError, UnknownTraverseError
from deepsimbad.store.traverses import Traverse

MAX_IDLE = 16


@dataclass
class _Loan:
    traverse: Traverse
    n_users: int = 0


class OpenTraverses:
    """Lends open traverses; a traverse that was dropped is closed after its last use."""

    def __init__(self, data_dir: Path) -> None:
        self._data_dir = data_dir
        self._open: OrderedDict[tuple[str, str], _Loan] = OrderedDict()
        self._lock = threading.RLock()

    @contextmanager
    def lend(self, domain: str, name: str) -> Iterator[Traverse]:
        """An open traverse inside the block, shared with other blocks; raises UnknownTraverseError."""
        key = domain, name
        with self._lock:
            if key in self._open:
                try:
                    self._open[key].traverse.check_is_there()
                except UnknownTraverseError:  # another process deleted it, and perhaps made it anew
                    self._drop(key)
            if key not in self._open:
                self._open[key] = _Loan(Traverse.open(self._data_dir, domain, name))
            self._open.move_to_end(key)
            loan = self._open[key]
            loan.n_users += 1
            idle_keys = [other for other in self._open if not self._open[other].n_users]
            for oldest_key in idle_keys[: max(0, len(self._open) - MAX_IDLE)]:
                self._drop(oldest_key)
        try:
            yield loan.traverse
        finally:
            with self._lock:
                loan.n_users -= 1
                if not loan.n_users and self._open.get(key) is not loan:
                    loan.traverse.close()

    def forget(self, domain: str, name: str | None = None) -> None:
        """Close a traverse, or all of a domain, as soon as nobody uses it."""
        with self._lock:
            for key in list(self._open):
                if key[0] == domain and name in {None, key[1]}:
                    self._drop(key)

    def close(self) -> None:
        """Close all, those in use after their last use."""
        with self._lock:
            for key in list(self._open):
                self._drop(key)

    def _drop(self, key: tuple[str, str]) -> None:
        loan = self._open.pop(key)
        if not loan.n_users:
            loan.traverse.close()


class SpoolRoom:
    """How many bytes of pictures wait in the spools of every domain, and how many may."""

    def __init__(self, data_dir: Path, max_bytes: int) -> None:
        self._data_dir, self._max_bytes = data_dir, max_bytes
        # By domain, at least as many as there are: jobs empty spools in processes of their own
        self._spooled_bytes: dict[str, int] = {}
        self._lock = threading.Lock()

    def make_room(self, domain: str, n_bytes: int) -> None:
        """Count a picture that is about to wait; raises SpoolFullError, and the traverse stays as it is."""
        with self._lock:
            spooled_bytes: dict[str, int] = {}
            if domain not in self._spooled_bytes or self._spooled_bytes[domain] + n_bytes > self._max_bytes:
                for name in Traverse.list(self._data_dir, domain):
                    with suppress(UnknownTraverseError), Traverse.open(self._data_dir, domain, name) as traverse:
                        spooled_bytes[name] = traverse.spooled_bytes
                self._spooled_bytes[domain] = sum(spooled_bytes.values())
            if self._spooled_bytes[domain] + n_bytes > self._max_bytes:
                fullest_name = max(spooled_bytes, key=lambda name: spooled_bytes[name])
                raise SpoolFullError(
                    f"{self._spooled_bytes[domain]} bytes of images wait in domain {domain} for its evaluator to be "
                    f"fitted, and {self._max_bytes} are the most: remap with the traverse that holds most of them, "
                    f"{fullest_name}, or delete it, or raise the setting max_spool_bytes; the frame was not stored",
                    limit="max_spool_bytes",
                    max_spool_bytes=self._max_bytes,
                    spooled_bytes=self._spooled_bytes[domain],
                    traverse=fullest_name,
                )
            self._spooled_bytes[domain] += n_bytes


MEMBERS = {"encodings": 2, "index": 1, "position_m": 1, "timestamp_us": 1, "x_m": 1, "y_m": 1, "name": 1}
"""Arrays that a batch may hold, and how many dimensions each has."""
REQUIRED_ARRAYS = ("encodings", "index", "position_m")
_KINDS = {"encodings": "f", "position_m": "fiu", "x_m": "fiu", "y_m": "fiu", "name": "U"}  # numpy's; else "iu"
_KIND_WORDS = {"f": "floats", "U": "texts"}
_MAX_HEADER_BYTES = 4096


def read_batch(file: IO[bytes], max_bytes: int) -> Drive:
    """Read the arrays of an npz file, whose values are not yet judged; `encodings` may still be of another float type.

    Raises:
        InvalidBatchError: Not such a file; pickled objects are never read.
        TooLargeError: The arrays are larger than `max_bytes`, unpacked.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            arrays = _arrays(archive, max_bytes)
    except DeepSimbadError:
        raise
    except Exception as error:  # zipfile and numpy raise some ten kinds over a file that was meddled with
        raise InvalidBatchError("the batch is not a whole npz file as numpy.savez writes it") from error
    return Drive(**{"frame_name" if name == "name" else name: array for name, array in arrays.items()})


def _arrays(archive: zipfile.ZipFile, max_bytes: int) -> dict[str, Any]:
    members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
    if not set(members) <= set(MEMBERS) or len(members) != len(archive.infolist()):
        message = f"the batch holds arrays that are not known or stand twice; known are {', '.join(MEMBERS)}"
        raise InvalidBatchError(message, allowed=list(MEMBERS))
    if missing := [name for name in REQUIRED_ARRAYS if name not in members]:
        raise InvalidBatchError(f"the batch lacks {', '.join(missing)}", missing=missing)
    n_bytes = sum(member.file_size for member in members.values())
    if n_bytes > max_bytes:
        message = f"the batch unpacks to {n_bytes} bytes; at most {max_bytes} are taken, send fewer frames at once"
        raise TooLargeError(message, max_bytes=max_bytes)
    arrays = {}
    for name, member in members.items():
        with archive.open(member) as stream:  # a piece at a time, into the array's own memory
            array = np.lib.format.read_array(stream, allow_pickle=False, max_header_size=_MAX_HEADER_BYTES)
            if stream.read(1):  # reading to the end is also what checks the member's checksum
                raise InvalidBatchError(f"{name} is longer than its header says")
        kinds, dtype = _KINDS.get(name, "iu"), array.dtype
        if dtype.kind not in kinds or dtype.itemsize > (4 * MAX_NAME_LENGTH if dtype.kind == "U" else 8):
            raise InvalidBatchError(f"{name} holds {dtype}; it must hold {_KIND_WORDS.get(kinds[0], 'integers')}")
        if array.ndim != MEMBERS[name]:
            raise InvalidBatchError(f"{name} has shape {list(array.shape)}; it must have {MEMBERS[name]} dimensions")
        arrays[name] = array
    return arrays
