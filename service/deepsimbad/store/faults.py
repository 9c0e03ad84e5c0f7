"""What the disk and SQLite can answer, said in the product's own errors."""

import errno
import json
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from deepsimbad.errors import DamagedFileError, DamagedMapError, InvalidInputError, UnavailableError

_REASONS_BY_ERRNO = {
    errno.ENOSPC: "disk_full",
    errno.EDQUOT: "disk_full",
    errno.EFBIG: "disk_full",
    errno.EROFS: "read_only",
    errno.EACCES: "read_only",
    errno.EPERM: "read_only",
    errno.EMFILE: "too_many_open_files",
    errno.ENFILE: "too_many_open_files",
    errno.ENOENT: "missing",
    errno.ENOLCK: "no_locks",
    errno.EOPNOTSUPP: "no_locks",
    errno.ENOSYS: "no_locks",
}
_REASONS_BY_SQLITE = {  # primary result codes
    sqlite3.SQLITE_FULL: "disk_full",
    sqlite3.SQLITE_READONLY: "read_only",
    sqlite3.SQLITE_PERM: "read_only",
    sqlite3.SQLITE_BUSY: "busy",
    sqlite3.SQLITE_LOCKED: "busy",
    sqlite3.SQLITE_CANTOPEN: "cannot_open",
    sqlite3.SQLITE_IOERR: "io_error",
    sqlite3.SQLITE_PROTOCOL: "busy",
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
    "io_error": "the disk failed to read or write it",
    "too_many_open_files": "too many files are open",
    "out_of_memory": "no memory is left",
    "closed": "it is closed",
    "no_locks": "its file system locks no files: keep the data directory on a local disk",
}


@contextmanager
def storage_faults(path: Path, damaged: type[DamagedFileError | DamagedMapError] = DamagedFileError) -> Iterator[None]:
    """Turn what SQLite and the system raise inside the block into errors of the product, causes chained.

    Args:
        path: The file at work, named in the message.
        damaged: What a file that is not what it should be becomes.

    Raises:
        UnavailableError: The disk is full, read-only, busy, ...; `hints["reason"]` is the word.
        DamagedFileError: (or `damaged`) The content is not that of such a file.
        InvalidInputError: A value that the schema refuses.
    """
    try:
        yield
    except sqlite3.Error as error:
        raise _from_sqlite(error, path, damaged) from error
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise damaged(f"{path.name} is damaged: it holds text that cannot be read", file=path.name) from error
    except MemoryError as error:  # SQLite's is raised as this one too
        raise _unavailable(path, "out_of_memory") from error
    except OSError as error:
        raise _unavailable(path, reason_of(error)) from error


def reason_of(error: OSError) -> str:
    """The word for what the system answered: disk_full, read_only, missing, ...; else io_error."""
    return _REASONS_BY_ERRNO.get(error.errno or 0, "io_error")


def _from_sqlite(error: sqlite3.Error, path: Path, damaged: type[DamagedFileError | DamagedMapError]) -> Exception:
    # Errors that Python's driver raises by itself carry no code: text that is not UTF-8, or a closed connection.
    code = getattr(error, "sqlite_errorcode", None)
    if code is None:
        if isinstance(error, sqlite3.ProgrammingError) and "closed" in str(error):
            return _unavailable(path, "closed")
        return damaged(f"{path.name} is damaged: {error}", file=path.name)
    primary = code & 0xFF
    if primary in _REASONS_BY_SQLITE:
        return _unavailable(path, _REASONS_BY_SQLITE[primary])
    if primary in _INPUT_CODES:
        return InvalidInputError(f"{path.name} cannot hold this: {error}")
    return damaged(f"{path.name} is damaged: {error}", file=path.name)


def _unavailable(path: Path, reason: str) -> UnavailableError:
    return UnavailableError(f"{path.name}: {_SENTENCES[reason]}", reason=reason, file=path.name)
