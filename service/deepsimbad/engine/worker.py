"""The one thread in which encoding and scoring run: a robot's live view goes before whatever waits in bulk."""

import itertools
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from enum import IntEnum
from queue import PriorityQueue
from typing import Any, TypeVar

from deepsimbad.errors import UnavailableError

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
    """

    def __init__(self, name: str = "inference") -> None:
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
        """
        answer: Future[T] = Future()
        with self._lock:
            if not self._open:
                raise UnavailableError("the service is shutting down")
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
            if not work.answer.set_running_or_notify_cancel():
                continue
            try:
                result = work.run()
            except BaseException as error:
                work.answer.set_exception(error)
            else:
                work.answer.set_result(result)
            del work  # or the last answer's arrays live until the next query
