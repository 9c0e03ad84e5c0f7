"""What the catalog says of jobs."""

from typing import Any

from deepsimbad.store import domain_table, job_queue, job_table
from deepsimbad.store.catalog_file import CatalogFile
from deepsimbad.store.list_page import ListPage
from deepsimbad.store.records import JobRecord


class JobCatalog(CatalogFile):
    """The jobs of all domains."""

    def create_job(self, domain: str, kind: str, config: dict[str, Any], job_id: str | None = None) -> JobRecord:
        """Note a queued job of this process, under an id that no job has or a new one; raises UnknownDomainError."""
        with self._writing() as db:
            domain_table.get(db, domain)
            return job_table.insert(db, domain, kind, config, self._owner.token(), job_id)

    def update_job(self, job_id: str, **fields: Any) -> JobRecord:
        """Change state, stage, progress, eta_s, result or error of a job; one that has ended stays as it is.

        The times of start and end follow from the state.

        Returns:
            The job as it now stands.

        Raises:
            UnknownJobError: There is no such job.
            InvalidInputError: A field cannot be changed or cannot hold the value.
        """
        with self._writing() as db:
            return job_table.update(db, job_id, fields)

    def start_job(self, job_id: str) -> JobRecord:
        """Let a queued job run; one that is not queued any more stays as it is. Raises UnknownJobError."""
        with self._writing() as db:
            return job_queue.start(db, job_id)

    def cancel_queued_job(self, job_id: str) -> JobRecord:
        """Cancel a job that has not begun; any other stays as it is. Raises UnknownJobError."""
        with self._writing() as db:
            return job_queue.cancel_queued(db, job_id)

    def give_back_job(self, job_id: str) -> JobRecord:
        """Let a running job wait for the next service, as this one stops. Raises UnknownJobError."""
        with self._writing() as db:
            return job_queue.give_back(db, job_id)

    def waiting_jobs(self) -> list[str]:
        """The queued jobs of this process by id, oldest first; among them those it took over from dead ones."""
        with self._reading() as db:
            return job_queue.waiting(db, self._owner.mark)

    def job(self, job_id: str) -> JobRecord:
        """One job; raises UnknownJobError."""
        with self._reading() as db:
            return job_table.get(db, job_id)

    def jobs(self, domain: str | None = None) -> list[JobRecord]:
        """Every job, or every job of a domain, oldest first; raises UnknownDomainError."""
        with self._reading() as db:
            if domain is not None:
                domain_table.get(db, domain)
            return job_table.list_jobs(db, domain)

    def newest_jobs(self, domain: str | None, before: int | None, limit: int) -> ListPage[JobRecord, int]:
        """A page of jobs, newest first, behind the key `before`; raises UnknownDomainError."""
        with self._reading() as db:
            if domain is not None:
                domain_table.get(db, domain)
            return job_table.newest(db, domain, before, limit)
