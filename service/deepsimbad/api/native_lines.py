"""What native libraries write to standard error, as lines of the log: few a minute, the others counted.

libpng and libjpeg print their complaints past Python. A sender of damaged images would fill the log with lines that no
reader of JSON understands.
"""

import faulthandler
import logging
import os
import select
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

log = logging.getLogger(__name__)

LINES_A_MINUTE = 5
_MINUTE_S = 60.0
_STDERR = 2
_LONGEST = 500  # bytes of a line; a longer one is cut, and so is one that never ends
_READ_AT_ONCE = 1 << 16
_ENDS_WITHIN_S = 5.0


@contextmanager
def native_lines_in_the_log() -> Iterator[None]:
    """Keep standard error for Python and for crashes: what else this process writes there goes to the log.

    `sys.stderr` and `faulthandler` write where they did; the descriptor itself is a pipe inside the block, in which
    logging is to be configured. Where standard error is closed nothing is done.
    """
    told = sys.stderr
    if told is None:
        yield
        return
    told.flush()
    real = os.dup(_STDERR)  # never closed: log records may come until the process ends
    read, write = os.pipe()
    # Who writes while nobody can read, as under the interpreter's lock, loses lines rather than waits for ever.
    os.set_blocking(write, False)
    os.dup2(write, _STDERR)
    os.close(write)
    sys.stderr = open(real, "w", encoding=told.encoding, errors="backslashreplace", buffering=1, closefd=False)  # noqa: SIM115
    was_enabled = faulthandler.is_enabled()
    faulthandler.enable(real)
    thread = threading.Thread(target=_tell, args=(read,), name="native-lines", daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.dup2(real, _STDERR)  # the last end to write to is closed, so the thread comes to an end
        thread.join(_ENDS_WITHIN_S)
        sys.stderr = told
        faulthandler.disable()
        if was_enabled:
            faulthandler.enable(_STDERR)


class Ration:
    """Lets a few lines a minute through and counts the others.

    Args:
        clock: Seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._ends_at = clock()
        self._n_let = 0
        self._n_left_out = 0

    def lets(self) -> bool:
        """Whether one more line is let through; it is counted either way."""
        if self._clock() >= self._ends_at and self._n_left_out == 0:
            self._ends_at, self._n_let = self._clock() + _MINUTE_S, 0
        self._n_let += 1
        self._n_left_out += self._n_let > LINES_A_MINUTE
        return self._n_let <= LINES_A_MINUTE

    @property
    def tells_in_s(self) -> float | None:
        """Seconds until those left out should be told; None: there are none."""
        return max(0.0, self._ends_at - self._clock()) if self._n_left_out > 0 else None

    def left_out(self) -> int:
        """How many were left out since this was last asked."""
        told, self._n_left_out = self._n_left_out, 0
        return told


def _tell(read: int) -> None:
    """Log what comes out of the pipe, until nobody can write to it any more."""
    ration, rest = Ration(), b""
    waiting = select.poll()
    waiting.register(read, select.POLLIN)
    while True:
        patience_s = ration.tells_in_s
        if patience_s == 0.0 or not waiting.poll(None if patience_s is None else 1000 * patience_s):
            _tell_left_out(ration)
            continue
        came = os.read(read, _READ_AT_ONCE)
        *lines, rest = (rest + came).split(b"\n")
        if not came or len(rest) > _LONGEST:
            lines, rest = [*lines, rest], b""
        for line in filter(None, lines):
            if ration.lets():
                log.warning("a library said", extra={"line": line[:_LONGEST].decode("utf-8", "replace")})
        if not came:
            break
    _tell_left_out(ration)
    os.close(read)


def _tell_left_out(ration: Ration) -> None:
    n_left_out = ration.left_out()
    if n_left_out > 0:
        log.warning("libraries said more", extra={"n_lines": n_left_out})
