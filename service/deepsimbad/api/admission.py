"""How much is done at once: what would be too much is answered 503 with Retry-After, most of it before its body."""

from collections.abc import Callable
from dataclasses import dataclass

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from deepsimbad.api.limits import framing_of, refuse_unread
from deepsimbad.engine.worker import Priority, queue_is_full
from deepsimbad.errors import OverloadedError

ALWAYS_ANSWERED = frozenset({"/healthz", "/readyz", "/metrics"})
FREE_BYTES = 1 << 16  # of a body; as much as the server buffers of every connection anyway
RETRY_AFTER_S = 1
_QUEUE_UP = ("/localizations", "/observations", "/sessions", "/prior")


@dataclass(frozen=True)
class AdmissionLimits:
    """What may be under way at once.

    Attributes:
        max_requests: Requests whose body has come and whose answer has not begun.
        max_uploads: Batches of frames on their way, or being stored.
        max_event_streams: Streams of job events.
        max_body_memory_bytes: Of bodies, those being received too.
    """

    max_requests: int
    max_uploads: int
    max_event_streams: int
    max_body_memory_bytes: int


class Shares:
    """What is in use; touched from the event loop alone."""

    def __init__(self, limits: AdmissionLimits) -> None:
        self.limits = limits
        self.n_requests = 0
        self.n_uploads = 0
        self.n_event_streams = 0
        self.n_body_bytes = 0

    def check_requests(self) -> None:
        """Raise OverloadedError where as many requests are under way as may."""
        _check(self.n_requests, self.limits.max_requests, "requests under way", "max_requests")

    def check_bytes(self, n_more: int) -> None:
        """Raise OverloadedError where so many bytes of a body have no room."""
        if self.n_body_bytes + n_more > self.limits.max_body_memory_bytes:
            raise OverloadedError(
                "the bodies being received fill the memory set aside for them: try again in a moment",
                retry_after_s=RETRY_AFTER_S,
                limit="max_body_memory_bytes",
            )


class AdmissionMiddleware:
    """Lets a request in where there is room for it, and takes its share back when its answer has gone.

    A request counts as under way from when its body has come to when its answer begins: whoever sends or reads slowly,
    or never to the end, takes a connection and memory for what was sent, but nobody's turn. Health, readiness and
    metrics are always answered.

    Args:
        app: The wrapped application.
        limits: What may be under way at once.
        queue_is_full: Whether the inference worker takes no more of a priority.
    """

    def __init__(self, app: ASGIApp, limits: AdmissionLimits, queue_is_full: Callable[[Priority], bool]) -> None:
        self.app = app
        self.shares = Shares(limits)
        self.queue_is_full = queue_is_full

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:  # noqa: D102 - ASGI
        if scope["type"] != "http" or scope["path"] in ALWAYS_ANSWERED:
            await self.app(scope, receive, send)
            return
        share = _Share(self.shares, scope, receive)
        try:
            share.take(self.queue_is_full)
        except OverloadedError as error:
            await refuse_unread(scope, receive, send, error)
            return
        try:
            await self.app(scope, share, share.sender(send))
        finally:
            share.give_back()


class _Share:
    """What one request has of all, and its `receive`."""

    def __init__(self, shares: Shares, scope: Scope, receive: Receive) -> None:
        self.shares = shares
        self.receive = receive
        method, path = scope["method"], scope["path"]
        self.is_upload = method == "POST" and path.endswith("/frames")
        self.is_event_stream = path.endswith("/events") and path.startswith("/v1/admin/jobs/")
        self.joins = _joins(method, path)
        self.framing = framing_of(scope)
        self.was_counted = self.is_counted = False
        self.n_body_bytes = 0  # beyond what is free
        self.n_free_bytes = FREE_BYTES

    def take(self, is_full: Callable[[Priority], bool]) -> None:
        """Take what is known to be needed; raises OverloadedError and takes nothing where there is no room."""
        shares, limits = self.shares, self.shares.limits
        if self.is_event_stream:
            _check(shares.n_event_streams, limits.max_event_streams, "event streams open", "max_event_streams")
            shares.n_event_streams += 1
            return
        shares.check_requests()
        if self.joins is not None and is_full(self.joins):
            raise queue_is_full()
        if self.is_upload:
            _check(shares.n_uploads, limits.max_uploads, "batches of frames on their way", "max_uploads")
            shares.n_uploads += 1
        else:
            n_needed = (self.framing.declared or 0) - FREE_BYTES
            # Only asked, not taken: who announces much and sends nothing should keep nobody out. More than there is
            # for all is another's to refuse, for good.
            if n_needed <= limits.max_body_memory_bytes:
                shares.check_bytes(n_needed)
        if not self.framing.has_body:
            self._count()

    async def __call__(self) -> Message:
        message = await self.receive()
        if message["type"] == "http.request" and self.framing.has_body and not self.is_event_stream:
            if not self.is_upload:  # those go to the disk as they come
                self._hold(len(message.get("body", b"")))
            if not message.get("more_body", False) and not self.was_counted:
                self.shares.check_requests()
                self._count()
        return message

    def sender(self, send: Send) -> Send:
        """`send`, which ends the request's turn with the first of its answer."""

        async def sends(message: Message) -> None:
            if self.is_counted:
                self._uncount()
            await send(message)

        return sends

    def give_back(self) -> None:
        """The answer has gone, or nobody waits for it."""
        if self.is_counted:
            self._uncount()
        self.shares.n_uploads -= self.is_upload
        self.shares.n_event_streams -= self.is_event_stream
        self.shares.n_body_bytes -= self.n_body_bytes

    def _count(self) -> None:
        self.was_counted = self.is_counted = True
        self.shares.n_requests += 1

    def _uncount(self) -> None:
        self.is_counted = False
        self.shares.n_requests -= 1

    def _hold(self, n_bytes: int) -> None:
        n_free = min(n_bytes, self.n_free_bytes)
        self.n_free_bytes -= n_free
        n_more = n_bytes - n_free
        self.shares.check_bytes(n_more)
        self.n_body_bytes += n_more
        self.shares.n_body_bytes += n_more


def _joins(method: str, path: str) -> Priority | None:
    """Which of the inference worker's queues a request will stand in."""
    if method in {"POST", "PUT"} and path.endswith(_QUEUE_UP):
        return Priority.LIVE
    return Priority.BATCH if method == "PUT" and "/frames/" in path else None


def _check(n_now: int, most: int, what: str, setting: str) -> None:
    if n_now >= most:
        raise OverloadedError(
            f"there are {n_now} {what} and no more are taken: try again in a moment",
            retry_after_s=RETRY_AFTER_S,
            limit=setting,
        )
