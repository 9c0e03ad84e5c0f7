"""What every request is wrapped in: an id, a log line, a measurement, and an answer even to our own faults."""

import asyncio
import logging
import re
import secrets
import time

from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from deepsimbad.api.metrics import Metrics
from deepsimbad.api.problems import error_response, unexpected_response
from deepsimbad.errors import UnavailableError

log = logging.getLogger(__name__)

_REQUEST_ID = re.compile(rb"[A-Za-z0-9._-]{1,64}")
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
# What every answer carries unless its route says otherwise: nothing here is for a browser to guess, keep or embed.
SECURITY_HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"cache-control", b"no-store"),
    (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-frame-options", b"DENY"),
    (b"cross-origin-resource-policy", b"same-origin"),
)
# Codes of answers that turn a request away for what it is or how many there are, before it is looked into.
REFUSALS = frozenset(
    {
        "unauthorized",
        "forbidden",
        "rate_limited",
        "overloaded",
        "too_many_sessions",
        "too_many_jobs",
        "too_many_domains",
        "body_too_large",
        "image_too_large",
        "headers_too_large",
        "request_timeout",
    }
)
_NAMED = ("domain", "session_id", "job_id")  # parameters of paths
_NOTED = ("key_id", "domain", "code", "limit")  # by whoever learnt it
_NOTHING: dict[str, str] = {}
_LONGEST_PATH = 256  # of a path in the log: the sender chooses it
UNROUTED = "(none)"
STOPPING = UnavailableError("the service is shutting down")
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
        request_id = request_id_of(scope)
        scope.setdefault("state", {})["request_id"] = request_id
        header = (b"x-request-id", request_id.encode("ascii"))
        status = 0

        async def send_marked(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                given = list(message.get("headers", ()))
                names = {name.lower() for name, _ in given}
                message["headers"] = [*given, header, *(each for each in SECURITY_HEADERS if each[0] not in names)]
            await send(message)

        started = time.perf_counter()
        self.metrics.request_began()
        try:
            await self.app(scope, receive, send_marked)
        except asyncio.CancelledError:  # the server stops and waits no longer
            if status == 0:
                await error_response(scope, STOPPING)(scope, receive, send_marked)
        except ClientDisconnect:  # nobody is left to be answered
            status = status or _SENDER_LEFT
        except Exception:
            log.exception("request failed", extra={"request_id": request_id, **_known(scope)})
            if status == 0:
                await unexpected_response(scope)(scope, receive, send_marked)
        finally:
            seconds = time.perf_counter() - started
            # Labels come from our own words alone: a stranger's paths would grow the registry without end.
            route = getattr(scope.get("route"), "path", UNROUTED)
            method = scope["method"] if scope["method"] in _METHODS else "OTHER"
            self.metrics.request_ended(method, route, status, seconds)
            known = _known(scope)
            if known.get("code") in REFUSALS:
                self.metrics.refused(known.get("limit", known["code"]))
            if log.isEnabledFor(logging.INFO):
                log.info(
                    "request",
                    extra={
                        "request_id": request_id,
                        "peer": (scope.get("client") or ("",))[0],
                        "method": method,
                        "path": scope["path"][:_LONGEST_PATH],
                        "status": status,
                        "ms": round(seconds * 1000, 2),
                        **known,
                    },
                )


def _known(scope: Scope) -> dict[str, str]:
    """Whose request it is, what it is about and the code of what was wrong, as far as each is known."""
    named, noted = scope.get("path_params") or _NOTHING, scope["state"]
    known = {name: noted[name] for name in _NOTED if name in noted}
    known |= {name: named[name] for name in _NAMED if name in named}
    return known


def request_id_of(scope: Scope) -> str:
    """The sender's own id for its request where that is well formed, else a new one."""
    for name, value in scope["headers"]:
        if name == b"x-request-id" and _REQUEST_ID.fullmatch(value):
            return str(value, "ascii")
    return secrets.token_hex(8)
