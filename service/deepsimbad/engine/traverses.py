"""Traverse files kept open while frames arrive: opening and closing one costs many times what a frame does.

And how many pictures may wait in them to be fitted.
"""

import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from deepsimbad.errors import SpoolFullError, UnknownTraverseError
from deepsimbad.store.traverses import Traverse

MAX_IDLE = 16


@dataclass
class _Loan:
    traverse: Traverse
    n_users: int = 0


class OpenTraverses:
    """Lends open traverses; one that is not to be lent again is closed after its last use."""

    def __init__(self, data_dir: Path) -> None:
        self._data_dir = data_dir
        self._open: OrderedDict[tuple[str, str], _Loan] = OrderedDict()
        self._lock = threading.RLock()

    @contextmanager
    def lend(self, domain: str, name: str) -> Iterator[Traverse]:
        """A traverse for the length of the block; several blocks may hold it at once; raises UnknownTraverseError."""
        key = domain, name
        with self._lock:
            if key in self._open:
                try:
                    self._open[key].traverse.check_is_there()
                except UnknownTraverseError:  # another process deleted it, and perhaps made it anew
                    self._drop(key)
            if key not in self._open:
                self._open[key] = _Loan(Traverse.open(self._data_dir, domain, name))
            self._open.move_to_end(key)
            loan = self._open[key]
            loan.n_users += 1
            idle = [other for other in self._open if not self._open[other].n_users]
            for oldest in idle[: max(0, len(self._open) - MAX_IDLE)]:
                self._drop(oldest)
        try:
            yield loan.traverse
        except UnknownTraverseError:  # another process deleted it under us
            with self._lock:
                if self._open.get(key) is loan:
                    self._drop(key)
            raise
        finally:
            with self._lock:
                loan.n_users -= 1
                if not loan.n_users and self._open.get(key) is not loan:
                    loan.traverse.close()

    def forget(self, domain: str, name: str | None = None) -> None:
        """Close a traverse, or all of a domain, as soon as nobody uses it."""
        with self._lock:
            for key in list(self._open):
                if key[0] == domain and name in {None, key[1]}:
                    self._drop(key)

    def close(self) -> None:
        """Close all, those in use after their last use."""
        with self._lock:
            for key in list(self._open):
                self._drop(key)

    def _drop(self, key: tuple[str, str]) -> None:
        loan = self._open.pop(key)
        if not loan.n_users:
            loan.traverse.close()


class SpoolRoom:
    """How many bytes of pictures wait in the spools of every domain, and how many may."""

    def __init__(self, data_dir: Path, max_bytes: int) -> None:
        self._data_dir, self._max_bytes = data_dir, max_bytes
        self._used: dict[str, int] = {}  # at least as much as there is: jobs empty spools in processes of their own
        self._lock = threading.Lock()

    def make_room(self, domain: str, n_bytes: int) -> None:
        """Count a picture that is about to wait; raises SpoolFullError, and the traverse stays as it is."""
        with self._lock:
            waiting: dict[str, int] = {}
            if domain not in self._used or self._used[domain] + n_bytes > self._max_bytes:
                for name in Traverse.list(self._data_dir, domain):
                    with suppress(UnknownTraverseError), Traverse.open(self._data_dir, domain, name) as traverse:
                        waiting[name] = traverse.spooled_bytes
                self._used[domain] = sum(waiting.values())
            if self._used[domain] + n_bytes > self._max_bytes:
                fullest = max(waiting, key=lambda name: waiting[name])
                raise SpoolFullError(
                    f"{self._used[domain]} bytes of images wait in domain {domain} for its evaluator to be fitted, and "
                    f"{self._max_bytes} are the most: remap with the traverse that holds most of them, {fullest}, or "
                    "delete it, or raise the setting max_spool_bytes; the frame was not stored",
                    limit="max_spool_bytes",
                    max_spool_bytes=self._max_bytes,
                    spooled_bytes=self._used[domain],
                    traverse=fullest,
                )
            self._used[domain] += n_bytes
