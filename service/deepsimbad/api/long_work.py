"""Long bodies and long answers: threads of their own work on them, so that the event loop goes on with all else."""

from collections.abc import Callable
from typing import TypeVar

from anyio import CapacityLimiter
from anyio.lowlevel import RunVar
from anyio.to_thread import run_sync
from pydantic import BaseModel

T = TypeVar("T")
AnswerT = TypeVar("AnswerT", bound=BaseModel)

LONG_LIST = 1000  # entries; a list of so many takes some milliseconds
_AT_ONCE = 1  # they hold the interpreter: two would end no sooner, and make the loop wait for both

_threads: RunVar[CapacityLimiter] = RunVar("threads for long work")


async def off_the_loop(run: Callable[[], T]) -> T:
    """Run a function in one of few threads, in order of arrival."""
    try:
        threads = _threads.get()
    except LookupError:
        threads = CapacityLimiter(_AT_ONCE)
        _threads.set(threads)
    return await run_sync(run, limiter=threads)


async def written(n_listed: int, render: Callable[[], AnswerT]) -> tuple[AnswerT, str]:
    """An answer and its JSON.

    Args:
        n_listed: Length of its longest list.
        render: Makes the answer.
    """

    def write() -> tuple[AnswerT, str]:
        answer = render()
        return answer, answer.model_dump_json()

    return await off_the_loop(write) if n_listed > LONG_LIST else write()
