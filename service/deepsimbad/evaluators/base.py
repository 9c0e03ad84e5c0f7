"""The contract every evaluator keeps (II-A).

The paper asks of an evaluator one thing only: a dissimilarity between a scene and a landmark. We split it in
two steps, `encode` and `dissimilarities`, so that each observation is encoded once however often the landmarks
change.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import OutOfMemoryError

Image: TypeAlias = NDArray[np.uint8]
"""[height, width, 3] BGR, upright, as `evaluators.image.decode_image` gives it."""

Observation: TypeAlias = Image
"""What an evaluator is shown."""

LandmarkModel: TypeAlias = Mapping[str, NDArray[np.generic]]
"""All an evaluator must remember of the landmarks, as named arrays the store saves without understanding."""


class Evaluator(Protocol):
    """Measures how far a scene is from each landmark.

    Evaluators are immutable after construction and may be called from several threads.
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
        """How many observations are best encoded at once."""

    def load(self) -> None:
        """Load what encoding needs, now rather than at first need.

        Raises:
            MissingPackageError, MissingWeightsError, InvalidWeightsError: It cannot be loaded.
            OutOfMemoryError: There is too little memory for it.
        """

    def prepare(self, observation: Observation) -> Observation:
        """Bring an observation to the size it is encoded at; `encode` does so itself with one that was not.

        Raises:
            InvalidImageError: An array that is not such an image.
            UnsupportedMediaTypeError: The evaluator takes ready encodings alone.
        """

    def encode(self, observations: Sequence[Observation]) -> NDArray[np.float32]:
        """Encode n observations to [n, d] float32, finite: no answer depends on its neighbours, beyond rounding.

        Raises:
            InvalidImageError: An array that is not such an image.
            UnsupportedMediaTypeError: The evaluator takes ready encodings alone.
            OutOfMemoryError: There is too little memory for it.
        """

    def fit_landmarks(self, encodings: NDArray[np.float32]) -> LandmarkModel:
        """Turn the selected landmarks, [r, d] float32 in landmark order, into the model that `dissimilarities` takes.

        Raises:
            InvalidEncodingError: Not [r >= 1, d], or NaN or infinity in it.
        """

    def check_model(self, model: LandmarkModel, n_landmarks: int) -> None:
        """Check that a landmark model, of whatever origin, can be compared with.

        Raises:
            InvalidEncodingError: It is not what `fit_landmarks` gives of r landmarks.
        """

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
    """What anybody says of too little memory, as one error: nobody's image is at fault. All else passes.

    Args:
        work: What is done with the image.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, OutOfMemoryError) or not is_lack_of_memory(error):
            raise
        raise OutOfMemoryError(
            f"there is too little memory to {work} an image now: try again, or give the service more"
        ) from error
