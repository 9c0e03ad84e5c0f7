"""What operators learn of jobs as they begin and end: a log line each, and how long they took."""

import logging
import time
from collections.abc import Callable
from typing import Any

from deepsimbad.api.metrics import Metrics
from deepsimbad.errors import CancelledError, DeepSimbadError
from deepsimbad.jobs.perform import RunJob
from deepsimbad.jobs.progress import ProgressState
from deepsimbad.store.records import JobRecord, JobState

log = logging.getLogger(__name__)


def watched(run_job: RunJob, metrics: Metrics, gives_back: Callable[[str], bool]) -> RunJob:
    """The same, watched.

    Args:
        run_job: Does a job.
        metrics: Told how long it took.
        gives_back: Whether the job of this id, which was stopped, goes on at the next start.
    """

    def run(
        job: JobRecord, on_progress: Callable[[ProgressState], None], is_cancelled: Callable[[], bool]
    ) -> dict[str, Any]:
        about = {"job_id": job.job_id, "domain": job.domain, "kind": job.kind}
        log.info("job started", extra={**about, "n_starts": job.n_starts})
        began = time.perf_counter()
        state, told = JobState.FAILED, {}
        try:
            result = run_job(job, on_progress, is_cancelled)
            state = JobState.SUCCEEDED
            told = {"map_version": result["map_version"], "active": result["active"]}
        except CancelledError:
            state = JobState.QUEUED if gives_back(job.job_id) else JobState.CANCELLED
            raise
        except DeepSimbadError as error:
            told = {"code": error.code, "why": error.message}
            raise
        finally:
            seconds = time.perf_counter() - began
            if state is JobState.QUEUED:  # the service stops; the next one goes on with it
                log.info("job stopped", extra={**about, "seconds": round(seconds, 2)})
            else:
                metrics.job_ended(job.kind, state.value, seconds)
                log.info("job ended", extra={**about, "state": state.value, "seconds": round(seconds, 2), **told})
        return result

    return run
