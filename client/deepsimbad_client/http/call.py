"""What one request of the contract says, and how its answer is read; nothing here sends."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BytesIO
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import quote
from uuid import uuid4

import httpx2
from pydantic import TypeAdapter, ValidationError

from deepsimbad_client.errors import InvalidArgumentError, MissingExtraError, UnexpectedAnswerError, api_error_class
from deepsimbad_client.http.models import Answer
from deepsimbad_client.http.retry import Repeat, problem_of, retry_after_s

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from deepsimbad_client.http.on_board import OnBoardEncoder

Model = TypeVar("Model", bound=Answer)

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
REQUEST_ID = "X-Request-ID"
BINARY = {"Accept": "application/octet-stream"}


@dataclass(frozen=True)
class Call:
    """One request.

    Attributes:
        method: The HTTP verb.
        path: Below the server's address, already quoted.
        params: The query; absent (None) values are left out, floats keep every digit.
        headers: On top of the client's own.
        body: The content, if any.
        repeat: When it is safe to send again.
        gone_is_done: A 404 or 410 after a try whose answer was lost means that try did it (deletes).
    """

    method: str
    path: str
    params: Mapping[str, float | str | None] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    body: bytes | None = None
    repeat: Repeat = Repeat.ALWAYS
    gone_is_done: bool = False

    def __str__(self) -> str:
        return f"{self.method} {self.path}"

    @classmethod
    def with_json(cls, method: str, path: str, document: Mapping[str, Any], **more: Any) -> "Call":
        """A call whose body is a document, absent (None) values left out; `more` are its other attributes.

        Raises InvalidArgumentError (it holds NaN or something JSON cannot say).
        """
        try:
            body = json.dumps({key: value for key, value in document.items() if value is not None}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise InvalidArgumentError(f"cannot be sent as JSON: {error}") from error
        more["headers"] = {"Content-Type": "application/json", **more.get("headers", {})}
        return cls(method, path, body=body.encode(), **more)

    @classmethod
    def delete(cls, path: str) -> "Call":
        """A call that deletes, and is done where nothing is left to delete after its answer was lost."""
        return cls("DELETE", path, gone_is_done=True)


def once(idempotency_key: str | None) -> dict[str, str]:
    """The header by which a request acts once however often it is sent; absent: a new key."""
    return {"Idempotency-Key": idempotency_key or uuid4().hex}


def in_path(kind: str, name: str) -> str:
    """A name that may stand in an address. Raises InvalidArgumentError (it is none, with what a name may hold)."""
    if NAME.fullmatch(name) is None:
        raise InvalidArgumentError(
            f"{name!r} cannot name a {kind}: use 1 to 64 letters, digits, '.', '_' and '-', the first a letter or digit"
        )
    return quote(name, safe="")


def domain_path(name: str) -> str:
    """Where the calls of a robot in a domain begin."""
    return f"/v1/domains/{in_path('domain', name)}"


def session_path(session_id: str) -> str:
    """Where the calls of a session begin."""
    return f"/v1/sessions/{in_path('session', session_id)}"


def raise_for_problem(response: httpx2.Response) -> None:
    """Turn an error answer into its named error. Raises ApiError, UnexpectedAnswerError."""
    status = response.status_code
    if response.is_success:
        return
    if status < 400:
        raise UnexpectedAnswerError(
            f"{response.request.url} answered {status} and points to {response.headers.get('location', 'nowhere')}: "
            "give the service's own address as the server"
        )
    problem = problem_of(response)
    code = problem.get("code")
    name = code if isinstance(code, str) else ""
    detail = problem.get("detail") or problem.get("title")
    request_id = response.headers.get(REQUEST_ID) or problem.get("request_id")
    raise api_error_class(status, name)(
        str(detail or f"the service answered {status} {response.reason_phrase}".rstrip()),
        status=status,
        code=name,
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
    """One page of a list, bare or under `key`, and what the next is asked for by (None: the list ends).

    Raises UnexpectedAnswerError (it is none).
    """
    request_id = response.headers.get(REQUEST_ID)
    adapter: TypeAdapter[tuple[Model, ...]] = TypeAdapter(tuple[kind, ...])  # type: ignore[valid-type]
    try:
        document = json.loads(response.content)
        listed = document[key] if isinstance(document, dict) else document
        following = document.get("next") if isinstance(document, dict) else None
        models = adapter.validate_python(listed)
    except (ValueError, KeyError) as error:
        raise _unexpected(response, error) from error
    return tuple(model.answering(request_id) for model in models), None if following is None else str(following)


def float_array(response: httpx2.Response) -> "NDArray[np.float32]":
    """The [n] float32 of an npy body. Raises MissingExtraError, UnexpectedAnswerError."""
    try:
        values = require_numpy().load(BytesIO(response.content), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise _unexpected(response, error) from error
    if values.ndim != 1:
        raise _unexpected(response, ValueError(f"an array of shape {values.shape}"))
    floats: NDArray[np.float32] = values.astype("<f4", copy=False)
    return floats


def require_on_board() -> "type[OnBoardEncoder]":
    """Import what encodes on board; raises MissingExtraError."""
    from deepsimbad_client.http.on_board import OnBoardEncoder  # noqa: PLC0415 - the client alone must work without it

    return OnBoardEncoder


def require_numpy() -> Any:
    """Import numpy where a call cannot do without; raises MissingExtraError."""
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
