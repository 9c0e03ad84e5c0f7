"""What a connection is told whose bytes never became a request: a problem document, written without ASGI."""

from collections.abc import Iterable
from typing import Any

from uvicorn.protocols.http.httptools_impl import STATUS_LINE

from deepsimbad.api.envelope import SECURITY_HEADERS, request_id_of
from deepsimbad.api.problems import error_response
from deepsimbad.errors import DeepSimbadError


def render_refusal(
    error: DeepSimbadError, scope: Any, default_headers: Iterable[tuple[bytes, bytes]]
) -> tuple[int, str, bytes]:
    """Everything that is written to a connection before it is closed.

    Args:
        error: Why.
        scope: The ASGI scope as far as it was read; None where not even a request line came.
        default_headers: Those that the server sends with every answer.

    Returns:
        The status, the request id, and the bytes.
    """
    read = scope or {"headers": ()}
    request_id = read.get("state", {}).get("request_id") or request_id_of(read)
    known = {"type": "http", "raw_path": read.get("raw_path", b""), "state": {"request_id": request_id}}
    response = error_response(known, error)
    content = [STATUS_LINE[response.status_code]]
    for name, value in (
        *default_headers,
        *response.raw_headers,
        (b"x-request-id", request_id.encode("ascii")),
        *SECURITY_HEADERS,
        (b"connection", b"close"),
    ):
        content += (name, b": ", value, b"\r\n")
    return response.status_code, request_id, b"".join([*content, b"\r\n", response.body])
