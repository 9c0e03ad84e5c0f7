"""The administrator's calls of the async client about maps, jobs and sessions."""

import asyncio
from collections.abc import AsyncIterator, Callable
from functools import partial
from pathlib import Path
from typing import Any

from deepsimbad_client import map_calls, session_calls
from deepsimbad_client.answers import job_of_event
from deepsimbad_client.map_download import MapDownload, MapFile
from deepsimbad_client.map_history import served_before
from deepsimbad_client.models import Job, ListedSession, MapVersion
from deepsimbad_client.observation import Numbers
from deepsimbad_client.paging import each_async
from deepsimbad_client.transport import AsyncTransport


class AsyncMapAdmin:
    """The awaiting twin of `deepsimbad_client.map_admin.MapAdmin`, which describes every call."""

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport

    async def remap(self, domain: str, *, idempotency_key: str | None = None, **config: Any) -> Job:
        """Submit a remap and return its job at once."""
        return await self._transport.send(map_calls.remap(domain, config, idempotency_key))

    async def feed_experience(
        self, domain: str, session_id: str, true_positions_m: Numbers, *, idempotency_key: str | None = None
    ) -> Job:
        """Teach the next map where a session's robot truly was at each of its observations."""
        return await self._transport.send(
            map_calls.feed_experience(domain, session_id, true_positions_m, idempotency_key)
        )

    async def jobs(self, domain: str | None = None) -> tuple[Job, ...]:
        """Jobs, newest first, of one domain or all."""
        return tuple([job async for job in self.iter_jobs(domain)])

    def iter_jobs(self, domain: str | None = None) -> AsyncIterator[Job]:
        """Yield jobs, newest first, of one domain or all, a page at a time."""
        return each_async(self._transport, partial(map_calls.jobs, domain))

    async def job(self, job_id: str) -> Job:
        """One job."""
        return await self._transport.send(map_calls.job(job_id))

    async def job_events(self, job_id: str) -> AsyncIterator[Job]:
        """Yield the job each time it has moved, the last time ended; one connection, not renewed when it breaks."""
        async with self._transport.stream(map_calls.job_events(job_id)) as events:
            async for event in events:
                job = job_of_event(event.data)
                if job is not None:
                    yield job
                if event.event == "done":
                    return

    async def cancel_job(self, job_id: str) -> None:
        """Ask a job to stop; it ends as cancelled soon after."""
        await self._transport.send(map_calls.cancel_job(job_id))

    async def maps(self, domain: str) -> tuple[MapVersion, ...]:
        """A domain's history of maps, newest version first."""
        return tuple([version async for version in self.iter_maps(domain)])

    def iter_maps(self, domain: str) -> AsyncIterator[MapVersion]:
        """Yield a domain's history of maps, newest version first, a page at a time."""
        return each_async(self._transport, partial(map_calls.maps, domain))

    async def activate(self, domain: str, version: int, *, expected: int | None = None) -> MapVersion:
        """Serve another version (or roll back to an older one)."""
        return await self._transport.send(map_calls.activate(domain, version, expected))

    async def rollback(self, domain: str) -> MapVersion:
        """Serve the version again that served before the active one; once more, and the present one is back."""
        active, before = served_before(domain, await self.maps(domain))
        return await self.activate(domain, before, expected=active)

    async def delete_map(self, domain: str, version: int) -> None:
        """Remove the file of a version; its place in the history stays."""
        await self._transport.send(map_calls.delete_map(domain, version))

    async def download_map(
        self,
        domain: str,
        version: int,
        path: str | Path,
        *,
        on_progress: Callable[[int, int | None], None] | None = None,
    ) -> MapFile:
        """Fetch the sealed file of a version, to keep or to import it elsewhere."""
        download = MapDownload(map_calls.map_file(domain, version), Path(path), on_progress)
        await self._transport.fetch(download)
        return await asyncio.to_thread(download.finish)

    async def sessions(self, domain: str | None = None) -> tuple[ListedSession, ...]:
        """Living sessions, newest first, of one domain or all."""
        return tuple([session async for session in self.iter_sessions(domain)])

    def iter_sessions(self, domain: str | None = None) -> AsyncIterator[ListedSession]:
        """Yield living sessions, newest first, of one domain or all, a page at a time."""
        return each_async(self._transport, partial(session_calls.living, domain))

    async def delete_session(self, session_id: str) -> None:
        """End a session, whoever began it."""
        await self._transport.send(session_calls.delete(session_id))
