"""What the catalog says of jobs, which all belong to the one service of the data directory."""

import math
import re
import secrets
import time
from collections.abc import Collection
from typing import Any

from sqlite_utils import Database

from deepsimbad.errors import JobInterruptedError, UnknownJobError
from deepsimbad.store.connection import OpenFile
from deepsimbad.store.records import JobRecord, JobState, ListPage, current_moment, from_json, get_domain, to_json

MAX_STARTS = 3  # of a job whose service died each time: it may be what kills it
_SELECT = """
    SELECT job_id, domain, kind, config, state, stage, progress, eta_s, result, error,
           created_at, started_at, finished_at, n_starts, rowid
    FROM job
"""
_MAX_ROWID = 2**63 - 1
_JOB_ID = re.compile(r"[0-9a-f]{32}")
_WAITING_AGAIN = {"state": JobState.QUEUED, "stage": None, "progress": 0, "eta_s": None}


class JobCatalog(OpenFile):
    """The jobs of all domains."""

    def create_job(self, domain: str, kind: str, config: dict[str, Any], job_id: str | None = None) -> JobRecord:
        """Note a queued job, under an id that no job has or a new one; raises UnknownDomainError."""
        job_id = job_id or secrets.token_hex(16)
        with self._writing() as db:
            get_domain(db, domain)
            db.execute(
                "INSERT INTO job (rowid, job_id, domain, kind, config, state, created_at) VALUES (?, ?, ?, ?, ?, ?, ?)",
                [_next_number(db, job_id), job_id, domain, kind, to_json(config), JobState.QUEUED, current_moment()],
            )
            return _get_job(db, job_id)

    def update_job(self, job_id: str, **fields: Any) -> JobRecord:
        """Change state, stage, progress, eta_s, result or error of a job; one that has ended stays as it is.

        The times of start and end follow from the state. Raises UnknownJobError, and InvalidInputError where a field
        cannot hold the value.
        """
        with self._writing() as db:
            return _update(db, job_id, fields)

    def start_job(self, job_id: str) -> JobRecord:
        """Let a queued job run; one that is not queued any more stays as it is. Raises UnknownJobError."""
        with self._writing() as db:
            job = _get_job(db, job_id)
            if job.state is not JobState.QUEUED:
                return job
            return _update(db, job_id, {"state": JobState.RUNNING, "n_starts": job.n_starts + 1})

    def cancel_queued_job(self, job_id: str) -> JobRecord:
        """Cancel a job that has not begun; any other stays as it is. Raises UnknownJobError."""
        with self._writing() as db:
            if _get_job(db, job_id).state is JobState.QUEUED:
                fields = {"state": JobState.CANCELLED, "eta_s": None, "finished_at": current_moment()}
                db.table("job").update(job_id, fields)  # it never started
            return _get_job(db, job_id)

    def give_back_job(self, job_id: str) -> JobRecord:
        """Let a running job wait for the next service, as this one stops; its start is not counted."""
        with self._writing() as db:
            job = _get_job(db, job_id)
            if job.state is JobState.RUNNING:
                db.table("job").update(job_id, {**_WAITING_AGAIN, "n_starts": job.n_starts - 1})
            return _get_job(db, job_id)

    def take_over_jobs(self) -> list[str]:
        """Let the jobs that ran when the last service died wait again; one that died at every start fails.

        Returns one line for each.
        """
        lines = []
        with self._writing() as db:
            rows = db.execute("SELECT job_id FROM job WHERE state = 'running' ORDER BY rowid").fetchall()
            for job in [_get_job(db, job_id) for (job_id,) in rows]:
                if job.n_starts < MAX_STARTS:
                    db.table("job").update(job.job_id, _WAITING_AGAIN)
                    lines.append(f"job {job.job_id} was interrupted and waits again")
                else:
                    reason = f"it was started {job.n_starts} times and the service died each time"
                    error = {"code": JobInterruptedError.code, "message": reason, "n_starts": job.n_starts}
                    _update(db, job.job_id, {"state": JobState.FAILED, "error": error, "eta_s": None})
                    lines.append(f"job {job.job_id} failed: {reason}")
        return lines

    def waiting_jobs(self) -> list[str]:
        """The queued jobs by id, oldest first."""
        with self._reading() as db:
            return [job_id for (job_id,) in db.execute("SELECT job_id FROM job WHERE state = 'queued' ORDER BY rowid")]

    def job(self, job_id: str) -> JobRecord:
        """One job; raises UnknownJobError."""
        with self._reading() as db:
            return _get_job(db, job_id)

    def newest_jobs(self, domain: str | None, last_key: int | None, limit: int) -> ListPage[JobRecord, int]:
        """A page of jobs, newest first, behind `last_key`; raises UnknownDomainError."""
        return ListPage.of(self.numbered_jobs(domain, last_key, limit + 1), limit)

    def numbered_jobs(self, domain: str | None, last_key: int | None, limit: int) -> list[tuple[int, JobRecord]]:
        """(key, job) of at most `limit` jobs, newest first, behind `last_key`; raises UnknownDomainError.

        Keys tell when a job was made, so that the jobs of several catalogs are one list.
        """
        with self._reading() as db:
            if domain is not None:
                get_domain(db, domain)
            rows = db.execute(
                f"{_SELECT} WHERE domain = coalesce(?, domain) AND rowid < ? ORDER BY rowid DESC LIMIT ?",
                [domain, _MAX_ROWID if last_key is None else last_key, limit],
            )
            return [(row[-1], _job(row)) for row in rows]

    def jobs(self, domain: str | None = None, states: Collection[JobState] = tuple(JobState)) -> list[JobRecord]:
        """The jobs in some states, of a domain or all, oldest first; raises UnknownDomainError."""
        with self._reading() as db:
            if domain is not None:
                get_domain(db, domain)
            condition = "domain = coalesce(?, domain) AND state IN (SELECT value FROM json_each(?)) ORDER BY rowid"
            return list(map(_job, db.execute(f"{_SELECT} WHERE {condition}", [domain, to_json(list(states))])))

    def n_jobs(self) -> dict[JobState, int]:
        """How many jobs there are of every state that any has; those of years are counted, not read."""
        with self._reading() as db:
            rows = db.execute("SELECT state, count(*) FROM job GROUP BY state")
            return {JobState(state): n_jobs for state, n_jobs in rows}

    def last_jobs(self, kind: str) -> list[JobRecord]:
        """The job of a kind that ended last in every domain that has one, by domain.

        Jobs run one after the other as they came, whatever the clock was set to. One cancelled while it waited is out
        of that order and did nothing: it counts only where no other of the domain ever ran.
        """
        with self._reading() as db:
            rows = db.execute(
                f"""
                {_SELECT} WHERE rowid IN (
                    SELECT first_value(rowid) OVER (PARTITION BY domain ORDER BY n_starts > 0 DESC, rowid DESC)
                    FROM job WHERE kind = ? AND finished_at IS NOT NULL
                ) ORDER BY domain
                """,  # noqa: S608 - of our own words
                [kind],
            )
            return list(map(_job, rows))


def _next_number(db: Database, job_id: str) -> int:
    """A row number past all others, whatever the clock: the time to ten microseconds, then three digits of the id."""
    (last_number,) = db.execute("SELECT coalesce(max(rowid), 0) FROM job").fetchone()
    return max(int(last_number) + 1, 1000 * int(1e5 * time.time()) + int(job_id[-4:], 16) % 1000)


def _get_job(db: Database, job_id: str) -> JobRecord:
    row = None
    if _JOB_ID.fullmatch(job_id) is not None:
        row = db.execute(f"{_SELECT} WHERE job_id = ?", [job_id]).fetchone()
    if row is None:
        raise UnknownJobError(f"there is no job {job_id!a}")
    return _job(row)


def _update(db: Database, job_id: str, fields: dict[str, Any]) -> JobRecord:
    job = _get_job(db, job_id)
    if job.state.is_final or not fields:
        return job
    values = {name: to_json(value) if isinstance(value, dict) else value for name, value in fields.items()}
    if not math.isfinite(fields.get("eta_s") or 0.0):
        values["eta_s"] = None  # an infinite guess means that it is not known
    state = JobState(values.get("state", job.state))
    if state is not JobState.QUEUED and job.started_at is None:
        values["started_at"] = current_moment()
    if state.is_final:
        values["finished_at"] = current_moment()
    db.table("job").update(job_id, values)
    return _get_job(db, job_id)


def _job(row: tuple[Any, ...]) -> JobRecord:
    job_id, domain, kind, config, state, stage, progress, eta_s, result, error, *rest, _ = row
    return JobRecord(
        job_id,
        domain,
        kind,
        from_json(config),
        JobState(state),
        stage,
        progress,
        eta_s,
        from_json(result),
        from_json(error),
        *rest,
    )
