"""Long bodies and answers are worked on beside the event loop, short ones on it."""

import asyncio
import threading

import pytest
from pydantic import BaseModel

from deepsimbad.api import bodies, long_work
from deepsimbad.api.bodies import MAX_NUMBERS, EncodingBody, parse_json
from deepsimbad.api.long_work import LONG_LIST, off_the_loop, written
from deepsimbad.api.problems import InvalidRequestError


class Answer(BaseModel):
    thread: int


def here() -> Answer:
    return Answer(thread=threading.get_ident())


@pytest.mark.parametrize("n_listed", [0, LONG_LIST, LONG_LIST + 1])
def test_a_long_answer_is_written_in_a_thread(n_listed: int) -> None:
    answer, text = asyncio.run(written(n_listed, here))
    assert (answer.thread == threading.get_ident()) == (n_listed <= LONG_LIST)
    assert Answer.model_validate_json(text) == answer


def test_few_threads_work_at_once() -> None:
    may_end = threading.Event()
    begun: list[int] = []

    def work() -> None:
        begun.append(threading.get_ident())
        assert may_end.wait(60)

    async def body() -> None:
        tasks = [asyncio.create_task(off_the_loop(work)) for _ in range(5)]
        while len(begun) < long_work._AT_ONCE:
            await asyncio.sleep(0)
        for _ in range(100):
            await asyncio.sleep(0)
        assert len(begun) == long_work._AT_ONCE
        may_end.set()
        await asyncio.gather(*tasks)

    asyncio.run(body())
    assert len(begun) == 5


@pytest.mark.parametrize("n_blanks", [0, 1 << 16])
def test_a_long_body_is_read_in_a_thread(n_blanks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[int] = []
    parsed = bodies._parsed

    def noting(body: bytes, kind: type[EncodingBody]) -> EncodingBody:
        threads.append(threading.get_ident())
        return parsed(body, kind)

    monkeypatch.setattr(bodies, "_parsed", noting)
    found = asyncio.run(parse_json(b'{"encoding":[1.5' + b" " * n_blanks + b"]}", EncodingBody))
    assert found.encoding == [1.5]
    assert (threads == [threading.get_ident()]) == (n_blanks == 0)


def test_a_body_of_too_many_numbers_is_refused_before_it_is_parsed() -> None:
    most = b'{"encoding":[' + b"1," * (MAX_NUMBERS - 1) + b"1%s]}"
    assert len(asyncio.run(parse_json(most % b"", EncodingBody)).encoding) == MAX_NUMBERS
    with pytest.raises(InvalidRequestError, match="numbers"):
        asyncio.run(parse_json(most % b",1", EncodingBody))
