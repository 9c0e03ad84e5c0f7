"""Pictures decoded beside the event loop as requests bring them, few at once, with remarks on each."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from anyio import CapacityLimiter
from anyio.to_thread import run_sync

from deepsimbad.core.frames import Camera
from deepsimbad.engine.worker import Priority, ready
from deepsimbad.errors import OverloadedError
from deepsimbad.evaluators.base import Evaluator, Image
from deepsimbad.evaluators.grey_levels import CLIPPED, FEW_GREYS, GreyLevels, clips, holds_few_greys, in_eight_bits
from deepsimbad.evaluators.image import KEPT_PIXELS, decode_deep, is_blank, picture_size
from deepsimbad.evaluators.image_files import ImageFile


class Decoders:
    """Decodes images in few threads and brings them to their evaluator's size there, so that little of each is held.

    An image of more than `KEPT_PIXELS` takes most of a second and memory for all its pixels until it is reduced. So
    there is one of those at a time, and usual images never wait for one; where eight wait, more are refused.
    """

    LARGE_WAITING = 8

    def __init__(self, max_pixels: int) -> None:
        self._max_pixels = max_pixels
        # Live views have threads of their own: frames of a traverse must not keep them waiting.
        self._threads = {Priority.LIVE: CapacityLimiter(4), Priority.BATCH: CapacityLimiter(2)}
        self._large = CapacityLimiter(1)

    async def decoded(
        self,
        body: bytes,
        evaluator: Evaluator,
        priority: Priority,
        levels: GreyLevels | None,
        cameras: Sequence[Camera] = (),
    ) -> "Decoded":
        """The image in a body at its evaluator's size; `levels` as `decode_file` takes them, `cameras` as `Decoded.of`.

        Raises:
            InvalidImageError, ImageTooLargeError, EmptyBodyError, OutOfMemoryError: As `ImageFile`.
            UnsupportedMediaTypeError, EvaluatorUnavailableError: The evaluator takes no images, or cannot be loaded.
            OverloadedError: The image is large, and as many large ones wait as may.
        """
        threads = self._threads[priority]
        image = await run_sync(self._read, body, evaluator, levels, cameras, limiter=threads)
        if not isinstance(image, ImageFile):
            return image
        if self._large.statistics().tasks_waiting >= self.LARGE_WAITING:
            raise OverloadedError(
                f"images of more than {KEPT_PIXELS} pixels are looked at one by one, and {self.LARGE_WAITING} wait: "
                "send smaller ones, or try again in a moment",
                retry_after_s=1,
                most_pixels_at_once=KEPT_PIXELS,
            )
        async with self._large:
            return await run_sync(Decoded.of, image, body, evaluator, levels, cameras, limiter=threads)

    def _read(
        self, body: bytes, evaluator: Evaluator, levels: GreyLevels | None, cameras: Sequence[Camera]
    ) -> "Decoded | ImageFile":
        """The file where its image is large, else what it decodes to."""
        file = ImageFile.read(body, self._max_pixels)
        return file if file.n_pixels > KEPT_PIXELS else Decoded.of(file, body, evaluator, levels, cameras)


class Decoded(NamedTuple):
    """An image, and what is known of its picture."""

    image: Image  # [height, width, 3] uint8 BGR at its evaluator's size
    is_blank: bool  # whether it shows nothing; judged at the evaluator's size, so that the size sent does not matter
    size: tuple[int, int] | None  # (width, height) as it was sent, upright by its file; None where nobody can tell
    levels: GreyLevels | None  # by which it is shown; None: it had 8 bits
    remarks: list[str]  # for a person, in sentences
    body: bytes  # the file it came in

    @classmethod
    def of(
        cls,
        file: ImageFile,
        body: bytes,
        evaluator: Evaluator,
        levels: GreyLevels | None,
        cameras: Sequence[Camera] = (),
    ) -> Self:
        """Decode the file in a body; takes milliseconds.

        A remark says where it is unlike the pictures of `cameras`, the map's; one that lies on its side in NCLT's way
        is turned upright.
        """
        ready(evaluator)  # where it is not, decoding is in vain
        pixels, size = decode_deep(file), picture_size(body)
        remarks = [CLIPPED] if levels is not None and clips(pixels, levels) else []
        pixels, levels_shown = in_eight_bits(pixels, levels)
        if size is not None and (turn := Camera(*size).turn_to(cameras)):
            pixels = np.ascontiguousarray(np.rot90(pixels, -turn // 90))
            remarks.append(f"the view lies on its side as NCLT's files do: it was turned by {turn} degrees")
        elif size is not None and (difference := Camera(*size).unlike(cameras, "the map's")) is not None:
            remarks.append(f"the view's pixels are not like the map's: {difference}")
        image = evaluator.prepare(pixels)
        shows_nothing = is_blank(image)
        remarks += [FEW_GREYS] if not shows_nothing and holds_few_greys(image) else []
        return cls(image, shows_nothing, size, levels_shown, remarks, body)
