"""Doing one job, in whatever process: everything it needs is opened here and closed again."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from deepsimbad.errors import DeepSimbadError, InvalidInputError
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.learn_online import LEARN_STAGES, learn_online, serve_learnt
from deepsimbad.jobs.map_config import RemapConfig
from deepsimbad.jobs.progress import Progress, ProgressState
from deepsimbad.jobs.remap import REMAP_STAGES, remap
from deepsimbad.jobs.remap_stages import RemapSize, remap_stages
from deepsimbad.jobs.session_walks import EXPERIENCE, walks_of
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.checkpoints import Checkpoints
from deepsimbad.store.records import JobRecord
from deepsimbad.store.sessions import SessionStore

REMAP = "remap"  # the kind of job
_KINDS = (REMAP, EXPERIENCE)


class RunJob(Protocol):
    """How the runner has a job done: in this process or in another."""

    def __call__(
        self, job: JobRecord, on_progress: Callable[[ProgressState], None], is_cancelled: Callable[[], bool]
    ) -> dict[str, Any]:
        """Do a job.

        Args:
            job: Which; its row is the caller's to write.
            on_progress: Called with every new state.
            is_cancelled: Asked again and again.

        Returns:
            The job's result.

        Raises:
            CancelledError: `is_cancelled` answered true.
            JobInterruptedError: The process that did it died.
            DeepSimbadError: What else is wrong, by name.
        """


class InThisProcess:
    """Does jobs in the caller's thread: for commands and tests. Live queries would wait for them.

    Args:
        data_dir: The data directory.
        n_threads: Threads to compute in.
    """

    def __init__(self, data_dir: Path, n_threads: int = 1) -> None:
        self._data_dir = data_dir
        self._n_threads = n_threads

    def __call__(
        self, job: JobRecord, on_progress: Callable[[ProgressState], None], is_cancelled: Callable[[], bool]
    ) -> dict[str, Any]:
        """As `RunJob`."""
        return perform(self._data_dir, job, self._n_threads, on_progress, is_cancelled)


def perform(
    data_dir: Path,
    job: JobRecord,
    n_threads: int,
    on_progress: Callable[[ProgressState], None],
    is_cancelled: Callable[[], bool],
) -> dict[str, Any]:
    """Do a job, or what is left of it; waits where another process still works on it.

    Args:
        data_dir: The data directory; the catalog and the sessions are opened anew.
        job: Which.
        n_threads: Threads to compute in.
        on_progress: Called with every new state.
        is_cancelled: Asked at every report.

    Returns:
        The job's result.

    Raises:
        DeepSimbadError: As `RunJob`.
    """
    if job.kind not in _KINDS:
        raise InvalidInputError(f"this release does no job of the kind {job.kind!a}", known=_KINDS)
    progress = Progress(_stages(data_dir, job), on_progress, is_cancelled)
    with (
        Catalog.open(data_dir) as catalog,
        Checkpoints.open(data_dir, job.job_id, progress.check) as checkpoints,
    ):
        progress.check()
        if job.kind == EXPERIENCE:
            return _learn(data_dir, catalog, job, progress)
        evaluator = make_evaluator(evaluator_config(catalog.domain(job.domain).evaluator))
        config = RemapConfig.from_dict(job.config)
        return remap(catalog, job.domain, config, evaluator, progress, checkpoints, n_threads)


def _stages(data_dir: Path, job: JobRecord) -> dict[str, float]:
    if job.kind == EXPERIENCE:
        return LEARN_STAGES
    config = RemapConfig.from_dict(job.config)
    try:
        size = RemapSize.of(data_dir, job.domain, config)
    except DeepSimbadError:  # the stage that needs the traverse will say so; one that was done needs it no more
        return REMAP_STAGES
    return remap_stages(config, size)


def _learn(data_dir: Path, catalog: Catalog, job: JobRecord, progress: Progress) -> dict[str, Any]:
    sealed = catalog.map_of_job(job.domain, job.job_id)
    if sealed is not None:  # what it learnt is in there; a second time would count double
        return serve_learnt(catalog, job.domain, sealed, progress)
    with SessionStore.open(data_dir) as sessions:
        walks = walks_of(sessions, catalog, job.domain, job.config["session_id"])
    return learn_online(catalog, job.domain, walks, progress, job_id=job.job_id)


def error_document(error: DeepSimbadError) -> dict[str, Any]:
    """How a job's row tells a named error."""
    return {"code": error.code, "message": error.message, **error.hints}
