"""Pictures that are kept: those that wait with a traverse to be fitted, and a domain's small ones for people."""

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.errors import DamagedFileError, UnknownThumbnailError
from deepsimbad.store import layout
from deepsimbad.store.connection import OpenFile, open_working_file
from deepsimbad.store.durable import storage_faults
from deepsimbad_migrations.thumbnail.migrations import migrations


class Spool(OpenFile):
    """What waits in a traverse's file to be fitted: pictures as they were sent, and encodings of views of them.

    Pictures are put there with their frames, in one transaction (`Traverse.put_frames`).
    """

    @property
    def spooled_bytes(self) -> int:
        """The bytes of all pictures that wait."""
        with self._reading() as db:
            return spool_size(db)[1]

    def picture(self, index: int) -> bytes | None:
        """A frame's picture as it was sent; None: it does not wait here."""
        with self._reading() as db:
            row = db.execute("SELECT body FROM spool WHERE frame_index = ?", [index]).fetchone()
            return None if row is None else bytes(row[0])

    def views(self, index: int, dim: int) -> NDArray[np.float32] | None:
        """[a, d] encodings of views of a frame; None: none were kept. Raises DamagedFileError."""
        with self._reading() as db:
            row = db.execute("SELECT body FROM view_encoding WHERE frame_index = ?", [index]).fetchone()
        if row is None:
            return None
        if not row[0] or len(row[0]) % (4 * dim):
            raise DamagedFileError(f"the views of frame {index} have another length: delete the traverse, upload anew")
        return np.frombuffer(row[0], "<f4").reshape(-1, dim).astype(np.float32)

    def keep_views(self, views: Mapping[int, NDArray[np.float32]]) -> None:
        """Keep encodings of views, [a, d] by frames' indices, until their frames change."""
        with self._writing() as db:
            db.conn.executemany(
                "INSERT OR REPLACE INTO view_encoding (frame_index, body) "
                "SELECT frame_index, ? FROM frame WHERE frame_index = ?",
                ((np.ascontiguousarray(body, "<f4").tobytes(), index) for index, body in views.items()),
            )

    def empty_spool(self) -> None:
        """Delete all pictures, and give their room on the disk back unless somebody is at the file just now."""
        with self._writing() as db:
            n_deleted = db.execute("DELETE FROM spool").rowcount
        if n_deleted:
            with self._lock, suppress(sqlite3.OperationalError):
                self._db.conn.execute("VACUUM")
                self._db.conn.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def spool_size(db: Database) -> tuple[int, int]:
    """How many pictures wait, and their bytes."""
    n_spooled, n_bytes = db.execute("SELECT count(*), coalesce(sum(length(body)), 0) FROM spool").fetchone()
    return n_spooled, n_bytes


def clear_spool(db: Database, indices: Sequence[int], contents: Sequence[int]) -> None:
    """Before frames are written: delete pictures of those indices, and views but those of equal pictures."""
    db.conn.executemany(
        """
        DELETE FROM view_encoding WHERE frame_index = ?
            AND (SELECT content_digest FROM frame WHERE frame.frame_index = view_encoding.frame_index) IS NOT ?
        """,
        zip(indices, contents, strict=True),
    )
    db.conn.executemany("DELETE FROM spool WHERE frame_index = ?", ([index] for index in indices))


def spool_pictures(db: Database, indices: Sequence[int], pictures: Mapping[int, bytes]) -> None:
    """After frames were written: store their pictures in the spool."""
    db.conn.executemany(
        "INSERT INTO spool (frame_index, body) VALUES (?, ?)",
        ((index, pictures[index]) for index in indices if index in pictures),
    )


class Thumbnails(OpenFile):
    """Small pictures of one domain's frames, by `Drive.digests`; usable from any thread and several processes.

    A domain works without the file, which may be removed while nothing runs to have its room back.
    """

    @classmethod
    def open(cls, data_dir: Path, domain: str, *, create: bool = False) -> Self:
        """Open a domain's file; raises UnknownThumbnailError where there is none, and none is to be made."""
        path = layout.thumbnails_path(data_dir, domain)
        if not create and not path.is_file():
            raise UnknownThumbnailError(
                f"domain {domain} keeps no pictures: PUT it with thumbnails: true, and map anew"
            )
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
        """The bytes of all pictures."""
        with self._reading() as db:
            (n_bytes,) = db.execute("SELECT coalesce(sum(length(body)), 0) FROM thumbnail").fetchone()
            return int(n_bytes)


def _signed(digest: int) -> int:
    """A digest as one of SQLite's integers, which have a sign."""
    return digest - (1 << 64) if digest >= 1 << 63 else digest
