"""Where views are encoded: the evaluators of all domains, the threads that run them, and the stopwatch of an answer."""

import asyncio
import itertools
import json
import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from enum import IntEnum
from queue import Empty, PriorityQueue
from time import monotonic, perf_counter
from typing import Any, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import (
    DeepSimbadError,
    EvaluatorUnavailableError,
    InvalidInputError,
    InvalidWeightsError,
    OverloadedError,
    UnavailableError,
)
from deepsimbad.evaluators.base import Evaluator, Image
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.registry import EvaluatorConfig, evaluator_config, make_evaluator
from deepsimbad.evaluators.scenes import Scene

T = TypeVar("T")

log = logging.getLogger(__name__)

RETRY_AFTER_S = 30.0  # an extractor that cannot be loaded is not tried again before: to read its weights takes seconds
_failures: WeakKeyDictionary[Evaluator, tuple[float, InvalidInputError]] = WeakKeyDictionary()


class EvaluatorPool:
    """Evaluators by configuration, made at first need, so that there is one copy of each network."""

    def __init__(
        self,
        compute: Compute | None = None,
        make: Callable[[EvaluatorConfig, Compute | None], Evaluator] = make_evaluator,
    ) -> None:
        self._compute = compute or Compute()
        self._make = make
        self._evaluators: dict[str, Evaluator] = {}
        self._lock = threading.Lock()

    def evaluator(self, raw_config: Mapping[str, Any]) -> Evaluator:
        """The evaluator of a configuration, loaded or not: ranked landmarks and ready encodings need no network.

        Raises:
            InvalidInputError: There is no evaluator of that kind or name.
        """
        config = evaluator_config(raw_config)
        key = json.dumps(config.as_dict(), sort_keys=True)
        with self._lock:
            if key not in self._evaluators:
                self._evaluators[key] = self._make(config, self._compute)
            return self._evaluators[key]

    def load_all(self, configs: Mapping[str, Mapping[str, Any]]) -> None:
        """Load the evaluators of domains, by domain; one that cannot be loaded is logged and holds up no other."""
        for domain, raw_config in configs.items():
            try:
                self.evaluator(raw_config).load()
            except DeepSimbadError as error:
                log.error("an extractor cannot be loaded", extra={"domain": domain, "why": error.message})


def ready(evaluator: Evaluator) -> Evaluator:
    """The evaluator of an existing domain, loaded, which takes a moment the first time.

    Raises:
        EvaluatorUnavailableError: It cannot be loaded, or could not some seconds ago; no robot's view is at fault.
        OutOfMemoryError: There is too little memory for it.
    """
    failed_at, failure = _failures.get(evaluator, (0.0, None))
    if failure is None or monotonic() - failed_at >= RETRY_AFTER_S:
        try:
            evaluator.load()
        except InvalidInputError as error:
            failure = error
            _failures[evaluator] = (monotonic(), error)
        else:
            _failures.pop(evaluator, None)
            return evaluator
    raise EvaluatorUnavailableError(
        f"the domain's extractor cannot be loaded: {failure.message}", reason=failure.code, **failure.hints
    ) from failure


@dataclass(frozen=True)
class EncodedImage:
    """An image that the domain's evaluator has encoded."""

    values: NDArray[np.float32]  # [d]
    weights_sha256: str | None  # of the network that encoded it; None where there is none
    encode_ms: float  # time that its whole batch took


def encode_images(evaluator: Evaluator, images: Sequence[Image | Scene]) -> list[EncodedImage]:
    """Encode images as one batch.

    Raises:
        UnsupportedMediaTypeError: The evaluator takes ready encodings alone.
        OutOfMemoryError: There is too little memory for the batch.
        EvaluatorUnavailableError: Its network gives something else than encodings.
    """
    start_s = perf_counter()
    try:
        encodings = evaluator.encode(images)
    except InvalidWeightsError as error:  # the network is at fault, not what a robot sent
        raise EvaluatorUnavailableError(error.message, reason=error.code, **error.hints) from error
    encode_ms = 1000 * (perf_counter() - start_s)
    return [EncodedImage(encoding, evaluator.weights_sha256, encode_ms) for encoding in encodings]


class Priority(IntEnum):
    """Order of work, least first; within one priority it is done in order of arrival."""

    LIVE = 0
    BATCH = 1
    _CLOSE = 2


class _Encoding(NamedTuple):
    evaluator: Evaluator
    view: Image | Scene


@dataclass(order=True)
class _Work:
    priority: Priority
    arrival: int
    task: Any = field(compare=False, default=None)  # a function, or of a line of images an `_Encoding`
    answer: Future[Any] = field(default_factory=Future, compare=False)


class _Line:
    """A thread with its line of work: live work first, each priority in order of arrival."""

    def __init__(self, name: str, max_waiting: int | None) -> None:
        self._max_waiting = max_waiting
        self._n_waiting = dict.fromkeys(Priority, 0)
        self._queue: PriorityQueue[_Work] = PriorityQueue()
        self._arrivals = itertools.count()
        self._is_open = True
        self._lock = threading.Lock()
        self.thread = threading.Thread(target=self._work, name=name, daemon=True)
        self.thread.start()

    @property
    def n_waiting(self) -> int:
        """How many pieces of work wait."""
        return self._queue.qsize()

    def join(self, priority: Priority, task: Callable[[], Any] | _Encoding) -> Future[Any]:
        """Put a task in line; raises UnavailableError and OverloadedError."""
        work = _Work(priority, next(self._arrivals), task)
        with self._lock:
            if not self._is_open:
                raise UnavailableError("the service is shutting down")
            if self._max_waiting is not None and self._n_waiting[priority] >= self._max_waiting:
                raise OverloadedError(
                    "too many views wait to be looked at: try again in a moment", retry_after_s=1, limit="max_queue"
                )
            self._n_waiting[priority] += 1
            self._queue.put(work)
        return work.answer

    def close(self) -> None:
        """Finish what is in line, then end the thread."""
        with self._lock:
            if not self._is_open:
                return
            self._is_open = False
            self._queue.put(_Work(Priority._CLOSE, next(self._arrivals)))
        self.thread.join()

    def _work(self) -> None:
        while (first := self._queue.get()).priority is not Priority._CLOSE:
            batch = self._with_company(first)
            del first
            with self._lock:
                for work in batch:
                    self._n_waiting[work.priority] -= 1
            self._do([work for work in batch if work.answer.set_running_or_notify_cancel()])
            del batch, work  # or the last answer's arrays live until the next is asked for

    def _with_company(self, first: _Work) -> list[_Work]:
        """Work taken off the line, with further work that is done together with it."""
        return [first]

    def _do(self, batch: list[_Work]) -> None:
        """Do the work and set its answers."""
        for work in batch:
            try:
                result = work.task()
            except BaseException as error:
                work.answer.set_exception(error)
            else:
                work.answer.set_result(result)


class _EncodingLine(_Line):
    """A line of images, which are encoded together where the machine gains by it."""

    def __init__(self, name: str, max_waiting: int | None, longest_wait_s: float) -> None:
        self._longest_wait_s = longest_wait_s
        super().__init__(name, max_waiting)

    def _with_company(self, first: _Work) -> list[_Work]:
        evaluator: Evaluator = first.task.evaluator
        batch, deadline_s = [first], monotonic() + self._longest_wait_s
        try:
            largest_batch = evaluator.largest_batch
        except Exception:  # its network cannot be loaded, which encoding it will tell
            return batch
        while len(batch) < largest_batch:
            left_s = deadline_s - monotonic()
            try:
                next_work = self._queue.get(timeout=left_s) if left_s > 0 else self._queue.get_nowait()
            except Empty:
                break
            if next_work.priority is Priority._CLOSE or next_work.task.evaluator is not evaluator:
                self._queue.put(next_work)  # in its old place: the order is by priority and arrival
                break
            batch.append(next_work)
        return batch

    def _do(self, batch: list[_Work]) -> None:
        """Encode the batch; where that fails encode each alone, so that only those at fault fail."""
        if not batch:
            return
        try:
            encoded = encode_images(batch[0].task.evaluator, [work.task.view for work in batch])
            answers = list(zip(batch, encoded, strict=True))
        except BaseException as error:
            if len(batch) == 1:
                batch[0].answer.set_exception(error)
                return
            for work in batch:
                self._do([work])
            return
        for work, image in answers:
            work.answer.set_result(image)


class InferenceWorker:
    """Encodes images in one thread and does long work in another, live work first.

    One thread each, because networks and long sums already use the cores they need: two at once would only make both
    late. Long work that is not urgent must be submitted in pieces that a live view can wait for. Short work belongs on
    the event loop: to hand a millisecond of work to another thread costs as much again, since the two then wait for
    each other's hold of the interpreter.

    Args:
        max_waiting: How many pieces of work of one priority may wait for a thread; None: any number.
        longest_wait_s: How long an image may wait for others to fill a batch, where one larger than 1 gains anything.
    """

    def __init__(self, max_waiting: int | None = None, longest_wait_s: float = 0.0) -> None:
        self._encoding = _EncodingLine("encoding", max_waiting, longest_wait_s)
        self._long_work = _Line("inference", max_waiting)

    @property
    def n_waiting(self) -> int:
        """How many images and functions wait."""
        return self._encoding.n_waiting + self._long_work.n_waiting

    @property
    def is_alive(self) -> bool:
        """Whether the threads run."""
        return self._encoding.thread.is_alive() and self._long_work.thread.is_alive()

    def submit(self, run: Callable[[], T], priority: Priority = Priority.LIVE) -> Future[T]:
        """Queue a function.

        Returns:
            The future of its result; cancelling it before the function began takes it off the queue.

        Raises:
            UnavailableError: The worker has been closed.
            OverloadedError: The limit on waiting work is reached.
        """
        return self._long_work.join(priority, run)

    def encode(
        self, evaluator: Evaluator, view: Image | Scene, priority: Priority = Priority.LIVE
    ) -> Future[EncodedImage]:
        """Queue an image or a scene to be encoded; returns and raises as `submit`."""
        return self._encoding.join(priority, _Encoding(evaluator, view))

    async def computed(self, run: Callable[[], T], *, is_short: bool = False) -> T:
        """The result of a function, which runs on the event loop where it is short, else on the worker."""
        return run() if is_short else await asyncio.wrap_future(self.submit(run))

    def close(self) -> None:
        """Finish what is queued, then end the threads."""
        self._encoding.close()
        self._long_work.close()


@dataclass
class Stopwatch:
    """Times the stages of one answer, from its making on: each lap names the stage that ends with it.

    One thread at a time works on an answer: laps follow each other, and their sum is never above the total.
    """

    _start_s: float = field(default_factory=perf_counter)
    _lap_s: float = field(default_factory=perf_counter)
    _spent_ms: dict[str, float] = field(default_factory=dict)

    def lap(self, stage: str, parts_ms: Mapping[str, float] | None = None) -> None:
        """Count the time since the last lap for a stage, less that of parts, which are stages of their own."""
        now_s, spent_ms = perf_counter(), self._spent_ms
        left_ms = 1000 * (now_s - self._lap_s)
        for part, part_ms in (parts_ms or {}).items():
            spent_ms[part] = spent_ms.get(part, 0.0) + part_ms
            left_ms -= part_ms
        spent_ms[stage] = spent_ms.get(stage, 0.0) + max(0.0, left_ms)
        self._lap_s = now_s

    def timings_ms(self) -> dict[str, float]:
        """Milliseconds by stage, and their `total` up to now."""
        timings_ms = {**self._spent_ms, "total": 1000 * (perf_counter() - self._start_s)}
        for stage, spent_ms in timings_ms.items():
            timings_ms[stage] = round(spent_ms, 3)
        return timings_ms
