"""One recorded drive on the disk: its frames' encodings and places, not its images."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.core.drive import UNKNOWN_TIMESTAMP, Drive
from deepsimbad.errors import ConflictError, DamagedFileError, UnknownDomainError, UnknownTraverseError
from deepsimbad.store import frame_table, layout
from deepsimbad.store.connection import migrate, open_database, use_write_ahead_log, write_transaction
from deepsimbad.store.documents import now
from deepsimbad.store.durable import remove_database, sync_file, sync_folder
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.open_file import OpenFile
from deepsimbad.store.write_ahead_log import check_log
from deepsimbad_migrations.traverse.migrations import migrations

IndexRanges = list[tuple[int, int]]  # the class has a `list` of its own
_NEW_SUFFIX = ".new"  # a file being made; never a traverse's own ending


class Traverse(OpenFile):
    """One traverse file; usable from any thread and several processes.

    A put that returned survives kill -9 and a power cut; one that did not is there whole or not at all. Every method
    raises UnavailableError or DamagedFileError where the file cannot be used, beside what it names itself.

    Args:
        name: Its name within the domain.
        path: Its file.
        db: The open file.
    """

    def __init__(self, name: str, path: Path, db: Database) -> None:
        super().__init__(path, db)
        self.name = name
        self._inode = path.stat().st_ino

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
            new = path.with_suffix(_NEW_SUFFIX)
            # A log that outlived its file would be replayed into the new one.
            remove_database(new)
            remove_database(path)
            try:
                with open_database(new, create=True) as db, db.atomic():
                    migrations.apply(db)
                    db.execute("INSERT INTO traverse (id, created_at) VALUES (1, ?)", [now()])
                sync_file(new)
                new.rename(path)
            except BaseException:
                remove_database(new)
                raise
            sync_folder(path.parent)
        return cls.open(data_dir, domain, name)

    @classmethod
    def open(cls, data_dir: Path, domain: str, name: str) -> Self:
        """Open a traverse; raises UnknownTraverseError."""
        path = layout.traverse_path(data_dir, domain, name)
        if not path.is_file():
            raise UnknownTraverseError(f"domain {domain} has no traverse {name}", known=cls.list(data_dir, domain)[:20])
        with _named(name), storage_faults(path), ExitStack() as on_error:
            check_log(path)
            db = open_database(path)
            on_error.callback(db.close)
            if not db.table_names():
                raise DamagedFileError(f"{path.name} is damaged: it is empty", file=path.name)
            use_write_ahead_log(db)
            migrate(db, migrations, path)
            traverse = cls(name, path, db)
            on_error.pop_all()
        return traverse

    @classmethod
    def delete(cls, data_dir: Path, domain: str, name: str) -> None:
        """Delete a traverse; a put going on ends first, later ones are refused. Raises UnknownTraverseError."""
        path = layout.traverse_path(data_dir, domain, name)
        with storage_faults(path), ExitStack() as until_gone:
            if path.parent.is_dir():
                until_gone.enter_context(_locked_folder(path.parent, domain))
            if not path.is_file():
                raise UnknownTraverseError(f"domain {domain} has no traverse {name}")
            try:
                db = until_gone.enter_context(open_database(path))
                until_gone.enter_context(write_transaction(db))
            except Exception as error:
                if getattr(error, "sqlite_errorname", "") == "SQLITE_BUSY":
                    raise
                # A damaged file cannot be locked, and can be deleted all the same.
            remove_database(path)
            sync_folder(path.parent)

    @classmethod
    def list(cls, data_dir: Path, domain: str) -> list[str]:
        """The names of a domain's traverses."""
        folder = layout.traverses_folder(data_dir, domain)
        with storage_faults(folder):
            if not folder.is_dir():
                return []
            return sorted(path.stem for path in folder.iterdir() if path.suffix == ".sqlite")

    @property
    def is_deleted(self) -> bool:
        """Whether its file is gone, or another lies in its place."""
        with storage_faults(self._path):
            try:
                return self._path.stat().st_ino != self._inode
            except FileNotFoundError:
                return True

    @contextmanager
    def _reading(self) -> Iterator[Database]:
        with _named(self.name), super()._reading() as db:
            yield db

    @contextmanager
    def _writing(self) -> Iterator[Database]:
        with _named(self.name), self._lock, storage_faults(self._path), write_transaction(self._db) as db:
            # Deletion holds the same write lock: a frame is never acknowledged into a file that is gone.
            if self.is_deleted:
                raise UnknownTraverseError(f"traverse {self.name} was deleted")
            yield db

    def put_frame(
        self,
        index: int,
        encoding: NDArray[np.float32],
        position_m: float,
        timestamp_us: int | None = None,
        x_m: float | None = None,
        y_m: float | None = None,
        weights_sha256: str | None = None,
    ) -> bool:
        """Store one frame, replacing one of the same index.

        Args:
            index: Place in the recording, from 0.
            encoding: [d] float32, d as for the traverse's first frame.
            position_m: Route position.
            timestamp_us: Microseconds, None where unknown.
            x_m: East, None where unknown.
            y_m: North, None where unknown.
            weights_sha256: Of the network that encoded it; None where none did.

        Returns:
            Whether the frame is new.

        Raises:
            InvalidInputError, InvalidRouteError, InvalidEncodingError: As `put_frames`.
        """
        frames = Drive(
            index=np.array([index]),
            position_m=np.array([position_m], np.float64),
            timestamp_us=np.array([UNKNOWN_TIMESTAMP if timestamp_us is None else timestamp_us]),
            x_m=np.array([np.nan if x_m is None else x_m], np.float64),
            y_m=np.array([np.nan if y_m is None else y_m], np.float64),
            encodings=np.asarray(encoding, np.float32)[np.newaxis],
            weights_sha256=weights_sha256,
        )
        return self.put_frames(frames)[0] == 1

    def put_frames(self, frames: Drive) -> tuple[int, int]:
        """Store a batch in one transaction, replacing frames of the same index.

        Returns:
            (n_new, n_replaced).

        Raises:
            InvalidInputError: Shapes differ, an index is out of range or there twice.
            InvalidRouteError: A position is NaN or infinite.
            InvalidEncodingError: An encoding is not finite, or of another length than those of the traverse.
            WeightsDifferError: The traverse holds frames that other weights encoded.
            UnknownTraverseError: The traverse was deleted meanwhile.
        """
        frames = frames.checked()
        if frames.n_frames == 0:
            return 0, 0
        with self._writing() as db:
            n_before = frame_table.count(db)
            frame_table.upsert(db, frames)
            n_new = frame_table.count(db) - n_before
        return n_new, frames.n_frames - n_new

    @property
    def n_frames(self) -> int:
        """How many frames there are."""
        with self._reading() as db:
            return frame_table.count(db)

    @property
    def encoding_dim(self) -> int | None:
        """The length of the encodings; None before the first frame."""
        with self._reading() as db:
            return frame_table.encoding_dim(db)

    @property
    def missing(self) -> IndexRanges:
        """The ranges [first, last] of indices below the greatest that have no frame."""
        with self._reading() as db:
            return frame_table.missing(db)

    def read(self) -> Drive:
        """All frames in index order, every checksum checked; one array of encodings, no copy beside it."""
        with self._reading() as db:
            return frame_table.read(db)


def remove_leftovers(data_dir: Path, domain: str) -> list[str]:
    """Remove what cut-short creations and deletions left in a domain's traverses; returns the files' names."""
    folder = layout.traverses_folder(data_dir, domain)
    if not folder.is_dir():
        return []
    removed = []
    with storage_faults(folder), _locked_folder(folder, domain):
        for path in sorted(folder.iterdir()):
            owner = path.with_name(path.name.removesuffix("-wal").removesuffix("-shm"))
            if _NEW_SUFFIX in (path.suffix, path.suffix.partition("-")[0]) or not owner.exists():
                path.unlink(missing_ok=True)
                removed.append(path.name)
    return removed


@contextmanager
def _named(name: str) -> Iterator[None]:
    """Say of damage which traverse it is in: whoever learns of it, in a job's row perhaps, knows no file's name."""
    try:
        yield
    except DamagedFileError as error:
        raise DamagedFileError(f"traverse {name}: {error.message}", **{**error.hints, "traverse": name}) from error


@contextmanager
def _locked_folder(folder: Path, domain: str) -> Iterator[None]:
    """Keep other processes from making or deleting a traverse of the domain meanwhile."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except FileNotFoundError as error:
        raise UnknownDomainError(f"there is no domain {domain}") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
