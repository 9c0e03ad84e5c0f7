"""The door of the service, which every request passes: its id, its key, its size, its turn, its log line.

Nothing that happens behind it leaves the sender without an answer or the log without a line.
"""

import asyncio
import logging
import random
import re
import time
from collections.abc import Mapping
from functools import lru_cache
from urllib.parse import urlsplit

from anyio import CancelScope
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from deepsimbad.api.keys import KeyRing, RateLimit
from deepsimbad.api.metrics import Metrics
from deepsimbad.api.problems import error_response, unexpected_response
from deepsimbad.api.requests import Slots
from deepsimbad.errors import (
    BodyTooLargeError,
    DeepSimbadError,
    ForeignHostError,
    InvalidInputError,
    UnavailableError,
    UnreadableRequestError,
    UnsupportedMediaTypeError,
)
from deepsimbad.settings import Settings, is_loopback

log = logging.getLogger(__name__)

FREE_BYTES = 1 << 16  # of a body, not counted; as much as the server buffers of every connection anyway
ALWAYS_ANSWERED = frozenset({"/healthz", "/readyz", "/metrics"})
# What every answer carries unless its route says otherwise: nothing here is for a browser to guess, keep or embed.
SECURITY_HEADERS = {
    b"x-content-type-options": b"nosniff",
    b"cache-control": b"no-store",
    b"content-security-policy": b"default-src 'none'; frame-ancestors 'none'",
    b"referrer-policy": b"no-referrer",
    b"x-frame-options": b"DENY",
    b"cross-origin-resource-policy": b"same-origin",
}
# Codes of answers that turn a request away for its kind or its number, before its content is looked at.
REFUSALS = {
    *("unauthorized", "forbidden", "foreign_host", "rate_limited", "overloaded"),
    *("too_many_sessions", "too_many_jobs", "too_many_domains", "body_too_large", "image_too_large"),
}
_CORS_REQUEST_HEADERS = (
    *("Authorization", "X-API-Key", "Content-Type", "X-Request-ID", "Idempotency-Key"),
    *("Range", "If-Range", "If-None-Match"),
)
_CORS_ANSWER_HEADERS = (
    *("X-Request-ID", "Retry-After", "Location", "WWW-Authenticate"),
    *("ETag", "Repr-Digest", "Content-Range", "Content-Disposition"),
)
UNROUTED = "(none)"
SHUTTING_DOWN = UnavailableError("the service is shutting down")
_REQUEST_ID = re.compile(rb"[A-Za-z0-9._-]{1,64}")
_BATCH_PATH = re.compile(r"/v1/admin/domains/[^/]+/traverses/[^/]+/frames")
_METHODS = {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"}
# Of a request's state or its path, in its log line
_LOG_FIELDS = ("key_id", "domain", "code", "limit", "session_id", "job_id")
_LONGEST_PATH = 256  # of a path in the log: the sender chooses it
_LONGEST_LENGTH = 20  # digits
_SENDER_LEFT = 499  # as proxies log it; never sent


class Door:
    """ASGI middleware around all routes.

    A request counts as under way from when its body has come to when its answer begins: whoever sends or reads slowly
    takes memory for what was sent, but nobody's turn. Health, readiness and metrics need no key and no turn; while no
    key exists they too refuse a foreign Host or Origin.
    """

    def __init__(self, app: ASGIApp, settings: Settings, keys: KeyRing, metrics: Metrics) -> None:
        self._routes = app
        self._app: ASGIApp = self._let_in
        if settings.cors_origins:
            self._app = CORSMiddleware(
                self._let_in,
                allow_origins=settings.cors_origins,
                allow_methods=("GET", "POST", "PUT", "DELETE"),
                allow_headers=_CORS_REQUEST_HEADERS,
                expose_headers=_CORS_ANSWER_HEADERS,
            )
        self.settings = settings
        self.keys = keys
        self.metrics = metrics
        self.rate_limit = RateLimit(settings.rate_limit_per_s, settings.rate_limit_burst)
        self.under_way = Slots(settings.max_requests, "requests are under way", "max_requests")
        self.body_bytes = Slots(settings.max_body_memory_bytes, "bytes of bodies are held", "max_body_memory_bytes")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:  # noqa: D102 - ASGI
        if scope["type"] != "http":
            await self._routes(scope, receive, send)
            return
        root = self.settings.root_path
        if root and scope["path"].startswith(f"{root}/"):  # a proxy may give it on or take it away
            scope["path"] = scope["path"].removeprefix(root)
        request = scope["door"] = _Request(self, scope, receive, send)
        self.metrics.begin_request()
        try:
            await self._app(scope, request.receive, request.send)
        except asyncio.CancelledError:  # the server stops and waits no longer
            if request.status == 0:
                await error_response(scope, SHUTTING_DOWN)(scope, receive, request.send)
        except ClientDisconnect:  # nobody is left to be answered
            request.status = request.status or _SENDER_LEFT
        except Exception:
            log.exception("request failed", extra={"request_id": scope["state"]["request_id"]})
            if request.status == 0:
                await unexpected_response(scope)(scope, receive, request.send)
        finally:
            request.end()

    async def _let_in(self, scope: Scope, receive: Receive, send: Send) -> None:
        request: _Request = scope["door"]
        try:
            if not self.keys.by_id:
                request.check_page()
            required_scope = self.keys.scope_for(scope["path"])
            if required_scope is not None:
                self.keys.admit(scope, required_scope, self.rate_limit)
            request.check_size()
        except DeepSimbadError as error:
            await error_response(scope, error)(scope, receive, send)
        else:
            await (self._head if scope["method"] == "HEAD" else self._routes)(scope, receive, send)

    async def _head(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer as GET would, without its body; a stream is cancelled before it begins."""
        with CancelScope() as cancel_scope:

            async def begin(message: Message) -> None:
                if cancel_scope.cancel_called:  # heard only where the route waits for something
                    return
                await send(message)
                await send({"type": "http.response.body"})
                cancel_scope.cancel()

            scope["method"] = "GET"
            try:
                await self._routes(scope, receive, begin)
            finally:
                scope["method"] = "HEAD"


class _Request:
    """One request on its way through the door."""

    def __init__(self, door: Door, scope: Scope, receive: Receive, send: Send) -> None:
        self.status = 0
        self._door = door
        self._scope = scope
        self._receive = receive
        self._send = send
        self._start_s = time.perf_counter()
        self._was_counted = False
        self._n_turns = 0  # that it takes of the door's slots
        self._n_bytes = self._n_held = 0  # of the body so far: all that came, and those counted as memory
        self._headers = dict(scope["headers"])
        self._max_bytes, self._is_batch = max_body_bytes(scope, self._headers, door.settings)
        request_id = self._headers.get(b"x-request-id", b"")
        if not _REQUEST_ID.fullmatch(request_id):
            request_id = b"%016x" % random.getrandbits(64)
        scope.setdefault("state", {})["request_id"] = request_id.decode()
        self._own_headers = {b"x-request-id": request_id, **SECURITY_HEADERS}

    # Checks of the head: each raises the error that the sender is answered

    def check_page(self) -> None:
        """While no key is asked, refuse what a page of another host may have sent.

        A page's own name may be answered by a loopback address (DNS rebinding): its Host betrays it.
        """
        settings, own_address = self._door.settings, (self._scope.get("server") or ("",))[0]
        host = self._headers.get(b"host", b"").decode("latin-1")
        origin = self._headers.get(b"origin", b"").decode("latin-1")
        if origin and origin.partition("://")[2] != host and not {origin, "*"} & set(settings.cors_origins):
            reason = f"a page of {origin[:100]!r} may not call it"
        elif host and not _is_ours(host, settings.host, own_address) and is_loopback(settings.host):
            reason = f"it is not asked by the name {host[:100]!r}"
        else:
            return
        raise ForeignHostError(f"this service asks for no key and answers its own machine alone: {reason}")

    def check_size(self) -> None:
        """Refuse a body that is too large, or for which there is no room, by what the head declares."""
        headers = self._headers
        length_text = headers.get(b"content-length", b"0").strip()
        if not length_text.isdigit() or len(length_text) > _LONGEST_LENGTH:
            raise InvalidInputError("Content-Length is not a number")
        n_declared, is_chunked = int(length_text), b"transfer-encoding" in headers
        if is_chunked and b"content-length" in headers:  # whoever stands between us may have taken the other one
            self._own_headers[b"connection"] = b"close"
            raise UnreadableRequestError("the body has both a Content-Length and a Transfer-Encoding")
        has_body = n_declared > 0 or is_chunked
        packing = headers.get(b"content-encoding", b"").strip().lower() or b"identity"
        if has_body and packing != b"identity":  # what it unpacks to is not known from its length
            raise UnsupportedMediaTypeError(
                f"Content-Encoding {packing[:100].decode('ascii', 'replace')!r} is not taken: send the body as it is",
                allowed=["identity"],
            )
        if n_declared > self._max_bytes:
            raise self._too_large(f"the body has {n_declared} bytes")
        if self._scope["path"] in ALWAYS_ANSWERED:
            self._was_counted = True
        elif not has_body:
            self._count()
        elif n_declared > FREE_BYTES and not self._is_batch:
            # Only asked for: who announces much and sends nothing should keep nobody out.
            self._door.body_bytes.check(n_declared - FREE_BYTES)

    # What comes and goes

    async def receive(self) -> Message:
        """The next part of the body, counted; raises BodyTooLargeError or OverloadedError."""
        message = await self._receive()
        if message["type"] == "http.request":
            self._n_bytes += len(message.get("body", b""))
            if self._n_bytes > self._max_bytes:
                raise self._too_large("the body is longer than is taken")
            n_more = self._n_bytes - FREE_BYTES - self._n_held
            if n_more > 0 and not self._is_batch:  # those go to the disk as they come
                self._door.body_bytes.take(n_more)
                self._n_held += n_more
            if not self._was_counted and not message.get("more_body", False):
                self._count()
        return message

    async def send(self, message: Message) -> None:
        """Pass on a part of the answer; the first one ends the request's turn."""
        if message["type"] == "http.response.start":
            self._door.under_way.give_back(self._n_turns)
            self._n_turns, self.status = 0, message["status"]
            headers = {**self._own_headers, **dict(message.get("headers", ()))}
            if headers.get(b"location", b"").startswith(b"/"):
                headers[b"location"] = self._door.settings.root_path.encode() + headers[b"location"]
            message["headers"] = list(headers.items())
        await self._send(message)

    def end(self) -> None:
        """Give back the request's slots and bytes, count it and log it: the answer has gone, or nobody waits for it."""
        self._door.under_way.give_back(self._n_turns)
        self._door.body_bytes.give_back(self._n_held)
        seconds = time.perf_counter() - self._start_s
        scope, metrics = self._scope, self._door.metrics
        # Labels come from our own words alone: a stranger's paths would grow the registry without end.
        route = getattr(scope.get("route"), "path", UNROUTED)
        method = scope["method"] if scope["method"] in _METHODS else "OTHER"
        metrics.end_request(method, route, self.status, seconds)
        state, log_fields = scope["state"] | (scope.get("path_params") or {}), {}
        for name in _LOG_FIELDS:
            if name in state:
                log_fields[name] = state[name]
        if log_fields.get("code") in REFUSALS:
            metrics.count_refusal(log_fields.get("limit", log_fields["code"]))
        if log.isEnabledFor(logging.INFO):
            line = {
                "request_id": scope["state"]["request_id"],
                "peer": (scope.get("client") or ("",))[0],
                "method": method,
                "path": scope["path"][:_LONGEST_PATH],
                "status": self.status,
                "ms": round(seconds * 1000, 2),
            }
            log.info("request", extra=line | log_fields)

    def _count(self) -> None:
        self._door.under_way.take()
        self._was_counted, self._n_turns = True, 1

    def _too_large(self, complaint: str) -> BodyTooLargeError:
        return BodyTooLargeError(
            f"{complaint}; at most {self._max_bytes} are taken here, send less at once", max_bytes=self._max_bytes
        )


def max_body_bytes(scope: Scope, headers: Mapping[bytes, bytes], settings: Settings) -> tuple[int, bool]:
    """The most bytes of a request's body, and whether it is a batch, which goes to the disk as it comes."""
    if scope["method"] == "POST" and _BATCH_PATH.fullmatch(scope["path"]) is not None:
        return settings.max_batch_bytes, True
    is_image = headers.get(b"content-type", b"").lower().startswith(b"image/")
    return settings.max_image_bytes if is_image else settings.max_json_bytes, False


@lru_cache(maxsize=64)
def _is_ours(host: str, *names: str) -> bool:
    """Whether a Host header, its port apart, means this machine, or is one of the names."""
    try:
        name = urlsplit(f"//{host}").hostname
    except ValueError:  # a bracket that is not closed
        return False
    return name is not None and (is_loopback(name) or name in names)
