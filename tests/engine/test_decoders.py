"""Images decoded beside the event loop: how many at once, and who waits for whom."""

import asyncio
import threading

import cv2
import numpy as np
import pytest

from deepsimbad.engine.decoders import Decoders
from deepsimbad.engine.worker import Priority
from deepsimbad.errors import ImageTooLargeError, OverloadedError, UnsupportedMediaTypeError
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.image import KEPT_PIXELS

SMALL = cv2.imencode(".png", np.arange(192, dtype=np.uint8).reshape(8, 8, 3))[1].tobytes()
BLANK = cv2.imencode(".png", np.full((8, 8, 3), 90, np.uint8))[1].tobytes()
LARGE = cv2.imencode(".png", np.full((2161, 3840, 3), 90, np.uint8))[1].tobytes()
EYES = FeatureL2("gradient_grid")
pytestmark = pytest.mark.anyio


async def wait_until(condition):
    for _ in range(6000):
        if condition():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it did not come about")


class HoldingEvaluator:
    """An evaluator that holds every image, in its decoder's thread, until it is let go."""

    def __init__(self):
        self.shapes = []
        self.n_most = 0
        self.go = threading.Event()
        self._lock = threading.Lock()

    def load(self):
        pass

    def prepare(self, image):
        with self._lock:
            self.shapes.append(image.shape)
            self.n_most = max(self.n_most, len(self.shapes))
        self.go.wait()
        with self._lock:
            self.shapes.remove(image.shape)
        return image


@pytest.fixture
def holder():
    holder = HoldingEvaluator()
    yield holder
    holder.go.set()


async def shape_of(decoders, body, eyes=EYES, priority=Priority.LIVE):
    picture = await decoders.decoded(body, eyes, priority, None)
    return picture.image.shape


async def test_few_images_are_held_at_full_size_and_live_views_have_places_of_their_own(holder):
    decoders = Decoders(2 * KEPT_PIXELS)
    tasks = [asyncio.create_task(shape_of(decoders, SMALL, holder, Priority.BATCH)) for _ in range(6)]
    await wait_until(lambda: len(holder.shapes) == 2)
    assert await shape_of(decoders, SMALL) == (128, 128, 3)
    assert len(holder.shapes) == 2
    holder.go.set()
    assert await asyncio.gather(*tasks) == [(8, 8, 3)] * 6
    assert holder.n_most == 2


async def test_large_images_wait_for_each_other_and_usual_ones_for_none_of_them(holder):
    decoders = Decoders(2 * KEPT_PIXELS)
    n_taken = 1 + Decoders.LARGE_WAITING  # one has its turn
    tasks = [asyncio.create_task(shape_of(decoders, LARGE, holder)) for _ in range(n_taken + 3)]
    await wait_until(lambda: sum(task.done() for task in tasks) == 3)
    assert await shape_of(decoders, SMALL) == (128, 128, 3)
    await wait_until(lambda: holder.shapes == [(1080, 1920, 3)])
    holder.go.set()
    answers = await asyncio.gather(*tasks, return_exceptions=True)
    assert [answer.hints["retry_after_s"] for answer in answers if isinstance(answer, OverloadedError)] == [1] * 3
    assert answers.count((1080, 1920, 3)) == n_taken
    assert holder.n_most == 1


async def test_a_refused_image_takes_no_place_and_what_shows_nothing_is_known_as_it_was_sent():
    decoders = Decoders(64)
    for _ in range(8):
        with pytest.raises(ImageTooLargeError):
            await decoders.decoded(LARGE, EYES, Priority.LIVE, None)
        with pytest.raises(UnsupportedMediaTypeError):
            await decoders.decoded(SMALL, FeatureL2("none"), Priority.LIVE, None)
    assert [(await decoders.decoded(body, EYES, Priority.LIVE, None)).is_blank for body in (BLANK, SMALL)] == [
        True,
        False,
    ]
