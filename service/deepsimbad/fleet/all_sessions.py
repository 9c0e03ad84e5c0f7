"""The sessions of the whole fleet, as a list that the replicas are asked for."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from ray.exceptions import RayError
from ray.serve.exceptions import RayServeException
from ray.serve.handle import DeploymentHandle

from deepsimbad.errors import UnavailableError
from deepsimbad.fleet.placement import session_owners
from deepsimbad.store.records import ListPage
from deepsimbad.store.sessions import ListedSession, SessionRecord
from deepsimbad.store.shared_sessions import SharedSessionStore

_TIMEOUT_S = 5.0


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
        try:
            listed = [entry for answer in asked for entry in answer.result(timeout_s=_TIMEOUT_S)]
        except (TimeoutError, RayError, RayServeException) as error:
            raise UnavailableError("a replica is away, so its sessions cannot be listed: try again") from error
        living = {
            entry.session.number: entry
            for entry in listed
            if entry.session.ending is None and entry.session.expires_at > at
        }
        last = newest[limit - 1][0] if len(newest) > limit else None
        return ListPage(tuple(living[number] for number in sorted(living, reverse=True)), last)
