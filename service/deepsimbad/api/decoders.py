"""Images on their way from a body to the inference worker: few at once, whatever is sent."""

from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

from anyio import CapacityLimiter
from anyio.to_thread import run_sync

from deepsimbad.engine.worker import Priority
from deepsimbad.errors import OverloadedError
from deepsimbad.evaluators.base import Image
from deepsimbad.evaluators.image import KEPT_PIXELS, claimed_pixels, decode_image

SLOTS = {Priority.LIVE: 4, Priority.BATCH: 2}  # images decoded and not yet looked at, each of up to KEPT_PIXELS
LARGE_WAITING = 8  # larger images that may wait for the one that is being decoded


class Decoders:
    """Decodes images in threads, and lets the next one begin when nobody needs the last one's pixels any more.

    An image of more than `KEPT_PIXELS` takes most of a second and memory for all its pixels until it is reduced. So
    there is one of those at a time, and usual images never wait for one; when too many wait, more are refused.

    Args:
        max_pixels: Most pixels that an image's header may claim.
    """

    def __init__(self, max_pixels: int) -> None:
        self._max_pixels = max_pixels
        # Live views have slots of their own: frames of a traverse hold theirs until no live view waits.
        self._slots = {priority: CapacityLimiter(n_slots) for priority, n_slots in SLOTS.items()}
        self._large = CapacityLimiter(1)
        self._threads = CapacityLimiter(sum(SLOTS.values()))

    @asynccontextmanager
    async def decoded(self, body: bytes, priority: Priority) -> AsyncIterator[Image]:
        """The image in a body, for as long as the block lasts; behind it nobody should hold it for long.

        Raises:
            InvalidImageError, ImageTooLargeError, EmptyBodyError: As `decode_image`.
            OverloadedError: The image is large, and as many large ones wait as may.
        """
        n_pixels = await run_sync(claimed_pixels, body, self._max_pixels)
        async with AsyncExitStack() as until_decoded, AsyncExitStack() as until_seen:
            if n_pixels > KEPT_PIXELS:
                self._check_large()
                await until_decoded.enter_async_context(self._large)
            await until_seen.enter_async_context(self._slots[priority])
            image = await run_sync(decode_image, body, self._max_pixels, limiter=self._threads)
            await until_decoded.aclose()
            yield image

    def _check_large(self) -> None:
        if self._large.statistics().tasks_waiting >= LARGE_WAITING:
            raise OverloadedError(
                f"images of more than {KEPT_PIXELS} pixels are looked at one by one, and {LARGE_WAITING} wait: "
                "send smaller ones, or try again in a moment",
                retry_after_s=1,
                most_pixels_at_once=KEPT_PIXELS,
            )
