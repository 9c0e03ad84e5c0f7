"""Bodies on their way through the front, which has them whole before it asks a replica, in the room the service has.

Whoever sends slowly takes memory for what came, and together they take no more than the setting. A batch lies on the
disk until all of it has come, as in the service; then one at a time is in memory.
"""

import asyncio
import tempfile
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

from starlette.requests import Request
from starlette.types import Receive, Scope

from deepsimbad.api.door import FREE_BYTES, most_body_bytes
from deepsimbad.api.keys import KeyRing, presented_key
from deepsimbad.api.requests import Slots
from deepsimbad.errors import UnauthorizedError, UnavailableError
from deepsimbad.settings import Settings
from deepsimbad.store.durable import storage_faults


class Bodies:
    """Those of one front; `keys` tells whose are read at all."""

    def __init__(self, settings: Settings, keys: KeyRing) -> None:
        self._settings = settings
        self._keys = keys
        self._room = Slots(settings.max_body_memory_bytes, "bytes of bodies are held", "max_body_memory_bytes")
        self._uploads = Slots(settings.max_uploads, "batches of frames are on their way", "max_uploads")
        self._batch = asyncio.Lock()  # of the one that is in memory

    @asynccontextmanager
    async def of(self, scope: Scope, receive: Receive) -> AsyncGenerator[bytes]:
        """The body of a request; of one that is refused by its head nothing, of one too long so much that it is seen.

        Raises:
            OverloadedError: There is no room for it.
            UnavailableError: Nor on the disk.
            ClientDisconnect: Its sender has gone before all of it had come.
        """
        headers = dict(scope["headers"])
        most, is_batch = most_body_bytes(scope, headers, self._settings)
        declared = headers.get(b"content-length", b"0")
        n_declared = int(declared[:20]) if declared.isdigit() else 0
        parts = _parts(scope, receive, most)
        if n_declared > most or not self._is_let_in(scope):
            yield b""
        elif is_batch:
            folder = Path(tempfile.gettempdir())
            async with AsyncExitStack() as turn:
                turn.enter_context(self._uploads.taken())
                with storage_faults(folder), tempfile.TemporaryFile(dir=folder) as spool:
                    async for part in parts:
                        await asyncio.to_thread(spool.write, part)
                    await turn.enter_async_context(self._batch)
                    spool.seek(0)
                    body = await asyncio.to_thread(spool.read)
                yield body
        else:
            self._room.check(max(0, n_declared - FREE_BYTES))
            came, n_held = bytearray(), 0
            try:
                async for part in parts:
                    came += part
                    if (n_more := len(came) - FREE_BYTES - n_held) > 0:
                        self._room.take(n_more)
                        n_held += n_more
                body = bytes(came)
                del came
                yield body
            finally:
                self._room.give_back(n_held)

    def _is_let_in(self, scope: Scope) -> bool:
        """Whether a replica would read the body of who comes with this key; it judges all that a key is for."""
        try:
            if self._keys.needed(scope["path"]) is not None:
                self._keys.holder(presented_key(scope))
        except UnauthorizedError:
            return False
        except UnavailableError:  # the replica says so
            return True
        return True


async def _parts(scope: Scope, receive: Receive, most: int) -> AsyncIterator[bytes]:
    """A body as it comes, until it is longer than it may be; raises ClientDisconnect."""
    n_bytes = 0
    async for part in Request(scope, receive).stream():
        n_bytes += len(part)
        yield part
        if n_bytes > most:
            return
