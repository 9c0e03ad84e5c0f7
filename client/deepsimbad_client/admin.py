"""The administrator's calls of the blocking client."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from deepsimbad_client import admin_calls
from deepsimbad_client.answers import job_of_event
from deepsimbad_client.models import Domain, FramesStored, FrameStored, Job, MapVersion, Traverse
from deepsimbad_client.observation import Image, Numbers, observation
from deepsimbad_client.transport import Transport

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


class Admin:
    """Makes, fills, remaps and switches domains."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def put_domain(
        self,
        name: str,
        evaluator: Mapping[str, Any],
        *,
        closed: bool = False,
        actions_m: Sequence[float] | None = None,
    ) -> Domain:
        """Make a domain; the same again changes nothing.

        Args:
            name: Letters, digits, '.', '_' and '-', at most 64.
            evaluator: `{"kind": ..., ...}`, how observations are compared with landmarks.
            closed: Whether the route's end is its start.
            actions_m: The forward moves a robot may be told to make; absent: the service's default.

        Raises:
            DomainDiffersError: A domain of that name exists with another configuration.
        """
        return self._transport.send(admin_calls.put_domain(name, evaluator, closed, actions_m))

    def delete_domain(self, name: str) -> None:
        """Remove a domain with all its maps and traverses."""
        self._transport.send(admin_calls.delete_domain(name))

    def create_traverse(self, domain: str, name: str) -> Traverse:
        """Make an empty traverse."""
        return self._transport.send(admin_calls.create_traverse(domain, name))

    def traverses(self, domain: str) -> tuple[Traverse, ...]:
        """Every traverse of a domain."""
        return self._transport.send(admin_calls.traverses(domain))

    def traverse(self, domain: str, name: str) -> Traverse:
        """One traverse: how many frames have arrived and which are missing."""
        return self._transport.send(admin_calls.traverse(domain, name))

    def delete_traverse(self, domain: str, name: str) -> None:
        """Remove a traverse and its frames."""
        self._transport.send(admin_calls.delete_traverse(domain, name))

    def put_frame(
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
        """Send one frame, an image or a ready encoding; the same index again replaces it.

        Args:
            domain: The domain.
            traverse: One of its traverses.
            index: The frame's place in the recording, from 0.
            image: An encoded image or its path.
            position_m: Distance along the route.
            timestamp_us: When it was taken.
            x_m: Where it was taken.
            y_m: Where it was taken.
            content_type: The image's media type; absent: read from its first bytes.
            encoding: A ready encoding instead of an image.
        """
        seen = observation(image, content_type=content_type, encoding=encoding)
        return self._transport.send(
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

    def put_frames(
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
        return self._transport.send(
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

    def remap(self, domain: str, **config: Any) -> Job:
        """Submit a remap and return its job at once; `deepsimbad_client.remap.remap` also follows it.

        Args:
            domain: The domain to map anew.
            **config: `training_traverse` and, where they should differ from the service's defaults,
                `landmark_traverse`, `n_landmarks`, `list_length`, `relevance`, `training_episodes`, `seed`, `activate`.
        """
        return self._transport.send(admin_calls.remap(domain, config))

    def feed_experience(self, domain: str, session_id: str, true_positions_m: Numbers) -> Job:
        """Teach the next map: where a session's robot truly was at each of its observations, known only afterwards.

        Args:
            domain: The session's domain.
            session_id: The session; it may have ended a while ago.
            true_positions_m: A position along the map's route for each observation, in order; None where unknown.

        Returns:
            The job that makes the next map version.
        """
        return self._transport.send(admin_calls.feed_experience(domain, session_id, true_positions_m))

    def jobs(self, domain: str | None = None) -> tuple[Job, ...]:
        """Jobs, newest first, of one domain or all."""
        return self._transport.send(admin_calls.jobs(domain))

    def job(self, job_id: str) -> Job:
        """One job."""
        return self._transport.send(admin_calls.job(job_id))

    def job_events(self, job_id: str) -> Iterator[Job]:
        """Yield the job each time it has moved, the last time ended; one connection, not renewed when it breaks.

        Raises:
            TransportError: The connection failed or broke off.
        """
        with self._transport.stream(admin_calls.job_events(job_id)) as events:
            for event in events:
                job = job_of_event(event.data)
                if job is not None:
                    yield job
                if event.event == "done":
                    return

    def cancel_job(self, job_id: str) -> None:
        """Ask a job to stop; it ends as cancelled soon after."""
        self._transport.send(admin_calls.cancel_job(job_id))

    def maps(self, domain: str) -> tuple[MapVersion, ...]:
        """A domain's history of maps."""
        return self._transport.send(admin_calls.maps(domain))

    def activate(self, domain: str, version: int, *, expected: int | None = None) -> MapVersion:
        """Serve another version (or roll back to an older one).

        Args:
            domain: The domain.
            version: The version to serve.
            expected: The version believed active now; absent: whichever is.

        Raises:
            LostActivationError: Another version than the expected one was active.
        """
        return self._transport.send(admin_calls.activate(domain, version, expected))
