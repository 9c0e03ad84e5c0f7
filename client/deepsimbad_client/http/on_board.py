"""Encoding on board: a robot encodes by a map's landmark model itself and sends a few bytes instead of an image.

The model is fetched once, or read from a file that was kept. Images are decoded, encoded and compared by the very
code that the service runs, so a view has the same encoding and ranks here as there. Needs
`pip install 'deep-simbad[edge]'`, and says so where that is missing.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from os import PathLike
from pathlib import Path

from deepsimbad_client.errors import (
    BrokenFrameError,
    InvalidArgumentError,
    InvalidLandmarkModelError,
    MissingExtraError,
    NotSavedError,
    OtherWeightsError,
    SourceError,
)
from deepsimbad_client.http import Image, Numbers, Observation, image_bytes, observation

INSTALL = "pip install 'deep-simbad[edge]'"

try:
    import numpy as np
    from numpy.typing import NDArray

    from deepsimbad.core.composed import is_composed
    from deepsimbad.core.descriptor import rank_landmarks
    from deepsimbad.core.landmark_model import PortableLandmarks, landmark_model_digest, unpack_landmarks
    from deepsimbad.core.on_board import (
        RANKS,
        UNIT_ENCODING,
        USUAL_BITS,
        pack_ranked_landmarks,
        pack_unit_encoding,
        ranked_landmarks_within,
    )
    from deepsimbad.errors import DeepSimbadError, InvalidImageError, InvalidInputError, MissingPackageError
    from deepsimbad.evaluators.base import Evaluator
    from deepsimbad.evaluators.compute import Compute
    from deepsimbad.evaluators.grey_levels import levels_in
    from deepsimbad.evaluators.image import decode_image, is_blank
    from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
    from deepsimbad.evaluators.space import compared_units
except ImportError as missing:
    raise MissingExtraError(f"encoding on board needs further packages: {INSTALL}") from missing

RANKS_BYTES = 64
"""Default size of ranks; what that costs in accuracy: docs/results/onboard.md."""
_MAX_PIXELS = 1 << 30  # the picture is the robot's own


class OnBoardEncoder:
    """Makes observations of a few bytes out of images, by a map's own `landmarks`; usable from several threads.

    Given by `Client.on_board`, or loaded from a file that `save` wrote, without a network. It is made in milliseconds;
    the extractor is loaded with the first image, or by `load_extractor`. `content` is the landmark model as the service
    sends it, `compute` where a network runs (absent: the fastest that is installed); `digest` names the landmarks and
    is sent with every observation, so that no other map answers it. Raises InvalidLandmarkModelError.
    """

    def __init__(self, content: bytes, compute: Compute | None = None) -> None:
        self._content = content
        with _named_errors("this landmark model cannot be used here"):
            self.landmarks: PortableLandmarks = unpack_landmarks(content)
            self._evaluator = make_evaluator(evaluator_config(self.landmarks.evaluator), compute)
            self._evaluator.check_model(self.landmarks.model, self.landmarks.n_landmarks)
        self.digest = landmark_model_digest(self.landmarks.model)

    @classmethod
    def load(cls, path: str | PathLike[str], compute: Compute | None = None) -> "OnBoardEncoder":
        """The encoder in a file that `save` wrote. Raises SourceError, InvalidLandmarkModelError."""
        try:
            content = Path(path).read_bytes()
        except OSError as error:
            raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
        return cls(content, compute)

    def save(self, path: str | PathLike[str]) -> None:
        """Keep the landmarks in a file (a numpy npz) for `load`; raises NotSavedError."""
        try:
            Path(path).write_bytes(self._content)
        except OSError as error:
            raise NotSavedError(f"{path} cannot be written: {error.strerror or error}") from error

    @property
    def map_version(self) -> int:
        """The version of the map that the landmarks come from."""
        return self.landmarks.map_version

    @property
    def n_landmarks(self) -> int:
        """The number of landmarks, r."""
        return self.landmarks.n_landmarks

    def load_extractor(self) -> None:
        """Load the extractor now and not with the first image.

        Raises MissingExtraError, OtherWeightsError, InvalidLandmarkModelError.
        """
        _ = self._loaded_evaluator

    @cached_property
    def _loaded_evaluator(self) -> Evaluator:
        """The evaluator with its extractor, whose weights are the map's."""
        with _named_errors("the map's extractor cannot be loaded here"):
            self._evaluator.load()
            weights_sha256, map_sha256 = self._evaluator.weights_sha256 or "", self.landmarks.weights_sha256
        if map_sha256 and weights_sha256 != map_sha256:
            raise OtherWeightsError(
                f"the weights here (sha256 {weights_sha256 or 'none'}) are not those that the images of map "
                f"{self.map_version} were encoded by (sha256 {map_sha256}): install the service's release of them"
            )
        return self._evaluator

    def view(
        self,
        image: "Image | NDArray[np.uint8] | None" = None,
        *,
        encoding: Numbers | None = None,
        n_bits: int = USUAL_BITS,
    ) -> Observation:
        """The observation that `Client.localize` and `Session.observe` take as `on_board`; give one form of the view.

        Of a map that compares encodings (`composed`) the unit encoding travels, in `n_bits` a number, 2 to 8: 61 bytes
        for 96 numbers by default, which tell more than all ranks. Of others the ranks that 64 bytes hold.

        `image` is an encoded one, its path, or [height, width, 3] uint8 BGR. A picture that shows nothing travels as
        JSON that says so. Raises InvalidArgumentError, BrokenFrameError, and as `load_extractor`.
        """
        if not is_composed(self.landmarks.model):
            return self.ranks(image, encoding=encoding)
        encodings = self._encoding_of(image, encoding)
        if encodings is None:
            return self._blank_view()
        with _named_arguments():
            u, _ = compared_units(self._evaluator, encodings, self.landmarks.model)
            return Observation(pack_unit_encoding(u[0], n_bits), UNIT_ENCODING, self.digest)

    def ranks(
        self, image: "Image | NDArray[np.uint8] | None" = None, *, encoding: Numbers | None = None, m: int | None = None
    ) -> Observation:
        """The observation as the m nearest of r landmarks, the paper's descriptor; m absent: as many as 64 bytes hold.

        Takes the same forms of a view, and raises the same errors, as `view`.
        """
        n_sent = ranked_landmarks_within(RANKS_BYTES, self.n_landmarks) if m is None else m
        if not 1 <= n_sent <= self.n_landmarks:
            raise InvalidArgumentError(f"m is {n_sent}: send 1 to {self.n_landmarks} landmarks")
        encodings = self._encoding_of(image, encoding)
        if encodings is None:
            return self._blank_view()
        with _named_arguments():
            dissimilarities = self._evaluator.dissimilarities(encodings, self.landmarks.model)[0]
        nearest_first = np.argsort(rank_landmarks(dissimilarities))
        body = pack_ranked_landmarks(nearest_first[:n_sent].tolist(), self.n_landmarks)
        return Observation(body, RANKS, self.digest)

    def _blank_view(self) -> Observation:
        return replace(observation(dissimilarities=[0] * self.n_landmarks), landmark_model=self.digest)

    def _encoding_of(
        self, image: "Image | NDArray[np.uint8] | None", encoding: Numbers | None
    ) -> NDArray[np.float32] | None:
        """The encoding of the view, [1, d]; None for an image that shows nothing."""
        if (image is None) == (encoding is None):
            raise InvalidArgumentError("give exactly one of image and encoding")
        if image is None:
            return np.asarray(encoding, np.float32).reshape(1, -1)
        if not self._evaluator.takes_images:
            raise InvalidArgumentError("the domain has no extractor and takes ready encodings alone: give encoding")
        if isinstance(image, np.ndarray):
            pixels, source = image, "the array given as image"
        else:
            source = str(image) if isinstance(image, str | PathLike) else "the bytes given as image"
            try:
                levels = levels_in(self.landmarks.model)
                pixels = decode_image(image_bytes(image), _MAX_PIXELS, levels=levels)
            except DeepSimbadError as error:
                raise BrokenFrameError(f"{source}: {error.message}") from error
        evaluator = self._loaded_evaluator
        if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
            raise InvalidArgumentError(f"{source} is {list(pixels.shape)} {pixels.dtype}, not [height, width, 3] uint8")
        with _named_errors("the image cannot be encoded"):
            pixels = evaluator.prepare(pixels)
            return None if is_blank(pixels) else evaluator.encode([pixels])


@contextmanager
def _named_arguments() -> Iterator[None]:
    """Raise the library's errors of invalid input as InvalidArgumentError."""
    try:
        yield
    except InvalidInputError as error:
        raise InvalidArgumentError(error.message) from error


@contextmanager
def _named_errors(failure: str) -> Iterator[None]:
    """Raise the library's errors as this client's; `failure` says what failed."""
    try:
        yield
    except (ImportError, MissingPackageError) as error:
        raise MissingExtraError(f"{error}; {INSTALL} brings what the default extractor needs") from error
    except InvalidImageError as error:
        raise InvalidArgumentError(error.message) from error
    except DeepSimbadError as error:
        raise InvalidLandmarkModelError(f"{failure}: {error.message}") from error
