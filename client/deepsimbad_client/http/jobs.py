"""Map a domain anew, and follow a job to its end, through lost connections and restarted services."""

import time
from collections.abc import Callable
from typing import Unpack

from deepsimbad_client.errors import ApiError, JobCancelledError, JobFailedError, TransportError
from deepsimbad_client.http.admin import RemapOptions
from deepsimbad_client.http.client import Client
from deepsimbad_client.http.models import Job
from deepsimbad_client.http.retry import RETRIED_STATUSES

PATIENCE_S = 600.0
POLL_S = 1.0
LONGEST_POLL_S = 15.0


def remap(
    client: Client,
    domain: str,
    training_traverse: str,
    *,
    on_progress: Callable[[Job], None] | None = None,
    patience_s: float = PATIENCE_S,
    **options: Unpack[RemapOptions],
) -> Job:
    """Make a new map of a domain of `training_traverse` and what `RemapOptions` names, and follow its job to its end.

    The `result` of the job holds `map_version`, `active` and `metrics`. Where the new map lost against the active
    one by more than the gate's margin, `active` is false and `check["why"]` says so. `on_progress` and `patience_s`
    are as in `follow_job`. Raises JobFailedError, ApiError, TransportError.
    """
    job = client.admin.remap(domain, training_traverse=training_traverse, **options)
    if on_progress is not None:
        on_progress(job)
    return follow_job(client, job.job_id, on_progress, patience_s=patience_s)


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

    `on_progress` is told of the job each time something is heard of it, `on_silence` the seconds since then each
    time the service has not answered; longer than `patience_s` it is not waited for. Raises JobFailedError,
    JobCancelledError, TransportError, ApiError.
    """
    last_heard, wait_s, streams = clock(), POLL_S, True
    while True:
        try:
            for job in client.admin.job_events(job_id) if streams else ():
                last_heard, wait_s = clock(), POLL_S
                if on_progress is not None:
                    on_progress(job)
                if job.ended:
                    return _succeeded(job)
        except TransportError:
            pass
        except ApiError as error:
            streams = _passes(error)
        try:
            job = client.admin.job(job_id)
        except (TransportError, ApiError) as error:
            if not _passes(error) or clock() - last_heard > patience_s:
                raise
            if on_silence is not None:
                on_silence(clock() - last_heard)
            wait_s = min(2 * wait_s, LONGEST_POLL_S)
        else:
            last_heard, wait_s = clock(), POLL_S
            if on_progress is not None:
                on_progress(job)
            if job.ended:
                return _succeeded(job)
        sleep(wait_s)


def _passes(error: TransportError | ApiError) -> bool:
    """Whether the service may answer again later."""
    return isinstance(error, TransportError) or error.status >= 500 or error.status in RETRIED_STATUSES


def _succeeded(job: Job) -> Job:
    if job.state == "cancelled":
        raise JobCancelledError(f"job {job.job_id} was cancelled", job)
    if job.state != "succeeded":
        raise JobFailedError(f"job {job.job_id} failed: {job.error_text or 'the service gave no reason'}", job)
    return job
