"""Pictures for people: small ones of a domain's frames, where it keeps them, and of every session's last view."""

import threading
from collections import OrderedDict
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.map import Map
from deepsimbad.errors import UnknownThumbnailError
from deepsimbad.evaluators.image import thumbnail
from deepsimbad.store.pictures import Thumbnails

_MOST_VIEWS = 32  # of sessions, the latest
_MOST_VIEW_BYTES = 64 << 20  # of all of them
_VIEW_HEIGHT = 240


class Pictures:
    """All pictures of one service; usable from any thread."""

    def __init__(self, data_dir: Path, max_pixels: int) -> None:
        self._data_dir = data_dir
        self._max_pixels = max_pixels
        self._views: OrderedDict[str, bytes] = OrderedDict()  # by session, as they came
        self._lock = threading.Lock()

    def keep(self, domain: str, frames: Iterable[tuple[int, bytes]]) -> None:
        """Keep small pictures of frames, given as digest and file; a file that is no image is passed over."""
        with Thumbnails.open(self._data_dir, domain, create=True) as file:
            for frame_digest, body in frames:
                if (picture := thumbnail(body, self._max_pixels)) is not None:
                    file.put(frame_digest, picture)

    def of_frame(self, snapshot: Map, digests: NDArray[np.uint64] | None, number: int) -> bytes:
        """The JPEG of a map image or a landmark, by the digests of all of them; raises UnknownThumbnailError."""
        if digests is None or number >= digests.size:
            raise UnknownThumbnailError(f"map {snapshot.version} of domain {snapshot.domain} has no picture {number}")
        with Thumbnails.open(self._data_dir, snapshot.domain) as file:
            return file.get(int(digests[number]))

    def n_bytes(self, domain: str) -> int:
        """The bytes of all small pictures of a domain."""
        try:
            with Thumbnails.open(self._data_dir, domain) as file:
                return file.n_bytes
        except UnknownThumbnailError:
            return 0

    def hold_view(self, session_id: str, body: bytes) -> None:
        """Hold the file of a session's last view, in memory alone; for domains that keep pictures."""
        with self._lock:
            self._views.pop(session_id, None)
            self._views[session_id] = body
            while len(self._views) > _MOST_VIEWS or sum(map(len, self._views.values())) > _MOST_VIEW_BYTES:
                self._views.popitem(last=False)

    def view(self, session_id: str) -> bytes | None:
        """A small JPEG of a session's last view; None where it is not held."""
        body = self._views.get(session_id)
        return None if body is None else thumbnail(body, self._max_pixels, _VIEW_HEIGHT)
