"""Body sizes, counted while a request streams in; a connection whose body was left unread is closed with care."""

import asyncio
import time
from collections.abc import Callable

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from deepsimbad.api.problems import error_response
from deepsimbad.errors import BodyTooLargeError, InvalidInputError

_DISCARDED_QUIETLY = 1 << 20  # the server throws this much of an unread body away by itself
_LINGER_S = 5.0  # how long a refused sender may go on before the connection is cut
_LINGER_IDLE_S = 1.0


class BodyLimitMiddleware:
    """Counts body bytes in `receive` and refuses a body over the limit, chunked ones too.

    A `Content-Length` over the limit is answered at once; a body that turns out longer raises where the route
    reads it. In both cases nothing beyond what was read is kept.

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
        body = _CountedBody(receive, self.limit_of(scope), _declared_length(scope), _is_chunked(scope))
        answer = _AnswerBeforeBody(body, send)
        try:
            body.check_declared()
        except (BodyTooLargeError, InvalidInputError) as error:
            await error_response(scope, error)(scope, receive, answer)
            return
        await self.app(scope, body, answer)


class _CountedBody:
    """`receive`, counting."""

    def __init__(self, receive: Receive, limit: int, declared: int | None, chunked: bool) -> None:
        self.receive = receive
        self.limit = limit
        self.declared = declared
        self.n_bytes = 0
        self.is_complete = not chunked and not declared

    def check_declared(self) -> None:
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


def _declared_length(scope: Scope) -> int | None:
    """`Content-Length`; None without one, -1 where it is no number."""
    for name, value in scope["headers"]:
        if name == b"content-length":
            return int(value) if value.isdigit() else -1
    return None


def _is_chunked(scope: Scope) -> bool:
    return any(name == b"transfer-encoding" for name, _ in scope["headers"])
