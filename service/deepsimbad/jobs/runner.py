"""One thread that has jobs done one after the other and keeps their rows true."""

import logging
import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from deepsimbad.errors import (
    CancelledError,
    DamagedFileError,
    DeepSimbadError,
    IdempotencyKeyReusedError,
    JobInterruptedError,
    TooManyJobsError,
    UnavailableError,
    UnknownJobError,
)
from deepsimbad.jobs.map_config import RemapConfig
from deepsimbad.jobs.perform import REMAP, RunJob, error_document
from deepsimbad.jobs.progress import ProgressState
from deepsimbad.jobs.session_walks import EXPERIENCE, ExperienceConfig
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.checkpoints import remove_checkpoints
from deepsimbad.store.records import JobRecord, JobState

_log = logging.getLogger(__name__)
_MAX_WAITING = 100
_RETRY_AFTER_S = 30  # a place is free when a job has ended, which takes longer than a query
_WRITTEN_AGAIN_S = 1.0

_Written = TypeVar("_Written")


class JobRunner:
    """Runs remaps, and what sessions taught, in the order they came; first those that an earlier service left.

    Args:
        catalog: Where jobs are recorded; `Catalog.discard_unfinished` has been called.
        run_job: Does a job; called in one thread that lives until `close`.
        on_activated: Called with the domain's name after a job activated a map.
        max_waiting: Jobs that may wait their turn.
    """

    def __init__(
        self,
        catalog: Catalog,
        run_job: RunJob,
        on_activated: Callable[[str], None],
        max_waiting: int = _MAX_WAITING,
    ) -> None:
        self._catalog = catalog
        self._run_job = run_job
        self._on_activated = on_activated
        self._max_waiting = max_waiting
        self._submitting = threading.Lock()
        self._waiting: queue.Queue[str | None] = queue.Queue()
        self._cancelled: dict[str, threading.Event] = {}
        self._closing = threading.Event()
        for job_id in catalog.waiting_jobs():
            self._queue(job_id)
        self._thread = threading.Thread(target=self._run, name="jobs", daemon=True)
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether the thread is there to take up jobs."""
        return self._thread.is_alive()

    def submit(self, domain: str, config: RemapConfig | ExperienceConfig, job_id: str | None = None) -> JobRecord:
        """Queue a remap, or the learning of what a session taught.

        Args:
            domain: Whose next map it makes.
            config: What is asked for.
            job_id: Its id, where a repetition of the request would have the same: the job that was made by the first
                one is returned then, as it stands. None: a new one.

        Raises:
            UnknownDomainError: No such domain.
            IdempotencyKeyReusedError: The job of that id was asked for something else.
            TooManyJobsError: As many jobs wait as may.
            UnavailableError: The service is shutting down.
        """
        with self._submitting:
            made = self.made_before(job_id, config)
            if made is not None:
                return made
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
            self._queue(job.job_id)
            return job

    def made_before(self, job_id: str | None, config: RemapConfig | ExperienceConfig) -> JobRecord | None:
        """The job of that id, which an earlier request made; None: there is none.

        Raises:
            IdempotencyKeyReusedError: It was asked for something else.
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

        Raises:
            UnknownJobError: No such job.
        """
        job = self._catalog.cancel_queued_job(job_id)
        event = self._cancelled.get(job_id)
        if event is not None:
            event.set()
        return job

    def gives_back(self, job_id: str) -> bool:
        """Whether a job that stops now is left to the next service; False: it was cancelled, or nothing stops it."""
        cancelled = self._cancelled.get(job_id)
        return self._closing.is_set() and not (cancelled is not None and cancelled.is_set())

    def close(self) -> None:
        """Stop what runs and wait for its clean end; it and what is queued are left to the next service."""
        self._closing.set()
        self._waiting.put(None)
        self._thread.join()

    def _queue(self, job_id: str) -> None:
        self._cancelled[job_id] = threading.Event()
        self._waiting.put(job_id)

    def _run(self) -> None:
        while (job_id := self._waiting.get()) is not None and not self._closing.is_set():
            try:
                self._run_one(job_id)
            except DeepSimbadError:
                _log.exception("the state of a job could not be recorded", extra={"job_id": job_id})
            finally:
                self._cancelled.pop(job_id, None)

    def _run_one(self, job_id: str) -> None:
        try:
            job = self._written(lambda: self._catalog.start_job(job_id))
        except UnknownJobError:  # cancelled while it waited, and then its domain was deleted
            return
        if job.state is not JobState.RUNNING:  # cancelled while it waited
            self._forget_checkpoints(job_id)
            return
        cancelled = self._cancelled[job_id]
        ending: dict[str, Any]
        try:
            result = self._run_job(
                job,
                lambda state: self._record(job_id, state),
                lambda: cancelled.is_set() or self._closing.is_set(),
            )
            ending = self._succeeded(job, result)
        except CancelledError as error:
            self._written(self._clear_away)
            if not cancelled.is_set():  # the service stops: nobody gave the job up
                self._catalog.give_back_job(job_id)
                return
            ending = self._done_all_the_same(job) or {"state": JobState.CANCELLED, "error": error_document(error)}
        except JobInterruptedError as error:
            _log.error("a job's process died", extra={"job_id": job_id, "why": error.message})
            self._written(self._clear_away)
            ending = self._done_all_the_same(job) or {"state": JobState.FAILED, "error": error_document(error)}
        except DeepSimbadError as error:
            _log.warning("a job failed", extra={"job_id": job_id, "code": error.code, "why": error.message})
            self._written(self._clear_away)
            ending = {"state": JobState.FAILED, "error": error_document(error)}
        except Exception:
            _log.exception("a job broke", extra={"job_id": job_id})
            broken = {"code": "internal_error", "message": "the job broke; the service's log tells where"}
            ending = {"state": JobState.FAILED, "error": broken}
        self._written(lambda: self._catalog.update_job(job_id, eta_s=None, **ending))
        self._forget_checkpoints(job_id)

    def _succeeded(self, job: JobRecord, result: dict[str, Any]) -> dict[str, Any]:
        if result["active"]:
            self._on_activated(job.domain)
        return {"state": JobState.SUCCEEDED, "result": result, "progress": 1.0}

    def _done_all_the_same(self, job: JobRecord) -> dict[str, Any] | None:
        """The ending of a job that was stopped, or died, behind its last step; None where it was before that."""
        made = self._catalog.map_of_job(job.domain, job.job_id)
        if made is None or made.activated_at is None:
            return None
        return self._succeeded(job, {"map_version": made.version, "active": True, "metrics": made.metrics})

    def _written(self, write: Callable[[], _Written]) -> _Written:
        """Write to the catalog, and again until a full disk has room; no job waits for ever for its end to be noted.

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
                if self._closing.wait(_WRITTEN_AGAIN_S):
                    raise

    def _clear_away(self) -> None:
        """Discard the map that a killed process was building."""
        for line in self._catalog.discard_abandoned_maps():
            _log.info("discarded", extra={"what": line})

    def _forget_checkpoints(self, job_id: str) -> None:
        try:
            remove_checkpoints(self._catalog.data_dir, job_id)
        except DeepSimbadError as error:  # the next start sweeps them away
            _log.warning("checkpoints not removed", extra={"job_id": job_id, "why": error.message})

    def _record(self, job_id: str, state: ProgressState) -> None:
        try:
            self._catalog.update_job(job_id, stage=state.stage, progress=state.progress, eta_s=state.eta_s)
        except DeepSimbadError as error:  # no reason to give hours of work up
            _log.warning("progress not recorded", extra={"job_id": job_id, "why": error.message})
