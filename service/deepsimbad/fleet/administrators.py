"""Who administers which domain, of several processes that do, and which of them a request is for.

A domain is its administrator's from its making on: that one has its drives and does its jobs. Who makes a domain is
told by its name, who made it stands in what the store says of it, so that another number of administrators moves none.
"""

import asyncio
import re
from collections.abc import Sequence
from urllib.parse import parse_qs, unquote

from deepsimbad.engine.session import domain_digits
from deepsimbad.errors import UnavailableError
from deepsimbad.fleet.backend import AWAY_S, Backend, Gone
from deepsimbad.fleet.placement import owners

_OF_DOMAIN = re.compile(r"/v1/(?:admin/)?domains/([^/]+)(?:/.*)?")
_OF_JOB = re.compile(r"/v1/admin/jobs/([^/]+)(?:/.*)?")
_JOBS = "/v1/admin/jobs"


class Administrators:
    """The processes that administer, by their numbers, and which of them is asked."""

    def __init__(self, backends: Sequence[Backend]) -> None:
        self.backends = backends

    async def of(self, path: str, query: bytes) -> Sequence[Backend]:
        """Who may answer a request, by its decoded path and its query, the better one first.

        What is of no domain any of them answers, and the first unless it is away.

        Raises:
            UnavailableError: There is no such administrator, or nobody to say who it is.
        """
        if (of_domain := _OF_DOMAIN.fullmatch(path)) is not None:
            return [await self._of_domain(unquote(of_domain[1]))]
        if path == _JOBS and (named := parse_qs(query.decode("latin-1")).get("domain")):
            return [await self._of_domain(named[-1])]
        if (of_job := _OF_JOB.fullmatch(path)) is not None and len(self.backends) > 1:
            return [await self._of_job(of_job[1])]
        return self.backends

    async def _of_domain(self, domain: str) -> Backend:
        number = await self._told(domain)  # each time: it may have been deleted, and made anew by another
        if number is None:  # whoever is asked to make it
            return self.backends[owners(domain_digits(domain), len(self.backends))[0]]
        if number >= len(self.backends):
            raise UnavailableError(
                f"domain {domain} is administered by number {number}, counted from 0, and the fleet has "
                f"{len(self.backends)}: start it with --administrators {number + 1} or more",
                reason="no_administrator",
            )
        return self.backends[number]

    async def _told(self, domain: str) -> int | None:
        """Who made a domain; None: there is none. All of them know."""
        for backend in self.backends:
            try:
                number: int | None = await backend.ask_briefly("administrator_of", domain)
            except Gone:
                continue
            return number
        raise UnavailableError("those that administer are away this moment: try again", retry_after_s=AWAY_S)

    async def _of_job(self, job_id: str) -> Backend:
        """Who has a job; the first where nobody has, to say so."""
        asked = (backend.ask_briefly("has_job", job_id) for backend in self.backends)
        answers = await asyncio.gather(*asked, return_exceptions=True)
        if True in answers:
            return self.backends[answers.index(True)]
        for answer in answers:
            if isinstance(answer, Gone):
                what = "one of those that administer is away, and no other has such a job: try again"
                raise UnavailableError(what, retry_after_s=AWAY_S)
            if isinstance(answer, BaseException):
                raise answer
        return self.backends[0]
