"""The process of one job: `python -m deepsimbad.jobs.child PRIORITY`, started by `jobs.runner` (decision 0011).

It sends its messages as JSON lines on its standard output, and takes from its standard input one line that names the
job, then perhaps one more, which cancels. When its input ends, its parent is dead and it ends at once.

Nothing heavy is imported before the priority is low: threads inherit it from the one that starts them.
"""

import ctypes
import faulthandler
import gc
import json
import logging
import os
import signal
import sys
import threading
import traceback
from contextlib import suppress
from enum import StrEnum
from itertools import islice
from pathlib import Path
from typing import Any

_LOWEST_NICE = 19
_PR_SET_PDEATHSIG = 1
_KILL_ME_FIRST = 500  # of 1000: where memory runs out, the kernel shall end the job rather than the service
_ORPHANED = 3  # exit code
_N_STANDARD = len(logging.makeLogRecord({}).__dict__)
_STANDARD = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "taskName", "color_message"}
_write_lock = threading.Lock()


def extras(record: logging.LogRecord) -> dict[str, Any]:
    """The `extra` fields of a log record, without those of libraries, which begin with an underscore."""
    items = islice(record.__dict__.items(), _N_STANDARD, None)
    return {name: value for name, value in items if name not in _STANDARD and not name.startswith("_")}


class JobPriority(StrEnum):
    """How far a job gives way to whatever else runs on the machine, from the politest on."""

    IDLE = "idle"
    LOW = "low"
    NORMAL = "normal"


def _take_priority(priority: JobPriority) -> None:
    """Give this process, and the threads it starts from now on, a priority, as far as the system has such.

    Idle takes the machine only while nobody else wants it: an idle-class thread is preempted at once, and the kernel
    (since 5.4) counts its core as free when it places a waking thread. Low still keeps about a seventieth of a
    contended core, so that it goes on where others never rest, and is not preempted by a thread that wakes up.
    """
    if priority is JobPriority.NORMAL:
        return
    with suppress(OSError):
        os.nice(_LOWEST_NICE)
    with suppress(OSError, AttributeError):
        kind = os.SCHED_IDLE if priority is JobPriority.IDLE else os.SCHED_BATCH
        os.sched_setscheduler(0, kind, os.sched_param(0))


def _tell(**message: Any) -> None:
    """Send one message, on a line of its own whatever a library has printed."""
    with _write_lock, suppress(BrokenPipeError):  # the parent is gone, and this process soon as well
        os.write(1, b"\n" + json.dumps(message, default=str).encode() + b"\n")


class _LogToParent(logging.Handler):
    """Sends log records as messages."""

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record."""
        extra = extras(record)
        if record.exc_info:
            extra["exception"] = logging.Formatter().formatException(record.exc_info)
        _tell(log={"name": record.name, "levelno": record.levelno, "msg": record.getMessage(), "extra": extra})


def _listen(commands: Any, cancellation: threading.Event) -> None:
    """Set `cancellation` when a line comes; end the process when the input ends."""
    while commands.readline():
        cancellation.set()
    os._exit(_ORPHANED)


def main() -> None:
    """Do the job that standard input names."""
    for signal_number in (signal.SIGINT, signal.SIGTERM):  # meant for the service, which then stops its job itself
        signal.signal(signal_number, signal.SIG_IGN)
    _take_priority(JobPriority(sys.argv[1]))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(_KILL_ME_FIRST), encoding="ascii")
    faulthandler.enable()
    line = sys.stdin.buffer.readline()
    if not line.endswith(b"\n"):
        os._exit(_ORPHANED)
    request, cancellation = json.loads(line), threading.Event()
    if sys.platform == "linux":  # the kernel ends this process with its parent at once, the listener a little later
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != request["parent_pid"]:  # it died before that
        os._exit(_ORPHANED)
    threading.Thread(target=_listen, args=(sys.stdin.buffer, cancellation), name="parent", daemon=True).start()
    logging.getLogger().addHandler(_LogToParent())
    logging.getLogger("deepsimbad").setLevel(request["log_level"])
    logging.captureWarnings(True)

    gc.disable()  # imports leave little behind, and looking for it would be an eighth of them
    from pydantic import TypeAdapter  # noqa: PLC0415 - nothing heavy before the priority is low

    from deepsimbad.errors import DeepSimbadError  # noqa: PLC0415
    from deepsimbad.evaluators.compute import Compute  # noqa: PLC0415
    from deepsimbad.jobs.runner import InThisProcess  # noqa: PLC0415
    from deepsimbad.store.records import JobRecord  # noqa: PLC0415

    gc.freeze()
    gc.enable()
    job = TypeAdapter(JobRecord).validate_python(request["job"])
    compute = TypeAdapter(Compute).validate_python(request["compute"])
    run_job = InThisProcess(Path(request["data_dir"]), request["n_threads"], compute)
    try:
        result = run_job(job, lambda state: _tell(progress=vars(state)), cancellation.is_set)
    except DeepSimbadError as error:
        _tell(error={"code": error.code, "message": error.message, "hints": error.hints})
    except Exception:
        _tell(broken=traceback.format_exc())
    else:
        _tell(result=result)


if __name__ == "__main__":
    main()
