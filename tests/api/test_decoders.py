"""How many images are held at once, and who waits for whom."""

import asyncio
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from deepsimbad.api.decoders import LARGE_WAITING, SLOTS, Decoders
from deepsimbad.engine.worker import Priority
from deepsimbad.errors import ImageTooLargeError, OverloadedError
from deepsimbad.evaluators.image import KEPT_PIXELS

USUAL = cv2.imencode(".png", np.full((8, 8, 3), 90, np.uint8))[1].tobytes()
LARGE = cv2.imencode(".png", np.full((2161, 3840, 3), 90, np.uint8))[1].tobytes()
MAX_PIXELS = 2 * KEPT_PIXELS


async def until(met: Callable[[], bool]) -> None:
    for _ in range(6000):
        if met():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it did not come about")


class Holders:
    """Those who hold an image until they are let go."""

    def __init__(self, decoders: Decoders) -> None:
        self.decoders = decoders
        self.n_holding = 0
        self.go = asyncio.Event()

    async def hold(self, body: bytes, priority: Priority = Priority.LIVE) -> tuple[int, ...]:
        async with self.decoders.decoded(body, priority) as image:
            self.n_holding += 1
            await self.go.wait()
            self.n_holding -= 1
            return image.shape


def test_an_image_keeps_its_place_until_it_was_looked_at() -> None:
    async def body() -> None:
        holders = Holders(Decoders(MAX_PIXELS))
        n_slots = SLOTS[Priority.BATCH]
        asked = [asyncio.create_task(holders.hold(USUAL, Priority.BATCH)) for _ in range(3 * n_slots)]
        await until(lambda: holders.n_holding == n_slots)
        async with holders.decoders.decoded(USUAL, Priority.LIVE) as image:  # live views have places of their own
            assert image.shape == (8, 8, 3)
        assert holders.n_holding == n_slots
        holders.go.set()
        assert await asyncio.gather(*asked) == [(8, 8, 3)] * len(asked)

    asyncio.run(body())


def test_large_images_wait_for_each_other_and_usual_ones_for_none_of_them() -> None:
    async def body() -> None:
        holders = Holders(Decoders(MAX_PIXELS))
        first = [asyncio.create_task(holders.hold(USUAL)) for _ in range(SLOTS[Priority.LIVE])]
        await until(lambda: holders.n_holding == len(first))
        large = [asyncio.create_task(holders.hold(LARGE)) for _ in range(LARGE_WAITING + 4)]
        await until(lambda: sum(each.done() for each in large) == 3)  # one has its turn, eight wait
        async with holders.decoders.decoded(USUAL, Priority.BATCH) as image:
            assert image.shape == (8, 8, 3)
        holders.go.set()
        ended = await asyncio.gather(*first, *large, return_exceptions=True)
        refused = [each for each in ended if isinstance(each, OverloadedError)]
        assert len(refused) == 3
        assert refused[0].hints["retry_after_s"] == 1
        assert ended.count((1080, 1920, 3)) == LARGE_WAITING + 1

    asyncio.run(body())


def test_a_refused_image_takes_no_place() -> None:
    async def body() -> None:
        decoders = Decoders(64)
        for _ in range(2 * SLOTS[Priority.LIVE]):
            with pytest.raises(ImageTooLargeError):
                async with decoders.decoded(LARGE, Priority.LIVE):
                    pass
        async with decoders.decoded(USUAL, Priority.LIVE) as image:
            assert image.shape == (8, 8, 3)

    asyncio.run(body())
