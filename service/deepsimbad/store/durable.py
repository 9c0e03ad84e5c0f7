"""Files that are on the disk when we say so, and their digests."""

import hashlib
import os
import shutil
from pathlib import Path


def sync_file(path: Path) -> None:
    """Wait until the file's content is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Wait until the folder's entries (new, renamed or removed files) are on the disk."""
    sync_file(folder)


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


def remove_folder(folder: Path) -> None:
    """Remove a folder whole: first out of sight by one rename, then its content."""
    grave = folder.with_name(f".removing-{folder.name}")
    if grave.exists():
        shutil.rmtree(grave)
    if folder.exists():
        folder.rename(grave)
        sync_folder(folder.parent)
        shutil.rmtree(grave)
