"""Which of several processes is asked: the owners of many domains, and an administrator.

The administrator that makes a domain keeps it: it has the domain's drives and does its jobs. Which one makes a domain
follows from its name; the one that made it is recorded in the map store, so that another number of administrators
moves no domain.
"""

import asyncio
import re
from collections import defaultdict
from collections.abc import Sequence
from typing import Any
from urllib.parse import parse_qs, unquote

from deepsimbad.engine.atlas import Part
from deepsimbad.engine.localizer import View
from deepsimbad.engine.maps import MappedDomain
from deepsimbad.engine.session import domain_digits
from deepsimbad.errors import DeepSimbadError, UnavailableError
from deepsimbad.fleet.backend import AWAY_S, Backend, Gone
from deepsimbad.fleet.placement import N_OWNERS, owners

_OF_DOMAIN = re.compile(r"/v1/(?:admin/)?domains/([^/]+)(?:/.*)?")
_OF_JOB = re.compile(r"/v1/admin/jobs/([^/]+)(?:/.*)?")
_JOBS = "/v1/admin/jobs"


class AskedOwners:
    """`engine.atlas.Owners` over replicas in the order of their numbers; the second owner answers for one that is away.

    Each domain is asked of one replica, and the answers are put together.
    """

    def __init__(self, replicas: Sequence[Backend]) -> None:
        self._replicas = replicas

    async def gather(self, names: Sequence[str], is_all: bool) -> tuple[list[MappedDomain], dict[str, DeepSimbadError]]:
        mapped_domains, left_out = list[MappedDomain](), dict[str, DeepSimbadError]()
        for asked_names, answer in await self._answers({name: name for name in names}, "gather_heads", is_all):
            if isinstance(answer, UnavailableError):
                left_out |= dict.fromkeys(asked_names, answer)
            elif isinstance(answer, DeepSimbadError):
                raise answer
            else:
                mapped_domains += answer[0]
                left_out |= answer[1]
        return sorted(mapped_domains, key=lambda domain: domain.record.name), left_out

    async def ask(
        self, domains: Sequence[MappedDomain], view: View, n_in_full: int, n_shortlist: int | None
    ) -> list[Part]:
        members = {domain.record.name: domain for domain in domains}
        return [
            Part({}, {}, dict.fromkeys(asked_names, answer)) if isinstance(answer, DeepSimbadError) else answer
            for asked_names, answer in await self._answers(members, "part", view, n_in_full, n_shortlist)
        ]

    async def _answers(self, by_name: dict[str, Any], method: str, *arguments: Any) -> list[tuple[Sequence[str], Any]]:
        """The answers of a method, which may be errors of ours, each with the names of the domains it is about."""
        answers, missing = list[tuple[Sequence[str], Any]](), list(by_name)
        for place in range(min(N_OWNERS, len(self._replicas))):
            by_owner = defaultdict[int, list[str]](list)
            for name in missing:
                by_owner[owners(domain_digits(name), len(self._replicas))[place]].append(name)
            missing = []
            calls = (
                self._replicas[owner].ask("answer", method, [by_name[name] for name in names], *arguments)
                for owner, names in by_owner.items()
            )
            replies = await asyncio.gather(*calls, return_exceptions=True)
            for names, answer in zip(by_owner.values(), replies, strict=True):
                if isinstance(answer, Gone):
                    missing += names
                elif isinstance(answer, BaseException) and not isinstance(answer, DeepSimbadError):
                    raise answer
                else:
                    answers.append((names, answer))
        if missing:
            error = UnavailableError("those that know the domain are away this moment: try again", retry_after_s=AWAY_S)
            answers.append((missing, error))
        return answers


class Administrators:
    """The administrators in the order of their numbers, and which of them is asked."""

    def __init__(self, backends: Sequence[Backend]) -> None:
        self.backends = backends

    async def of(self, path: str, query: bytes) -> Sequence[Backend]:
        """The administrators that may answer a request, by its decoded path and its query, the preferred one first.

        A request about no domain may be answered by any of them.

        Raises:
            UnavailableError: The domain's administrator is not in the fleet, or none can tell which one it is.
        """
        if (of_domain := _OF_DOMAIN.fullmatch(path)) is not None:
            return [await self._of_domain(unquote(of_domain[1]))]
        if path == _JOBS and (domain_names := parse_qs(query.decode("latin-1")).get("domain")):
            return [await self._of_domain(domain_names[-1])]
        if (of_job := _OF_JOB.fullmatch(path)) is not None and len(self.backends) > 1:
            return [await self._of_job(of_job[1])]
        return self.backends

    async def _of_domain(self, domain: str) -> Backend:
        number = await self._administrator_of(domain)  # each time: it may have been deleted, and made anew by another
        if number is None:  # the one that is to make it
            return self.backends[owners(domain_digits(domain), len(self.backends))[0]]
        if number >= len(self.backends):
            raise UnavailableError(
                f"domain {domain} is administered by number {number}, counted from 0, and the fleet has "
                f"{len(self.backends)}: start it with --administrators {number + 1} or more",
                reason="no_administrator",
            )
        return self.backends[number]

    async def _administrator_of(self, domain: str) -> int | None:
        """Number of the administrator that made a domain, as any of them knows; None: there is no such domain."""
        for backend in self.backends:
            try:
                number: int | None = await backend.ask_briefly("administrator_of", domain)
            except Gone:
                continue
            return number
        raise UnavailableError("those that administer are away this moment: try again", retry_after_s=AWAY_S)

    async def _of_job(self, job_id: str) -> Backend:
        """The administrator that has a job; the first where none has it, to answer so."""
        calls = (backend.ask_briefly("has_job", job_id) for backend in self.backends)
        answers = await asyncio.gather(*calls, return_exceptions=True)
        if True in answers:
            return self.backends[answers.index(True)]
        for answer in answers:
            if isinstance(answer, Gone):
                message = "one of those that administer is away, and no other has such a job: try again"
                raise UnavailableError(message, retry_after_s=AWAY_S)
            if isinstance(answer, BaseException):
                raise answer
        return self.backends[0]
