"""A SQLite file that is open: read under a lock, closed at the end of a block, its faults named."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self

from sqlite_utils import Database

from deepsimbad.store.faults import storage_faults


class OpenFile:
    """What every kind of file has in common; usable from any thread.

    Args:
        path: The file, for messages.
        db: The same, open.
    """

    def __init__(self, path: Path, db: Database) -> None:
        self._path = path
        self._db = db
        self._lock = threading.RLock()

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @contextmanager
    def _reading(self) -> Iterator[Database]:
        """One consistent state of the file."""
        with self._lock, storage_faults(self._path), self._db.atomic() as db:
            yield db
