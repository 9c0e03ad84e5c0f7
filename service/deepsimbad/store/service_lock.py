"""One service a data directory: the second is refused before it opens a file.

Two services would each keep sessions in memory that the other does not know of. Commands take no lock: the catalog's
transactions keep them and a service apart.
"""

import fcntl
import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Self

from deepsimbad.errors import DataDirInUseError, UnavailableError
from deepsimbad.store.data_dir import make_data_dir
from deepsimbad.store.faults import reason_of
from deepsimbad.store.layout import service_lock_path

_MOST_BYTES = 4096


class ServiceLock:
    """The lock of one service, held until `release` or the end of the process, however that comes.

    The file stays when the lock goes: were it removed, a third process could lock it anew beside a second that has just
    opened the old one.

    Args:
        descriptor: The locked file.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor: int | None = descriptor

    @classmethod
    def take(cls, data_dir: Path, about: str) -> Self:
        """Lock a data directory, which is made where it is missing.

        Args:
            data_dir: The folder.
            about: Where the service listens, for the message that a second one gives.

        Raises:
            DataDirInUseError: Another service has it.
            UnavailableError: The folder cannot be made or written, or its file system locks no files.
        """
        make_data_dir(data_dir)
        path = service_lock_path(data_dir)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise UnavailableError(
                f"the data directory {data_dir} cannot be used: {error.strerror}", reason=reason_of(error)
            ) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            other = _read(descriptor)
            os.close(descriptor)
            raise _in_use(data_dir, other) from error
        except OSError as error:
            os.close(descriptor)
            raise UnavailableError(
                f"the file system of the data directory {data_dir} locks no files ({error.strerror}): "
                "keep it on a local disk",
                reason=reason_of(error),
            ) from error
        with suppress(OSError):  # on a full disk the lock holds all the same, it only cannot say whose it is
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, json.dumps({"pid": os.getpid(), "address": about}).encode(), 0)
        return cls(descriptor)

    def release(self) -> None:
        """Let another service have the data directory."""
        if self._descriptor is not None:
            with suppress(OSError):
                os.ftruncate(self._descriptor, 0)
            os.close(self._descriptor)
            self._descriptor = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.release()


def _read(descriptor: int) -> dict[str, object]:
    """What the other wrote; nothing where it has not come to that yet."""
    try:
        other = json.loads(os.pread(descriptor, _MOST_BYTES, 0))
    except (OSError, ValueError):
        return {}
    return other if isinstance(other, dict) else {}


def _in_use(data_dir: Path, other: dict[str, object]) -> DataDirInUseError:
    whose = f"process {other.get('pid', 'unknown')}, listening on {other.get('address', 'an unknown address')}"
    return DataDirInUseError(
        f"another service ({whose}) runs on the data directory {data_dir}: stop it, or name another --data-dir",
        pid=other.get("pid"),
        address=other.get("address"),
    )
