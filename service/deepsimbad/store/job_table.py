"""The catalog's statements on jobs. Every function stands inside a transaction of its caller."""

import math
import re
import secrets
from collections.abc import Mapping
from typing import Any

from sqlite_utils import Database

from deepsimbad.errors import InvalidInputError, UnknownJobError
from deepsimbad.store.documents import from_json, now, row_reader, to_json
from deepsimbad.store.list_page import ListPage
from deepsimbad.store.records import JobRecord, JobState

_SELECT = """
    SELECT job_id, domain, kind, config, state, stage, progress, eta_s, result, error,
           created_at, started_at, finished_at, n_starts, rowid
    FROM job
"""
_MAX_ROWID = 2**63 - 1
_JOB_ID = re.compile(r"[0-9a-f]{32}")
_DOCUMENTS = ("result", "error")
_FIELDS = ("state", "stage", "progress", "eta_s", *_DOCUMENTS)


@row_reader
def _record(row: tuple[Any, ...]) -> JobRecord:
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
        None if result is None else from_json(result),
        None if error is None else from_json(error),
        *rest,
    )


def insert(
    db: Database, domain: str, kind: str, config: dict[str, Any], owner: str, job_id: str | None = None
) -> JobRecord:
    """Insert a queued job under an id that no job has; None: a new one."""
    job_id = job_id or secrets.token_hex(16)
    db.execute(
        """
        INSERT INTO job (job_id, domain, kind, config, state, owner, created_at)
        VALUES (?, ?, ?, ?, 'queued', ?, ?)
        """,
        [job_id, domain, kind, to_json(config), owner, now()],
    )
    return get(db, job_id)


def get(db: Database, job_id: str) -> JobRecord:
    """One job; raises UnknownJobError."""
    row = None
    if _JOB_ID.fullmatch(job_id) is not None:
        row = db.execute(f"{_SELECT} WHERE job_id = ?", [job_id]).fetchone()
    if row is None:
        raise UnknownJobError(f"there is no job {job_id!a}")
    return _record(row)


def list_jobs(db: Database, domain: str | None) -> list[JobRecord]:
    """Every job, or every job of a domain, oldest first."""
    if domain is None:
        return [_record(row) for row in db.execute(f"{_SELECT} ORDER BY rowid")]
    return [_record(row) for row in db.execute(f"{_SELECT} WHERE domain = ? ORDER BY rowid", [domain])]


def newest(db: Database, domain: str | None, before: int | None, limit: int) -> ListPage[JobRecord, int]:
    """Jobs of a domain or all, newest first, from the one after the key `before` on."""
    found = db.execute(
        f"{_SELECT} WHERE domain = coalesce(?, domain) AND rowid < ? ORDER BY rowid DESC LIMIT ?",
        [domain, _MAX_ROWID if before is None else before, limit + 1],
    )
    return ListPage.of(((row[-1], _record(row)) for row in found), limit)


def update(db: Database, job_id: str, fields: Mapping[str, Any]) -> JobRecord:
    """Change some of state, stage, progress, eta_s, result, error; a job that has ended stays as it is.

    Raises:
        UnknownJobError: There is no such job.
        InvalidInputError: A field is not one of these, or its value cannot be.
    """
    unknown = set(fields) - set(_FIELDS)
    if unknown:
        raise InvalidInputError(f"a job has no changeable field {', '.join(sorted(unknown))}", known=_FIELDS)
    present = get(db, job_id)
    if present.state.is_final or not fields:
        return present
    values = dict(fields)
    for name in _DOCUMENTS:
        if values.get(name) is not None:
            values[name] = to_json(values[name])
    if "progress" in values and not 0 <= float(values["progress"]) <= 1:
        raise InvalidInputError(f"progress runs from 0 to 1; {values['progress']} does not")
    if values.get("eta_s") is not None and not math.isfinite(values["eta_s"]):
        values["eta_s"] = None  # not known is what an infinite guess means
    if "state" in values:
        try:
            state = JobState(values["state"])
        except ValueError as error:
            raise InvalidInputError(f"a job is never {values['state']!a}", known=list(JobState)) from error
        values["state"] = state.value
        if state is not JobState.QUEUED and present.started_at is None:
            values["started_at"] = now()
        if state.is_final:
            values["finished_at"] = now()
    db.table("job").update(job_id, values)
    return get(db, job_id)


def unfinished(db: Database, domain: str | None = None) -> list[tuple[str, str]]:
    """Every queued or running job: id, owner."""
    return list(
        db.execute(
            "SELECT job_id, owner FROM job WHERE state IN ('queued', 'running') AND domain = coalesce(?, domain)",
            [domain],
        )
    )
