"""The contract every evaluator keeps (II-A).

The paper asks of an evaluator one thing only: a dissimilarity between a scene and a landmark. We split it in two steps,
`encode` and `dissimilarities`, so that each image is encoded once however often the landmarks change.

**Fitted evaluators.** `fit` makes the landmark model, named arrays that a map keeps and a robot gets, of a `Lesson`:
the landmarks and all that is known around them. `fitting` says what it learns from; where that is images, those of a
traverse wait in its spool until a remap is made of it (`jobs.fitting`), and `Lesson.views` holds encodings of
augmented views of every landmark. Without them (the spool is gone, encodings came ready) it fits on encodings alone.

**composed** compares unit vectors. Where the dissimilarity is squared L2 (`is_squared_l2`) they are made of encodings;
where it is any other, a scene's *dissimilarities to all fitted landmarks* take the encoding's place, as II-A has it:
D(x, R) is a vector space, each landmark a dimension. `comparison_vectors` gives the one or the other. All else,
standardising by season, places as sums, lists, live statistics, is the same for all evaluators
(docs/decisions/0029-own-space.md). `evaluators.space.OwnDissimilarities` does this for an evaluator that defines
`own_dissimilarities`.

Methods of evaluators without a docstring do just what is described here.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import OutOfMemoryError

if TYPE_CHECKING:
    from deepsimbad.evaluators.scenes import Form, Scene

Image: TypeAlias = NDArray[np.uint8]
"""[height, width, 3] BGR, upright, as `evaluators.image.decode_image` gives it."""

LandmarkModel: TypeAlias = Mapping[str, NDArray[np.generic]]
"""All an evaluator must remember of the landmarks, as named arrays the store saves without understanding."""


class Fitting(StrEnum):
    """What an evaluator learns from."""

    NOTHING = "nothing"  # the landmarks' encodings are its model
    ENCODINGS = "encodings"  # of the drives that are known
    IMAGES = "images"  # the same, and augmented views of the landmarks: images wait in a spool


@dataclass(frozen=True)
class Lesson:
    """The landmarks that an evaluator is fitted to, and all that is known around them."""

    encodings: NDArray[np.float32]  # [m, d] of the drive that landmarks were chosen from, in its order
    landmarks: NDArray[np.int64]  # [r] which of its frames they are, in landmark order
    position_m: NDArray[np.float64] | None = None  # [m] along its route; None: a metre a frame
    other: NDArray[np.float32] | None = None  # [n, d] of another drive of the same route; None: none is known
    # [k, 2] (frame, the other drive's frame) that saw one place; empty where there is no other
    places: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 2), np.int64))
    # [r, a, d] of augmented views of every landmark, the second half relit; None: no images
    views: NDArray[np.float32] | None = None
    seed: int = 0  # of everything random
    on_progress: Callable[[float], None] = lambda _: None  # takes the share done, 0..1; may raise CancelledError


@dataclass(frozen=True)
class Fitted:
    """The result of fitting: a landmark model, and what is known of it."""

    model: LandmarkModel
    metrics: Mapping[str, Any] = field(default_factory=dict)  # JSON-ready, for `metrics.fitting` of the map
    warnings: tuple[str, ...] = ()  # sentences that begin with a stable name and a colon, for `metrics.warnings`


class Evaluator(Protocol):
    """Measures how far a scene is from each landmark; immutable, and called from several threads.

    What needs the network raises MissingPackageError, MissingWeightsError, InvalidWeightsError or OutOfMemoryError;
    what is given images, UnsupportedMediaTypeError where ready encodings alone are taken, and InvalidImageError of an
    array that is no image.
    """

    @property
    def forms(self) -> frozenset["Form"]:
        """The forms of an observation that it makes encodings of; none where ready ones alone are taken."""

    def lacking(self, forms: frozenset["Form"]) -> frozenset["Form"]:
        """The forms of which a map's frame that has only `forms` needs one more; live views need none."""

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
    def halves(self) -> tuple[int, ...]:
        """Lengths of the two encodings that lie side by side in a fused one; empty for others."""

    @property
    def weights_sha256(self) -> str | None:
        """SHA-256 in hex of the weights and of how they are used, so that encodings can be told apart; or None."""

    @property
    def largest_batch(self) -> int:
        """How many images are best encoded at once."""

    def load(self) -> None:
        """Load what encoding needs, now rather than at first need."""

    def prepare(self, image: Image) -> Image:
        """Bring an image to the size it is encoded at; `encode` does so too with images that were not prepared."""

    def encode(self, images: "Sequence[Image | Scene]") -> NDArray[np.float32]:
        """Encode n images, or scenes in forms that it takes, to [n, d] float32, finite.

        No answer depends on its neighbours, beyond rounding.
        """

    @property
    def fitting(self) -> Fitting:
        """What `fit` learns from."""

    @property
    def is_squared_l2(self) -> bool:
        """Whether dissimilarities are squared L2 between encodings, which `composed` then compares."""

    def fit(self, lesson: Lesson) -> Fitted:
        """Make the model that `dissimilarities` takes.

        Raises:
            InvalidEncodingError: Encodings are not [m >= 1, d], or hold NaN or infinity.
            TooFewToFitError: There is too little to learn from.
            MissingPackageError: A package that training needs is not installed.
            CancelledError: As `on_progress` says.
        """

    def check_model(self, model: LandmarkModel, n_landmarks: int) -> None:
        """Raise InvalidEncodingError where a model, of whatever origin, is not what `fit` gives of r landmarks."""

    def dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """Compare scenes, [n, d] float32, with landmarks: [n, r] float32, at least 0, finite, smaller is nearer.

        Raises:
            InvalidEncodingError: Wrong length, NaN or infinity, or so large that the dissimilarity overflows.
        """

    def comparison_vectors(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """What `composed` makes unit vectors of: encodings [n, d] as they are, or own dissimilarities [n, r].

        Raises:
            InvalidEncodingError: As `dissimilarities`.
        """


_LACK_OF_MEMORY = ("out of memory", "allocate memory", "bad_alloc", "bad allocation", "insufficient memory")


def is_lack_of_memory(error: BaseException) -> bool:
    """Whether an error of Python, numpy, OpenCV, PyTorch or ONNX Runtime speaks of too little memory."""
    return isinstance(error, MemoryError) or any(words in str(error).lower() for words in _LACK_OF_MEMORY)


@contextmanager
def named_lack_of_memory(work: str) -> Iterator[None]:
    """Raise any library's error of too little memory to `work` an image as OutOfMemoryError, and others as they are."""
    try:
        yield
    except Exception as error:
        if isinstance(error, OutOfMemoryError) or not is_lack_of_memory(error):
            raise
        raise OutOfMemoryError(
            f"there is too little memory to {work} an image now: try again, or give the service more"
        ) from error
