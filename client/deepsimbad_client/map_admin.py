"""The administrator's calls of the blocking client about maps, jobs and sessions."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from deepsimbad_client import map_calls, session_calls
from deepsimbad_client.answers import job_of_event
from deepsimbad_client.map_download import MapDownload, MapFile
from deepsimbad_client.map_history import served_before
from deepsimbad_client.models import Job, ListedSession, MapVersion
from deepsimbad_client.observation import Numbers
from deepsimbad_client.paging import each
from deepsimbad_client.transport import Transport


class MapAdmin:
    """Remaps domains, follows jobs, switches and fetches maps, looks after sessions.

    Lists come page by page. `jobs` and its like fetch every page at once; `iter_jobs` and its like fetch a page when
    its first entry is wanted.
    """

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def remap(self, domain: str, *, idempotency_key: str | None = None, **config: Any) -> Job:
        """Submit a remap and return its job at once; `deepsimbad_client.remap.remap` also follows it.

        A lost answer is asked for again and makes no second job.

        Args:
            domain: The domain to map anew.
            idempotency_key: Names this request, so that it can be repeated after a `TransportError`; absent: a new one.
            **config: `training_traverse` and, where they should differ from the service's defaults,
                `landmark_traverse`, `n_landmarks`, `list_length`, `relevance`, `training_episodes`, `seed`, `activate`,
                `check_traverse`, `gate_margin`, `append`, `same_route`.

        Raises:
            TooManyJobsError: As many jobs wait as may.
        """
        return self._transport.send(map_calls.remap(domain, config, idempotency_key))

    def feed_experience(
        self, domain: str, session_id: str, true_positions_m: Numbers, *, idempotency_key: str | None = None
    ) -> Job:
        """Teach the next map: where a session's robot truly was at each of its observations, known only afterwards.

        Args:
            domain: The session's domain.
            session_id: The session; it may have ended a while ago.
            true_positions_m: A position along the map's route for each observation, in order; None where unknown.
            idempotency_key: As of `remap`.

        Returns:
            The job that makes the next map version.

        Raises:
            TooManyJobsError: As many jobs wait as may.
        """
        return self._transport.send(map_calls.feed_experience(domain, session_id, true_positions_m, idempotency_key))

    def jobs(self, domain: str | None = None) -> tuple[Job, ...]:
        """Jobs, newest first, of one domain or all."""
        return tuple(self.iter_jobs(domain))

    def iter_jobs(self, domain: str | None = None) -> Iterator[Job]:
        """Yield jobs, newest first, of one domain or all, a page at a time."""
        return each(self._transport, partial(map_calls.jobs, domain))

    def job(self, job_id: str) -> Job:
        """One job."""
        return self._transport.send(map_calls.job(job_id))

    def job_events(self, job_id: str) -> Iterator[Job]:
        """Yield the job each time it has moved, the last time ended; one connection, not renewed when it breaks.

        Raises:
            TransportError: The connection failed or broke off.
        """
        with self._transport.stream(map_calls.job_events(job_id)) as events:
            for event in events:
                job = job_of_event(event.data)
                if job is not None:
                    yield job
                if event.event == "done":
                    return

    def cancel_job(self, job_id: str) -> None:
        """Ask a job to stop; it ends as cancelled soon after."""
        self._transport.send(map_calls.cancel_job(job_id))

    def maps(self, domain: str) -> tuple[MapVersion, ...]:
        """A domain's history of maps, newest version first."""
        return tuple(self.iter_maps(domain))

    def iter_maps(self, domain: str) -> Iterator[MapVersion]:
        """Yield a domain's history of maps, newest version first, a page at a time."""
        return each(self._transport, partial(map_calls.maps, domain))

    def activate(self, domain: str, version: int, *, expected: int | None = None) -> MapVersion:
        """Serve another version (or roll back to an older one).

        Args:
            domain: The domain.
            version: The version to serve.
            expected: The version believed active now; absent: whichever is.

        Raises:
            LostActivationError: Another version than the expected one was active.
            RetiredMapError: The version's file was removed.
        """
        return self._transport.send(map_calls.activate(domain, version, expected))

    def rollback(self, domain: str) -> MapVersion:
        """Serve the version again that served before the active one; once more, and the present one is back.

        Raises:
            NoEarlierMapError: No other version has served, or their files were removed.
            LostActivationError: Another version was activated meanwhile.
        """
        active, before = served_before(domain, self.maps(domain))
        return self.activate(domain, before, expected=active)

    def delete_map(self, domain: str, version: int) -> None:
        """Remove the file of a version; its place in the history stays.

        Raises:
            MapInUseError: It serves, is being built, or a living session keeps it.
        """
        self._transport.send(map_calls.delete_map(domain, version))

    def download_map(
        self,
        domain: str,
        version: int,
        path: str | Path,
        *,
        on_progress: Callable[[int, int | None], None] | None = None,
    ) -> MapFile:
        """Fetch the sealed file of a version, to keep or to import it elsewhere.

        It is written beside `path`, checked against the digest that the service names, and then renamed. A download
        that was interrupted goes on where it stopped, this time or the next.

        Args:
            domain: The domain.
            version: One of its versions.
            path: Where it shall lie; a file of that name is replaced.
            on_progress: Told of the bytes there and the bytes in all (None: not known).

        Raises:
            RetiredMapError: Its file was removed.
            DamagedDownloadError: What came has another digest than the service named.
            NotSavedError: It cannot be written.
        """
        download = MapDownload(map_calls.map_file(domain, version), Path(path), on_progress)
        self._transport.fetch(download)
        return download.finish()

    def sessions(self, domain: str | None = None) -> tuple[ListedSession, ...]:
        """Living sessions, newest first, of one domain or all; `Client.attach_session` looks into one or ends it."""
        return tuple(self.iter_sessions(domain))

    def iter_sessions(self, domain: str | None = None) -> Iterator[ListedSession]:
        """Yield living sessions, newest first, of one domain or all, a page at a time."""
        return each(self._transport, partial(session_calls.living, domain))

    def delete_session(self, session_id: str) -> None:
        """End a session, whoever began it."""
        self._transport.send(session_calls.delete(session_id))
