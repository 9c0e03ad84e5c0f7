"""The jobs of the whole fleet, as a list that those who administer are asked for."""

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from ray.exceptions import RayError
from ray.serve.exceptions import RayServeException
from ray.serve.handle import DeploymentHandle

from deepsimbad.errors import UnavailableError
from deepsimbad.fleet.backend import AWAY_S
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import JobRecord, ListPage

_TIMEOUT_S = 5.0


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
        try:
            numbered += [entry for answer in asked for entry in answer.result(timeout_s=_TIMEOUT_S)]
        except (TimeoutError, RayError, RayServeException) as error:
            for answer in asked:  # nobody waits for them any more
                with suppress(RayError, RayServeException):  # which is what it would have answered
                    answer.cancel()
            raise UnavailableError(
                "one of those that administer is away, so its jobs cannot be listed: try again, or ask for those of "
                "one domain",
                retry_after_s=AWAY_S,
            ) from error
        return ListPage.of(sorted(numbered, key=lambda entry: entry[0], reverse=True), limit)
