"""Small pictures of a domain's frames, for people; whatever map a frame is in, it is known by its encoding.

They are an aside: a domain works without the file, and whoever wants its room back may remove it while nothing runs.
"""

from pathlib import Path
from typing import Self

from deepsimbad.errors import UnknownThumbnailError
from deepsimbad.store import layout
from deepsimbad.store.connection import OpenFile, open_working_file
from deepsimbad.store.durable import storage_faults
from deepsimbad_migrations.thumbnail.migrations import migrations


class Thumbnails(OpenFile):
    """One domain's; usable from any thread and several processes."""

    @classmethod
    def open(cls, data_dir: Path, domain: str, *, create: bool = False) -> Self | None:
        """Open a domain's file; None: there is none, and none is to be made."""
        path = layout.thumbnails_path(data_dir, domain)
        if not create and not path.is_file():
            return None
        with storage_faults(path):
            return cls(path, open_working_file(path, migrations, create=create, is_checked=False))

    def put(self, frame_digest: int, body: bytes) -> None:
        """Keep a JPEG of a frame."""
        with self._writing() as db:
            db.execute("INSERT OR REPLACE INTO thumbnail VALUES (?, ?)", [_signed(frame_digest), body])

    def get(self, frame_digest: int) -> bytes:
        """The JPEG of a frame; raises UnknownThumbnailError."""
        with self._reading() as db:
            row = db.execute("SELECT body FROM thumbnail WHERE frame_digest = ?", [_signed(frame_digest)]).fetchone()
        if row is None:
            raise UnknownThumbnailError("no picture was kept of this frame")
        return bytes(row[0])

    @property
    def n_bytes(self) -> int:
        """Of all pictures."""
        with self._reading() as db:
            (n_bytes,) = db.execute("SELECT coalesce(sum(length(body)), 0) FROM thumbnail").fetchone()
            return int(n_bytes)


def _signed(digest: int) -> int:
    """SQLite's integers have a sign."""
    return digest - (1 << 64) if digest >= 1 << 63 else digest
