"""The requests of the contract and the reading of their answers; nothing here sends."""

import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from enum import Enum
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Protocol, TypedDict, TypeVar, Unpack
from urllib.parse import quote
from uuid import uuid4

import httpx2
from pydantic import TypeAdapter, ValidationError

from deepsimbad_client.errors import (
    BrokenFrameError,
    InvalidArgumentError,
    MissingExtraError,
    UnexpectedAnswerError,
    api_error_class,
)
from deepsimbad_client.http.models import Answer

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Model = TypeVar("Model", bound=Answer)
Numbers = Iterable[Any]  # any sequence of numbers, numpy arrays among them

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
MAX_NAME_LENGTH = 255  # of a frame
_NO_CHARACTER = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
REQUEST_ID = "X-Request-ID"
BINARY = {"Accept": "application/octet-stream"}
RETRIED_STATUSES = frozenset({408, 429, 502, 503, 504})
# Turned away before it was acted on, 408 because not all of it came. 502 and 504 come from a proxy that cannot know.
REFUSED_STATUSES = frozenset({408, 429, 503})
_SIGNATURES = {
    "image/jpeg": rb"\xff\xd8\xff",
    "image/png": rb"\x89PNG\r\n\x1a\n",
    "image/tiff": rb"II[*+]\x00|MM\x00[*+]",
    "image/webp": rb"(?s:RIFF....WEBP)",
}


class Pixels(Protocol):
    """An array of [height, width, 3] BGR or [height, width] grey, uint8."""

    @property
    def dtype(self) -> Any: ...  # noqa: D102
    @property
    def shape(self) -> tuple[int, ...]: ...  # noqa: D102


Image = bytes | bytearray | memoryview | str | PathLike[str] | IO[bytes] | Pixels
"""An encoded image, the path or the open file of one, or its pixels."""


class Repeat(Enum):
    """When a call is safe to send again; its value is the statuses that say so."""

    ALWAYS = RETRIED_STATUSES  # idempotent
    IF_UNTOUCHED = REFUSED_STATUSES  # acts once: only when the service surely did not act
    NEVER = frozenset[int]()  # the caller has its own way to go on


@dataclass(frozen=True)
class Call:
    """One request: of `params`, None is left out, floats keep every digit, a sequence repeats its name."""

    method: str
    path: str  # below the server's address, already quoted
    params: Mapping[str, float | str | Sequence[str] | None] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    body: bytes | None = None
    repeat: Repeat = Repeat.ALWAYS
    gone_is_done: bool = False  # a 404 or 410 after a try whose answer was lost means that this try did it (deletes)

    def __str__(self) -> str:
        return f"{self.method} {self.path}"

    @classmethod
    def with_json(cls, method: str, path: str, document: Mapping[str, Any], **fields: Any) -> "Call":
        """A call whose body is a document without its None values; raises InvalidArgumentError for NaN."""
        try:
            body = json_of({key: value for key, value in document.items() if value is not None})
        except (TypeError, ValueError) as error:
            raise InvalidArgumentError(f"cannot be sent as JSON: {error}") from error
        fields["headers"] = {"Content-Type": "application/json", **fields.get("headers", {})}
        return cls(method, path, body=body.encode(), **fields)

    @classmethod
    def delete(cls, path: str) -> "Call":
        """A call that deletes; if its answer was lost, finding nothing left to delete counts as success."""
        return cls("DELETE", path, gone_is_done=True)


def idempotency_header(idempotency_key: str | None) -> dict[str, str]:
    """The header by which a request acts once however often it is sent; None: a new key is drawn."""
    return {"Idempotency-Key": idempotency_key or uuid4().hex}


def in_path(kind: str, name: str) -> str:
    """A name that may stand in an address; raises InvalidArgumentError."""
    if NAME.fullmatch(name) is None:
        raise InvalidArgumentError(
            f"{name!r} cannot name a {kind}: use 1 to 64 letters, digits, '.', '_' and '-', the first a letter or digit"
        )
    return quote(name, safe="")


def domain_path(name: str) -> str:
    """The path that a robot's calls in a domain begin with; raises InvalidArgumentError."""
    return f"/v1/domains/{in_path('domain', name)}"


def session_path(session_id: str) -> str:
    """The path that a session's calls begin with; raises InvalidArgumentError."""
    return f"/v1/sessions/{in_path('session', session_id)}"


@dataclass(frozen=True)
class Observation:
    """The body of one observation, ready to post."""

    body: bytes
    content_type: str
    landmark_model: str | None = None  # digest of the model it was made with on board; the answering map must match

    @property
    def headers(self) -> dict[str, str]:
        """The request headers: the content type, and the landmark model that must match."""
        match_header = {} if self.landmark_model is None else {"If-Match": f'"{self.landmark_model}"'}
        return {"Content-Type": self.content_type, **match_header}


class ViewForm(TypedDict, total=False):
    """The forms of a view other than an image; exactly one is given."""

    content_type: str | None  # the image's media type; absent: read from its first bytes
    ranked_landmarks: Numbers | None  # landmark ids, nearest first, 1..r of them
    dissimilarities: Numbers | None  # r finite numbers in landmark order, smaller is nearer
    encoding: Numbers | None  # a ready encoding, where the domain takes them
    objects: Iterable[Mapping[str, Any]] | None  # {"label", "box", "score"} each, where the domain takes them
    text: str | None  # what is seen in words, where the domain takes them
    on_board: Observation | None  # what an `OnBoardEncoder` made of an image, a few bytes


def media_type_of(body: bytes) -> str | None:
    """The media type that an image's first bytes show; None for a format the service does not take."""
    return next((kind for kind, pattern in _SIGNATURES.items() if re.match(pattern, body)), None)


def observation(image: Image | None = None, **view: Unpack[ViewForm]) -> Observation:
    """Make the body of one observation; raises InvalidArgumentError, BrokenFrameError (the file cannot be read)."""
    content_type = view.pop("content_type", None)
    forms = {name: form for name, form in view.items() if form is not None}
    scene: dict[str, Any] = {name: forms[name] for name in ("objects", "text") if name in forms}
    if scene and len(scene) == len(forms):
        return scene_observation(scene, None if image is None else image_bytes(image))
    if len(forms) + (image is not None) != 1:
        raise InvalidArgumentError(
            "give exactly one of image, on_board, ranked_landmarks, dissimilarities and encoding; or objects and text, "
            "beside an image where the domain takes both"
        )
    if image is not None:
        body = image_bytes(image)
        media_type = content_type or media_type_of(body)
        if media_type is None:
            source = "the file" if isinstance(image, str | PathLike) or hasattr(image, "read") else "the bytes"
            raise InvalidArgumentError(f"{source} given as image is not a JPEG, PNG, TIFF or WebP")
        return Observation(body, media_type)
    ((name, form),) = forms.items()
    if isinstance(form, Observation):
        return form
    try:
        text = json_of({name: _plain(form)})
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(f"{name} must be plain numbers without NaN or infinity: {error}") from error
    return Observation(text.encode(), "application/json")


def scene_observation(scene: Mapping[str, Any], image: bytes | None = None) -> Observation:
    """The body of a view given as objects, a text, or both: JSON, or a multipart form where an image goes with it."""
    try:
        scene = {name: value if isinstance(value, str) else list(value) for name, value in scene.items()}
        if image is None:
            return Observation(json_of(scene).encode(), "application/json")
        parts = {name: value if isinstance(value, str) else json_of(value) for name, value in scene.items()}
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(f"objects and text must be plain JSON: {error}") from error
    content = {"image": image, **{name: value.encode() for name, value in parts.items()}}
    boundary = hashlib.sha256(b"".join(content.values())).hexdigest()[:40]  # equal views, equal bytes
    body = b"".join(
        b'--%s\r\nContent-Disposition: form-data; name="%s"\r\n\r\n%s\r\n' % (boundary.encode(), name.encode(), value)
        for name, value in content.items()
    )
    return Observation(body + f"--{boundary}--\r\n".encode(), f"multipart/form-data; boundary={boundary}")


def image_bytes(image: Image) -> bytes:
    """The encoded image: bytes as they are, a file's content, pixels as PNG.

    Raises InvalidArgumentError, BrokenFrameError (the file cannot be read).
    """
    content: Any = image
    try:
        if isinstance(image, str | PathLike):
            content = Path(image).read_bytes()
        elif hasattr(image, "read"):
            content = image.read()
    except OSError as error:
        raise BrokenFrameError(f"cannot read {image!s}: {error.strerror or error}") from error
    if isinstance(content, bytes | bytearray | memoryview):
        return bytes(content)
    if not hasattr(content, "dtype"):
        image_type = type(image).__name__ + (" that reads text" if isinstance(content, str) else "")
        raise InvalidArgumentError(
            f"image is {image_type}: give encoded bytes, a path, a file opened as binary, or an array of pixels"
        )
    has_pixels = content.ndim in {2, 3} and content.shape[2:] in {(), (3,)} and content.size
    if not has_pixels or str(content.dtype) != "uint8":
        raise InvalidArgumentError(
            f"image is {list(content.shape)} {content.dtype}: "
            "pixels are [height, width, 3] BGR or [height, width], uint8"
        )
    try:
        import cv2  # noqa: PLC0415 - the client alone must work without it
    except ImportError as error:
        raise MissingExtraError("pixels need OpenCV: pip install 'deep-simbad[replay]'") from error
    return bytes(cv2.imencode(".png", content)[1].tobytes())


def text_of(name: str) -> str:
    """A frame's name as the service takes it: cut, with control characters and lone surrogates as U+FFFD."""
    return _NO_CHARACTER.sub("\ufffd", name)[:MAX_NAME_LENGTH]


def known_positions(true_positions_m: Numbers) -> list[float | None]:
    """Positions as a list for JSON: NaN becomes None."""
    return [None if isinstance(value, float) and math.isnan(value) else value for value in _plain(true_positions_m)]


def json_of(value: Any) -> str:
    """Compact JSON, numpy's numbers as Python's; raises TypeError or ValueError for what JSON lacks, such as NaN."""

    def plain_number(number: Any) -> Any:
        if (plain := of_python(number)) is number:
            raise TypeError(f"{type(number).__name__} is no number")
        return plain

    return json.dumps(value, allow_nan=False, separators=(",", ":"), default=plain_number)


def of_python(value: Any) -> Any:
    """A numpy number or array as Python's number or list; all else as it is."""
    return value.tolist() if hasattr(value, "tolist") else value


def _plain(values: Any) -> list[Any]:
    return [of_python(value) for value in of_python(values)]


def problem_of(response: httpx2.Response) -> dict[str, Any]:
    """The problem document (RFC 9457) of an error answer; empty where it holds none, such as a proxy's own page."""
    try:
        document = json.loads(response.content)
    except ValueError:
        return {}
    return document if isinstance(document, dict) else {}


def retry_after_s(header: str | None, moment: datetime | None = None) -> float | None:
    """Seconds from `moment` (None: now) that a `Retry-After` header asks for, as seconds or a date; None: unusable."""
    header = (header or "").strip()
    if header.isascii() and header.isdigit():
        return float(header)
    try:
        date = parsedate_to_datetime(header)
    except ValueError:
        return None
    date = date if date.tzinfo else date.replace(tzinfo=UTC)
    return max(0.0, (date - (moment or datetime.now(UTC))).total_seconds())


def raise_for_problem(response: httpx2.Response) -> None:
    """Turn an error answer into its ApiError, and a redirect into an UnexpectedAnswerError."""
    status = response.status_code
    if response.is_success:
        return
    if status < 400:
        raise UnexpectedAnswerError(
            f"{response.request.url} answered {status} and points to {response.headers.get('location', 'nowhere')}: "
            "give the service's own address as the server"
        )
    problem = problem_of(response)
    code = str(problem.get("code") or "")
    detail = problem.get("detail") or problem.get("title")
    request_id = response.headers.get(REQUEST_ID) or problem.get("request_id")
    status_line = f"{response.request.url} answered {status} {response.reason_phrase}".rstrip()
    raise api_error_class(status, code)(
        str(detail or f"{status_line}, and no reason as this service gives: is the address right?"),
        status=status,
        code=code,
        problem=problem,
        request_id=str(request_id) if request_id else None,
        retry_after_s=retry_after_s(response.headers.get("retry-after")),
    )


def model_of(kind: type[Model], response: httpx2.Response) -> Model:
    """The model that an answer holds; raises UnexpectedAnswerError."""
    try:
        return kind.model_validate_json(response.content).answering(response.headers.get(REQUEST_ID))
    except ValidationError as error:
        raise _unexpected(response, error) from error


def page_of(kind: type[Model], key: str, response: httpx2.Response) -> tuple[tuple[Model, ...], str | None]:
    """One page of a list, bare or under `key`, and the cursor of the next page (None: the list ends).

    Raises UnexpectedAnswerError.
    """
    adapter: TypeAdapter[tuple[Model, ...]] = TypeAdapter(tuple[kind, ...])  # type: ignore[valid-type]
    try:
        document = json.loads(response.content)
        cursor = document.get("next") if isinstance(document, dict) else None
        models = adapter.validate_python(document[key] if isinstance(document, dict) else document)
    except (ValueError, KeyError) as error:
        raise _unexpected(response, error) from error
    request_id = response.headers.get(REQUEST_ID)
    return tuple(model.answering(request_id) for model in models), None if cursor is None else str(cursor)


def float_array(response: httpx2.Response) -> "NDArray[np.float32]":
    """The [n] float32 of an npy body; raises MissingExtraError, UnexpectedAnswerError."""
    values = _arrays_of(response)
    if values.ndim != 1:
        raise _unexpected(response, ValueError(f"an array of shape {values.shape}"))
    floats: NDArray[np.float32] = values.astype("<f4", copy=False)
    return floats


def named_arrays(response: httpx2.Response) -> "dict[str, NDArray[Any]]":
    """The arrays of an npz body; raises MissingExtraError, UnexpectedAnswerError."""
    with _arrays_of(response) as arrays:
        return dict(arrays)


def _arrays_of(response: httpx2.Response) -> Any:
    try:
        return require_numpy().load(BytesIO(response.content), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise _unexpected(response, error) from error


def require_numpy() -> Any:
    """Import numpy for a call that needs it; raises MissingExtraError."""
    try:
        import numpy as np  # noqa: PLC0415 - the client alone must work without it
    except ImportError as error:
        raise MissingExtraError("arrays need numpy: pip install 'deep-simbad[replay]'") from error
    return np


def _unexpected(response: httpx2.Response, error: Exception) -> UnexpectedAnswerError:
    reason = str(error)
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        reason = f"{'.'.join(str(part) for part in first['loc']) or 'body'}: {first['msg']}"
    return UnexpectedAnswerError(
        f"{response.request.url} did not answer as this client's contract says ({reason}): "
        "is this a Deep SIMBAD service, and of this version?"
    )
