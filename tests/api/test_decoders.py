"""How many images are decoded at once, and who waits for whom."""

import asyncio
import threading
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest

from deepsimbad.api.decoders import LARGE_WAITING, SLOTS, Decoded, Decoders
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
        n_slots = SLOTS[Priority.BATCH]
        asked = [asyncio.create_task(decoders.decoded(USUAL, slow, Priority.BATCH)) for _ in range(3 * n_slots)]
        await until(lambda: len(slow.held) == n_slots)
        live = await decoders.decoded(USUAL, FeatureL2("gradient_grid"), Priority.LIVE)
        assert live.image.shape == (128, 128, 3)
        assert len(slow.held) == n_slots
        slow.go.set()
        assert [done.image.shape for done in await asyncio.gather(*asked)] == [(8, 8, 3)] * len(asked)
        assert slow.most == n_slots

    asyncio.run(body())


def test_large_images_wait_for_each_other_and_usual_ones_for_none_of_them(slow: Slow) -> None:
    async def body() -> None:
        decoders = Decoders(MAX_PIXELS)
        large = [asyncio.create_task(decoders.decoded(LARGE, slow, Priority.LIVE)) for _ in range(LARGE_WAITING + 4)]
        await until(lambda: sum(each.done() for each in large) == 3)  # one has its turn, eight wait
        usual = await decoders.decoded(USUAL, FeatureL2("gradient_grid"), Priority.LIVE)
        assert usual.image.shape == (128, 128, 3)
        await until(lambda: slow.held == [(1080, 1920, 3)])
        slow.go.set()
        ended = await asyncio.gather(*large, return_exceptions=True)
        refused = [each for each in ended if isinstance(each, OverloadedError)]
        assert len(refused) == 3
        assert refused[0].hints["retry_after_s"] == 1
        reduced = [each.image.shape for each in ended if isinstance(each, Decoded)]
        assert reduced == [(1080, 1920, 3)] * (LARGE_WAITING + 1)
        assert slow.most == 1

    asyncio.run(body())


def test_a_refused_image_takes_no_place() -> None:
    async def body() -> None:
        decoders, eyes = Decoders(64), FeatureL2("gradient_grid")
        for _ in range(2 * SLOTS[Priority.LIVE]):
            with pytest.raises(ImageTooLargeError):
                await decoders.decoded(LARGE, eyes, Priority.LIVE)
            with pytest.raises(UnsupportedMediaTypeError):
                await decoders.decoded(USUAL, FeatureL2("none"), Priority.LIVE)
        assert (await decoders.decoded(USUAL, eyes, Priority.LIVE)).image.shape == (128, 128, 3)

    asyncio.run(body())


def test_what_shows_nothing_is_known_by_the_image_as_it_was_sent() -> None:
    async def body() -> None:
        decoders, eyes = Decoders(64), FeatureL2("gradient_grid")
        assert (await decoders.decoded(BLANK, eyes, Priority.LIVE)).is_blank
        assert not (await decoders.decoded(USUAL, eyes, Priority.LIVE)).is_blank

    asyncio.run(body())
