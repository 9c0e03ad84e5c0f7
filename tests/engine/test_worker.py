"""The inference worker: who goes first, and what becomes of errors."""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

from deepsimbad.engine.worker import EncodedImage, InferenceWorker, Priority
from deepsimbad.errors import InvalidImageError, InvalidInputError, OverloadedError, UnavailableError


@pytest.fixture
def worker() -> Iterator[InferenceWorker]:
    with closing(InferenceWorker(max_waiting=16)) as inference_worker:
        yield inference_worker


def test_live_goes_before_batch_and_each_in_order_of_arrival(worker: InferenceWorker) -> None:
    gate, order = threading.Event(), []
    first = worker.submit(gate.wait)
    batch = [worker.submit(lambda n=n: order.append(("batch", n)), Priority.BATCH) for n in range(3)]
    live = [worker.submit(lambda n=n: order.append(("live", n)), Priority.LIVE) for n in range(3)]
    assert worker.n_waiting >= 6
    gate.set()
    for answer in (first, *batch, *live):
        answer.result(60)
    assert order == [("live", 0), ("live", 1), ("live", 2), ("batch", 0), ("batch", 1), ("batch", 2)]
    assert worker.n_waiting == 0


def test_an_error_reaches_the_one_who_asked_and_nobody_else(worker: InferenceWorker) -> None:
    def fail() -> None:
        raise InvalidInputError("no")

    failing_answer, sound_answer = worker.submit(fail), worker.submit(lambda: 7)
    with pytest.raises(InvalidInputError, match="no"):
        failing_answer.result(60)
    assert sound_answer.result(60) == 7


def test_closing_finishes_what_is_queued_and_takes_no_more() -> None:
    worker, gate = InferenceWorker(), threading.Event()
    answers = [worker.submit(gate.wait), *[worker.submit(lambda n=n: n, Priority.BATCH) for n in range(5)]]
    threading.Timer(0.05, gate.set).start()
    worker.close()
    assert [answer.result(0) for answer in answers[1:]] == list(range(5))
    with pytest.raises(UnavailableError):
        worker.submit(lambda: None)
    worker.close()


def test_no_more_of_one_priority_wait_than_may(worker: InferenceWorker) -> None:
    gate, has_begun = threading.Event(), threading.Event()
    worker.submit(lambda: (has_begun.set(), gate.wait(60)))
    assert has_begun.wait(60)
    for priority in (Priority.LIVE, Priority.BATCH):
        answers = [worker.submit(lambda: 1, priority) for _ in range(16)]
        with pytest.raises(OverloadedError) as caught:
            worker.submit(lambda: 1, priority)
        assert caught.value.hints["retry_after_s"] == 1
    gate.set()
    assert [answer.result(60) for answer in answers] == [1] * 16
    assert worker.submit(lambda: 2).result(60) == 2


class Eyes:
    """An evaluator that encodes an image to its first pixel and notes the sizes of its batches."""

    weights_sha256 = "f" * 64

    def __init__(self, largest_batch: int) -> None:
        self.largest_batch = largest_batch
        self.batches: list[int] = []

    def encode(self, images):
        self.batches.append(len(images))
        if any(image[0, 0, 0] == 255 for image in images):
            raise InvalidImageError("no picture")
        return np.array([[image[0, 0, 0]] for image in images], np.float32)


def grey(level: int) -> np.ndarray:
    return np.full((4, 4, 3), level, np.uint8)


class HoldingEvaluator:
    """An evaluator that holds up the encoding thread until its gate is set."""

    largest_batch, weights_sha256 = 1, None

    def __init__(self) -> None:
        self.has_begun, self.gate = threading.Event(), threading.Event()

    def encode(self, images):
        self.has_begun.set()
        assert self.gate.wait(60)
        return np.zeros((len(images), 1), np.float32)


def block_encoding(worker):
    """Hold up the encoding thread; it goes on when the event that is returned is set."""
    evaluator = HoldingEvaluator()
    worker.encode(evaluator, grey(0))
    assert evaluator.has_begun.wait(60)
    return evaluator.gate


def test_images_that_wait_are_encoded_together_as_many_as_pay(worker: InferenceWorker) -> None:
    eyes, gate = Eyes(largest_batch=4), block_encoding(worker)
    answers = [worker.encode(eyes, grey(level)) for level in range(10)]
    assert worker.n_waiting == 10
    gate.set()
    views = [answer.result(60) for answer in answers]
    assert all(isinstance(view, EncodedImage) and view.weights_sha256 == eyes.weights_sha256 for view in views)
    assert [view.values.tolist() for view in views] == [[level] for level in range(10)]
    assert eyes.batches == [4, 4, 2]
    assert worker.n_waiting == 0


def test_where_batches_do_not_pay_nobody_waits_for_company() -> None:
    eyes = Eyes(largest_batch=1)
    with closing(InferenceWorker(longest_wait_s=3600)) as worker:
        answers = [worker.encode(eyes, grey(level)) for level in range(3)]
        assert [answer.result(60).values[0] for answer in answers] == [0, 1, 2]
    assert eyes.batches == [1, 1, 1]


def test_an_image_waits_for_company_no_longer_than_it_may() -> None:
    eyes = Eyes(largest_batch=64)
    with closing(InferenceWorker(longest_wait_s=0.02)) as worker:
        assert worker.encode(eyes, grey(7)).result(60).values[0] == 7
    assert eyes.batches == [1]


def test_an_image_that_waits_for_company_is_encoded_when_the_worker_is_closed() -> None:
    worker, eyes = InferenceWorker(longest_wait_s=3600), Eyes(largest_batch=64)
    answer = worker.encode(eyes, grey(7))
    worker.close()
    assert answer.result(0).values[0] == 7


def test_an_evaluator_that_gives_too_few_encodings_fails_its_views_and_no_others(worker: InferenceWorker) -> None:
    eyes, gate = Eyes(largest_batch=3), block_encoding(worker)
    eyes.encode = lambda images: np.zeros((len(images) - 1, 1), np.float32)
    answers = [worker.encode(eyes, grey(level)) for level in range(3)]
    gate.set()
    for answer in answers:
        with pytest.raises(ValueError, match="shorter"):
            answer.result(60)
    assert worker.encode(Eyes(largest_batch=3), grey(7)).result(60).values[0] == 7


def test_a_batch_takes_live_views_first_and_is_of_one_evaluator(worker: InferenceWorker) -> None:
    eyes, other_eyes, order, gate = Eyes(3), Eyes(3), [], block_encoding(worker)

    def look(evaluator, level, priority):
        answer = worker.encode(evaluator, grey(level), priority)
        answer.add_done_callback(lambda future: order.append((priority.name, int(future.result().values[0]))))
        return answer

    frames = [look(eyes, level, Priority.BATCH) for level in (1, 2)]
    live = [look(eyes, 3, Priority.LIVE), look(other_eyes, 4, Priority.LIVE), look(eyes, 5, Priority.LIVE)]
    gate.set()
    for answer in (*frames, *live):
        answer.result(60)
    worker.close()  # and so the last callback has run
    assert order == [("LIVE", 3), ("LIVE", 4), ("LIVE", 5), ("BATCH", 1), ("BATCH", 2)]
    assert eyes.batches == [1, 3]  # the other evaluator's view came in between, and keeps its place
    assert other_eyes.batches == [1]


def test_one_bad_image_fails_alone_and_a_cancelled_one_is_not_encoded(worker: InferenceWorker) -> None:
    eyes, gate = Eyes(largest_batch=4), block_encoding(worker)
    answers = [worker.encode(eyes, grey(level)) for level in (1, 255, 3, 4)]
    assert answers[3].cancel()  # and is not encoded
    gate.set()
    assert [answers[place].result(60).values[0] for place in (0, 2)] == [1, 3]
    assert eyes.batches == [3, 1, 1, 1]
    with pytest.raises(InvalidImageError):
        answers[1].result(60)


def test_images_and_long_work_do_not_wait_for_each_other(worker: InferenceWorker) -> None:
    gate = block_encoding(worker)
    assert worker.submit(lambda: 7).result(60) == 7
    for _ in range(16):
        worker.encode(Eyes(1), grey(1))
    with pytest.raises(OverloadedError):
        worker.encode(Eyes(1), grey(1))
    gate.set()
    end_of_work = threading.Event()
    worker.submit(end_of_work.wait)
    assert worker.encode(Eyes(1), grey(7), Priority.BATCH).result(60).values[0] == 7
    end_of_work.set()


def test_what_is_short_runs_where_it_is_asked_for(worker: InferenceWorker) -> None:
    async def thread_name(*, is_short: bool) -> str:
        return await worker.computed(lambda: threading.current_thread().name, is_short=is_short)

    assert asyncio.run(thread_name(is_short=True)) == threading.current_thread().name
    assert asyncio.run(thread_name(is_short=False)) == "inference"


def test_a_network_that_cannot_be_loaded_fails_its_views_and_the_thread_goes_on(worker: InferenceWorker) -> None:
    class Missing:
        @property
        def largest_batch(self) -> int:
            raise InvalidInputError("no weights")

        def encode(self, _: object) -> None:
            raise InvalidInputError("no weights")

    with pytest.raises(InvalidInputError, match="no weights"):
        worker.encode(Missing(), grey(1)).result(60)
    assert worker.encode(Eyes(1), grey(7)).result(60).values[0] == 7
    assert worker.is_alive
