"""The one thread in which encoding and scoring run: a robot's live view goes before whatever waits in bulk.

Images of several robots are encoded in one batch where the machine gains by it. A stopwatch tells where the time of an
answer goes, waiting among it.
"""

import itertools
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from enum import IntEnum
from queue import Empty, PriorityQueue
from time import monotonic, perf_counter
from typing import Any, TypeVar

import numpy as np

from deepsimbad.engine.encoders import encode_images
from deepsimbad.engine.views import EncodedImage, View
from deepsimbad.errors import OverloadedError, UnavailableError
from deepsimbad.evaluators.base import Evaluator

T = TypeVar("T")

_MOST_UNSCORED = 8  # encoded images whose answers are not yet made


class Priority(IntEnum):
    """Who goes first; within one priority, in order of arrival."""

    LIVE = 0
    BATCH = 1
    _CLOSE = 2


@dataclass(order=True)
class _Work:
    priority: Priority
    arrival: int
    run: Callable[[Any], Any] = field(compare=False)
    view: Any = field(default=None, compare=False)
    encoder: Evaluator | None = field(default=None, compare=False)  # of an image
    answer: Future[Any] = field(default_factory=Future, compare=False)


class InferenceWorker:
    """Runs submitted functions one at a time, live ones first.

    One thread, because encoders and scoring already use the cores they need: two at once would only make both late.
    A batch must be submitted in pieces short enough that a live view can wait for one. What is made of encoded images
    runs in a thread beside it, so that the next images are encoded meanwhile.

    Args:
        name: Of the thread.
        max_waiting: How many functions of one priority may wait; None: any number.
        longest_wait_s: How long an image may wait for others to fill a batch, where one larger than 1 gains anything.
    """

    def __init__(self, name: str = "inference", max_waiting: int | None = None, longest_wait_s: float = 0.0) -> None:
        self._max_waiting = max_waiting
        self._longest_wait_s = longest_wait_s
        self._n_waiting = dict.fromkeys(Priority, 0)
        self._queue: PriorityQueue[_Work] = PriorityQueue()
        self._arrivals = itertools.count()
        self._open = True
        self._lock = threading.Lock()
        self._unscored = threading.Semaphore(_MOST_UNSCORED)
        self._scorer = ThreadPoolExecutor(1, f"{name} of images")
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
            OverloadedError: As many wait as may.
        """
        return self.look(None, None, lambda _: run(), priority)

    def look(
        self,
        evaluator: Evaluator | None,
        view: View | None,
        run: Callable[[Any], T],
        priority: Priority = Priority.LIVE,
    ) -> Future[T]:
        """Queue a function of a view; an image is encoded before, maybe in one batch with others.

        Args:
            evaluator: Encodes an image.
            view: An image, or what needs no encoding.
            run: Given an `EncodedImage` in the place of an image, other views as they are.
            priority: Who goes first.

        Returns:
            Its result or error to come, as `submit`; raises as `submit`.
        """
        encoder = evaluator if isinstance(view, np.ndarray) else None
        work = _Work(priority, next(self._arrivals), run, view, encoder)
        with self._lock:
            if not self._open:
                raise UnavailableError("the service is shutting down")
            if self._max_waiting is not None and self._n_waiting[priority] >= self._max_waiting:
                raise OverloadedError(
                    "too many views wait to be looked at: try again in a moment", retry_after_s=1, limit="max_queue"
                )
            self._n_waiting[priority] += 1
            self._queue.put(work)
        return work.answer

    def close(self) -> None:
        """Finish what is queued, then end the thread."""
        with self._lock:
            if not self._open:
                return
            self._open = False
            self._queue.put(_Work(Priority._CLOSE, next(self._arrivals), lambda _: None))
        self._thread.join()
        self._scorer.shutdown()

    def _work(self) -> None:
        while (first := self._queue.get()).priority is not Priority._CLOSE:
            encoder = first.encoder
            batch = [first] if encoder is None else self._with_company(first, encoder.largest_batch)
            del first
            with self._lock:
                for work in batch:
                    self._n_waiting[work.priority] -= 1
            for work in batch.copy():
                if not work.answer.set_running_or_notify_cancel():
                    batch.remove(work)
            if encoder is not None and batch:
                _encode(encoder, batch)
            while batch:  # emptied, or the last answer's arrays live until the next query
                work = batch.pop(0)
                if work.encoder is None:
                    _finish(work)
                else:
                    self._unscored.acquire()  # where scoring is slower, images wait in the queue, which is counted
                    self._scorer.submit(_finish, work).add_done_callback(lambda _: self._unscored.release())
                del work

    def _with_company(self, first: _Work, largest: int) -> list[_Work]:
        """An image with those that are encoded together with it, taken off the queue."""
        batch = [first]
        until = monotonic() + self._longest_wait_s
        while len(batch) < largest:
            left_s = until - monotonic()
            try:
                following = self._queue.get(timeout=left_s) if left_s > 0 else self._queue.get_nowait()
            except Empty:
                break
            if following.encoder is not first.encoder:
                self._queue.put(following)  # in its old place: the order is by priority and arrival
                break
            batch.append(following)
        return batch


def _encode(encoder: Evaluator, batch: list[_Work]) -> None:
    """Put encodings in the place of the images of a batch; those of an image that cannot be encoded fail alone."""
    try:
        for work, encoded in zip(batch, encode_images(encoder, [work.view for work in batch]), strict=True):
            work.view = encoded
    except BaseException as error:
        if len(batch) == 1:
            batch.pop().answer.set_exception(error)
            return
        alone = [[work] for work in batch]
        for single in alone:
            _encode(encoder, single)
        batch[:] = [work for single in alone for work in single]


def _finish(work: _Work) -> None:
    try:
        result = work.run(work.view)
    except BaseException as error:
        work.answer.set_exception(error)
    else:
        work.answer.set_result(result)


@dataclass
class Stopwatch:
    """Where the time of one answer goes, from its making on: each lap names what was done since the one before.

    An answer is in the hands of one thread at a time: laps follow each other, and their sum is never above the total.
    """

    _began: float = field(default_factory=perf_counter)
    _last: float = field(default_factory=perf_counter)
    _spent_ms: dict[str, float] = field(default_factory=dict)

    def lap(self, stage: str, view: View | None = None) -> None:
        """Count the time since the last lap to a stage; what an image's encoding took within it, to `encode`."""
        now = perf_counter()
        encode_ms = view.encode_ms if isinstance(view, EncodedImage) else 0.0
        spent_ms = max(0.0, 1000 * (now - self._last) - encode_ms)
        self._spent_ms[stage] = round(self._spent_ms.get(stage, 0.0) + spent_ms, 3)
        if encode_ms:
            self._spent_ms["encode"] = round(encode_ms, 3)
        self._last = now

    def take(self, timings_ms: Mapping[str, float]) -> None:
        """Take over stages that were measured since the last lap, by whoever did the work."""
        for stage, spent_ms in timings_ms.items():
            self._spent_ms[stage] = round(spent_ms, 3)
        self._last = perf_counter()

    def timings_ms(self) -> dict[str, float]:
        """Milliseconds by stage, and their `total` up to now."""
        return {**self._spent_ms, "total": round(1000 * (perf_counter() - self._began), 3)}
