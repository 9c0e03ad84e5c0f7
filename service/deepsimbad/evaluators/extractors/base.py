"""What an extractor is, and one that runs a network: images are brought to its size, then computed in batches."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from deepsimbad.evaluators.base import Image
from deepsimbad.evaluators.image import resized
from deepsimbad.evaluators.runtimes import Run

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of red, green and blue from 0 to 1; most pretrained networks take images standardised by them."""

_LONGEST_SIDE = 1024  # pixels, where images keep their aspect; larger ones are reduced


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
        """See `Evaluator.weights_sha256`."""

    @property
    def largest_batch(self) -> int:
        """How many images are best encoded at once here; more only take more memory."""

    def prepare(self, image: Image) -> Image:
        """Bring an image to the size it is encoded at; one that has it already comes back as it is."""

    def encode(self, images: Sequence[Image]) -> NDArray[np.float32]:
        """Encode images.

        Args:
            images: n of [height, width, 3] uint8 BGR, of any size.

        Returns:
            [n, d] float32, rows of unit length, also for a uniform image. An image's encoding does not depend on the
            others in the call beyond the last bits of a float32.

        Raises:
            OutOfMemoryError: There is no memory left for it.
        """


@dataclass(frozen=True)
class NetworkExtractor:
    """An extractor that runs a network."""

    run: Run  # the network
    encoding_dim: int  # d
    weights_sha256: str | None  # as `encodings_sha256` gives it
    input_size: tuple[int, int] | None  # (width, height) every image is brought to; None: they keep their aspect
    shortest_side: int = 1  # pixels, of images that keep their aspect; shorter sides are enlarged

    @property
    def largest_batch(self) -> int:
        return self.run.largest_batch

    def encode(self, images: Sequence[Image]) -> NDArray[np.float32]:
        encodings = np.empty((len(images), self.encoding_dim), np.float32)
        first = 0
        while first < len(images):
            pixels = [self.prepare(images[first])]
            while len(pixels) < min(self.largest_batch, len(images) - first):
                following = self.prepare(images[first + len(pixels)])
                if following.shape != pixels[0].shape:
                    break
                pixels.append(following)
            # Rounded, so that a file holds them in half the bytes; that changes no cosine by more than 1e-6.
            encodings[first : first + len(pixels)] = self.run(np.stack(pixels)).astype(np.float16)
            first += len(pixels)
        return encodings

    def prepare(self, image: Image) -> Image:
        height, width = image.shape[:2]
        if self.input_size is not None:
            return resized(image, self.input_size)
        shrink = min(1.0, _LONGEST_SIDE / max(width, height))
        wide, high = (max(self.shortest_side, round(side * shrink)) for side in (width, height))
        return resized(image, (wide, high))


def in_pixels(shares: tuple[float, float, float]) -> tuple[float, float, float]:
    """Three channels from 0 to 1 on the scale of pixels, 0 to 255."""
    red, green, blue = shares
    return red * 255, green * 255, blue * 255
