"""The process of one job: `python -m deepsimbad.jobs.job_child PRIORITY`, started by `job_process`.

It says everything as JSON lines on its standard output, and takes from its standard input one line that says which job,
then perhaps one more, which cancels. When its input ends, its parent is dead and it ends at once.

Nothing heavy is imported before the priority is low: threads inherit it from the one that starts them.
"""

import ctypes
import faulthandler
import json
import logging
import os
import signal
import sys
import threading
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from deepsimbad.jobs.job_priority import JobPriority, take_priority

_PR_SET_PDEATHSIG = 1
_KILL_ME_FIRST = 500  # of 1000: where memory runs out, the kernel shall end the job rather than the service
_ORPHANED = 3  # exit code


class _Parent:
    """The other end of the pipes.

    Args:
        lines: Where messages go.
        commands: File descriptor they come from.
    """

    def __init__(self, lines: TextIO, commands: int) -> None:
        self._lines = lines
        self._commands = commands
        self._lock = threading.Lock()
        self.cancelled = threading.Event()

    def tell(self, **message: Any) -> None:
        """Send one message."""
        line = json.dumps(message, default=str)
        with self._lock:
            self._lines.write(line + "\n")
            self._lines.flush()

    def order(self) -> dict[str, Any]:
        """The first line: what to do."""
        line = b""
        while not line.endswith(b"\n"):
            octet = os.read(self._commands, 1)  # byte by byte: what follows is the listener's
            if not octet:
                os._exit(_ORPHANED)
            line += octet
        order: dict[str, Any] = json.loads(line)
        return order

    def listen(self) -> None:
        """Wait for the one thing that may follow, or for the end."""
        while os.read(self._commands, 64):
            self.cancelled.set()
        os._exit(_ORPHANED)


class _LogToParent(logging.Handler):
    """Sends log records as messages."""

    def __init__(self, parent: _Parent) -> None:
        super().__init__()
        self._parent = parent
        self._plain = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "taskName"}

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record."""
        extra = {name: value for name, value in record.__dict__.items() if name not in self._plain}
        if record.exc_info:
            extra["exception"] = logging.Formatter().formatException(record.exc_info)
        with suppress(OSError):  # the parent is gone, and this process soon as well
            self._parent.tell(
                log={"logger": record.name, "level": record.levelno, "message": record.getMessage(), "extra": extra}
            )


def main() -> None:
    """Do the job that standard input names."""
    for signal_number in (signal.SIGINT, signal.SIGTERM):  # meant for the service, which then stops its job itself
        signal.signal(signal_number, signal.SIG_IGN)
    take_priority(JobPriority(sys.argv[1]))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(_KILL_ME_FIRST), encoding="ascii")
    faulthandler.enable()
    lines = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever a library prints is no message
    parent = _Parent(lines, 0)
    order = parent.order()
    _die_with(order["parent_pid"])
    threading.Thread(target=parent.listen, name="parent", daemon=True).start()
    root = logging.getLogger()
    root.addHandler(_LogToParent(parent))
    logging.getLogger("deepsimbad").setLevel(order["log_level"])
    logging.captureWarnings(True)
    _perform(order, parent)


def _perform(order: dict[str, Any], parent: _Parent) -> None:
    from deepsimbad.errors import DeepSimbadError  # noqa: PLC0415 - nothing heavy before the priority is low
    from deepsimbad.jobs.perform import perform  # noqa: PLC0415
    from deepsimbad.jobs.progress import ProgressState  # noqa: PLC0415
    from deepsimbad.store.records import JobRecord, JobState  # noqa: PLC0415

    def on_progress(state: ProgressState) -> None:
        parent.tell(progress=[state.stage, state.progress, state.eta_s])

    job = JobRecord(**{**order["job"], "state": JobState(order["job"]["state"])})
    try:
        result = perform(Path(order["data_dir"]), job, order["n_threads"], on_progress, parent.cancelled.is_set)
    except DeepSimbadError as error:
        parent.tell(error={"code": error.code, "message": error.message, "hints": error.hints})
    except Exception:
        parent.tell(broken=traceback.format_exc())
    else:
        parent.tell(result=result)


def _die_with(parent_pid: int) -> None:
    """Let the kernel end this process with its parent, where it can; the listener notices a little later."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent_pid:  # it died before that
            os._exit(_ORPHANED)


if __name__ == "__main__":
    main()
