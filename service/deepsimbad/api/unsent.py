"""How much of what was written to a connection its peer has not taken yet."""

import asyncio
import sys

if sys.platform == "linux":
    import fcntl
    import struct
    import termios


def n_unsent_bytes(transport: asyncio.Transport) -> int:
    """Bytes in the transport's buffer, and on Linux those that the kernel holds unacknowledged too.

    The kernel takes more only once a good part of what it holds has gone: a thin link that moves all the time can
    leave the transport's own buffer as it is for minutes.
    """
    n_bytes = transport.get_write_buffer_size()
    if sys.platform == "linux":
        socket = transport.get_extra_info("socket")
        if socket is not None and socket.fileno() >= 0:
            n_bytes += struct.unpack("i", fcntl.ioctl(socket.fileno(), termios.TIOCOUTQ, bytes(4)))[0]
    return n_bytes
