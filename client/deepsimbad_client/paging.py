"""Every entry of a list that comes page by page."""

from collections.abc import AsyncIterator, Callable, Iterator
from typing import TypeVar

from deepsimbad_client.call import Call
from deepsimbad_client.page import Page
from deepsimbad_client.transport import AsyncTransport, Transport

Entry = TypeVar("Entry")


def each(transport: Transport, asking: Callable[[str | None], Call[Page[Entry]]]) -> Iterator[Entry]:
    """Yield every entry; a page is fetched when its first entry is wanted.

    Args:
        transport: Sends the calls.
        asking: Makes the call for the page behind a cursor; None: the first page.
    """
    page = transport.send(asking(None))
    yield from page.entries
    while page.next is not None:
        page = transport.send(asking(page.next))
        yield from page.entries


async def each_async(
    transport: AsyncTransport, asking: Callable[[str | None], Call[Page[Entry]]]
) -> AsyncIterator[Entry]:
    """See `each`."""
    page = await transport.send(asking(None))
    for entry in page.entries:
        yield entry
    while page.next is not None:
        page = await transport.send(asking(page.next))
        for entry in page.entries:
            yield entry
