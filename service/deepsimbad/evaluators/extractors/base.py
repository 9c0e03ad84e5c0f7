"""The contract of an extractor."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from deepsimbad.evaluators.base import Image


class Extractor(Protocol):
    """A pure function from images to unit-length encodings. Loaded when it is made; usable from several threads."""

    @property
    def input_size(self) -> tuple[int, int] | None:
        """(width, height) in pixels it works at, aspect not kept; None: it takes images as they are."""

    @property
    def encoding_dim(self) -> int:
        """Length d of its encodings."""

    @property
    def weights_sha256(self) -> str | None:
        """SHA-256 in hex of the file its weights come from; None where it has none."""

    @property
    def largest_batch(self) -> int:
        """How many images are best encoded at once here; more only take more memory."""

    def prepare(self, image: Image) -> Image:
        """Bring an image to the size it is encoded at; one that is there already comes back as it is."""

    def encode(self, images: Sequence[Image]) -> NDArray[np.float32]:
        """Encode images.

        Args:
            images: n of [height, width, 3] uint8 BGR, of any size.

        Returns:
            [n, d] float32, rows of unit length, also for a uniform image. An image's encoding does not depend on the
            others in the call beyond the last bits of a float32.

        Raises:
            UnavailableError: There is no memory left for it.
        """
