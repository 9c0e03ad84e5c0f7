"""The catalog's statements by which jobs are taken up and given back. Each stands inside a transaction of its caller.

A job belongs to the process that queued it, told by its `owner`. Where that process died, the next service takes the
job over.
"""

from sqlite_utils import Database

from deepsimbad.store import job_table
from deepsimbad.store.documents import now
from deepsimbad.store.records import JobRecord


def start(db: Database, job_id: str) -> JobRecord:
    """Let a queued job run; any other stays as it is. Raises UnknownJobError."""
    db.execute(
        """
        UPDATE job SET state = 'running', n_starts = n_starts + 1, started_at = coalesce(started_at, ?)
        WHERE job_id = ? AND state = 'queued'
        """,
        [now(), job_id],
    )
    return job_table.get(db, job_id)


def cancel_queued(db: Database, job_id: str) -> JobRecord:
    """Cancel a job that has not begun; any other stays as it is. Raises UnknownJobError."""
    db.execute(
        "UPDATE job SET state = 'cancelled', eta_s = NULL, finished_at = ? WHERE job_id = ? AND state = 'queued'",
        [now(), job_id],
    )
    return job_table.get(db, job_id)


def give_back(db: Database, job_id: str) -> JobRecord:
    """Let a running job wait again because its service stops; that start counts for nothing. Raises UnknownJobError."""
    db.execute(
        """
        UPDATE job SET state = 'queued', n_starts = n_starts - 1, stage = NULL, progress = 0, eta_s = NULL
        WHERE job_id = ? AND state = 'running'
        """,
        [job_id],
    )
    return job_table.get(db, job_id)


def take_over(db: Database, job_id: str, owner: str) -> None:
    """Let an unfinished job of a dead process wait for this one."""
    db.execute(
        """
        UPDATE job SET state = 'queued', owner = ?, stage = NULL, progress = 0, eta_s = NULL
        WHERE job_id = ? AND state IN ('queued', 'running')
        """,
        [owner, job_id],
    )


def waiting(db: Database, owner: str) -> list[str]:
    """The queued jobs of a process, by id, oldest first."""
    rows = db.execute("SELECT job_id FROM job WHERE state = 'queued' AND owner = ? ORDER BY rowid", [owner])
    return [job_id for (job_id,) in rows]
