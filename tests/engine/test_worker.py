"""The inference worker: who goes first, and what becomes of errors."""

import threading
from collections.abc import Iterator

import pytest

from deepsimbad.engine.worker import InferenceWorker, Priority
from deepsimbad.errors import InvalidInputError, OverloadedError, UnavailableError


@pytest.fixture
def worker() -> Iterator[InferenceWorker]:
    made = InferenceWorker("worker under test")
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
        answer.result(5)
    assert done == [("live", 0), ("live", 1), ("live", 2), ("batch", 0), ("batch", 1), ("batch", 2)]
    assert worker.n_waiting == 0


def test_an_error_reaches_the_one_who_asked_and_nobody_else(worker: InferenceWorker) -> None:
    def fail() -> None:
        raise InvalidInputError("no")

    failing, sound = worker.submit(fail), worker.submit(lambda: 7)
    with pytest.raises(InvalidInputError, match="no"):
        failing.result(5)
    assert sound.result(5) == 7


def test_what_was_cancelled_before_it_began_does_not_run(worker: InferenceWorker) -> None:
    gate, ran = threading.Event(), []
    worker.submit(gate.wait)
    answer = worker.submit(lambda: ran.append(1))
    assert answer.cancel()
    gate.set()
    worker.submit(lambda: None).result(5)
    assert ran == []


def test_one_thread_runs_all(worker: InferenceWorker) -> None:
    threads = {worker.submit(threading.get_ident).result(5) for _ in range(20)}
    assert len(threads) == 1


def test_closing_finishes_what_is_queued_and_takes_no_more() -> None:
    worker = InferenceWorker()
    gate = threading.Event()
    answers = [worker.submit(gate.wait), *[worker.submit(lambda n=n: n, Priority.BATCH) for n in range(5)]]
    threading.Timer(0.05, gate.set).start()
    worker.close()
    assert [answer.result(0) for answer in answers[1:]] == list(range(5))
    with pytest.raises(UnavailableError):
        worker.submit(lambda: None)
    worker.close()


def test_no_more_of_one_priority_wait_than_may() -> None:
    worker, gate, begun = InferenceWorker(max_waiting=2), threading.Event(), threading.Event()
    try:
        running = worker.submit(lambda: (begun.set(), gate.wait(30)))
        assert begun.wait(30)
        waiting = [worker.submit(lambda: 1, priority) for priority in (Priority.LIVE, Priority.BATCH) for _ in range(2)]
        for priority in (Priority.LIVE, Priority.BATCH):
            assert worker.is_full(priority)
            with pytest.raises(OverloadedError) as caught:
                worker.submit(lambda: 1, priority)
            assert caught.value.hints["retry_after_s"] == 1
        gate.set()
        running.result(30)
        assert [answer.result(30) for answer in waiting] == [1] * 4
        assert not worker.is_full(Priority.LIVE)
        assert worker.submit(lambda: 2).result(30) == 2
    finally:
        gate.set()
        worker.close()
