"""The inference worker: who goes first, and what becomes of errors."""

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from deepsimbad.engine.localizer import NothingSeen
from deepsimbad.engine.worker import EncodedImage, InferenceWorker, Priority
from deepsimbad.errors import InvalidImageError, InvalidInputError, OverloadedError, UnavailableError


@pytest.fixture
def worker() -> Iterator[InferenceWorker]:
    made = InferenceWorker(max_waiting=16)
    yield made
    made.close()


def test_live_goes_before_batch_and_each_in_order_of_arrival(worker: InferenceWorker) -> None:
    gate, done = threading.Event(), []
    first = worker.submit(gate.wait)
    batch = [worker.submit(lambda n=n: done.append(("batch", n)), Priority.BATCH) for n in range(3)]
    live = [worker.submit(lambda n=n: done.append(("live", n)), Priority.LIVE) for n in range(3)]
    assert worker.n_waiting >= 6
    gate.set()
    for answer in (first, *batch, *live):
        answer.result(60)
    assert done == [("live", 0), ("live", 1), ("live", 2), ("batch", 0), ("batch", 1), ("batch", 2)]
    assert worker.n_waiting == 0


def test_an_error_reaches_the_one_who_asked_and_nobody_else(worker: InferenceWorker) -> None:
    def fail() -> None:
        raise InvalidInputError("no")

    failing, sound = worker.submit(fail), worker.submit(lambda: 7)
    with pytest.raises(InvalidInputError, match="no"):
        failing.result(60)
    assert sound.result(60) == 7


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
    gate, begun = threading.Event(), threading.Event()
    worker.submit(lambda: (begun.set(), gate.wait(60)))
    assert begun.wait(60)
    for priority in (Priority.LIVE, Priority.BATCH):
        waiting = [worker.submit(lambda: 1, priority) for _ in range(16)]
        with pytest.raises(OverloadedError) as caught:
            worker.submit(lambda: 1, priority)
        assert caught.value.hints["retry_after_s"] == 1
    gate.set()
    assert [answer.result(60) for answer in waiting] == [1] * 16
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


def looked(worker, eyes, levels, priority=Priority.LIVE):
    """Answers to come of images that all wait before the worker gets to the first."""
    gate = threading.Event()
    worker.submit(gate.wait)
    answers = [worker.look(eyes, grey(level), lambda seen: seen, priority) for level in levels]
    return gate, answers


def test_images_that_wait_are_encoded_together_as_many_as_pay(worker: InferenceWorker) -> None:
    eyes = Eyes(largest_batch=4)
    gate, answers = looked(worker, eyes, range(10))
    gate.set()
    seen = [answer.result(60) for answer in answers]
    assert all(isinstance(view, EncodedImage) and view.weights_sha256 == eyes.weights_sha256 for view in seen)
    assert [view.values.tolist() for view in seen] == [[level] for level in range(10)]
    assert eyes.batches == [4, 4, 2]
    assert worker.n_waiting == 0


def test_where_batches_do_not_pay_nobody_waits_for_company() -> None:
    worker, eyes = InferenceWorker(longest_wait_s=3600), Eyes(largest_batch=1)
    try:
        gate, answers = looked(worker, eyes, range(3))
        gate.set()
        assert [answer.result(60).values[0] for answer in answers] == [0, 1, 2]
        assert eyes.batches == [1, 1, 1]
    finally:
        worker.close()


def test_an_image_waits_for_company_no_longer_than_it_may() -> None:
    worker, eyes = InferenceWorker(longest_wait_s=0.02), Eyes(largest_batch=64)
    try:
        assert worker.look(eyes, grey(7), lambda seen: seen.values[0]).result(60) == 7
        assert eyes.batches == [1]
    finally:
        worker.close()


def test_an_evaluator_that_gives_too_few_encodings_fails_its_views_and_no_others(worker: InferenceWorker) -> None:
    eyes = Eyes(largest_batch=3)
    eyes.encode = lambda images: np.zeros((len(images) - 1, 1), np.float32)
    gate, answers = looked(worker, eyes, range(3))
    gate.set()
    for answer in answers:
        with pytest.raises(ValueError, match="shorter"):
            answer.result(60)
    assert worker.submit(lambda: 7).result(60) == 7


def test_a_batch_takes_live_views_first_and_is_of_one_evaluator(worker: InferenceWorker) -> None:
    eyes, others, order = Eyes(3), Eyes(3), []
    gate = threading.Event()
    worker.submit(gate.wait)

    def look(at, level, priority):
        return worker.look(at, grey(level), lambda seen: order.append((priority.name, int(seen.values[0]))), priority)

    frames = [look(eyes, level, Priority.BATCH) for level in (1, 2)]
    live = [look(eyes, 3, Priority.LIVE), look(others, 4, Priority.LIVE), look(eyes, 5, Priority.LIVE)]
    gate.set()
    for answer in (*frames, *live):
        answer.result(60)
    assert order == [("LIVE", 3), ("LIVE", 4), ("LIVE", 5), ("BATCH", 1), ("BATCH", 2)]
    assert eyes.batches == [1, 3]  # the other evaluator's view came in between, and keeps its place
    assert others.batches == [1]


def test_one_bad_image_fails_alone_and_a_cancelled_one_is_not_encoded(worker: InferenceWorker) -> None:
    eyes = Eyes(largest_batch=4)
    gate, answers = looked(worker, eyes, [1, 255, 3, 4])
    assert answers[3].cancel()  # and is not encoded
    gate.set()
    assert [answers[place].result(60).values[0] for place in (0, 2)] == [1, 3]
    assert eyes.batches == [3, 1, 1, 1]
    with pytest.raises(InvalidImageError):
        answers[1].result(60)


def test_what_needs_no_encoding_is_passed_on_as_it_is(worker: InferenceWorker) -> None:
    eyes, nothing = Eyes(4), NothingSeen()
    assert worker.look(eyes, nothing, lambda seen: seen).result(60) is nothing
    assert eyes.batches == []


def test_slow_answers_fill_the_queue_that_is_counted() -> None:
    worker, eyes, gate = InferenceWorker(max_waiting=3), Eyes(largest_batch=1), threading.Event()
    answers = []
    try:
        looks = (worker.look(eyes, grey(n), lambda seen: (gate.wait(60), seen)[1]) for n in range(100))
        with pytest.raises(OverloadedError):
            answers.extend(looks)
        assert len(answers) < 30
        gate.set()
        assert [answer.result(60).values[0] for answer in answers] == list(range(len(answers)))
    finally:
        gate.set()
        worker.close()
