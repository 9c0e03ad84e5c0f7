"""Doing jobs in processes of their own, so that no live query ever waits for one (decision 0011)."""

import dataclasses
import json
import logging
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from deepsimbad.errors import CancelledError, DeepSimbadError, JobInterruptedError, UnavailableError
from deepsimbad.jobs.job_priority import JobPriority
from deepsimbad.jobs.progress import ProgressState
from deepsimbad.store.records import JobRecord

_log = logging.getLogger(__name__)
_MODULE = "deepsimbad.jobs.job_child"
_THREAD_VARIABLES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_LOOK_AGAIN_S = 0.1
_ENDS_WITHIN_S = 10.0  # after its last word
_READ_AT_ONCE = 1 << 16


class BrokenJobError(Exception):
    """A job broke by a fault of its own; the notes hold the child's stack, for the log alone."""


class InAnotherProcess:
    """Does every job in a child process that gives way to this one and dies with it.

    Call it from a thread that lives as long as the child may: Linux ties the child to the thread that started it.

    Args:
        data_dir: The data directory.
        n_threads: Threads the child computes in.
        priority: How far the child gives way to everything else.
        stops_within_s: A child that does not stop so soon after a cancel is killed, which harms nothing either.
    """

    def __init__(
        self,
        data_dir: Path,
        n_threads: int,
        priority: JobPriority = JobPriority.IDLE,
        stops_within_s: float = 3.0,
    ) -> None:
        self._data_dir = data_dir
        self._n_threads = n_threads
        self._priority = priority
        self._stops_within_s = stops_within_s

    def __call__(
        self, job: JobRecord, on_progress: Callable[[ProgressState], None], is_cancelled: Callable[[], bool]
    ) -> dict[str, Any]:
        """As `perform.RunJob`."""
        order = {
            "job": dataclasses.asdict(job),
            "data_dir": str(self._data_dir.resolve()),
            "n_threads": self._n_threads,
            "parent_pid": os.getpid(),
            "log_level": logging.getLogger("deepsimbad").getEffectiveLevel(),
        }
        limits = dict.fromkeys(_THREAD_VARIABLES, str(self._n_threads))  # read when the libraries load, not later
        with _Child(order, self._priority, limits) as child:
            _log.info("a job's process started", extra={"job_id": job.job_id, "pid": child.pid})
            result = None
            for message in child.messages(is_cancelled, self._stops_within_s):
                match message:
                    case {"progress": [stage, progress, eta_s]}:
                        on_progress(ProgressState(stage, progress, eta_s))
                    case {"log": record}:
                        _log_here(record, job.job_id)
                    case {"said": line}:
                        _log.warning("the job's process said", extra={"job_id": job.job_id, "line": line})
                    case {"error": {"code": code, "message": text, "hints": hints}}:
                        raise _error_class(code)(text, **hints)
                    case {"broken": stack}:
                        broken = BrokenJobError("in the job's process:")
                        broken.add_note(stack)
                        raise broken
                    case {"result": result}:
                        break
            if result is not None:
                return dict(result)
            raise child.died(is_cancelled())


class _Child:
    """The process of one job, as its parent sees it.

    Args:
        order: What it is to do.
        priority: How far it gives way.
        limits: Environment variables besides the present ones.
    """

    def __init__(self, order: dict[str, Any], priority: JobPriority, limits: dict[str, str]) -> None:
        try:
            self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                [sys.executable, "-P", "-m", _MODULE, priority],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env={**os.environ, **limits},
                bufsize=0,
                process_group=0,  # Ctrl-C is for the service alone; as a session of its own it would be its equal
            )
        except OSError as error:
            raise UnavailableError(
                f"no process could be started for the job: {error.strerror}", reason="no_process"
            ) from error
        self._was_killed = False
        self._send(json.dumps(order).encode() + b"\n")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing of it is left, whatever happened."""
        try:
            self._process.wait(_ENDS_WITHIN_S if kind is None else 1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                pipe.close()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def messages(self, is_cancelled: Callable[[], bool], stops_within_s: float) -> Iterator[dict[str, Any]]:
        """What it says, until it says no more; a cancel is handed on, and enforced where it is not obeyed."""
        process = self._process
        if process.stdout is None or process.stderr is None:
            raise BrokenJobError("the job's process has no pipes")
        rests = {process.stdout.fileno(): b"", process.stderr.fileno(): b""}
        messages = process.stdout.fileno()
        kill_at: float | None = None
        while rests:
            poll = select.poll()  # select knows no descriptor above 1023, and robots hold many
            for descriptor in rests:
                poll.register(descriptor, select.POLLIN)
            for descriptor, _ in poll.poll(1000 * _LOOK_AGAIN_S):
                read = os.read(descriptor, _READ_AT_ONCE)
                *lines, rest = (rests[descriptor] + read).split(b"\n")
                rests[descriptor] = rest
                if not read:
                    lines = [rest] if rest else []
                    del rests[descriptor]
                for line in lines:
                    yield _message(line) if descriptor == messages else _said(line)
            if kill_at is None and is_cancelled():
                self._send(b"cancel\n")
                kill_at = time.monotonic() + stops_within_s
            elif kill_at is not None and time.monotonic() > kill_at and not self._was_killed:
                self._was_killed = True
                process.kill()

    def died(self, cancelled: bool) -> DeepSimbadError:
        """Why it ended without a last word."""
        code = self._process.wait()
        if cancelled:
            return CancelledError("cancelled; it was killed, because it did not stop by itself")
        if code < 0:
            try:
                name = signal.Signals(-code).name
            except ValueError:  # a real-time signal
                name = f"signal {-code}"
            why = f"was ended by {name}"
            if -code == signal.SIGKILL:
                why += ", as the system does where memory runs out"
            return JobInterruptedError(f"the job's process {why}: start it again", signal=name)
        return JobInterruptedError(f"the job's process ended with code {code}: start it again", exit_code=code)

    def _send(self, line: bytes) -> None:
        if self._process.stdin is None:
            return
        try:
            self._process.stdin.write(line)
        except BrokenPipeError:  # it has died; what it said last tells more
            return


def _message(line: bytes) -> dict[str, Any]:
    try:
        message = json.loads(line)
    except ValueError:  # the half of a line that its death cut off
        return _said(line)
    return message if isinstance(message, dict) else _said(line)


def _said(line: bytes) -> dict[str, Any]:
    return {"said": line.decode("utf-8", "replace")}


def _log_here(record: dict[str, Any], job_id: str) -> None:
    """Write a record of the child to this process's log."""
    made = logging.makeLogRecord(
        {
            **record["extra"],
            "name": record["logger"],
            "levelno": record["level"],
            "levelname": logging.getLevelName(record["level"]),
            "msg": "%s",
            "args": (record["message"],),
            "job_id": job_id,
        }
    )
    logging.getLogger(record["logger"]).handle(made)


def _error_class(code: str) -> type[DeepSimbadError]:
    """The class of the tree that has a code; the root where none has."""
    waiting: list[type[DeepSimbadError]] = [DeepSimbadError]
    for candidate in waiting:
        if candidate.code == code:
            return candidate
        waiting.extend(candidate.__subclasses__())
    return DeepSimbadError
