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


def taken_mark(transport: asyncio.Transport) -> int:
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
