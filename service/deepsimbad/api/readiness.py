"""Whether the service can do what it is there for, told by trying: threads, both files, room on the disk."""

import os
import shutil
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import TimeoutError as TookTooLong
from pathlib import Path

from deepsimbad.errors import DeepSimbadError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.sessions import SessionStore

MEBIBYTE = 1024 * 1024
LEAST_FREE_BYTES = 16 * MEBIBYTE  # with less, the next map or the write-ahead log may not fit
TRUSTED_S = 1.0  # anybody may ask, and every look writes to the disk
_WRITE_TIMEOUT_S = 2.0


class ReadinessCheck:
    """Looks at most once a second; from any thread.

    Args:
        catalog: Read.
        sessions: Read and written.
        threads: What must be alive, by a name that a person understands.
        monotonic: Seconds that never go back.
    """

    def __init__(
        self,
        catalog: Catalog,
        sessions: SessionStore,
        threads: Sequence[tuple[str, Callable[[], bool]]],
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._catalog = catalog
        self._sessions = sessions
        self._threads = threads
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._looked_at: float | None = None
        self._faults: tuple[str, ...] = ()

    def faults(self) -> tuple[str, ...]:
        """One sentence for everything that is wrong; none where the service is ready. May wait for the disk."""
        with self._lock:
            now = self._monotonic()
            if self._looked_at is None or now - self._looked_at > TRUSTED_S:
                self._faults = tuple(self._look())
                self._looked_at = self._monotonic()
            return self._faults

    def _look(self) -> Sequence[str]:
        found = [f"{name} has ended: restart the service" for name, is_alive in self._threads if not is_alive()]
        for look in (self._catalog.check, self._sessions.check, self._write):
            try:
                look()
            except DeepSimbadError as error:
                found.append(error.message)
            except TookTooLong:
                found.append(f"sessions.sqlite: a write takes longer than {_WRITE_TIMEOUT_S:g} s")
        found += disk_faults(self._catalog.data_dir)
        return list(dict.fromkeys(found))

    def _write(self) -> None:
        self._sessions.try_writing().result(_WRITE_TIMEOUT_S)


def disk_faults(data_dir: Path) -> list[str]:
    """What is wrong with the file system of the data directory."""
    try:
        n_free = shutil.disk_usage(data_dir).free
        is_read_only = bool(os.statvfs(data_dir).f_flag & os.ST_RDONLY)
    except OSError as error:
        return [f"the data directory cannot be looked at: {error.strerror}"]
    found = []
    if is_read_only:
        found.append("the data directory lies on a read-only file system")
    if n_free < LEAST_FREE_BYTES:
        found.append(
            f"{n_free / MEBIBYTE:.0f} MiB are free in the data directory, fewer than {LEAST_FREE_BYTES // MEBIBYTE}"
        )
    return found
