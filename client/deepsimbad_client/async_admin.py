"""The administrator's calls of the async client."""

from collections.abc import AsyncIterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from deepsimbad_client import admin_calls
from deepsimbad_client.answers import job_of_event
from deepsimbad_client.models import Domain, FramesStored, FrameStored, Job, MapVersion, Traverse
from deepsimbad_client.observation import Image, Numbers, observation
from deepsimbad_client.transport import AsyncTransport

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


class AsyncAdmin:
    """The awaiting twin of `deepsimbad_client.admin.Admin`, which describes every call."""

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport

    async def put_domain(
        self,
        name: str,
        evaluator: Mapping[str, Any],
        *,
        closed: bool = False,
        actions_m: Sequence[float] | None = None,
    ) -> Domain:
        """Make a domain; the same again changes nothing."""
        return await self._transport.send(admin_calls.put_domain(name, evaluator, closed, actions_m))

    async def delete_domain(self, name: str) -> None:
        """Remove a domain with all its maps and traverses."""
        await self._transport.send(admin_calls.delete_domain(name))

    async def create_traverse(self, domain: str, name: str) -> Traverse:
        """Make an empty traverse."""
        return await self._transport.send(admin_calls.create_traverse(domain, name))

    async def traverses(self, domain: str) -> tuple[Traverse, ...]:
        """Every traverse of a domain."""
        return await self._transport.send(admin_calls.traverses(domain))

    async def traverse(self, domain: str, name: str) -> Traverse:
        """One traverse: how many frames have arrived and which are missing."""
        return await self._transport.send(admin_calls.traverse(domain, name))

    async def delete_traverse(self, domain: str, name: str) -> None:
        """Remove a traverse and its frames."""
        await self._transport.send(admin_calls.delete_traverse(domain, name))

    async def put_frame(
        self,
        domain: str,
        traverse: str,
        index: int,
        image: Image | None = None,
        *,
        position_m: float,
        timestamp_us: int | None = None,
        x_m: float | None = None,
        y_m: float | None = None,
        content_type: str | None = None,
        encoding: Numbers | None = None,
    ) -> FrameStored:
        """Send one frame, an image or a ready encoding; the same index again replaces it."""
        seen = observation(image, content_type=content_type, encoding=encoding)
        return await self._transport.send(
            admin_calls.put_frame(
                domain,
                traverse,
                index,
                seen,
                position_m=position_m,
                timestamp_us=timestamp_us,
                x_m=x_m,
                y_m=y_m,
            )
        )

    async def put_frames(
        self,
        domain: str,
        traverse: str,
        *,
        encodings: "ArrayLike",
        index: "ArrayLike",
        position_m: "ArrayLike",
        timestamp_us: "ArrayLike | None" = None,
        x_m: "ArrayLike | None" = None,
        y_m: "ArrayLike | None" = None,
    ) -> FramesStored:
        """Send a batch of frames whose encodings [n, d] are known (needs numpy)."""
        return await self._transport.send(
            admin_calls.put_frames(
                domain,
                traverse,
                encodings=encodings,
                index=index,
                position_m=position_m,
                timestamp_us=timestamp_us,
                x_m=x_m,
                y_m=y_m,
            )
        )

    async def remap(self, domain: str, **config: Any) -> Job:
        """Submit a remap and return its job at once."""
        return await self._transport.send(admin_calls.remap(domain, config))

    async def feed_experience(self, domain: str, session_id: str, true_positions_m: Numbers) -> Job:
        """Teach the next map where a session's robot truly was at each of its observations."""
        return await self._transport.send(admin_calls.feed_experience(domain, session_id, true_positions_m))

    async def jobs(self, domain: str | None = None) -> tuple[Job, ...]:
        """Jobs, newest first, of one domain or all."""
        return await self._transport.send(admin_calls.jobs(domain))

    async def job(self, job_id: str) -> Job:
        """One job."""
        return await self._transport.send(admin_calls.job(job_id))

    async def job_events(self, job_id: str) -> AsyncIterator[Job]:
        """Yield the job each time it has moved, the last time ended; one connection, not renewed when it breaks."""
        async with self._transport.stream(admin_calls.job_events(job_id)) as events:
            async for event in events:
                job = job_of_event(event.data)
                if job is not None:
                    yield job
                if event.event == "done":
                    return

    async def cancel_job(self, job_id: str) -> None:
        """Ask a job to stop; it ends as cancelled soon after."""
        await self._transport.send(admin_calls.cancel_job(job_id))

    async def maps(self, domain: str) -> tuple[MapVersion, ...]:
        """A domain's history of maps."""
        return await self._transport.send(admin_calls.maps(domain))

    async def activate(self, domain: str, version: int, *, expected: int | None = None) -> MapVersion:
        """Serve another version (or roll back to an older one)."""
        return await self._transport.send(admin_calls.activate(domain, version, expected))
