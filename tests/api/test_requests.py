"""Long bodies are read beside the event loop, and none that is longer than anything here."""

import threading
from types import SimpleNamespace

import pytest
from anyio import CapacityLimiter

from deepsimbad.api import requests
from deepsimbad.api.frames import FrameBody
from deepsimbad.api.problems import InvalidRequestError
from deepsimbad.api.requests import MAX_NUMBERS, parse_json

pytestmark = pytest.mark.anyio


@pytest.fixture
def running():
    return SimpleNamespace(long_work=CapacityLimiter(1))  # as much of the service as these need


@pytest.mark.parametrize("n_blanks", [0, 1 << 16])
async def test_a_long_body_is_read_in_a_thread(running, n_blanks, monkeypatch):
    threads = []
    parsed = requests._parsed

    def noting(body, kind):
        threads.append(threading.get_ident())
        return parsed(body, kind)

    monkeypatch.setattr(requests, "_parsed", noting)
    body = await parse_json(b'{"encoding":[1.5' + b" " * n_blanks + b"]}", FrameBody, running)
    assert body.encoding == (1.5,)
    assert (threads == [threading.get_ident()]) == (n_blanks == 0)


async def test_a_body_of_too_many_numbers_is_refused_before_it_is_parsed(running):
    most = b'{"encoding":[' + b"1," * (MAX_NUMBERS - 1) + b"1%s]}"
    assert len((await parse_json(most % b"", FrameBody, running)).encoding) == MAX_NUMBERS
    with pytest.raises(InvalidRequestError, match="numbers"):
        await parse_json(most % b",1", FrameBody, running)
