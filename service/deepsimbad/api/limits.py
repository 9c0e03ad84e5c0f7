"""Body sizes, counted while a request streams in; a connection whose body was left unread is closed with care."""

import asyncio
import time
from collections.abc import Callable
from typing import NamedTuple

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from deepsimbad.api.problems import error_response
from deepsimbad.errors import BodyTooLargeError, DeepSimbadError, InvalidInputError, UnsupportedMediaTypeError

_DISCARDED_QUIETLY = 1 << 20  # the server throws this much of an unread body away by itself
_LINGER_S = 5.0  # how long a refused sender may go on before the connection is cut
_LINGER_IDLE_S = 1.0


class Framing(NamedTuple):
    """How a request says that its body comes.

    Attributes:
        declared: `Content-Length`; None without one, -1 where it is no number.
        coding: `Transfer-Encoding`, empty without one.
        content_coding: `Content-Encoding`, empty without one.
    """

    declared: int | None
    coding: bytes
    content_coding: bytes

    @property
    def has_body(self) -> bool:
        """Whether a byte of a body may come."""
        return bool(self.declared) or bool(self.coding)


def framing_of(scope: Scope) -> Framing:
    """Read the headers that say how the body comes."""
    declared, coding, content_coding = None, b"", b""
    for name, value in scope["headers"]:
        if name == b"content-length":
            declared = int(value) if value.isdigit() else -1
        elif name == b"transfer-encoding":
            coding = value
        elif name == b"content-encoding":
            content_coding = value
    return Framing(declared, coding, content_coding)


async def refuse_unread(scope: Scope, receive: Receive, send: Send, error: DeepSimbadError) -> None:
    """Answer with an error before the body was read, and close with care where much of it may still come."""
    body = _CountedBody(receive, 1 << 62, framing_of(scope))
    await error_response(scope, error)(scope, receive, _AnswerBeforeBody(body, send))


class BodyLimitMiddleware:
    """Counts body bytes in `receive` and refuses a body over the limit, chunked ones too.

    A `Content-Length` over the limit is answered at once; a body that turns out longer raises where the route
    reads it. In both cases nothing beyond what was read is kept. A body that is packed in any way is refused: what it
    unpacks to is not known from its length.

    An answer sent before the body was read closes the connection, but not at once: most senders only look for the
    answer after their last byte, and closing on unread bytes would reset the connection under it.

    Args:
        app: The wrapped application.
        limit_of: The most bytes the request of a scope may carry.
    """

    def __init__(self, app: ASGIApp, limit_of: Callable[[Scope], int]) -> None:
        self.app = app
        self.limit_of = limit_of

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:  # noqa: D102 - ASGI
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        body = _CountedBody(receive, self.limit_of(scope), framing_of(scope))
        answer = _AnswerBeforeBody(body, send)
        try:
            body.check_declared()
        except DeepSimbadError as error:
            await error_response(scope, error)(scope, receive, answer)
            return
        await self.app(scope, body, answer)


class _CountedBody:
    """`receive`, counting."""

    def __init__(self, receive: Receive, limit: int, framing: Framing) -> None:
        self.receive = receive
        self.limit = limit
        self.framing = framing
        self.declared = framing.declared
        self.n_bytes = 0
        self.is_complete = not framing.has_body

    def check_declared(self) -> None:
        """Judge what the headers say of the body."""
        if self.framing.coding.strip().lower() not in {b"", b"chunked"}:
            raise _packed("Transfer-Encoding", self.framing.coding, "chunked")
        if self.framing.has_body and self.framing.content_coding.strip().lower() not in {b"", b"identity"}:
            raise _packed("Content-Encoding", self.framing.content_coding, "identity")
        if self.declared is not None and self.declared < 0:
            raise InvalidInputError("Content-Length is not a number")
        if self.declared is not None and self.declared > self.limit:
            raise self._too_large(f"the body has {self.declared} bytes")

    async def __call__(self) -> Message:
        message = await self.receive()
        if message["type"] != "http.request":
            return message
        self.is_complete = not message.get("more_body", False)
        self.n_bytes += len(message.get("body", b""))
        if self.n_bytes > self.limit:
            raise self._too_large("the body is longer than is taken")
        return message

    @property
    def may_be_left(self) -> bool:
        """Whether nothing much of the body can still be on its way."""
        return self.is_complete or (self.declared is not None and self.declared - self.n_bytes <= _DISCARDED_QUIETLY)

    async def discard(self) -> None:
        """Throw away what still comes, for a while."""
        deadline = time.monotonic() + _LINGER_S
        while not self.is_complete and (left := deadline - time.monotonic()) > 0:
            try:
                message = await asyncio.wait_for(self.receive(), min(left, _LINGER_IDLE_S))
            except TimeoutError:
                return
            self.is_complete = message["type"] != "http.request" or not message.get("more_body", False)

    def _too_large(self, what: str) -> BodyTooLargeError:
        return BodyTooLargeError(
            f"{what}; at most {self.limit} are taken here, send less at once", max_bytes=self.limit
        )


class _AnswerBeforeBody:
    """`send`, which closes the connection with care where the body was left unread."""

    def __init__(self, body: _CountedBody, send: Send) -> None:
        self.body = body
        self.send = send
        self.closes = False

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start" and not self.body.may_be_left:
            self.closes = True
            message = {**message, "headers": [*message.get("headers", ()), (b"connection", b"close")]}
        if self.closes and message["type"] == "http.response.body" and not message.get("more_body", False):
            await self.send({**message, "more_body": True})
            await self.body.discard()
            message = {"type": "http.response.body", "body": b"", "more_body": False}
        await self.send(message)


def _packed(header: str, value: bytes, allowed: str) -> UnsupportedMediaTypeError:
    return UnsupportedMediaTypeError(
        f"{header} {value[:100].decode('ascii', 'replace')!r} is not taken: send the body as it is", allowed=[allowed]
    )
