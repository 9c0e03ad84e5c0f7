"""Follow a job to its end, through lost connections and restarted services."""

import time
from collections.abc import Callable

from deepsimbad_client.client import Client
from deepsimbad_client.errors import ApiError, JobCancelledError, JobFailedError, TransportError
from deepsimbad_client.models import Job
from deepsimbad_client.retry import RETRIED_STATUSES

PATIENCE_S = 600.0
POLL_S = 1.0
LONGEST_POLL_S = 15.0


def follow_job(
    client: Client,
    job_id: str,
    on_progress: Callable[[Job], None] | None = None,
    *,
    on_silence: Callable[[float], None] | None = None,
    patience_s: float = PATIENCE_S,
    sleep: Callable[[float], None] = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> Job:
    """Follow a job until it has succeeded.

    Listens to its event stream; where that breaks off, asks for the job now and then until the service answers again
    and listens anew; where there is no stream at all, goes on asking. A service that was restarted takes the job up
    again: it is queued once more, and its progress may be less than it was.

    Args:
        client: The client.
        job_id: The job.
        on_progress: Told of the job each time something is heard of it.
        on_silence: Told the seconds since then each time the service has not answered.
        patience_s: Longest silence of the service that is waited out.
        sleep: Waits.
        clock: Seconds that never go backwards.

    Returns:
        The job, succeeded.

    Raises:
        JobFailedError: It failed.
        JobCancelledError: It was cancelled.
        TransportError: Nothing was heard for `patience_s`; the job itself may go on.
        ApiError: The service does not know the job, or refuses to tell.
    """
    heard = clock()
    streams = True
    wait_s = POLL_S
    while True:
        if streams:
            try:
                for job in client.admin.job_events(job_id):
                    heard = clock()
                    wait_s = POLL_S
                    _tell(on_progress, job)
                    if job.ended:
                        return _outcome(job)
            except TransportError:
                pass
            except ApiError as error:
                streams = _passes(error)
        try:
            job = client.admin.job(job_id)
        except (TransportError, ApiError) as error:
            if not _passes(error) or clock() - heard > patience_s:
                raise
            if on_silence is not None:
                on_silence(clock() - heard)
            wait_s = min(2 * wait_s, LONGEST_POLL_S)
        else:
            heard = clock()
            wait_s = POLL_S
            _tell(on_progress, job)
            if job.ended:
                return _outcome(job)
        sleep(wait_s)


def _passes(error: TransportError | ApiError) -> bool:
    """Whether the service may answer again later."""
    return isinstance(error, TransportError) or error.status >= 500 or error.status in RETRIED_STATUSES


def _tell(on_progress: Callable[[Job], None] | None, job: Job) -> None:
    if on_progress is not None:
        on_progress(job)


def _outcome(job: Job) -> Job:
    if job.state == "cancelled":
        raise JobCancelledError(f"job {job.job_id} was cancelled", job)
    if job.state != "succeeded":
        reason = job.error_text or "the service gave no reason"
        raise JobFailedError(f"job {job.job_id} failed: {reason}", job)
    return job
