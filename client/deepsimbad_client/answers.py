"""From an HTTP response to a model or a named error."""

import json
from collections.abc import Callable
from io import BytesIO
from typing import TYPE_CHECKING, Any, TypeVar, cast

import httpx2
from pydantic import TypeAdapter, ValidationError

from deepsimbad_client.errors import MissingExtraError, UnexpectedAnswerError, api_error_class
from deepsimbad_client.models import Answer, Job, NextBestView
from deepsimbad_client.page import Page
from deepsimbad_client.problem import problem_of
from deepsimbad_client.retry import retry_after_s, utc_now

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from deepsimbad_client.on_board import OnBoardEncoder

Model = TypeVar("Model", bound=Answer)

REQUEST_ID = "X-Request-ID"


def raise_for_problem(response: httpx2.Response) -> None:
    """Turn an error answer into its named error.

    Raises:
        ApiError: The subclass that the problem's code or the status names.
        UnexpectedAnswerError: A redirect, which the contract does not know.
    """
    status = response.status_code
    if response.is_success:
        return
    if status < 400:
        where = response.headers.get("location", "nowhere")
        raise UnexpectedAnswerError(
            f"{response.request.url} answered {status} and points to {where}: "
            "give the service's own address as the server"
        )
    problem = problem_of(response)
    code = problem.get("code")
    detail = problem.get("detail") or problem.get("title")
    request_id = response.headers.get(REQUEST_ID) or problem.get("request_id")
    name = code if isinstance(code, str) else ""
    raise api_error_class(status, name)(
        str(detail or f"the service answered {status} {response.reason_phrase}".rstrip()),
        status=status,
        code=name,
        problem=problem,
        request_id=str(request_id) if request_id else None,
        retry_after_s=retry_after_s(response.headers.get("retry-after"), utc_now()),
    )


def model(kind: type[Model]) -> Callable[[httpx2.Response], Model]:
    """A parser of one model."""

    def parse(response: httpx2.Response) -> Model:
        try:
            return kind.model_validate_json(response.content).answering(response.headers.get(REQUEST_ID))
        except ValidationError as error:
            raise _unexpected(response, error) from error

    return parse


def models(kind: type[Model], key: str) -> Callable[[httpx2.Response], tuple[Model, ...]]:
    """A parser of a whole list of models, bare or under `key`."""
    of_page = page(kind, key)
    return lambda response: of_page(response).entries


def page(kind: type[Model], key: str) -> Callable[[httpx2.Response], Page[Model]]:
    """A parser of one page of a list of models under `key`; a list that says nothing of a next page is whole."""
    adapter: TypeAdapter[tuple[Model, ...]] = TypeAdapter(tuple[kind, ...])  # type: ignore[valid-type]

    def parse(response: httpx2.Response) -> Page[Model]:
        request_id = response.headers.get(REQUEST_ID)
        try:
            document = json.loads(response.content)
            listed = document[key] if isinstance(document, dict) else document
            behind = document.get("next") if isinstance(document, dict) else None
            entries = tuple(entry.answering(request_id) for entry in adapter.validate_python(listed))
            return Page(entries, None if behind is None else str(behind))
        except (ValueError, KeyError) as error:
            raise _unexpected(response, error) from error

    return parse


def text(response: httpx2.Response) -> str:
    """A parser of plain text."""
    return response.text


def on_board_encoder() -> "Callable[[httpx2.Response], OnBoardEncoder]":
    """A parser of a landmark model.

    Raises:
        MissingExtraError: The packages that it takes are not installed.
    """
    from deepsimbad_client.on_board import OnBoardEncoder  # noqa: PLC0415 - the client alone must work without it

    return lambda response: OnBoardEncoder(response.content)


def nothing(response: httpx2.Response) -> None:
    """A parser of answers without content."""
    del response


def next_best_view_of(response: httpx2.Response) -> NextBestView | None:
    """A parser of the move to make next; None where the map can name none."""
    return None if response.content.strip() == b"null" else model(NextBestView)(response)


def float_array(response: httpx2.Response) -> "NDArray[np.float32]":
    """A parser of a float32 npy body.

    Raises:
        MissingExtraError: numpy is not installed.
        UnexpectedAnswerError: The body is not such an array.
    """
    try:
        values = require_numpy().load(BytesIO(response.content), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise _unexpected(response, error) from error
    if values.ndim != 1:
        raise _unexpected(response, ValueError(f"an array of shape {values.shape}"))
    return cast("NDArray[np.float32]", values.astype("<f4", copy=False))


def job_of_event(data: str) -> Job | None:
    """The job an event of a job's stream holds; None for an event that holds none."""
    try:
        return Job.model_validate_json(data)
    except ValidationError:
        return None


def require_numpy() -> Any:
    """Import numpy where a call cannot do without.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        import numpy as np  # noqa: PLC0415 - the client alone must work without it
    except ImportError as error:
        raise MissingExtraError("arrays need numpy: pip install 'deep-simbad[replay]'") from error
    return np


def _unexpected(response: httpx2.Response, error: Exception) -> UnexpectedAnswerError:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        reason = f"{'.'.join(str(part) for part in first['loc']) or 'body'}: {first['msg']}"
    else:
        reason = str(error)
    return UnexpectedAnswerError(
        f"{response.request.url} did not answer as this client's contract says ({reason}): "
        "is this a Deep SIMBAD service, and of this version?"
    )
