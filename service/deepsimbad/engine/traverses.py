"""Traverse files kept open while frames arrive: opening and closing one costs many times what a frame does."""

import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from deepsimbad.errors import UnknownTraverseError
from deepsimbad.store.traverses import Traverse

MAX_IDLE = 16


@dataclass
class _Open:
    traverse: Traverse
    n_users: int = 0
    is_doomed: bool = False


class OpenTraverses:
    """Lends open traverses.

    Args:
        data_dir: The data directory.
    """

    def __init__(self, data_dir: Path) -> None:
        self._data_dir = data_dir
        self._open: OrderedDict[tuple[str, str], _Open] = OrderedDict()
        self._lock = threading.RLock()

    @contextmanager
    def lend(self, domain: str, name: str) -> Iterator[Traverse]:
        """A traverse for the length of the block; several blocks may hold it at once.

        Raises:
            UnknownTraverseError: There is none, or it was deleted meanwhile.
        """
        lent = self._take(domain, name)
        try:
            yield lent.traverse
        except UnknownTraverseError:  # another process deleted it under us
            self._doom((domain, name), lent)
            raise
        finally:
            with self._lock:
                lent.n_users -= 1
                if lent.is_doomed and lent.n_users == 0:
                    lent.traverse.close()

    def forget(self, domain: str, name: str | None = None) -> None:
        """Close a traverse, or all of a domain, as soon as nobody uses it."""
        with self._lock:
            for key, lent in list(self._open.items()):
                if key[0] == domain and name in {None, key[1]}:
                    self._doom(key, lent)

    def close(self) -> None:
        """Close all, those in use after their last use."""
        with self._lock:
            for key, lent in list(self._open.items()):
                self._doom(key, lent)

    def _take(self, domain: str, name: str) -> _Open:
        key = (domain, name)
        with self._lock:
            lent = self._open.get(key)
            if lent is not None and lent.traverse.is_deleted:  # by another process, which may have made it anew
                self._doom(key, lent)
            if key not in self._open:
                self._open[key] = _Open(Traverse.open(self._data_dir, domain, name))
            self._open.move_to_end(key)
            lent = self._open[key]
            lent.n_users += 1
            idle = [key for key, other in self._open.items() if other.n_users == 0]
            for oldest in idle[: max(0, len(self._open) - MAX_IDLE)]:
                self._open.pop(oldest).traverse.close()
            return lent

    def _doom(self, key: tuple[str, str], lent: _Open) -> None:
        with self._lock:
            if self._open.get(key) is lent:
                del self._open[key]
            if not lent.is_doomed:
                lent.is_doomed = True
                if lent.n_users == 0:
                    lent.traverse.close()
