"""How much of what was written to a connection its peer has not taken yet, and whether it goes on taking it."""

import asyncio
import struct
import sys
from contextlib import suppress

if sys.platform == "linux":
    import fcntl
    import socket
    import termios

_BYTES_ACKNOWLEDGED_AT = 120  # of Linux' struct tcp_info: tcpi_bytes_acked, 64 bits


class Outgoing:
    """What was written to one connection, watched while its peer takes it.

    Args:
        transport: The connection's.
    """

    def __init__(self, transport: asyncio.Transport) -> None:
        self._transport = transport
        self._mark: int | None = None  # of what the peer had when last looked at; None: not watched
        self._moved_at = 0.0

    @property
    def is_watched(self) -> bool:
        """Whether there was something to take when last looked at."""
        return self._mark is not None

    def watch(self, now: float) -> None:
        """Watch from now on, if not already."""
        if self._mark is None:
            self._mark, self._moved_at = _taken_mark(self._transport), now

    def stalled_s(self, now: float) -> float | None:
        """Seconds for which nothing was taken; None where all was, which ends the watch."""
        if n_pending_bytes(self._transport) == 0:
            self._mark = None
            return None
        mark = _taken_mark(self._transport)
        if mark != self._mark:
            self._mark, self._moved_at = mark, now
        return now - self._moved_at


def n_pending_bytes(transport: asyncio.Transport) -> int:
    """Bytes in the transport's buffer, and on Linux those that the kernel holds unacknowledged too.

    A transport of TLS hands all it has to another beneath it and calls its own buffer empty; but that one is empty
    only where the kernel's is.
    """
    n_bytes = transport.get_write_buffer_size()
    if sys.platform == "linux":
        connection = transport.get_extra_info("socket")
        with suppress(OSError):  # just closed
            n_bytes += struct.unpack("i", fcntl.ioctl(connection.fileno(), termios.TIOCOUTQ, bytes(4)))[0]
    return n_bytes


def _taken_mark(transport: asyncio.Transport) -> int:
    """A number that is another one whenever the peer has taken more.

    On Linux what was acknowledged. Elsewhere what the transport holds, which can stand still for minutes on a thin
    link: the kernel takes more only once a good part of what it holds has gone.
    """
    if sys.platform == "linux":
        connection = transport.get_extra_info("socket")
        with suppress(OSError):
            told = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _BYTES_ACKNOWLEDGED_AT + 8)
            if len(told) == _BYTES_ACKNOWLEDGED_AT + 8:
                return int(struct.unpack_from("Q", told, _BYTES_ACKNOWLEDGED_AT)[0])
    return transport.get_write_buffer_size()
