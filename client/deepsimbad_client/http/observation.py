"""The body of one observation: an image, or what a robot that encodes on board has worked out itself."""

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from deepsimbad_client.errors import BrokenFrameError, InvalidArgumentError

_SIGNATURES = {
    "image/jpeg": rb"\xff\xd8\xff",
    "image/png": rb"\x89PNG\r\n\x1a\n",
    "image/tiff": rb"II[*+]\x00|MM\x00[*+]",
    "image/webp": rb"(?s:RIFF....WEBP)",
}

Image = bytes | bytearray | memoryview | str | PathLike[str]  # An encoded image, or the path of one
Numbers = Iterable[Any]  # Any sequence of numbers, numpy arrays among them


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
    return next((kind for kind, pattern in _SIGNATURES.items() if re.match(pattern, body)), None)


def observation(
    image: Image | None = None,
    content_type: str | None = None,
    ranked_landmarks: Numbers | None = None,
    dissimilarities: Numbers | None = None,
    encoding: Numbers | None = None,
    ranked: Observation | None = None,
) -> Observation:
    """Make the body of one observation from exactly one of its forms, which are those of `Client.localize`.

    Raises InvalidArgumentError, BrokenFrameError.
    """
    numbers = {"ranked_landmarks": ranked_landmarks, "dissimilarities": dissimilarities, "encoding": encoding}
    forms = [(name, values) for name, values in numbers.items() if values is not None]
    if len(forms) + (image is not None) + (ranked is not None) != 1:
        raise InvalidArgumentError("give exactly one of image, ranked, ranked_landmarks, dissimilarities and encoding")
    if ranked is not None:
        return ranked
    if image is None:
        return _json_observation(*forms[0])
    body = image_bytes(image)
    media_type = content_type or media_type_of(body)
    if media_type is None:
        what = "the file" if isinstance(image, str | PathLike) else "the bytes"
        raise InvalidArgumentError(f"{what} given as image is not a JPEG, PNG, TIFF or WebP")
    return Observation(body, media_type)


def image_bytes(image: Image) -> bytes:
    """The bytes of an encoded image, or of the file at a path; raises BrokenFrameError."""
    if not isinstance(image, str | PathLike):
        return bytes(image)
    try:
        return Path(image).read_bytes()
    except OSError as error:
        raise BrokenFrameError(f"cannot read {image}: {error.strerror or error}") from error


def known_positions(true_positions_m: Numbers) -> list[float | None]:
    """Positions as JSON takes them: NaN becomes None."""
    return [None if isinstance(value, float) and math.isnan(value) else value for value in _plain(true_positions_m)]


def _json_observation(name: str, values: Numbers) -> Observation:
    try:
        text = json.dumps({name: _plain(values)}, allow_nan=False, separators=(",", ":"))
    except ValueError as error:
        raise InvalidArgumentError(f"{name} holds NaN or infinity") from error
    except TypeError as error:
        raise InvalidArgumentError(f"{name} must be plain numbers: {error}") from error
    return Observation(text.encode(), "application/json")


def _plain(values: Numbers) -> list[Any]:
    return list(values.tolist() if hasattr(values, "tolist") else values)
