"""Images on their way from a body to the inference worker: few are decoded at once, whatever is sent."""

from dataclasses import dataclass

from anyio import CapacityLimiter
from anyio.to_thread import run_sync

from deepsimbad.engine.encoders import ready
from deepsimbad.engine.worker import Priority
from deepsimbad.errors import OverloadedError
from deepsimbad.evaluators.base import Evaluator, Image
from deepsimbad.evaluators.image import KEPT_PIXELS, ImageFile, is_blank

SLOTS = {Priority.LIVE: 4, Priority.BATCH: 2}  # images decoded and not yet reduced, each of up to KEPT_PIXELS
LARGE_WAITING = 8  # larger images that may wait for the one that is being decoded


@dataclass(frozen=True)
class Decoded:
    """An image at the size that its evaluator encodes.

    Attributes:
        image: [height, width, 3] uint8 BGR.
        is_blank: Whether it shows nothing.
    """

    image: Image
    is_blank: bool


class Decoders:
    """Decodes images in threads and brings them to their evaluator's size there, so that little of each is held.

    An image of more than `KEPT_PIXELS` takes most of a second and memory for all its pixels until it is reduced. So
    there is one of those at a time, and usual images never wait for one; when too many wait, more are refused.

    Args:
        max_pixels: Most pixels that an image's header may claim.
    """

    def __init__(self, max_pixels: int) -> None:
        self._max_pixels = max_pixels
        # Live views have slots of their own: frames of a traverse must not keep them waiting.
        self._slots = {priority: CapacityLimiter(n_slots) for priority, n_slots in SLOTS.items()}
        self._large = CapacityLimiter(1)

    async def decoded(self, body: bytes, evaluator: Evaluator, priority: Priority) -> Decoded:
        """The image in a body.

        Raises:
            InvalidImageError, ImageTooLargeError, EmptyBodyError: As `ImageFile`.
            UnsupportedMediaTypeError: The evaluator takes ready encodings alone.
            EvaluatorUnavailableError: It cannot be loaded any more.
            OverloadedError: The image is large, and as many large ones wait as may.
        """
        slots = self._slots[priority]
        image = await run_sync(self._read, body, evaluator, limiter=slots)
        if isinstance(image, Decoded):
            return image
        self._check_large()
        async with self._large:
            return await run_sync(_decode, image, evaluator, limiter=slots)

    def _read(self, body: bytes, evaluator: Evaluator) -> Decoded | ImageFile:
        """The file where its image is large, else what it decodes to."""
        file = ImageFile.read(body, self._max_pixels)
        return file if file.n_pixels > KEPT_PIXELS else _decode(file, evaluator)

    def _check_large(self) -> None:
        if self._large.statistics().tasks_waiting >= LARGE_WAITING:
            raise OverloadedError(
                f"images of more than {KEPT_PIXELS} pixels are looked at one by one, and {LARGE_WAITING} wait: "
                "send smaller ones, or try again in a moment",
                retry_after_s=1,
                most_pixels_at_once=KEPT_PIXELS,
            )


def _decode(file: ImageFile, evaluator: Evaluator) -> Decoded:
    ready(evaluator)  # where it is not, decoding is in vain
    image = file.decode()
    return Decoded(evaluator.prepare(image), is_blank(image))
