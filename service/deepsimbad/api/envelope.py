"""What every request is wrapped in: an id, a log line, a measurement, and an answer even to our own faults."""

import logging
import re
import secrets
import time

from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from deepsimbad.api.metrics import Metrics
from deepsimbad.api.problems import unexpected_response

log = logging.getLogger(__name__)

_REQUEST_ID = re.compile(rb"[A-Za-z0-9._-]{1,64}")
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
UNROUTED = "(none)"
_SENDER_LEFT = 499  # as proxies log it; never sent


class EnvelopeMiddleware:
    """Outermost: nothing that happens inside leaves the sender without an answer or the log without a line.

    The id is the sender's `X-Request-ID` where that is well formed, else a new one; it stands in the answer's
    header, in every problem document and in the log.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self.app = app
        self.metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:  # noqa: D102 - ASGI
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request_id = _request_id(scope)
        scope.setdefault("state", {})["request_id"] = request_id
        header = (b"x-request-id", request_id.encode("ascii"))
        status = 0

        async def send_marked(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                message["headers"] = [
                    *message.get("headers", ()),
                    header,
                    (b"x-content-type-options", b"nosniff"),
                ]
            await send(message)

        started = time.perf_counter()
        self.metrics.request_began()
        try:
            await self.app(scope, receive, send_marked)
        except ClientDisconnect:  # nobody is left to be answered
            status = status or _SENDER_LEFT
        except Exception:
            log.exception("request failed", extra={"request_id": request_id})
            if status == 0:
                await unexpected_response(scope)(scope, receive, send_marked)
        finally:
            seconds = time.perf_counter() - started
            # Labels come from our own words alone: a stranger's paths would grow the registry without end.
            route = getattr(scope.get("route"), "path", UNROUTED)
            method = scope["method"] if scope["method"] in _METHODS else "OTHER"
            self.metrics.request_ended(method, route, status, seconds)
            if log.isEnabledFor(logging.INFO):
                log.info(
                    "request",
                    extra={
                        "request_id": request_id,
                        "method": method,
                        "path": scope["path"],
                        "status": status,
                        "ms": round(seconds * 1000, 2),
                    },
                )


def _request_id(scope: Scope) -> str:
    for name, value in scope["headers"]:
        if name == b"x-request-id" and _REQUEST_ID.fullmatch(value):
            return str(value, "ascii")
    return secrets.token_hex(8)
