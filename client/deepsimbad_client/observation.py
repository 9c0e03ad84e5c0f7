"""The body of one observation: an image, or what a robot that encodes on board has worked out itself."""

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from deepsimbad_client.errors import BrokenFrameError, InvalidArgumentError

SIGNATURES: tuple[tuple[bytes, str], ...] = (
    (rb"\xff\xd8\xff", "image/jpeg"),
    (rb"\x89PNG\r\n\x1a\n", "image/png"),
    (rb"II[*+]\x00", "image/tiff"),
    (rb"MM\x00[*+]", "image/tiff"),
    (rb"RIFF....WEBP", "image/webp"),
)
_PATTERNS = tuple((re.compile(pattern, re.DOTALL), media_type) for pattern, media_type in SIGNATURES)

Image = bytes | bytearray | memoryview | str | PathLike[str]
"""An encoded image, or the path of one."""
Numbers = Iterable[Any]
"""Any sequence of numbers, numpy arrays among them."""


@dataclass(frozen=True)
class Observation:
    """A body ready to post.

    Attributes:
        body: Its bytes.
        content_type: Their media type.
        landmark_model: Digest of the landmarks that it was ranked by, which the answering map must have; None: unsaid.
    """

    body: bytes
    content_type: str
    landmark_model: str | None = None

    @property
    def headers(self) -> dict[str, str]:
        """What a request says of it."""
        matching = {} if self.landmark_model is None else {"If-Match": f'"{self.landmark_model}"'}
        return {"Content-Type": self.content_type, **matching}


def media_type_of(body: bytes) -> str | None:
    """The media type an image's first bytes show, or None for a format the service does not take."""
    for pattern, media_type in _PATTERNS:
        if pattern.match(body):
            return media_type
    return None


def observation(
    image: Image | None = None,
    *,
    content_type: str | None = None,
    ranked_landmarks: Numbers | None = None,
    dissimilarities: Numbers | None = None,
    encoding: Numbers | None = None,
    ranked: Observation | None = None,
) -> Observation:
    """Make the body of one observation from exactly one of its forms.

    Args:
        image: An encoded image (JPEG, PNG, TIFF, WebP), or its path; sent as it is.
        content_type: The image's media type; absent: read from its first bytes.
        ranked_landmarks: Landmark ids, nearest first.
        dissimilarities: r finite numbers in landmark order, smaller is nearer.
        encoding: A ready encoding.
        ranked: What an `OnBoardEncoder` made of an image; sent as it is.

    Raises:
        InvalidArgumentError: None or several given, not an image, or NaN among the numbers.
        BrokenFrameError: The image file cannot be read.
    """
    forms = {"ranked_landmarks": ranked_landmarks, "dissimilarities": dissimilarities, "encoding": encoding}
    given = {name: values for name, values in forms.items() if values is not None}
    if len(given) + (image is not None) + (ranked is not None) != 1:
        raise InvalidArgumentError("give exactly one of image, ranked, ranked_landmarks, dissimilarities and encoding")
    if ranked is not None:
        return ranked
    if image is None:
        ((name, values),) = given.items()
        return _json_observation(name, values)
    body = image_bytes(image)
    found = content_type or media_type_of(body)
    if found is None:
        what = "the file" if isinstance(image, str | PathLike) else "the bytes"
        raise InvalidArgumentError(f"{what} given as image is not a JPEG, PNG, TIFF or WebP")
    return Observation(body, found)


def image_bytes(image: Image) -> bytes:
    """The bytes of an encoded image, or of the file at a path; raises BrokenFrameError."""
    if not isinstance(image, str | PathLike):
        return bytes(image)
    try:
        return Path(image).read_bytes()
    except OSError as error:
        raise BrokenFrameError(f"cannot read {image}: {error.strerror or error}") from error


def _json_observation(name: str, values: Numbers) -> Observation:
    plain = values.tolist() if hasattr(values, "tolist") else list(values)
    try:
        text = json.dumps({name: plain}, allow_nan=False, separators=(",", ":"))
    except ValueError as error:
        raise InvalidArgumentError(f"{name} holds NaN or infinity") from error
    except TypeError as error:
        raise InvalidArgumentError(f"{name} must be plain numbers: {error}") from error
    return Observation(text.encode(), "application/json")
