"""One thread that runs jobs one after the other and keeps their rows true."""

import logging
import queue
import threading
from collections.abc import Callable
from typing import Any

from deepsimbad.errors import CancelledError, ConflictError, DeepSimbadError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.jobs.learn_online import LEARN_STAGES, learn_online
from deepsimbad.jobs.map_config import RemapConfig
from deepsimbad.jobs.progress import Progress, ProgressState
from deepsimbad.jobs.remap import REMAP_STAGES, error_document, remap
from deepsimbad.jobs.session_walks import EXPERIENCE, ExperienceConfig, walks_of
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import JobRecord, JobState
from deepsimbad.store.sessions import SessionStore

_log = logging.getLogger(__name__)
_MAX_QUEUED = 100
REMAP = "remap"


class JobRunner:
    """Runs remaps, and what sessions taught, in the order they came.

    Args:
        catalog: Where jobs are recorded.
        evaluator_of: Gives the evaluator of a domain.
        on_activated: Called with the domain's name after a job activated a map.
        sessions: What experience is learnt from; None: from nothing.
    """

    def __init__(
        self,
        catalog: Catalog,
        evaluator_of: Callable[[str], Evaluator],
        on_activated: Callable[[str], None],
        sessions: SessionStore | None = None,
    ) -> None:
        self._catalog = catalog
        self._evaluator_of = evaluator_of
        self._on_activated = on_activated
        self._sessions = sessions
        self._waiting: queue.Queue[str | None] = queue.Queue()
        self._cancelled: dict[str, threading.Event] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="jobs", daemon=True)
        self._thread.start()

    def submit(self, domain: str, config: RemapConfig | ExperienceConfig) -> JobRecord:
        """Queue a remap, or the learning of what a session taught.

        Raises:
            UnknownDomainError: No such domain.
            ConflictError: Too many jobs wait, or the service is shutting down.
        """
        if self._closing.is_set():
            raise ConflictError("the service is shutting down and takes no new job")
        if self._waiting.qsize() >= _MAX_QUEUED:
            raise ConflictError(f"{_MAX_QUEUED} jobs wait already; try again later", limit=_MAX_QUEUED)
        kind = REMAP if isinstance(config, RemapConfig) else EXPERIENCE
        job = self._catalog.create_job(domain, kind, config.as_dict())
        self._cancelled[job.job_id] = threading.Event()
        self._waiting.put(job.job_id)
        return job

    def cancel(self, job_id: str) -> JobRecord:
        """Ask a job to stop; a queued one ends at once, a running one at its next report.

        Raises:
            UnknownJobError: No such job.
        """
        job = self._catalog.job(job_id)
        event = self._cancelled.get(job_id)
        if event is not None:
            event.set()
        if job.state is JobState.QUEUED:
            job = self._catalog.update_job(job_id, state=JobState.CANCELLED, eta_s=None)
        return job

    def close(self) -> None:
        """Cancel what runs and wait for its clean end."""
        self._closing.set()
        self._waiting.put(None)
        self._thread.join()

    def _run(self) -> None:
        while True:
            job_id = self._waiting.get()
            if job_id is None:
                return
            try:
                self._run_one(job_id)
            except DeepSimbadError:
                _log.exception("the state of job %s could not be recorded", job_id)
            finally:
                self._cancelled.pop(job_id, None)

    def _run_one(self, job_id: str) -> None:
        job = self._catalog.job(job_id)
        if job.state is not JobState.QUEUED:  # cancelled, or its domain deleted, while it waited
            return
        cancelled = self._cancelled[job_id]
        self._catalog.update_job(job_id, state=JobState.RUNNING)
        ending: dict[str, Any]
        try:
            progress = Progress(
                LEARN_STAGES if job.kind == EXPERIENCE else REMAP_STAGES,
                lambda state: self._record(job_id, state),
                lambda: cancelled.is_set() or self._closing.is_set(),
            )
            result = self._work(job, progress)
            if result["active"]:
                self._on_activated(job.domain)
            ending = {"state": JobState.SUCCEEDED, "result": result, "progress": 1.0}
        except CancelledError as error:
            ending = {"state": JobState.CANCELLED, "error": error_document(error)}
        except DeepSimbadError as error:
            _log.warning("job %s failed: %s", job_id, error)
            ending = {"state": JobState.FAILED, "error": error_document(error)}
        except Exception:
            _log.exception("job %s broke", job_id)
            broken = {"code": "internal_error", "message": "the job broke; the service's log tells where"}
            ending = {"state": JobState.FAILED, "error": broken}
        self._catalog.update_job(job_id, eta_s=None, **ending)

    def _work(self, job: JobRecord, progress: Progress) -> dict[str, Any]:
        if job.kind == EXPERIENCE and self._sessions is not None:
            walks = walks_of(self._sessions, self._catalog, job.domain, job.config["session_id"])
            return learn_online(self._catalog, job.domain, walks, progress)
        config = RemapConfig.from_dict(job.config)
        return remap(self._catalog, job.domain, config, self._evaluator_of(job.domain), progress)

    def _record(self, job_id: str, state: ProgressState) -> None:
        self._catalog.update_job(job_id, stage=state.stage, progress=state.progress, eta_s=state.eta_s)
