"""Many writers, one disk: whatever waits while a transaction is being synced goes into the next one together."""

import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import AbstractContextManager
from queue import SimpleQueue
from typing import Any, TypeVar

from sqlite_utils import Database

from deepsimbad.errors import UnavailableError

T = TypeVar("T")

MAX_BATCH = 256

_Write = tuple[Callable[[Database], Any], "Future[Any]"]


class GroupCommit:
    """One thread that commits what others hand in; a write counts when its future has a result, not earlier.

    Args:
        transaction: Gives a write transaction.
        on_commit: Called with the number of writes of every transaction.
    """

    def __init__(
        self, transaction: Callable[[], AbstractContextManager[Database]], on_commit: Callable[[int], None]
    ) -> None:
        self._transaction = transaction
        self._on_commit = on_commit
        self._waiting: SimpleQueue[_Write | None] = SimpleQueue()
        self._is_open = True
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._work, name="commits", daemon=True)
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether the thread is there to commit."""
        return self._thread.is_alive()

    def submit(self, run: Callable[[Database], T]) -> Future[T]:
        """Queue a write.

        Args:
            run: Called inside a transaction, perhaps a second time in another one.

        Returns:
            Its result to come, once it is on the disk; or its error, and then nothing of it was kept.

        Raises:
            UnavailableError: The file has been closed.
        """
        done: Future[T] = Future()
        with self._lock:
            if not self._is_open:
                raise UnavailableError("the service is shutting down")
            self._waiting.put((run, done))
        done.set_running_or_notify_cancel()  # whoever stops waiting does not undo it
        return done

    def close(self) -> None:
        """Commit what waits, then end the thread."""
        with self._lock:
            if self._is_open:
                self._is_open = False
                self._waiting.put(None)
        self._thread.join()

    def _work(self) -> None:
        while (write := self._waiting.get()) is not None:
            batch = [write]
            while len(batch) < MAX_BATCH and not self._waiting.empty():
                write = self._waiting.get()
                if write is None:
                    break
                batch.append(write)
            self._commit(batch)
            if write is None:
                return

    def _commit(self, batch: list[_Write]) -> None:
        try:
            with self._transaction() as db:
                results = [run(db) for run, _ in batch]
        except BaseException as error:
            if len(batch) == 1:
                batch[0][1].set_exception(error)
                return
            for write in batch:  # one that cannot be written should not take the others with it
                self._commit([write])
            return
        self._on_commit(len(batch))
        for (_, done), result in zip(batch, results, strict=True):
            done.set_result(result)
