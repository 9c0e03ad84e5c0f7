"""Work on many items at once, hand the results back in order, and never run far ahead."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_order(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    concurrency: int,
    on_end: Callable[[], None] | None = None,
) -> Iterator[tuple[Item, Result]]:
    """Yield (item, work(item)) in the items' order, with at most `concurrency` at work and as many waiting.

    The first failure is raised in its turn; what has not begun by then never begins. So it is when the caller stops.
    `on_end` is called then, before what is still at work is waited for: long work can look whether it should go on.
    """
    executor = ThreadPoolExecutor(max_workers=max(1, concurrency), thread_name_prefix="deepsimbad-client")
    pending: deque[tuple[Item, Future[Result]]] = deque()
    try:
        for item in items:
            pending.append((item, executor.submit(work, item)))
            if len(pending) >= 2 * max(1, concurrency):
                first, future = pending.popleft()
                yield first, future.result()
        while pending:
            first, future = pending.popleft()
            yield first, future.result()
    finally:
        if on_end is not None:
            on_end()
        executor.shutdown(wait=True, cancel_futures=True)
