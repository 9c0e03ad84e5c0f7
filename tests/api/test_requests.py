"""Bodies read and images decoded beside the event loop: how many at once, and who waits for whom."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import pytest
from anyio import CapacityLimiter

from deepsimbad.api import requests
from deepsimbad.api.problems import InvalidRequestError
from deepsimbad.api.requests import LONG_LIST, MAX_NUMBERS, Decoders, Services, parse_json
from deepsimbad.api.traverses import EncodingBody
from deepsimbad.engine.worker import Priority
from deepsimbad.errors import ImageTooLargeError, OverloadedError, UnsupportedMediaTypeError
from deepsimbad.evaluators.base import Image
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.image import KEPT_PIXELS

PLAIN = np.arange(192, dtype=np.uint8).reshape(8, 8, 3)
USUAL = cv2.imencode(".png", PLAIN)[1].tobytes()
BLANK = cv2.imencode(".png", np.full((8, 8, 3), 90, np.uint8))[1].tobytes()
LARGE = cv2.imencode(".png", np.full((2161, 3840, 3), 90, np.uint8))[1].tobytes()
MAX_PIXELS = 2 * KEPT_PIXELS


async def until(met: Callable[[], bool]) -> None:
    for _ in range(6000):
        if met():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it did not come about")


class Slow:
    """An evaluator that holds every image, in its decoder's thread, until it is let go."""

    def __init__(self) -> None:
        self.held: list[tuple[int, ...]] = []
        self.most = 0
        self.go = threading.Event()
        self._lock = threading.Lock()

    def load(self) -> None:
        pass

    def prepare(self, image: Image) -> Image:
        with self._lock:
            self.held.append(image.shape)
            self.most = max(self.most, len(self.held))
        self.go.wait()
        with self._lock:
            self.held.remove(image.shape)
        return image


@pytest.fixture
def slow() -> Iterator[Slow]:
    made = Slow()
    yield made
    made.go.set()


def test_few_images_are_held_at_full_size_and_live_views_have_places_of_their_own(slow: Slow) -> None:
    async def body() -> None:
        decoders = Decoders(MAX_PIXELS)
        n_slots = 2
        asked = [asyncio.create_task(decoders.decoded(USUAL, slow, Priority.BATCH)) for _ in range(3 * n_slots)]
        await until(lambda: len(slow.held) == n_slots)
        live = await decoders.decoded(USUAL, FeatureL2("gradient_grid"), Priority.LIVE)
        assert live[0].shape == (128, 128, 3)
        assert len(slow.held) == n_slots
        slow.go.set()
        assert [done[0].shape for done in await asyncio.gather(*asked)] == [(8, 8, 3)] * len(asked)
        assert slow.most == n_slots

    asyncio.run(body())


def test_large_images_wait_for_each_other_and_usual_ones_for_none_of_them(slow: Slow) -> None:
    async def body() -> None:
        decoders = Decoders(MAX_PIXELS)
        large = [
            asyncio.create_task(decoders.decoded(LARGE, slow, Priority.LIVE)) for _ in range(Decoders.LARGE_WAITING + 4)
        ]
        await until(lambda: sum(each.done() for each in large) == 3)  # one has its turn, eight wait
        usual = await decoders.decoded(USUAL, FeatureL2("gradient_grid"), Priority.LIVE)
        assert usual[0].shape == (128, 128, 3)
        await until(lambda: slow.held == [(1080, 1920, 3)])
        slow.go.set()
        ended = await asyncio.gather(*large, return_exceptions=True)
        refused = [each for each in ended if isinstance(each, OverloadedError)]
        assert len(refused) == 3
        assert refused[0].hints["retry_after_s"] == 1
        reduced = [each[0].shape for each in ended if isinstance(each, tuple)]
        assert reduced == [(1080, 1920, 3)] * (Decoders.LARGE_WAITING + 1)
        assert slow.most == 1

    asyncio.run(body())


def test_a_refused_image_takes_no_place() -> None:
    async def body() -> None:
        decoders, eyes = Decoders(64), FeatureL2("gradient_grid")
        for _ in range(2 * 4):
            with pytest.raises(ImageTooLargeError):
                await decoders.decoded(LARGE, eyes, Priority.LIVE)
            with pytest.raises(UnsupportedMediaTypeError):
                await decoders.decoded(USUAL, FeatureL2("none"), Priority.LIVE)
        assert (await decoders.decoded(USUAL, eyes, Priority.LIVE))[0].shape == (128, 128, 3)

    asyncio.run(body())


def test_what_shows_nothing_is_known_by_the_image_as_it_was_sent() -> None:
    async def body() -> None:
        decoders, eyes = Decoders(64), FeatureL2("gradient_grid")
        assert (await decoders.decoded(BLANK, eyes, Priority.LIVE))[1]
        assert not (await decoders.decoded(USUAL, eyes, Priority.LIVE))[1]

    asyncio.run(body())


class Running:
    """As much of the service as reads bodies and writes answers."""

    def __init__(self) -> None:
        self.long_work = CapacityLimiter(1)
        self.written = Services.written.__get__(self)


@pytest.mark.parametrize("n_listed", [0, LONG_LIST, LONG_LIST + 1])
def test_a_long_answer_is_written_in_a_thread(n_listed: int) -> None:
    async def body() -> tuple[int, bytes]:
        return await Running().written(n_listed, threading.get_ident)

    assert (asyncio.run(body())[0] == threading.get_ident()) == (n_listed <= LONG_LIST)


@pytest.mark.parametrize("n_blanks", [0, 1 << 16])
def test_a_long_body_is_read_in_a_thread(n_blanks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[int] = []
    parsed = requests._parsed

    def noting(body: bytes, kind: type[EncodingBody]) -> EncodingBody:
        threads.append(threading.get_ident())
        return parsed(body, kind)

    monkeypatch.setattr(requests, "_parsed", noting)
    body = asyncio.run(_encoding(b'{"encoding":[1.5' + b" " * n_blanks + b"]}"))
    assert body.encoding == [1.5]
    assert (threads == [threading.get_ident()]) == (n_blanks == 0)


async def _encoding(body: bytes) -> EncodingBody:
    running: Any = Running()
    return await parse_json(body, EncodingBody, running)


def test_a_body_of_too_many_numbers_is_refused_before_it_is_parsed() -> None:
    most = b'{"encoding":[' + b"1," * (MAX_NUMBERS - 1) + b"1%s]}"
    assert len(asyncio.run(_encoding(most % b"")).encoding) == MAX_NUMBERS
    with pytest.raises(InvalidRequestError, match="numbers"):
        asyncio.run(_encoding(most % b",1"))
