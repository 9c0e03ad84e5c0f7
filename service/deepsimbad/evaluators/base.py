"""The contract every evaluator keeps (II-A).

The paper asks of an evaluator one thing only: a dissimilarity between a scene and a landmark. We split it in two steps,
`encode` and `dissimilarities`, so that each image is encoded once however often the landmarks change.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import OutOfMemoryError

Image: TypeAlias = NDArray[np.uint8]
"""[height, width, 3] BGR, upright, as `evaluators.image.decode_image` gives it."""

LandmarkModel: TypeAlias = Mapping[str, NDArray[np.generic]]
"""All an evaluator must remember of the landmarks, as named arrays the store saves without understanding."""


class Evaluator(Protocol):
    """Measures how far a scene is from each landmark; immutable, and called from several threads.

    What needs the network raises MissingPackageError, MissingWeightsError, InvalidWeightsError or OutOfMemoryError;
    what is given images, UnsupportedMediaTypeError where ready encodings alone are taken, and InvalidImageError of an
    array that is no image.
    """

    @property
    def takes_images(self) -> bool:
        """Whether it encodes images; else it takes ready encodings alone."""

    @property
    def input_size(self) -> tuple[int, int] | None:
        """(width, height) in pixels a client should resize to; None: images are taken as they are, or not at all."""

    @property
    def encoding_dim(self) -> int | None:
        """Length d of what `encode` gives; None where no images are taken. Ready encodings may have any one length."""

    @property
    def weights_sha256(self) -> str | None:
        """SHA-256 in hex that encodings are told apart by: of their weights, and of what is done with them; or None."""

    @property
    def largest_batch(self) -> int:
        """How many images are best encoded at once."""

    def load(self) -> None:
        """Load what encoding needs, now rather than at first need."""

    def prepare(self, image: Image) -> Image:
        """Bring an image to the size it is encoded at; `encode` does so itself with one that was not."""

    def encode(self, images: Sequence[Image]) -> NDArray[np.float32]:
        """Encode n images to [n, d] float32, finite: no answer depends on its neighbours, beyond rounding."""

    def fit_landmarks(self, encodings: NDArray[np.float32]) -> LandmarkModel:
        """Turn the selected landmarks, [r, d] float32 in landmark order, into the model that `dissimilarities` takes.

        Raises:
            InvalidEncodingError: Not [r >= 1, d], or NaN or infinity in it.
        """

    def check_model(self, model: LandmarkModel, n_landmarks: int) -> None:
        """Raise InvalidEncodingError where a model, of whatever origin, is not what `fit_landmarks` gives of r."""

    def dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """Compare scenes, [n, d] float32, with landmarks: [n, r] float32, at least 0, finite, smaller is nearer.

        Raises:
            InvalidEncodingError: Wrong length, NaN or infinity, or so large that the dissimilarity overflows.
        """


_LACK_OF_MEMORY = ("out of memory", "allocate memory", "bad_alloc", "bad allocation", "insufficient memory")


def is_lack_of_memory(error: BaseException) -> bool:
    """Whether an error of Python, numpy, OpenCV, PyTorch or ONNX Runtime speaks of too little memory."""
    return isinstance(error, MemoryError) or any(words in str(error).lower() for words in _LACK_OF_MEMORY)


@contextmanager
def named_lack_of_memory(work: str) -> Iterator[None]:
    """What anybody says of too little memory to `work` an image, as one error. All else passes."""
    try:
        yield
    except Exception as error:
        if isinstance(error, OutOfMemoryError) or not is_lack_of_memory(error):
            raise
        raise OutOfMemoryError(
            f"there is too little memory to {work} an image now: try again, or give the service more"
        ) from error
