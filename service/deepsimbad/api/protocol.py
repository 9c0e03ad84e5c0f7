"""The connection: uvicorn's HTTP protocol, with the limits on time and bytes that uvicorn has not."""

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import httptools
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

from deepsimbad.api.outgoing import Outgoing, n_pending_bytes
from deepsimbad.api.refusal import render_refusal
from deepsimbad.errors import (
    DeepSimbadError,
    HeadersTooLargeError,
    OverloadedError,
    RequestTimeoutError,
    UnreadableRequestError,
)

log = logging.getLogger(__name__)

MAX_HEADERS = 128
MAX_PIPELINED = 64
LINGER_S = 2.0  # a refused sender may go on for so long, or for so many bytes, before the connection is cut
LINGER_BYTES = 1 << 20
_LOOKS_PER_STALL = 8  # how often a connection is looked at that may be waiting for us rather than for its peer

# What the next byte of a connection belongs to.
_FRESH, _IDLE, _HEAD, _BODY = range(4)


@dataclass(frozen=True)
class WireLimits:
    """What one connection may cost.

    Attributes:
        header_timeout_s: From the first byte of a request, or from connecting, to the end of its headers.
        stall_timeout_s: Between two bytes of a body, or of an answer that the peer takes.
        max_header_bytes: Request line and headers together.
        max_connections: Open at once, all peers together.
        refused: Told the code of every refusal, for the metrics.
    """

    header_timeout_s: float
    stall_timeout_s: float
    max_header_bytes: int
    max_connections: int
    refused: Callable[[str], None]


def protocol_class(limits: WireLimits) -> type[asyncio.Protocol]:
    """The protocol with these limits, as `uvicorn.Config(http=...)` takes it."""
    return type("LimitedProtocol", (LimitedProtocol,), {"limits": limits})


class LimitedProtocol(HttpToolsProtocol):
    """Closes connections whose peer is too slow, too long or no HTTP, and says why in a problem document.

    A request costs it no timer: one handle a connection looks now and then whether a deadline has passed, and is set
    anew only then. Bytes are handed to the parser in pieces no longer than a head may be, so that what it keeps of a
    head, of trailers or of a chunk's extensions has the same bound.

    What the parser refuses, or what takes too long, is answered in its turn: after the answers to the requests before
    it on the connection.
    """

    limits: ClassVar[WireLimits]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._place = _FRESH
        self._n_loose = 0  # bytes since the head began; in a body, since its last content
        self._advanced = False  # whether a piece held more than loose bytes
        self._since = 0.0  # when the head began, or when the body last moved
        self._running: RequestResponseCycle | None = None  # uvicorn's `cycle` is the newest, which may still wait
        self._refusal: DeepSimbadError | None = None
        self._n_dropped = 0
        self._outgoing: Outgoing  # as soon as there is a transport
        self._look: asyncio.TimerHandle | None = None
        self._look_at = 0.0

    # The transport's side

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # noqa: D102
        super().connection_made(transport)
        self._outgoing = Outgoing(transport)
        self._since = self.loop.time()
        if len(self.connections) > self.limits.max_connections:
            self._make_room()
        if self._refusal is not None:
            return
        self._look_by(self._since + self.limits.header_timeout_s)

    def _make_room(self) -> None:
        """Close a connection that asks for nothing; where all are at work, this new one.

        Those that never asked go first, then those between two requests, the longest silent first: whoever opens
        connections and says nothing loses them to those who have something to say.
        """
        others = [other for other in self.connections if isinstance(other, LimitedProtocol) and other is not self]
        silent = [other for other in others if other._refusal is None and other._is_silent]
        chosen = min(silent, key=lambda other: (other.cycle is not None, other._since), default=self)
        chosen._refusal = OverloadedError("too many connections")
        self.limits.refused("max_connections")
        chosen.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: D102
        if self._look is not None:
            self._look.cancel()
            self._look = None
        if self._running is not None:
            _disconnect(self._running)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:  # noqa: D102
        if self._refusal is not None:
            self._drop(len(data))
            return
        self._unset_keepalive_if_required()
        if self._place in {_FRESH, _IDLE}:
            self._begin_head()
        n_read, limit = 0, self.limits.max_header_bytes
        while n_read < len(data):
            room = limit - self._n_loose
            if room <= 0:
                what = "headers are" if self._place == _HEAD else "chunk extensions or trailers are"
                self._refuse(HeadersTooLargeError(f"the request's {what} longer than {limit} bytes", max_bytes=limit))
                return
            whole = n_read == 0 and len(data) <= room
            n_read += self._feed(data if whole else data[n_read : n_read + room])
            if self._refusal is not None:
                return
        if self._place == _HEAD:
            self._look_by(self._since + self.limits.header_timeout_s)
        elif self._place == _BODY:
            if not self.cycle.response_complete:  # what comes after the answer has no more time than the rest had
                self._since = self.loop.time()
            self._look_by(self._since + self.limits.stall_timeout_s)

    def pause_writing(self) -> None:  # noqa: D102
        super().pause_writing()
        self._watch_answer()

    def shutdown(self) -> None:  # noqa: D102
        is_refused = self._refusal is not None and not self._is_under_way
        if is_refused or self.cycle is None or self.cycle.response_complete:
            self._close()
        else:
            super().shutdown()

    def timeout_keep_alive_handler(self) -> None:  # noqa: D102
        self._close()

    # The parser's side

    def _feed(self, piece: bytes) -> int:
        """Parse a piece; returns how much of it was read."""
        n_read, self._advanced = len(piece), False
        try:
            self.parser.feed_data(piece)
        except httptools.HttpParserUpgrade as offer:
            self._decline_upgrade()
            return int(offer.args[0])
        except httptools.HttpParserError as error:
            self._refuse(_named(error))
            return n_read
        self._n_loose = 0 if self._advanced else self._n_loose + n_read
        if self._place != _IDLE and len(self.headers or ()) > MAX_HEADERS:
            self._refuse(_too_many_headers())
        return n_read

    def on_message_begin(self) -> None:  # noqa: D102
        if self._place != _HEAD:
            self._begin_head()
        super().on_message_begin()

    def on_headers_complete(self) -> None:  # noqa: D102
        if len(self.headers) > MAX_HEADERS:
            raise _too_many_headers()
        if self.parser.should_upgrade():
            if self.parser.get_method() == b"CONNECT":
                raise UnreadableRequestError("the service is no proxy: CONNECT is not taken")
            return  # it is read again, without the offer
        if len(self.pipeline) >= MAX_PIPELINED:
            raise OverloadedError(
                f"more than {MAX_PIPELINED} requests wait on this connection for their answers", retry_after_s=1
            )
        super().on_headers_complete()
        self._place, self._advanced = _BODY, True
        self.headers = []  # trailers come through the same door, and are no headers

    def on_body(self, body: bytes) -> None:  # noqa: D102
        self._advanced = True
        super().on_body(body)

    def on_message_complete(self) -> None:  # noqa: D102
        if self._place == _HEAD:  # an offer to upgrade ends so
            return
        self._place, self._advanced = _IDLE, True
        super().on_message_complete()

    def _decline_upgrade(self) -> None:
        """Read a head again without its offer: the parser thinks that a message with an offer has no body."""
        head = [self.parser.get_method(), b" ", self.url, b" HTTP/", self.parser.get_http_version().encode(), b"\r\n"]
        for name, value in self.headers:
            if name != b"upgrade":
                head += (name, b": ", value, b"\r\n")
        self.parser = httptools.HttpRequestParser(self)
        self.parser.set_dangerous_leniencies(lenient_data_after_close=True)  # as uvicorn has it
        self._feed(b"".join([*head, b"\r\n"]))

    def _begin_head(self) -> None:
        self._place, self._advanced, self._n_loose = _HEAD, True, 0
        self._since = self.loop.time()
        self.scope = None  # type: ignore[assignment]  # as uvicorn has it before a request line

    # The application's side

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: Any) -> None:
        self._running = cycle
        super()._start_asgi_task(cycle, app)

    def on_response_complete(self) -> None:  # noqa: D102
        super().on_response_complete()
        if self.scheme == "https" or self.transport.get_write_buffer_size() > 0:
            self._watch_answer()
        if self._refusal is not None and not self._is_under_way:
            self._unset_keepalive_if_required()
            self._answer_refusal()

    @property
    def _is_under_way(self) -> bool:
        return self._running is not None and not self._running.response_complete

    @property
    def _is_silent(self) -> bool:
        """Whether no request of this connection is read or answered.

        The rest of a body whose answer has gone is nobody's request: announcing one must not hold a place.
        """
        is_read = self._place == _BODY and not (self.cycle is not None and self.cycle.response_complete)
        return not is_read and not self._is_under_way and not self.pipeline

    # Time

    def _look_by(self, at: float) -> None:
        """Look at the deadlines at `at`, a time of the loop, if not earlier."""
        if self._look is not None:
            if self._look_at <= at:
                return
            self._look.cancel()
        self._look_at = at
        self._look = self.loop.call_at(at, self._look_now)

    def _look_now(self) -> None:
        self._look = None
        now = self.loop.time()
        if self._outgoing.is_watched and not self._answer_moves(now):
            return
        if self._refusal is not None or self.transport.is_closing():
            return
        if self._place in {_FRESH, _HEAD}:
            self._time_out_at(now, self._since + self.limits.header_timeout_s)
        elif self._place == _BODY:
            if self.flow.read_paused or self.cycle.waiting_for_100_continue:  # it is we who do not read
                self._since = now
                self._look_by(now + self._look_every_s)
            else:
                self._time_out_at(now, self._since + self.limits.stall_timeout_s)

    def _time_out_at(self, now: float, at: float) -> None:
        if now < at:
            self._look_by(at)
        elif self._place == _FRESH:
            self.limits.refused("silent_connection")
            self.transport.abort()  # nothing was written, and the peer of a handshake might not let it close
        elif self._place == _HEAD:
            limit_s = self.limits.header_timeout_s
            self._refuse(RequestTimeoutError(f"the request's headers were not whole after {limit_s:g} s"))
        else:
            limit_s = self.limits.stall_timeout_s
            self._refuse(RequestTimeoutError(f"no byte of the request's body came for {limit_s:g} s"))

    def _watch_answer(self) -> None:
        if not self._outgoing.is_watched:
            now = self.loop.time()
            self._outgoing.watch(now)
            self._look_by(now + self._look_every_s)

    def _answer_moves(self, now: float) -> bool:
        """Whether the peer takes what it asked for; the connection is cut where it does not."""
        stalled_s = self._outgoing.stalled_s(now)
        if stalled_s is None:
            if self.transport.is_closing():  # by a handshake that the peer leaves open
                self.transport.abort()
            return not self.transport.is_closing()
        if stalled_s >= self.limits.stall_timeout_s:
            self.limits.refused("answer_not_read")
            self.transport.abort()
            return False
        self._look_by(now + self._look_every_s)
        return True

    @property
    def _look_every_s(self) -> float:
        return min(self.limits.stall_timeout_s / _LOOKS_PER_STALL, LINGER_S)

    def _close(self) -> None:
        """Close when what was written has gone; cut where the peer does not let it."""
        if self.scheme == "https" or self.transport.get_write_buffer_size() > 0:
            self._watch_answer()
        self.transport.close()

    # Refusing

    def _refuse(self, error: DeepSimbadError) -> None:
        """Read no more; answer the message that is being read with a problem, in its turn, and close."""
        self._refusal = error
        self.headers = []
        own = self.cycle if self._place == _BODY else None
        if own is not None and own is self._running:
            self._running = None
            _disconnect(own)
            if own.response_started:  # there is only one answer a request
                self.limits.refused(error.code)
                self._close()
                return
        elif own is not None:
            self.pipeline.popleft()  # its head was whole, so it waits there, newest first; it never runs
        if self._is_under_way:
            self.flow.pause_reading()
        else:
            self._answer_refusal()

    def _answer_refusal(self) -> None:
        error = self._refusal
        if error is None or self.transport.is_closing():
            return
        self.limits.refused(error.code)
        status, request_id, answer = render_refusal(error, self.scope, self.server_state.default_headers)
        log.info(
            "request refused",
            extra={"request_id": request_id, "status": status, "code": error.code, "peer": (self.client or ("",))[0]},
        )
        self.transport.write(answer)
        if isinstance(error, RequestTimeoutError):  # nothing of it is on its way
            self._close()
            return
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self.flow.resume_reading()  # closing on unread bytes would reset the connection under the answer
        if self._look is not None:
            self._look.cancel()
        self._look = self.loop.call_later(LINGER_S, self._end_linger)

    def _drop(self, n_bytes: int) -> None:
        self._n_dropped += n_bytes
        if self._n_dropped > LINGER_BYTES and not self._is_under_way:
            self._end_linger()

    def _end_linger(self) -> None:
        self._look = None
        if n_pending_bytes(self.transport) == 0:
            self.transport.abort()  # all is with the peer, who may still be sending
        else:
            self._close()


def _disconnect(cycle: RequestResponseCycle) -> None:
    """Tell the application that nobody waits for its answer any more."""
    if not cycle.response_complete:
        cycle.disconnected = True
        cycle.message_event.set()


def _named(error: httptools.HttpParserError) -> DeepSimbadError:
    if isinstance(error.__context__, DeepSimbadError):  # raised by a callback of ours, to stop the parser
        return error.__context__
    if isinstance(error, httptools.HttpParserCallbackError):
        return UnreadableRequestError("the request's target cannot be read")
    return UnreadableRequestError(f"these bytes are no request: {error}")


def _too_many_headers() -> HeadersTooLargeError:
    return HeadersTooLargeError(f"the request has more than {MAX_HEADERS} headers", max_headers=MAX_HEADERS)
