"""The contract of an embedded extractor."""

from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from deepsimbad.evaluators.base import Image


class Extractor(Protocol):
    """A pure function of one image.

    Attributes:
        name: The word that selects it in a configuration.
        input_size: (width, height) in pixels it works at; any other size is resized, aspect not kept.
        encoding_dim: Length d of its encodings.
    """

    name: ClassVar[str]
    input_size: ClassVar[tuple[int, int]]
    encoding_dim: ClassVar[int]

    def __call__(self, image: Image) -> NDArray[np.float32]:
        """Encode one image.

        Args:
            image: [height, width, 3] uint8 BGR, of any size.

        Returns:
            [d] float32 of unit length, also for a uniform image; the same bits for the same pixels.
        """
