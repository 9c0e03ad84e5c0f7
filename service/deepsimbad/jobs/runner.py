"""Jobs: done one after the other, each in a process of its own so that no live query waits for one (decision 0011).

A job whose process or service died starts again from what is durable, and makes one map.
"""

import dataclasses
import json
import logging
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from deepsimbad.errors import (
    CancelledError,
    DamagedFileError,
    DeepSimbadError,
    IdempotencyKeyReusedError,
    InvalidInputError,
    JobInterruptedError,
    OutOfMemoryError,
    TooManyJobsError,
    UnavailableError,
    UnknownJobError,
)
from deepsimbad.evaluators.compute import Compute, available_cores
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.child import JobPriority
from deepsimbad.jobs.fitting import fitting_of
from deepsimbad.jobs.progress import Progress, ProgressState
from deepsimbad.jobs.remap import remap
from deepsimbad.jobs.remap_config import REMAP_STAGES, RemapConfig, stages_in
from deepsimbad.jobs.versions import EXPERIENCE, LEARN_STAGES, ExperienceConfig, learn_online, serve_learnt, walks_of
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import JobRecord, JobState
from deepsimbad.store.sessions import SessionStore
from deepsimbad.store.shared_catalog import open_catalog

_log = logging.getLogger(__name__)
REMAP = "remap"  # the kind of job
_MAX_WAITING = 100
_RETRY_AFTER_S = 30  # a place is free once a job has ended, which takes longer than a query
_RETRY_WRITE_S = 1.0
_THREAD_VARIABLES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_POLL_S = 0.1
_EXIT_TIMEOUT_S = 10.0  # of a child, after its last message

_T = TypeVar("_T")
RunJob: TypeAlias = Callable[[JobRecord, Callable[[ProgressState], None], Callable[[], bool]], dict[str, Any]]
"""Does a job and returns its result; calls the first function with every new state, and asks the second if to stop.

The caller writes the job's row. Raises CancelledError, JobInterruptedError where the process that did it died, or
another error of the tree.
"""


def job_threads(n_threads: int) -> int:
    """The threads that a job beside a living service computes in; 0 stands for one less than there are cores."""
    return n_threads or max(1, available_cores() - 1)


class JobRunner:
    """Runs jobs in one thread, in the order they came; first those that an earlier service left.

    Args:
        catalog: Where jobs are recorded; `Catalog.discard_unfinished` has been called.
        run_job: Does a job; called in a thread that lives until `close`.
        on_activated: Called with the domain's name after a job activated a map.
        max_waiting: Jobs that may wait their turn.
        on_ended: Called with a job's kind, how it ended, and the seconds it took.
    """

    def __init__(
        self,
        catalog: Catalog,
        run_job: RunJob,
        on_activated: Callable[[str], None],
        max_waiting: int = _MAX_WAITING,
        on_ended: Callable[[str, str, float], None] = lambda *_: None,
    ) -> None:
        self._catalog = catalog
        self._run_job = run_job
        self._on_activated = on_activated
        self._max_waiting = max_waiting
        self._on_ended = on_ended
        self._submit_lock = threading.Lock()
        self._job_queue: queue.Queue[str | None] = queue.Queue()
        self._cancellations: dict[str, threading.Event] = {}
        self._closing = threading.Event()
        for job_id in catalog.waiting_jobs():
            self._enqueue(job_id)
        self._thread = threading.Thread(target=self._run, name="jobs", daemon=True)
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether the thread is there to take up jobs."""
        return self._thread.is_alive()

    def submit(self, domain: str, config: RemapConfig | ExperienceConfig, job_id: str | None = None) -> JobRecord:
        """Queue a remap, or the learning of what a session taught, as the domain's next map.

        Args:
            job_id: Its id, where a repetition of the request would have the same: the job that was made by the first
                one is returned then, as it stands. None: a new one.

        Raises:
            UnknownDomainError: No such domain.
            IdempotencyKeyReusedError: The job of that id was asked for something else.
            TooManyJobsError: As many jobs wait as may.
            UnavailableError: The service is shutting down.
        """
        with self._submit_lock:
            earlier_record = self.earlier_job(job_id, config)
            if earlier_record is not None:
                return earlier_record
            if self._closing.is_set():
                raise UnavailableError("the service is shutting down and takes no new job")
            if len(self._catalog.waiting_jobs()) >= self._max_waiting:
                raise TooManyJobsError(
                    f"{self._max_waiting} jobs wait already, and no more may: cancel one, or wait",
                    limit="max_jobs",
                    max_jobs=self._max_waiting,
                    retry_after_s=_RETRY_AFTER_S,
                )
            kind = REMAP if isinstance(config, RemapConfig) else EXPERIENCE
            job = self._catalog.create_job(domain, kind, config.as_dict(), job_id)
            self._enqueue(job.job_id)
            return job

    def earlier_job(self, job_id: str | None, config: RemapConfig | ExperienceConfig) -> JobRecord | None:
        """The job that an earlier request of this id made; None: there is none.

        Raises IdempotencyKeyReusedError: that request was for something else.
        """
        if job_id is None:
            return None
        try:
            job = self._catalog.job(job_id)
        except UnknownJobError:
            return None
        if job.config != config.as_dict():
            raise IdempotencyKeyReusedError("this idempotency key came before with another body: choose a new one")
        return job

    def cancel(self, job_id: str) -> JobRecord:
        """Ask a job to stop; a queued one ends at once, a running one at its next report.

        Raises UnknownJobError: no such job.
        """
        job = self._catalog.cancel_queued_job(job_id)
        event = self._cancellations.get(job_id)
        if event is not None:
            event.set()
        return job

    def close(self) -> None:
        """Stop what runs and wait for its clean end; it and what is queued are left to the next service."""
        self._closing.set()
        self._job_queue.put(None)
        self._thread.join()

    def _enqueue(self, job_id: str) -> None:
        self._cancellations[job_id] = threading.Event()
        self._job_queue.put(job_id)

    def _run(self) -> None:
        while (job_id := self._job_queue.get()) is not None and not self._closing.is_set():
            try:
                self._run_one(job_id)
            except DeepSimbadError:
                _log.exception("the state of a job could not be recorded", extra={"job_id": job_id})
            finally:
                self._cancellations.pop(job_id, None)

    def _run_one(self, job_id: str) -> None:
        try:
            job = self._write(lambda: self._catalog.start_job(job_id))
        except UnknownJobError:  # cancelled while it waited, and then its domain was deleted
            return
        if job.state is not JobState.RUNNING:  # cancelled while it waited
            return
        log_fields: dict[str, Any] = {"job_id": job_id, "domain": job.domain, "kind": job.kind}
        _log.info("job started", extra={**log_fields, "n_starts": job.n_starts})
        started_s = time.perf_counter()
        ending = self._ending(job, self._cancellations[job_id])
        seconds = time.perf_counter() - started_s
        log_fields["seconds"] = round(seconds, 2)
        if ending is None:
            self._catalog.give_back_job(job_id)
            _log.info("job stopped", extra=log_fields)
            return
        self._write(lambda: self._catalog.update_job(job_id, eta_s=None, **ending))
        state = ending["state"].value
        if "error" in ending:
            log_fields |= {"code": ending["error"]["code"], "why": ending["error"]["message"]}
        else:
            log_fields |= {name: ending["result"][name] for name in ("map_version", "active")}
        _log.info("job ended", extra={**log_fields, "state": state})
        self._on_ended(job.kind, state, seconds)

    def _ending(self, job: JobRecord, cancellation: threading.Event) -> dict[str, Any] | None:
        """Do a job; answers the fields of its row, or None where it ends because the service stops."""

        def record(state: ProgressState) -> None:
            try:
                self._catalog.update_job(job.job_id, stage=state.stage, progress=state.progress, eta_s=state.eta_s)
            except DeepSimbadError as error:  # no reason to give hours of work up
                _log.warning("progress not recorded", extra={"job_id": job.job_id, "why": error.message})

        try:
            result = self._run_job(job, record, lambda: cancellation.is_set() or self._closing.is_set())
            return self._succeeded(job, result)
        except DeepSimbadError as error:
            is_cancelled, has_died = isinstance(error, CancelledError), isinstance(error, JobInterruptedError)
            log_fields = {"job_id": job.job_id, "why": error.message}
            if has_died:
                _log.error("a job's process died", extra=log_fields)
            elif not is_cancelled:
                _log.warning("a job failed", extra={**log_fields, "code": error.code})
            for line in self._write(self._catalog.discard_abandoned_maps):  # what a killed process was building
                _log.info("discarded", extra={"what": line})
            if is_cancelled and not cancellation.is_set():
                return None
            map_record = self._catalog.map_of_job(job.domain, job.job_id) if is_cancelled or has_died else None
            if map_record is None or map_record.activated_at is None:
                state = JobState.CANCELLED if is_cancelled else JobState.FAILED
                return {"state": state, "error": {"code": error.code, "message": error.message, **error.hints}}
            # It was behind its last step.
            return self._succeeded(
                job, {"map_version": map_record.version, "active": True, "metrics": map_record.metrics}
            )
        except Exception:
            _log.exception("a job broke", extra={"job_id": job.job_id})
            error_document = {"code": "internal_error", "message": "the job broke; the service's log tells where"}
            return {"state": JobState.FAILED, "error": error_document}

    def _succeeded(self, job: JobRecord, result: dict[str, Any]) -> dict[str, Any]:
        if result["active"]:
            self._on_activated(job.domain)
        return {"state": JobState.SUCCEEDED, "result": result, "progress": 1.0}

    def _write(self, write: Callable[[], _T]) -> _T:
        """Write to the catalog, again and again until a full disk has room, so that a job's end is noted in the end.

        Raises:
            UnavailableError: The service stops meanwhile: the next one finds the job as it stands.
            DamagedFileError: Waiting would not help.
        """
        while True:
            try:
                return write()
            except DamagedFileError:
                raise
            except UnavailableError as error:
                _log.warning("the catalog cannot be written", extra={"why": error.message})
                if self._closing.wait(_RETRY_WRITE_S):
                    raise


@dataclass(frozen=True)
class InThisProcess:
    """Does jobs in the caller's thread, as `RunJob`: in a job's own process, and for tests."""

    data_dir: Path  # the catalog and the sessions in it are opened anew
    n_threads: int = 1  # that it computes in
    compute: Compute = field(default_factory=Compute)  # how networks are computed, where an evaluator is fitted

    def __call__(
        self, job: JobRecord, on_progress: Callable[[ProgressState], None], is_cancelled: Callable[[], bool]
    ) -> dict[str, Any]:
        """Do a job."""
        if job.kind not in {REMAP, EXPERIENCE}:
            raise InvalidInputError(f"this release does no job of the kind {job.kind!a}", known=(REMAP, EXPERIENCE))
        try:
            if job.kind == EXPERIENCE:
                return self._learn(job, Progress(LEARN_STAGES, on_progress, is_cancelled))
            config = RemapConfig.from_dict(job.config)
            with open_catalog(self.data_dir) as catalog:
                Progress({}, None, is_cancelled).check()
                evaluator = make_evaluator(evaluator_config(catalog.domain(job.domain).evaluator), self.compute)
                try:
                    stages = stages_in(self.data_dir, job.domain, config, fitting_of(evaluator, config.relevance))
                except DeepSimbadError:  # the stage that needs the traverse will say so
                    stages = REMAP_STAGES
                progress = Progress(stages, on_progress, is_cancelled)
                return remap(catalog, job.domain, config, evaluator, progress, self.n_threads, job.job_id)
        except MemoryError as error:
            raise OutOfMemoryError("too little memory is left for the job") from error

    def _learn(self, job: JobRecord, progress: Progress) -> dict[str, Any]:
        with open_catalog(self.data_dir) as catalog:
            progress.check()
            record = catalog.map_of_job(job.domain, job.job_id)
            if record is not None:  # what it learnt is in there; a second time would count double
                return serve_learnt(catalog, job.domain, record, progress)
            with SessionStore.open(self.data_dir) as sessions:
                walks = walks_of(sessions, catalog, job.domain, job.config["session_id"])
            return learn_online(catalog, job.domain, walks, progress, job.job_id)


class BrokenJobError(Exception):
    """A job broke by a fault of its own; the notes hold the child's stack, for the log alone."""


@dataclass(frozen=True)
class InAnotherProcess:
    """Does every job in a child process that gives way to this one and dies with it, as `RunJob`.

    Call it from a thread that lives as long as the child may: Linux ties the child to the thread that started it.
    """

    data_dir: Path
    n_threads: int  # the child computes in
    priority: JobPriority = JobPriority.IDLE
    stops_within_s: float = 3.0  # a child that takes longer after a cancel is killed, which harms nothing either
    compute: Compute = field(default_factory=Compute)  # how it computes networks

    def __call__(
        self, job: JobRecord, on_progress: Callable[[ProgressState], None], is_cancelled: Callable[[], bool]
    ) -> dict[str, Any]:
        """Do a job."""
        child = self._start(job)
        _log.info("a job's process started", extra={"job_id": job.job_id, "pid": child.pid})
        with child:
            try:
                for message in self._messages(child, is_cancelled):
                    match message:
                        case {"progress": progress}:
                            on_progress(ProgressState(**progress))
                        case {"log": record}:
                            _log_here(record, job.job_id)
                        case {"error": {"code": code, "message": text, "hints": hints}}:
                            raise DeepSimbadError.by_code.get(code, DeepSimbadError)(text, **hints)
                        case {"broken": stack}:
                            broken = BrokenJobError("in the job's process:")
                            broken.add_note(stack)
                            raise broken
                        case {"result": result}:
                            return dict(result)
                        case line:  # what a library printed, or the half of a line that its death cut off
                            _log.warning("the job's process said", extra={"job_id": job.job_id, "line": line})
                raise _death(child.wait(), is_cancelled())
            finally:
                _end(child)

    def _start(self, job: JobRecord) -> "subprocess.Popen[bytes]":
        order = {
            "job": dataclasses.asdict(job),
            "data_dir": str(self.data_dir.resolve()),
            "n_threads": self.n_threads,
            "compute": {**dataclasses.asdict(self.compute), "weights_dir": str(self.compute.weights_dir.resolve())},
            "parent_pid": os.getpid(),
            "log_level": logging.getLogger("deepsimbad").getEffectiveLevel(),
        }
        try:
            child = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                [sys.executable, "-P", "-m", "deepsimbad.jobs.child", self.priority],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env={**os.environ, **dict.fromkeys(_THREAD_VARIABLES, str(self.n_threads))},
                process_group=0,  # Ctrl-C is for the service alone; as a session of its own it would be its equal
            )
        except OSError as error:
            raise UnavailableError(
                f"no process could be started for the job: {error.strerror}", reason="no_process"
            ) from error
        _send(child, json.dumps(order).encode())
        return child

    def _messages(self, child: "subprocess.Popen[bytes]", is_cancelled: Callable[[], bool]) -> Iterator[Any]:
        """A child's messages, and other lines as text, until it says no more; a cancel is handed on, and enforced."""
        lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()

        def read() -> None:
            for line in child.stdout or ():
                lines.put(line)
            lines.put(None)

        threading.Thread(target=read, name="a job's words", daemon=True).start()
        kill_at: float | None = None
        line: bytes | None = b""
        while line is not None:
            try:
                line = lines.get(timeout=_POLL_S)
            except queue.Empty:
                line = b""
            if line and line.strip():
                text = line.decode("utf-8", "replace").rstrip()
                try:
                    message = json.loads(text)
                except ValueError:
                    message = None
                yield message if isinstance(message, dict) else text
            if kill_at is None and is_cancelled():
                _send(child, b"cancel")
                kill_at = time.monotonic() + self.stops_within_s
            elif kill_at is not None and time.monotonic() > kill_at:
                child.kill()


def _send(child: "subprocess.Popen[bytes]", line: bytes) -> None:
    try:
        if child.stdin is not None:
            child.stdin.write(line + b"\n")
            child.stdin.flush()
    except BrokenPipeError:  # it has died; what it said last tells more
        return


def _end(child: "subprocess.Popen[bytes]") -> None:
    """Leave nothing of a child, whatever happened."""
    if child.stdin is not None:
        with suppress(BrokenPipeError):  # what it died too early to hear
            child.stdin.close()
    try:
        child.wait(_EXIT_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def _death(code: int, is_cancelled: bool) -> DeepSimbadError:
    """The error for a child that ended without a result or an error."""
    if is_cancelled:
        return CancelledError("cancelled; it was killed, because it did not stop by itself")
    if code >= 0:
        return JobInterruptedError(f"the job's process ended with code {code}: start it again", exit_code=code)
    try:
        name = signal.Signals(-code).name
    except ValueError:  # a real-time signal
        name = f"signal {-code}"
    explanation = ", as the system does where memory runs out" if -code == signal.SIGKILL else ""
    return JobInterruptedError(f"the job's process was ended by {name}{explanation}: start it again", signal=name)


def _log_here(record: dict[str, Any], job_id: str) -> None:
    """Write a record of the child to this process's log."""
    levelname = logging.getLevelName(record["levelno"])
    fields = {"name": record["name"], "levelno": record["levelno"], "levelname": levelname}
    text = {"msg": "%s", "args": (record["msg"],)}
    logging.getLogger(record["name"]).handle(
        logging.makeLogRecord({**record["extra"], **fields, **text, "job_id": job_id})
    )
