"""The administrator's calls of the async client."""

from collections.abc import AsyncIterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from deepsimbad_client import admin_calls
from deepsimbad_client.async_map_admin import AsyncMapAdmin
from deepsimbad_client.models import Domain, FramesStored, FrameStored, Traverse
from deepsimbad_client.observation import Image, Numbers, observation
from deepsimbad_client.paging import each_async

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


class AsyncAdmin(AsyncMapAdmin):
    """The awaiting twin of `deepsimbad_client.admin.Admin`, which describes every call."""

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
        """Make an empty traverse; one of that name that is there stays as it is."""
        return await self._transport.send(admin_calls.create_traverse(domain, name))

    async def traverses(self, domain: str) -> tuple[Traverse, ...]:
        """Every traverse of a domain, by name."""
        return tuple([traverse async for traverse in self.iter_traverses(domain)])

    def iter_traverses(self, domain: str) -> AsyncIterator[Traverse]:
        """Yield every traverse of a domain, by name, a page at a time."""
        return each_async(self._transport, partial(admin_calls.traverses, domain))

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
