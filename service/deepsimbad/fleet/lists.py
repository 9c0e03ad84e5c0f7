"""What is listed of the whole fleet: sessions, by asking the replicas, and jobs, by asking those who administer."""

from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from ray.exceptions import RayError
from ray.serve.exceptions import RayServeException
from ray.serve.handle import DeploymentHandle, DeploymentResponse

from deepsimbad.errors import UnavailableError
from deepsimbad.fleet.backend import AWAY_S, BRIEFLY_S
from deepsimbad.fleet.placement import session_owners
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import JobRecord, ListPage
from deepsimbad.store.sessions import ListedSession, SessionRecord
from deepsimbad.store.shared_sessions import SharedSessionStore


class AllSessions(SharedSessionStore):
    """The sessions as one that administers sees them: it looks after none, and lists them all."""

    replicas: Sequence[DeploymentHandle[Any]] = ()

    def living(self) -> list[SessionRecord]:
        """None, though copies of some be here."""
        return []

    def newest_living(
        self, domain: str | None, before: int | None, limit: int, at: float
    ) -> ListPage[ListedSession, int]:
        """Those that live, each as the replica has it that looks after it."""
        marks = [mark for mark in self.marks() if domain in {None, mark.domain}]
        newest = sorted((mark.number, mark.session_id) for mark in marks if before is None or mark.number < before)[
            ::-1
        ]
        by_owner = defaultdict[int, list[str]](list)
        for _, session_id in newest[:limit]:
            by_owner[session_owners(session_id, len(self.replicas))[0]].append(session_id)
        asked = [self.replicas[owner].listed.remote(session_ids) for owner, session_ids in by_owner.items()]
        listed = _answers(asked, "a replica is away, so its sessions cannot be listed: try again")
        living = {
            entry.session.number: entry
            for entry in listed
            if entry.session.ending is None and entry.session.expires_at > at
        }
        last = newest[limit - 1][0] if len(newest) > limit else None
        return ListPage(tuple(living[number] for number in sorted(living, reverse=True)), last)


class AllJobs:
    """The jobs as one of several that administer sees them: its own, and those that the `others` are asked for."""

    def __init__(self) -> None:
        self.others: Sequence[DeploymentHandle[Any]] = ()

    def newest(self, catalog: Catalog, domain: str | None, before: int | None, limit: int) -> ListPage[JobRecord, int]:
        """As `Catalog.newest_jobs`, of all of them; those of one domain are its administrator's, which is asked."""
        if domain is not None:
            return catalog.newest_jobs(domain, before, limit)
        asked = [other.jobs.remote(before, limit + 1) for other in self.others]
        numbered = catalog.numbered_jobs(None, before, limit + 1)
        numbered += _answers(
            asked,
            "one of those that administer is away, so its jobs cannot be listed: try again, or ask for those of one "
            "domain",
        )
        return ListPage.of(sorted(numbered, key=lambda entry: entry[0], reverse=True), limit)


def _answers(asked: Sequence[DeploymentResponse[Any]], away: str) -> list[Any]:
    """All that those who were asked have, whose lists follow one another; raises UnavailableError, saying `away`."""
    try:
        return [entry for answer in asked for entry in answer.result(timeout_s=BRIEFLY_S)]
    except (TimeoutError, RayError, RayServeException) as error:
        for answer in asked:  # nobody waits for them any more
            with suppress(RayError, RayServeException):  # which is what it would have answered
                answer.cancel()
        raise UnavailableError(away, retry_after_s=AWAY_S) from error
