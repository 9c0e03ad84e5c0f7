"""The administrator's calls of the blocking client."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from deepsimbad_client import admin_calls
from deepsimbad_client.map_admin import MapAdmin
from deepsimbad_client.models import Domain, FramesStored, FrameStored, Traverse
from deepsimbad_client.observation import Image, Numbers, observation
from deepsimbad_client.paging import each

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


class Admin(MapAdmin):
    """Makes and fills domains; and, as `MapAdmin`, remaps and switches them."""

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
        """Make an empty traverse; one of that name that is there stays as it is."""
        return self._transport.send(admin_calls.create_traverse(domain, name))

    def traverses(self, domain: str) -> tuple[Traverse, ...]:
        """Every traverse of a domain, by name."""
        return tuple(self.iter_traverses(domain))

    def iter_traverses(self, domain: str) -> Iterator[Traverse]:
        """Yield every traverse of a domain, by name, a page at a time."""
        return each(self._transport, partial(admin_calls.traverses, domain))

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
