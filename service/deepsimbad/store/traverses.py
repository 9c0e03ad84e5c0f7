"""One recorded drive on the disk: its frames' encodings and places; images alone that wait to be fitted."""

import dataclasses
import fcntl
import hashlib
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import repeat
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.core.drive import SHOWS_NOTHING, UNLIKE_ALL, Drive
from deepsimbad.core.frames import IDENTITY, UNKNOWN_CONTENT, UNKNOWN_TIMESTAMP, Camera, differences
from deepsimbad.core.relevance import shows_nothing
from deepsimbad.errors import (
    ConflictError,
    DamagedFileError,
    DeepSimbadError,
    FramesDifferError,
    GreyLevelsDifferError,
    InvalidEncodingError,
    UnknownDomainError,
    UnknownTraverseError,
    WeightsDifferError,
    nearest_of,
)
from deepsimbad.store import layout
from deepsimbad.store.arrays import is_halvable
from deepsimbad.store.connection import (
    FileState,
    file_state,
    look_at,
    open_database,
    open_working_file,
    write_transaction,
)
from deepsimbad.store.durable import lock_folder, remove_database, storage_faults, sync
from deepsimbad.store.pictures import Spool, clear_spool, spool_pictures, spool_size
from deepsimbad.store.records import current_moment, to_json
from deepsimbad_migrations.traverse.migrations import migrations

_ROWS_AT_ONCE = 1024
_NAMED_INDICES = 100  # most that an error names
_DTYPE_OF_BYTES = {2.0: "<f2", 4.0: "<f4"}  # by the bytes of one number


@dataclass(frozen=True)
class TraverseSummary:
    """What has arrived of a traverse."""

    name: str
    n_frames: int
    missing: list[tuple[int, int]]  # ranges [first, last] of indices below the greatest that have no frame
    length_m: float | None  # from the least position to the greatest; None before the first frame
    span_us: tuple[int, int] | None  # the first and the last known time of a frame
    digest: str | None  # SHA-256 in hex of `Traverse.identities`; None: no frames, or one of unknown content
    n_uninformative: int  # frames whose pictures show nothing, or are so unlike all others that they seem to
    n_spooled: int  # pictures that wait to be fitted
    spooled_bytes: int
    grey_levels: tuple[int, int] | None  # what is shown black and white of more than 8 bits; None: nobody said yet
    cameras: tuple[Camera, ...]  # which took its pictures, the one of most first
    warnings: tuple[str, ...]  # what a person should know of its pictures, in sentences


class Traverse(Spool):
    """One traverse file; usable from any thread and several processes.

    A put that returned survives kill -9 and a power cut; one that did not is there whole or not at all. Every method
    raises UnavailableError or DamagedFileError where the file cannot be used, beside what it names itself.
    """

    def __init__(self, name: str, path: Path, db: Database) -> None:
        super().__init__(path, db)
        self.name = name

    @classmethod
    def create(cls, data_dir: Path, domain: str, name: str) -> Self:
        """Make an empty traverse and open it.

        Raises:
            InvalidInputError: The name cannot be a name.
            UnknownDomainError: There is no such domain.
            ConflictError: The domain has a traverse of that name.
        """
        path = layout.traverse_path(data_dir, domain, name)
        with storage_faults(path), _locked_folder(path.parent, domain):
            if path.exists():
                raise ConflictError(f"domain {domain} has a traverse {name}: delete it first, or choose another name")
            new_path = path.with_suffix(".new")
            remove_database(new_path)
            remove_database(path)  # a log that outlived its file would be replayed into the new one
            with open_database(new_path, create=True) as db, db.atomic():
                migrations.apply(db)
                db.execute("INSERT INTO traverse (id, created_at) VALUES (1, ?)", [current_moment()])
            sync(new_path)
            new_path.rename(path)
            sync(path.parent)
        return cls.open(data_dir, domain, name)

    @classmethod
    def open(cls, data_dir: Path, domain: str, name: str) -> Self:
        """Open a traverse; raises UnknownTraverseError."""
        path = layout.traverse_path(data_dir, domain, name)
        if not path.is_file():
            raise _unknown(data_dir, domain, name)
        try:
            with storage_faults(path):
                return cls(name, path, open_working_file(path, migrations, is_checked=False))
        except DeepSimbadError as error:
            if path.is_file():
                raise
            raise _unknown(data_dir, domain, name) from error  # it was deleted this moment

    @classmethod
    def delete(cls, data_dir: Path, domain: str, name: str) -> None:
        """Delete a traverse; a put going on ends first, later ones are refused. Raises UnknownTraverseError."""
        path = layout.traverse_path(data_dir, domain, name)
        with storage_faults(path), ExitStack() as stack:
            if path.parent.is_dir():
                stack.enter_context(_locked_folder(path.parent, domain))
            if not path.is_file():
                raise _unknown(data_dir, domain, name)
            try:
                db = stack.enter_context(open_database(path))
                stack.enter_context(write_transaction(db))
            except Exception as error:
                if getattr(error, "sqlite_errorname", "") == "SQLITE_BUSY":
                    raise
                # A damaged file cannot be locked, and can be deleted all the same.
            remove_database(path)
            sync(path.parent)

    @classmethod
    def list(cls, data_dir: Path, domain: str) -> list[str]:
        """The names of a domain's traverses."""
        folder = layout.traverses_folder(data_dir, domain)
        with storage_faults(folder):
            if not folder.is_dir():
                return []
            return sorted(path.stem for path in folder.iterdir() if path.suffix == ".sqlite")

    @classmethod
    def main_camera(cls, data_dir: Path, domain: str, name: str) -> Camera | None:
        """Which camera took most of its pictures; raises UnknownTraverseError. An unchanged file is opened once."""
        path = layout.traverse_path(data_dir, domain, name)
        with storage_faults(path):
            if not path.is_file():
                raise _unknown(data_dir, domain, name)
            return _main_camera(data_dir, domain, name, file_state(path))

    def _removal_error(self, path: Path) -> DeepSimbadError:
        if path == self._path:
            return UnknownTraverseError(f"traverse {self.name} was deleted")
        return super()._removal_error(path)

    def put_frames(
        self, frames: Drive, replace: bool = True, pictures: Mapping[int, bytes] = MappingProxyType({})
    ) -> tuple[int, int]:
        """Store a batch in one transaction; never holds a second copy of it.

        Args:
            replace: Whether they replace stored frames of the same index; else equal ones are passed over.
            pictures: The pictures that shall wait in the spool, as they were sent, by frame index.

        Returns:
            (n_new, n_replaced).

        Raises:
            InvalidInputError: Shapes differ, an index is out of range or there twice.
            InvalidRouteError: A position is NaN or infinite.
            InvalidEncodingError: An encoding is not finite, or of another length than those of the traverse.
            WeightsDifferError: The traverse holds frames that other weights encoded.
            GreyLevelsDifferError: The traverse's pictures are shown by other grey levels.
            FramesDifferError: None may be replaced, and some would be.
            UnknownTraverseError: The traverse was deleted meanwhile.
        """
        frames = frames.checked()
        content = np.where(frames.content_digest == UNKNOWN_CONTENT, frames.digests(), frames.content_digest)
        frames = dataclasses.replace(frames, content_digest=content)
        if frames.n_frames == 0:
            return 0, 0
        with self._writing() as db:
            rows = np.arange(frames.n_frames)  # of the frames that are written
            if not replace:
                rows = rows[~np.isin(frames.index, self._equal(db, frames))]
            n_before, dim = _count(db), frames.encodings.shape[1]
            present_dim, weights_sha256 = self._description(db)
            if present_dim not in {None, dim}:
                raise InvalidEncodingError(
                    f"encodings of this traverse hold {present_dim} numbers, these {dim}", encoding_dim=present_dim
                )
            WeightsDifferError.check("the traverse", weights_sha256, "a frame", frames.weights_sha256)
            db.execute(
                "UPDATE traverse SET encoding_dim = ?, weights_sha256 = coalesce(?, weights_sha256)",
                [dim, frames.weights_sha256],
            )
            if frames.grey_levels is not None:
                _keep_levels(db, frames.grey_levels)
                if (levels := _levels(db)) != frames.grey_levels:
                    raise GreyLevelsDifferError(
                        f"pictures of this traverse are shown by the grey levels {levels}, these by "
                        f"{frames.grey_levels}",
                        grey_levels=levels,
                    )
            columns = (
                frames.index,
                frames.position_m,
                frames.timestamp_us,
                frames.x_m,
                frames.y_m,
                frames.frame_name,
                frames.content_digest.view(np.int64),  # SQLite's integers have a sign
                frames.shows_nothing.astype(np.int64),
            )
            indices = frames.index[rows].tolist()
            clear_spool(db, indices, frames.content_digest.view(np.int64)[rows].tolist())
            camera = frames.camera
            camera_columns = (None,) * 3 if camera is None else (camera.name, camera.width, camera.height)
            db.conn.executemany(  # NaN becomes NULL
                """
                INSERT INTO frame (frame_index, position_m, timestamp_us, x_m, y_m, name, content_digest, shows_nothing,
                    camera, image_width, image_height)
                VALUES (?, ?, nullif(?, -1), ?, ?, nullif(?, ''), ?, ?, ?, ?, ?)
                ON CONFLICT (frame_index) DO UPDATE SET position_m = excluded.position_m,
                    timestamp_us = excluded.timestamp_us, x_m = excluded.x_m, y_m = excluded.y_m,
                    name = excluded.name, content_digest = excluded.content_digest,
                    shows_nothing = excluded.shows_nothing, camera = excluded.camera,
                    image_width = excluded.image_width, image_height = excluded.image_height
                """,
                zip(
                    *(map(values.item, rows) for values in columns),
                    *(repeat(value, rows.size) for value in camera_columns),
                    strict=True,
                ),
            )
            db.conn.executemany(
                """
                INSERT INTO encoding (frame_index, body) VALUES (?, ?)
                ON CONFLICT (frame_index) DO UPDATE SET body = excluded.body
                """,
                ((int(frames.index[row]), _pack(frames.encodings[row])) for row in rows),
            )
            spool_pictures(db, indices, pictures)
            n_new = _count(db) - n_before
        return n_new, rows.size - n_new

    def _equal(self, db: Database, frames: Drive) -> NDArray[np.int64]:
        """The indices of those frames that are stored already; raises FramesDifferError where one differs."""
        stored_identities = _identities(db, frames.index)
        common_indices, rows, _ = np.intersect1d(frames.index, stored_identities["index"], return_indices=True)
        masks = differences({name: getattr(frames, name)[rows] for name in IDENTITY}, stored_identities)
        if masks:
            indices = common_indices[np.any(list(masks.values()), axis=0)].tolist()
            raise FramesDifferError(
                f"{len(indices)} frames of traverse {self.name} are there already and differ in "
                f"{', '.join(masks)}, the first of index {indices[0]}: nothing was stored. Have them "
                "replaced, or choose another traverse",
                n_differing=len(indices),
                indices=indices[:_NAMED_INDICES],
            )
        return common_indices

    def identities(self) -> dict[str, NDArray[Any]]:
        """`index` and the arrays of `core.frames.IDENTITY` of all frames, in index order; reads no encodings."""
        with self._reading() as db:
            return _identities(db)

    @property
    def n_frames(self) -> int:
        """How many frames there are; reads no encodings."""
        with self._reading() as db:
            return _count(db)

    @property
    def encoding_dim(self) -> int | None:
        """The length of the encodings; None before the first frame."""
        with self._reading() as db:
            return self._description(db)[0]

    def summary(self) -> "TraverseSummary":
        """What has arrived, of one moment; reads the encodings where the file was written to since it last did."""
        n_blank, n_unlike_all = _uninformative(self._path, file_state(self._path))
        with self._reading() as db:
            n_frames, length_m, *span_us = db.execute(
                "SELECT count(*), max(position_m) - min(position_m), min(timestamp_us), max(timestamp_us) FROM frame"
            ).fetchone()
            missing = db.execute(
                """
                SELECT previous + 1, frame_index - 1 FROM (
                    SELECT lag(frame_index, 1, -1) OVER (ORDER BY frame_index) AS previous, frame_index FROM frame
                ) WHERE frame_index > previous + 1 ORDER BY frame_index
                """
            ).fetchall()
            cameras = _cameras(db)
            reasons = (camera.unlike(cameras[:1], "most") for camera in cameras[1:])
            warnings = [
                f"some of its pictures are not like the others: {reason}" for reason in reasons if reason is not None
            ][:1]
            for n_pictures, reason in ((n_blank, SHOWS_NOTHING), (n_unlike_all, UNLIKE_ALL)):
                if n_pictures:
                    warnings.append(f"{n_pictures} of {n_frames} pictures {reason}")
            n_spooled, spooled_bytes = spool_size(db)
            return TraverseSummary(
                name=self.name,
                n_frames=n_frames,
                missing=missing,
                length_m=length_m,
                span_us=None if span_us[0] is None else (span_us[0], span_us[1]),
                digest=_digest(_identities(db)),
                n_uninformative=n_blank + n_unlike_all,
                n_spooled=n_spooled,
                spooled_bytes=spooled_bytes,
                grey_levels=_levels(db),
                cameras=cameras,
                warnings=tuple(warnings),
            )

    @property
    def grey_levels(self) -> tuple[int, int] | None:
        """What is shown black and white of pictures of more than 8 bits; None where nobody said yet."""
        with self._reading() as db:
            return _levels(db)

    def keep_levels(self, levels: tuple[int, int]) -> tuple[int, int]:
        """Keep grey levels for all pictures to come, unless there are some; answers those that count."""
        with self._writing() as db:
            _keep_levels(db, levels)
            return _levels(db) or levels

    def read(self) -> Drive:
        """All frames in index order; one array of encodings, no copy beside it."""
        with self._reading() as db:
            n_frames, (dim, weights_sha256), cameras = _count(db), self._description(db), _cameras(db)
            levels, places = _levels(db), np.empty((n_frames, 3))
            indices, timestamp_us = np.empty(n_frames, np.int64), np.empty(n_frames, np.int64)
            encodings, is_blank = np.empty((n_frames, dim or 0), np.float32), np.empty(n_frames, np.bool_)
            names: list[str] = []  # the class has a `list` of its own
            rows = db.execute(
                """
                SELECT frame.frame_index, coalesce(timestamp_us, ?), coalesce(name, ''),
                    coalesce(shows_nothing, 0), position_m, x_m, y_m, body
                FROM frame LEFT JOIN encoding ON encoding.frame_index = frame.frame_index
                ORDER BY frame.frame_index
                """,
                [UNKNOWN_TIMESTAMP],
            )
            for row, (frame_index, moment_us, name, shows_nothing, *place, body) in enumerate(rows):
                names.append(name)
                indices[row], timestamp_us[row], places[row] = frame_index, moment_us, place  # None becomes NaN
                is_blank[row] = shows_nothing
                encodings[row] = _unpack(self.name, frame_index, body, dim)
        position_m, x_m, y_m = places.T.copy()
        return Drive(
            name=self.name, camera=next(iter(cameras), None), index=indices, position_m=position_m,
            timestamp_us=timestamp_us, x_m=x_m, y_m=y_m, frame_name=np.array(names, np.str_), encodings=encodings,
            weights_sha256=weights_sha256, grey_levels=levels, shows_nothing=is_blank,
        )  # fmt: skip

    def _description(self, db: Database) -> tuple[int | None, str | None]:
        """The length of the encodings, and by which weights images were encoded; None where there are none yet."""
        row: tuple[int | None, str | None] | None = db.execute(
            "SELECT encoding_dim, weights_sha256 FROM traverse"
        ).fetchone()
        if row is None:
            raise DamagedFileError(f"traverse {self.name} is damaged: it does not describe itself; upload it again")
        return row


def _identities(db: Database, indices: NDArray[np.int64] | None = None) -> dict[str, NDArray[Any]]:
    """As `Traverse.identities`, of the frames at `indices` (None: all)."""
    condition = "" if indices is None else "WHERE frame_index IN (SELECT value FROM json_each(?))"
    rows = db.execute(
        f"""
        SELECT frame_index, position_m, coalesce(timestamp_us, -1), x_m, y_m, coalesce(content_digest, 0)
        FROM frame {condition} ORDER BY frame_index
        """,  # noqa: S608 - of our own words
        [] if indices is None else [to_json(indices.tolist())],
    ).fetchall()
    index, position_m, timestamp_us, x_m, y_m, content = zip(*rows, strict=True) if rows else [()] * 6
    return {
        "index": np.array(index, np.int64),
        "position_m": np.array(position_m, np.float64),
        "timestamp_us": np.array(timestamp_us, np.int64),
        "x_m": np.array(x_m, np.float64),  # None becomes NaN
        "y_m": np.array(y_m, np.float64),
        "content_digest": np.array(content, np.int64).view(np.uint64),
    }


def _levels(db: Database) -> tuple[int, int] | None:
    row: tuple[int, int] | None = db.execute("SELECT black, white FROM traverse WHERE black IS NOT NULL").fetchone()
    return row


def _keep_levels(db: Database, levels: tuple[int, int] | None) -> None:
    if levels is not None:
        db.execute("UPDATE traverse SET black = ?, white = ? WHERE black IS NULL", list(levels))


def _digest(identities: dict[str, NDArray[Any]]) -> str | None:
    if not identities["index"].size or (identities["content_digest"] == UNKNOWN_CONTENT).any():
        return None
    digest = hashlib.sha256()
    for array in identities.values():
        digest.update(array.astype(array.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


@lru_cache(maxsize=4096)
def _main_camera(data_dir: Path, domain: str, name: str, _: FileState) -> Camera | None:
    with Traverse.open(data_dir, domain, name) as traverse, traverse._reading() as db:
        return next(iter(_cameras(db)), None)


@lru_cache(maxsize=4096)
def _uninformative(path: Path, _: FileState) -> tuple[int, int]:
    """How many pictures show nothing by themselves, and how many of the others as `Drive.is_unlike_all`."""

    def count_frames(db: Database) -> tuple[int, int]:
        (dim,) = db.execute("SELECT encoding_dim FROM traverse").fetchone()
        frames = "FROM frame LEFT JOIN encoding USING (frame_index) ORDER BY frame_index"
        is_blank = np.array([row[0] for row in db.execute(f"SELECT coalesce(shows_nothing, 0) {frames}")], np.bool_)

        def blocks() -> Iterator[NDArray[np.float32]]:
            rows = db.execute(f"SELECT frame_index, body {frames}")
            while block := rows.fetchmany(_ROWS_AT_ONCE):
                yield np.stack([_unpack(path.stem, index, body, dim) for index, body in block])

        return int(is_blank.sum()), int((shows_nothing(blocks) & ~is_blank).sum())

    return look_at(path, count_frames)


def _cameras(db: Database) -> tuple[Camera, ...]:
    rows = db.execute(
        """
        SELECT image_width, image_height, camera FROM frame WHERE image_width IS NOT NULL
        GROUP BY 1, 2, 3 ORDER BY count(*) DESC, min(frame_index)
        """
    )
    return tuple(Camera(*row) for row in rows)


def _pack(encoding: NDArray[np.float32]) -> bytes:
    return encoding.astype("<f2" if is_halvable(encoding) else "<f4").tobytes()


def _unpack(name: str, frame_index: int, body: bytes | None, dim: int | None) -> NDArray[np.float32]:
    """The encoding [d] of a frame; raises DamagedFileError."""
    dtype = _DTYPE_OF_BYTES.get(len(body or b"") / (dim or 1))  # a single number would be broadcast
    if dtype is None:
        raise DamagedFileError(
            f"traverse {name} is damaged: the encoding of frame {frame_index} has another length; "
            "delete it and upload it again"
        )
    return np.frombuffer(body or b"", dtype).astype(np.float32)


def _count(db: Database) -> int:
    (n_frames,) = db.execute("SELECT count(*) FROM frame").fetchone()
    return int(n_frames)


@contextmanager
def _locked_folder(folder: Path, domain: str) -> Iterator[None]:
    """Keep other processes from making or deleting a traverse of the domain meanwhile."""
    try:
        descriptor = lock_folder(folder, fcntl.LOCK_EX)
    except FileNotFoundError as error:
        raise UnknownDomainError(f"there is no domain {domain}") from error
    try:
        yield
    finally:
        os.close(descriptor)


def _unknown(data_dir: Path, domain: str, name: str) -> UnknownTraverseError:
    names = Traverse.list(data_dir, domain)
    return UnknownTraverseError(f"domain {domain} has no traverse {name}{nearest_of(name, names)}", known=names[:20])
