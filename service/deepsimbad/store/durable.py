"""Files that are on the disk when we say so, and their digests."""

import errno
import fcntl
import hashlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from deepsimbad.errors import ConflictError, InvalidInputError

_GRAVE_PREFIX = ".removing-"
_NO_HARD_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK, errno.EACCES}


def sync(path: Path) -> None:
    """Wait until a file's content, or a folder's entries (new, renamed or removed files), are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def written_aside(file: Path, what: str) -> Iterator[Path]:
    """Let a new file appear whole or not at all, and never in the place of another.

    Args:
        file: The file.
        what: It is, for messages: "a backup".

    Yields:
        A path to write it at, in a folder beside it that holds whatever else is needed meanwhile and goes away.

    Raises:
        InvalidInputError: There is no folder for it.
        ConflictError: There is a file of that name.
        OSError: The disk is full, ...
    """
    taken = ConflictError(f"{file} exists: {what} never replaces a file, choose another name")
    if not file.parent.is_dir():
        raise InvalidInputError(f"there is no folder {file.parent} for {what}")
    if file.exists():
        raise taken
    folder = Path(tempfile.mkdtemp(prefix=f".{file.name}.", suffix=".part", dir=file.parent))
    try:
        new = folder / file.name
        yield new
        sync(new)
        try:
            os.link(new, file)  # unlike a rename it never replaces
        except OSError as error:
            if file.exists():
                raise taken from error
            if error.errno not in _NO_HARD_LINKS:
                raise
            new.rename(file)
        sync(file.parent)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def sha256_of(path: Path) -> str:
    """The file's SHA-256 in lower-case hex, read in pieces."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def remove_database(path: Path) -> bool:
    """Remove a SQLite file with its side files; returns whether the file was there.

    The file itself goes first: a journal without its file is ignored, a file without its journal may be wrong.
    """
    existed = path.exists()
    path.unlink(missing_ok=True)
    for suffix in ("-journal", "-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    return existed


def bury(folder: Path) -> None:
    """Take a folder out of sight by one rename; `empty_graves` removes its content, which may take long."""
    if folder.exists():
        folder.rename(folder.with_name(f"{_GRAVE_PREFIX}{secrets.token_hex(8)}"))
        sync(folder.parent)


def empty_graves(parent: Path) -> None:
    """Remove what was buried in a folder, also by others who may be at it now."""
    for grave in parent.glob(f"{_GRAVE_PREFIX}*"):
        shutil.rmtree(grave, ignore_errors=True)


def lock_folder(folder: Path, operation: int) -> int | None:
    """Open and lock a folder; the lock ends with the descriptor, or with the process in any way.

    Args:
        folder: Which; its name leads to the folder that was locked.
        operation: As of `fcntl.flock`.

    Returns:
        The descriptor; None: LOCK_NB was asked for and another holds it.

    Raises:
        OSError: There is no such folder, or its file system locks nothing.
    """
    while True:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(descriptor, operation)
            if folder.stat().st_ino == os.fstat(descriptor).st_ino:  # else another has taken its place meanwhile
                return descriptor
        except BlockingIOError:
            os.close(descriptor)
            return None
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
