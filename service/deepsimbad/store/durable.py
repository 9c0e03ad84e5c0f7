"""Files and folders that are on the disk when we say so, who holds them, and what the disk and SQLite can answer."""

import errno
import fcntl
import hashlib
import json
import os
import secrets
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from deepsimbad.errors import (
    ConflictError,
    DamagedFileError,
    DamagedMapError,
    DataDirInUseError,
    InvalidInputError,
    UnavailableError,
)
from deepsimbad.store.layout import service_lock_path

PRIVATE = 0o700
"""Rights of a data directory that we make: nobody else comes as far as what is in it."""
_GRAVE_PREFIX = ".removing-"
_REASONS_BY_ERRNO = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "disk_full"),
    **dict.fromkeys((errno.EROFS, errno.EACCES, errno.EPERM), "read_only"),
    **dict.fromkeys((errno.EMFILE, errno.ENFILE), "too_many_open_files"),
    **dict.fromkeys((errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS), "no_locks"),
    **dict.fromkeys((errno.EEXIST, errno.ENOTDIR), "no_folder"),
    errno.ENOENT: "missing",
}
_REASONS_BY_SQLITE = {  # primary result codes, but for the second
    sqlite3.SQLITE_FULL: "disk_full",
    sqlite3.SQLITE_IOERR_SHMSIZE: "disk_full",  # who reads a file with a write-ahead log needs 32 kB beside it
    sqlite3.SQLITE_READONLY: "read_only",
    sqlite3.SQLITE_PERM: "read_only",
    sqlite3.SQLITE_BUSY: "busy",
    sqlite3.SQLITE_LOCKED: "busy",
    sqlite3.SQLITE_PROTOCOL: "busy",
    sqlite3.SQLITE_CANTOPEN: "cannot_open",
    sqlite3.SQLITE_IOERR: "io_error",
    sqlite3.SQLITE_NOMEM: "out_of_memory",
    sqlite3.SQLITE_MISUSE: "closed",
}
_INPUT_CODES = (sqlite3.SQLITE_TOOBIG, sqlite3.SQLITE_CONSTRAINT, sqlite3.SQLITE_RANGE)
_SENTENCES = {
    "disk_full": "no space is left to write it: free some and try again",
    "read_only": "it may not be written",
    "busy": "another process keeps it locked: try again",
    "cannot_open": "it cannot be opened",
    "missing": "it is not there",
    "no_folder": "a file is where a folder should be",
    "io_error": "the disk failed to read or write it",
    "too_many_open_files": "too many files are open",
    "out_of_memory": "no memory is left",
    "closed": "it is closed",
    "no_locks": "its file system locks no files: keep the data directory on a local disk",
}


@contextmanager
def storage_faults(
    path: Path, damage_error: type[DamagedFileError | DamagedMapError] = DamagedFileError
) -> Iterator[None]:
    """Turn what SQLite and the system raise inside the block into errors of the product that name the file.

    UnavailableError where the disk is full, read-only, busy, ... (`hints["reason"]`), `damage_error` where the content
    is not that of such a file, InvalidInputError where the schema refuses a value.
    """
    try:
        yield
    except (sqlite3.Error, UnicodeDecodeError, json.JSONDecodeError) as error:
        # Errors that Python's driver raises by itself carry no code: text that is not UTF-8, or a closed connection.
        code = getattr(error, "sqlite_errorcode", 0)
        code = code if code in _REASONS_BY_SQLITE else code & 0xFF
        if isinstance(error, sqlite3.ProgrammingError) and "closed" in str(error):
            code = sqlite3.SQLITE_MISUSE
        if code in _INPUT_CODES:
            raise InvalidInputError(f"{path.name} cannot hold this: {error}") from error
        if code not in _REASONS_BY_SQLITE:
            raise damage_error(f"{path.name} is damaged: {error}", file=path.name) from error
        raise _unavailable(path, _REASONS_BY_SQLITE[code]) from error
    except MemoryError as error:  # SQLite's is raised as this one too
        raise _unavailable(path, "out_of_memory") from error
    except OSError as error:
        raise _unavailable(path, _REASONS_BY_ERRNO.get(error.errno or 0, "io_error")) from error


def _unavailable(path: Path, reason: str) -> UnavailableError:
    return UnavailableError(f"{path.name}: {_SENTENCES[reason]}", reason=reason, file=path.name)


def sync(path: Path) -> None:
    """Wait until a file's content, or a folder's entries (new, renamed or removed files), are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def written_aside(file: Path, label: str) -> Iterator[Path]:
    """Let a new file, which errors call `label` ("a backup"), appear whole or not at all, and never replace another.

    Yields a path to write it at, in a folder beside it that holds whatever else is needed meanwhile and goes away.

    Raises:
        InvalidInputError: There is no folder for it.
        ConflictError: There is a file of that name.
        OSError: The disk is full, ...
    """
    conflict = ConflictError(f"{file} exists: {label} never replaces a file, choose another name")
    if not file.parent.is_dir():
        raise InvalidInputError(f"there is no folder {file.parent} for {label}")
    if file.exists():
        raise conflict
    folder = Path(tempfile.mkdtemp(prefix=f".{file.name}.", suffix=".part", dir=file.parent))
    try:
        new_path = folder / file.name
        yield new_path
        sync(new_path)
        try:
            os.link(new_path, file)  # unlike a rename it never replaces
        except FileExistsError as error:
            raise conflict from error
        except OSError:  # a file system without hard links
            new_path.rename(file)
        sync(file.parent)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def sha256_of(path: Path) -> str:
    """The file's SHA-256 in lower-case hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def verify(path: Path, sha256: str) -> None:
    """Check a sealed file against the digest the catalog keeps.

    Raises:
        DamagedMapError: The file is missing or not the one that was sealed.
        UnavailableError: The disk failed, ...
    """
    if not path.is_file():
        raise DamagedMapError(f"{path.name} is missing", file=path.name)
    with storage_faults(path, DamagedMapError):
        digest = sha256_of(path)
    if digest != sha256:
        raise DamagedMapError(
            f"{path.name} is not the file that was sealed: its SHA-256 differs", file=path.name, sha256=digest
        )


def remove_database(path: Path) -> bool:
    """Remove a SQLite file with its side files; returns whether the file was there.

    The file itself goes first: a journal without its file is ignored, a file without its journal may be wrong.
    """
    was_there = path.exists()
    for suffix in ("", "-journal", "-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    return was_there


def bury(folder: Path) -> None:
    """Take a folder out of sight by one rename; `empty_graves` removes its content, which may take long."""
    if folder.exists():
        folder.rename(folder.with_name(f"{_GRAVE_PREFIX}{secrets.token_hex(8)}"))
        sync(folder.parent)


def empty_graves(parent: Path) -> None:
    """Remove what was buried in a folder, also by others who may be at it now."""
    for grave in parent.glob(f"{_GRAVE_PREFIX}*"):
        shutil.rmtree(grave, ignore_errors=True)


def lock_folder(folder: Path, operation: int) -> int:
    """Open and lock a folder (`fcntl.flock`); the lock ends with the descriptor, or with the process in any way.

    Raises OSError: BlockingIOError where LOCK_NB was asked for and another holds it.
    """
    while True:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(descriptor, operation)
            if folder.stat().st_ino == os.fstat(descriptor).st_ino:  # else another has taken its place meanwhile
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def make_data_dir(data_dir: Path) -> None:
    """Make the folder, which its owner alone may enter, and those above it where they are missing."""
    with storage_faults(data_dir):
        data_dir.mkdir(PRIVATE, parents=True, exist_ok=True)


@contextmanager
def service_lock(data_dir: Path, description: str) -> Iterator[None]:
    """Hold a data directory, made where it is missing, as its one service until the end of the block or process.

    Two services would each keep sessions in memory that the other does not know of; commands take no lock. The folder
    itself is locked, which cannot be taken away while its files are in use; a file in it holds the `description`: where
    the service listens, or what has the folder instead of one.

    Raises:
        DataDirInUseError: Another service has it.
        UnavailableError: The folder cannot be made or written, or its file system locks nothing.
    """
    make_data_dir(data_dir)
    file = service_lock_path(data_dir)
    with storage_faults(data_dir):
        try:
            descriptor = lock_folder(data_dir, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder: dict[str, object] = {}
            with suppress(OSError, ValueError):  # it may not have come to that yet
                holder = dict(json.loads(file.read_text(encoding="utf-8")))
            pid, address = holder.get("pid"), holder.get("address")
            raise DataDirInUseError(
                f"another service (process {pid or 'unknown'}, listening on {address or 'an unknown address'}) runs on "
                f"the data directory {data_dir}: stop it, or name another --data-dir",
                pid=pid,
                address=address,
            ) from error
    try:
        with storage_faults(data_dir):
            try:
                file.write_text(json.dumps({"pid": os.getpid(), "address": description}), encoding="utf-8")
            except OSError as error:
                if error.errno != errno.ENOSPC:  # then it holds all the same, and only cannot say whose it is
                    raise
        yield
    finally:
        with suppress(OSError):
            file.unlink()
        os.close(descriptor)
