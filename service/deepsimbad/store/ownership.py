"""Which unfinished work belongs to a living process.

Every process that builds maps holds an advisory lock on a file of its own for as long as it lives. The kernel drops the
lock when the process dies in any way, kill -9 included, so that a restart, or a second process on the same data
directory, can tell work that was abandoned from work that goes on. Process ids cannot: they are reused.
"""

import fcntl
import os
import re
import secrets
from pathlib import Path

_TOKEN = re.compile(r"[0-9a-f]{32}")


class Owner:
    """The mark of one open catalog; taken when the first unfinished work is written.

    Args:
        folder: Where the lock files lie.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._token = secrets.token_hex(16)
        self._descriptor: int | None = None

    @property
    def mark(self) -> str:
        """The mark, whether anything carries it yet or not."""
        return self._token

    def token(self) -> str:
        """The mark to write beside unfinished work; alive until `release`."""
        path = self._folder / self._token
        while self._descriptor is None:
            self._folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            if path.exists() and path.stat().st_ino == os.fstat(descriptor).st_ino:
                self._descriptor = descriptor
            else:  # swept away between opening and locking
                os.close(descriptor)
        return self._token

    def release(self) -> None:
        """Give the mark up: what still carries it is abandoned."""
        if self._descriptor is not None:
            (self._folder / self._token).unlink(missing_ok=True)
            os.close(self._descriptor)
            self._descriptor = None
            self._token = secrets.token_hex(16)


def is_alive(folder: Path, token: str) -> bool:
    """Whether the owner of the mark still lives; the lock file of a dead one is removed."""
    if _TOKEN.fullmatch(token) is None:
        return False
    path = folder / token
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    else:
        path.unlink(missing_ok=True)
        return False
    finally:
        os.close(descriptor)


def sweep(folder: Path) -> None:
    """Remove the lock files of dead processes."""
    if folder.is_dir():
        for path in folder.iterdir():
            is_alive(folder, path.name)
