"""Many writers, one disk: whatever waits while a transaction is being synced goes into the next one together."""

import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from sqlite_utils import Database

from deepsimbad.errors import UnavailableError
from deepsimbad.store.connection import write_transaction
from deepsimbad.store.faults import storage_faults

T = TypeVar("T")

MAX_BATCH = 256


@dataclass(frozen=True)
class _Write:
    run: Callable[[Database], Any]
    done: Future[Any]


class GroupCommit:
    """One thread that commits what others hand in; a write counts when its future has a result, not earlier.

    Args:
        db: An open file that nothing else writes through.
        path: The file, for messages.
        on_commit: Called with the number of writes of every transaction.
        before_commit: Called as the last thing inside every transaction.
    """

    def __init__(
        self,
        db: Database,
        path: Path,
        on_commit: Callable[[int], None] = lambda _: None,
        before_commit: Callable[[], None] = lambda: None,
    ) -> None:
        self._db = db
        self._path = path
        self._on_commit = on_commit
        self._before_commit = before_commit
        self._waiting: SimpleQueue[_Write | None] = SimpleQueue()
        self._open = True
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
            if not self._open:
                raise UnavailableError("the service is shutting down")
            self._waiting.put(_Write(run, done))
        return done

    def close(self) -> None:
        """Commit what waits, then end the thread."""
        with self._lock:
            if not self._open:
                return
            self._open = False
            self._waiting.put(None)
        self._thread.join()

    def _work(self) -> None:
        closing = False
        while not closing:
            batch: list[_Write] = []
            write = self._waiting.get()
            while write is not None:
                batch.append(write)
                if len(batch) == MAX_BATCH:
                    break
                try:
                    write = self._waiting.get_nowait()
                except Empty:
                    break
            closing = write is None
            for each in batch:
                each.done.set_running_or_notify_cancel()  # too late to cancel; one cancelled earlier is written as well
            self._commit(batch)

    def _commit(self, batch: list[_Write]) -> None:
        if not batch:
            return
        try:
            with storage_faults(self._path), write_transaction(self._db) as db:
                results = [write.run(db) for write in batch]
                self._before_commit()
        except BaseException as error:
            if len(batch) == 1:
                _settle(batch[0].done, error=error)
                return
            for write in batch:  # one that cannot be written should not take the others with it
                self._commit([write])
            return
        self._on_commit(len(batch))
        for write, result in zip(batch, results, strict=True):
            _settle(write.done, result)


def _settle(done: Future[Any], result: Any = None, error: BaseException | None = None) -> None:
    if done.cancelled():
        return
    if error is not None:
        done.set_exception(error)
    else:
        done.set_result(result)
