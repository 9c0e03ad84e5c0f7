"""Errors as RFC 9457 problem details: the one table from the error tree to HTTP statuses."""

import json
import logging
import math
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import Scope

from deepsimbad.errors import (
    AccessError,
    BusyError,
    CancelledError,
    ConflictError,
    DeepSimbadError,
    ForbiddenError,
    GoneError,
    InvalidInputError,
    NotFoundError,
    OverloadedError,
    SettingsError,
    TooLargeError,
    UnavailableError,
    UnreadableRequestError,
    UnsupportedMediaTypeError,
)

log = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
RETRY_AFTER_S = 5

# Looked up along an error's bases, nearest first, so a branch may hold an exception to its parent's rule.
STATUS_OF_BRANCH: Mapping[type[BaseException], HTTPStatus] = {
    SettingsError: HTTPStatus.INTERNAL_SERVER_ERROR,
    InvalidInputError: HTTPStatus.UNPROCESSABLE_ENTITY,
    AccessError: HTTPStatus.UNAUTHORIZED,
    ForbiddenError: HTTPStatus.FORBIDDEN,
    NotFoundError: HTTPStatus.NOT_FOUND,
    UnreadableRequestError: HTTPStatus.BAD_REQUEST,
    ConflictError: HTTPStatus.CONFLICT,
    CancelledError: HTTPStatus.CONFLICT,
    GoneError: HTTPStatus.GONE,
    BusyError: HTTPStatus.TOO_MANY_REQUESTS,
    TooLargeError: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    UnsupportedMediaTypeError: HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
    UnavailableError: HTTPStatus.SERVICE_UNAVAILABLE,
}

# The titles of answers that no error of ours stands behind.
_TITLE_OF_CODE = {
    "invalid_request": "A value of the request cannot be accepted",
    "not_found": "Nothing answers to this path",
    "method_not_allowed": "The path does not answer to this method",
    "range_not_satisfiable": "The range begins behind the end",
    "internal_error": "The service failed; the fault is its own",
}
_CODE_OF_STATUS = {404: "not_found", 405: "method_not_allowed", 416: "range_not_satisfiable"}


class InvalidRequestError(InvalidInputError):
    """A value of the request cannot be accepted."""

    code = "invalid_request"


def status_of(error: DeepSimbadError) -> int:
    """The HTTP status of an error of the tree: that of the nearest branch in the table, else 500."""
    for base in type(error).__mro__:
        if base in STATUS_OF_BRANCH:
            return int(STATUS_OF_BRANCH[base])
    return int(HTTPStatus.INTERNAL_SERVER_ERROR)


def problem_response(
    scope: Scope,
    status: int,
    code: str,
    detail: str,
    *,
    title: str | None = None,
    hints: Mapping[str, Any] | None = None,
    headers: Mapping[str, str] | None = None,
) -> Response:
    """Render one problem; its code, and the limit that was met, are noted for the log.

    Args:
        scope: The request's, for `instance` and the request id.
        status: HTTP status.
        code: Stable word that scripts may test.
        detail: One sentence on this occurrence.
        title: One sentence on this kind of problem; None looks it up by code, then by status.
        hints: Further members that help (limits, allowed values).
        headers: Further headers, `Allow` and the like.
    """
    document = {name: _json_ready(value) for name, value in (hints or {}).items()}
    document |= {
        "type": f"urn:deepsimbad:problem:{code}",
        "title": title or _TITLE_OF_CODE.get(code) or HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
        "instance": _instance(scope),
        "code": code,
        "request_id": scope.get("state", {}).get("request_id"),
    }
    noted = scope.setdefault("state", {})  # for the log
    noted["code"] = code
    if isinstance(document.get("limit"), str):
        noted["limit"] = document["limit"]
    sent = dict(headers or {})
    if status == HTTPStatus.UNAUTHORIZED:
        sent.setdefault("WWW-Authenticate", "Bearer")
    if status in {HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.TOO_MANY_REQUESTS}:
        sent.setdefault("Retry-After", str(RETRY_AFTER_S))
    # json escapes everything outside ASCII, so text that cannot be encoded (lone surrogates) still travels.
    return Response(json.dumps(document).encode("ascii"), status, headers=sent, media_type=MEDIA_TYPE)


def error_response(scope: Scope, error: DeepSimbadError) -> Response:
    """Render an error of the tree."""
    status = status_of(error)
    if status >= HTTPStatus.INTERNAL_SERVER_ERROR and not isinstance(error, OverloadedError):
        # What stands behind a 503 helps; where nothing does its sentence says all, and a probe repeats it all night.
        is_told = status == HTTPStatus.SERVICE_UNAVAILABLE and error.__cause__ is None
        about = {"request_id": scope.get("state", {}).get("request_id"), "code": error.code, "why": error.message}
        log.warning("not answered", exc_info=None if is_told else error, extra=about)
    summary = (type(error).__doc__ or "").strip().partition("\n")[0].rstrip(".")
    retry_after_s = error.hints.get("retry_after_s")
    headers = None if retry_after_s is None else {"Retry-After": str(retry_after_s)}
    return problem_response(scope, status, error.code, error.message, title=summary, hints=error.hints, headers=headers)


def unexpected_response(scope: Scope) -> Response:
    """Render a fault of ours: no cause, no stack, only the request id by which the log can be searched."""
    detail = "The service failed in a way it did not foresee; quote the request id to its operator."
    return problem_response(scope, HTTPStatus.INTERNAL_SERVER_ERROR, "internal_error", detail)


def invalid_request(error: ValidationError, where: str) -> InvalidRequestError:
    """The tree's error for what a model refused; `where` is "body" and the like, the first part of every place."""
    return _invalid_request(error.errors(include_url=False, include_context=False, include_input=False), where)


def install_problem_handlers(app: FastAPI, routes: Sequence[Route] = ()) -> None:
    """Let every error that leaves a route of `app` be answered as a problem; `Allow` is told from its `routes`."""

    async def from_tree(request: Request, error: Any) -> Response:
        return error_response(request.scope, error)

    async def from_validation(request: Request, error: Any) -> Response:
        # The stock answer echoes the input, so that NaN in it becomes a 500.
        return error_response(request.scope, _invalid_request(error.errors()))

    async def from_http(request: Request, error: Any) -> Response:
        code = _CODE_OF_STATUS.get(error.status_code, f"http_{error.status_code}")
        detail = f"{request.method} {_instance(request.scope)}: {error.detail}"
        headers = dict(error.headers or {})
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:  # the framework names those of one route
            path = request.scope["path"]
            methods = {method for route in routes if route.path_regex.match(path) for method in route.methods or ()}
            headers["Allow"] = ", ".join(sorted(methods)) or headers.get("Allow", "")
        return problem_response(request.scope, error.status_code, code, detail, headers=headers)

    app.add_exception_handler(DeepSimbadError, from_tree)
    app.add_exception_handler(RequestValidationError, from_validation)
    app.add_exception_handler(HTTPException, from_http)


def _invalid_request(findings: Sequence[Mapping[str, Any]], *where: str) -> InvalidRequestError:
    """One error of up to 20 findings of pydantic's, which puts its own words before those of our validators."""
    errors = [
        {"loc": [*where, *finding["loc"]], "msg": finding["msg"].removeprefix("Value error, "), "type": finding["type"]}
        for finding in findings[:20]
    ]
    first = errors[0] if errors else {"loc": [], "msg": "unreadable", "type": "unreadable"}
    place = ".".join(str(part) for part in first["loc"])
    return InvalidRequestError(f"{place}: {first['msg']}", errors=errors)


def _instance(scope: Scope) -> str:
    """The path as it was sent, percent-encoding kept, so that it is ASCII."""
    raw: bytes = scope.get("raw_path") or b""
    return raw.partition(b"?")[0].decode("ascii", "backslashreplace") or "/"


def _json_ready(value: Any) -> Any:
    """The value with numpy scalars, tuples and non-finite numbers made sendable."""
    if isinstance(value, Mapping):
        return {str(name): _json_ready(member) for name, member in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_json_ready(member) for member in value]
    if hasattr(value, "item"):
        return _json_ready(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)
