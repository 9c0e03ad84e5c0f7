"""The one thread in which encoding and scoring run: a robot's live view goes before whatever waits in bulk."""

import itertools
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from enum import IntEnum
from queue import PriorityQueue
from typing import Any, TypeVar

from deepsimbad.errors import OverloadedError, UnavailableError

T = TypeVar("T")


class Priority(IntEnum):
    """Who goes first; within one priority, in order of arrival."""

    LIVE = 0
    BATCH = 1
    _CLOSE = 2


@dataclass(order=True)
class _Work:
    priority: Priority
    arrival: int
    run: Callable[[], Any] = field(compare=False)
    answer: Future[Any] = field(compare=False)


class InferenceWorker:
    """Runs submitted functions one at a time, live ones first.

    One thread, because encoders and scoring already use the cores they need: two at once would only make both late.
    A batch must be submitted in pieces short enough that a live view can wait for one.

    Args:
        name: Of the thread.
        max_waiting: How many functions of one priority may wait; None: any number.
    """

    def __init__(self, name: str = "inference", max_waiting: int | None = None) -> None:
        self._max_waiting = max_waiting
        self._n_waiting = dict.fromkeys(Priority, 0)
        self._queue: PriorityQueue[_Work] = PriorityQueue()
        self._arrivals = itertools.count()
        self._open = True
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    @property
    def n_waiting(self) -> int:
        """How many functions wait."""
        return self._queue.qsize()

    def is_full(self, priority: Priority = Priority.LIVE) -> bool:
        """Whether as many functions of a priority wait as may."""
        return self._max_waiting is not None and self._n_waiting[priority] >= self._max_waiting

    @property
    def is_alive(self) -> bool:
        """Whether the thread is there to run them."""
        return self._thread.is_alive()

    def submit(self, run: Callable[[], T], priority: Priority = Priority.LIVE) -> Future[T]:
        """Queue a function.

        Returns:
            Its result or error to come; cancelling it before it began takes it off the queue.

        Raises:
            UnavailableError: The worker has been closed.
            OverloadedError: As many wait as may.
        """
        answer: Future[T] = Future()
        with self._lock:
            if not self._open:
                raise UnavailableError("the service is shutting down")
            if self.is_full(priority):
                raise queue_is_full()
            self._n_waiting[priority] += 1
            self._queue.put(_Work(priority, next(self._arrivals), run, answer))
        return answer

    def close(self) -> None:
        """Finish what is queued, then end the thread."""
        with self._lock:
            if not self._open:
                return
            self._open = False
            self._queue.put(_Work(Priority._CLOSE, next(self._arrivals), lambda: None, Future()))
        self._thread.join()

    def _work(self) -> None:
        while (work := self._queue.get()).priority is not Priority._CLOSE:
            with self._lock:
                self._n_waiting[work.priority] -= 1
            if not work.answer.set_running_or_notify_cancel():
                continue
            try:
                result = work.run()
            except BaseException as error:
                work.answer.set_exception(error)
            else:
                work.answer.set_result(result)
            del work  # or the last answer's arrays live until the next query


def queue_is_full() -> OverloadedError:
    """What is raised where a function would have to wait behind too many."""
    return OverloadedError(
        "too many views wait to be looked at: try again in a moment", retry_after_s=1, limit="max_queue"
    )
