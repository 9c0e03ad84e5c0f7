"""The data directory itself: made, or refused by name, and held by one service at a time.

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
from deepsimbad.store.durable import lock_folder
from deepsimbad.store.faults import reason_of
from deepsimbad.store.layout import service_lock_path

PRIVATE = 0o700
"""Rights of a data directory that we make: nobody else comes as far as what is in it."""


def make_data_dir(data_dir: Path) -> None:
    """Make the folder, which its owner alone may enter, and those above it where they are missing.

    Raises:
        UnavailableError: It cannot be: `hints["reason"]` is read_only, missing, disk_full, ...
    """
    try:
        data_dir.mkdir(PRIVATE, parents=True, exist_ok=True)
    except OSError as error:
        raise UnavailableError(
            f"the data directory {data_dir} cannot be made: {error.strerror}", reason=reason_of(error)
        ) from error


class ServiceLock:
    """A data directory held by one service until `release` or the end of the process, however that comes.

    The folder itself is locked, which cannot be taken away while its files are in use; a file in it says whose it is.

    Args:
        data_dir: The folder.
        descriptor: The same, open and locked.
    """

    def __init__(self, data_dir: Path, descriptor: int) -> None:
        self._about = service_lock_path(data_dir)
        self._descriptor: int | None = descriptor

    @classmethod
    def take(cls, data_dir: Path, about: str) -> Self:
        """Lock a data directory, which is made where it is missing.

        Args:
            data_dir: The folder.
            about: Where the service listens, for the message that a second one gives.

        Raises:
            DataDirInUseError: Another service has it.
            UnavailableError: The folder cannot be made or written, or its file system locks nothing.
        """
        make_data_dir(data_dir)
        file = service_lock_path(data_dir)
        try:
            descriptor = lock_folder(data_dir, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UnavailableError(
                f"the data directory {data_dir} cannot be locked ({error.strerror}): keep it on a local disk",
                reason=reason_of(error),
            ) from error
        if descriptor is None:
            raise _in_use(data_dir, file)
        try:
            file.write_text(json.dumps({"pid": os.getpid(), "address": about}), encoding="utf-8")
        except OSError as error:
            if reason_of(error) != "disk_full":  # then the lock holds all the same, it only cannot say whose it is
                os.close(descriptor)
                raise UnavailableError(
                    f"the data directory {data_dir} cannot be used: {error.strerror}", reason=reason_of(error)
                ) from error
        return cls(data_dir, descriptor)

    def release(self) -> None:
        """Let another service have the data directory."""
        if self._descriptor is not None:
            with suppress(OSError):
                self._about.unlink()
            os.close(self._descriptor)
            self._descriptor = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.release()


def _in_use(data_dir: Path, file: Path) -> DataDirInUseError:
    other: dict[str, object] = {}
    with suppress(OSError, ValueError):  # it may not have come to that yet
        other = dict(json.loads(file.read_text(encoding="utf-8")))
    whose = f"process {other.get('pid', 'unknown')}, listening on {other.get('address', 'an unknown address')}"
    return DataDirInUseError(
        f"another service ({whose}) runs on the data directory {data_dir}: stop it, or name another --data-dir",
        pid=other.get("pid"),
        address=other.get("address"),
    )
