"""A backup made a data directory again: whole, or not at all."""

import fcntl
import os
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from sqlite_utils import Database

from deepsimbad.errors import ConflictError, InvalidArchiveError
from deepsimbad.store import domain_table, layout
from deepsimbad.store.archive import ArchiveReader, opened_archive
from deepsimbad.store.backup import BACKUP_FORMAT, CATALOG, SESSIONS, is_member
from deepsimbad.store.connection import check_integrity, in_todays_schema, look_at
from deepsimbad.store.data_dir import PRIVATE, make_data_dir
from deepsimbad.store.durable import sync_file, sync_folder
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.service_lock import ServiceLock
from deepsimbad_migrations.catalog.migrations import migrations as catalog_migrations

_MARK = ".restoring"  # beside what a restore has unpacked so far: such a folder may be cleared away


@dataclass(frozen=True)
class RestoreReport:
    """What was restored: `created_at` and `release` are the backup's."""

    data_dir: str
    n_files: int
    bytes: int
    created_at: str
    release: str


def restore(file: Path, data_dir: Path, on_progress: Callable[[float], None]) -> RestoreReport:
    """Make a data directory of a backup; nothing takes its name before every digest was checked.

    Args:
        file: The backup.
        data_dir: Where; absent or empty.
        on_progress: Called with 0..1; what it raises (a cancel) ends the restore and leaves nothing, but a service's
            lock, held by nobody, in a folder that was there.

    Raises:
        InvalidArchiveError: It is not a backup, was cut short or changed, or would write elsewhere.
        DataDirInUseError: A service runs on the data directory.
        ConflictError: The data directory is not empty, or another restore is at work on it.
        DamagedFileError: A newer release made it.
        UnavailableError: The disk is full, ...
    """
    data_dir = Path(os.path.realpath(data_dir))
    n_expected = 2 * max(1, file.stat().st_size if file.is_file() else 1)
    n_done = 0

    def done(n_bytes: int) -> None:
        nonlocal n_done
        n_done += n_bytes
        on_progress(min(1.0, n_done / n_expected))

    with storage_faults(data_dir), ExitStack() as parts:
        was_there = _check_empty(data_dir, parts)
        archive = parts.enter_context(opened_archive(file, is_member, done))
        _check_kind(file, archive)
        staging = parts.enter_context(_staging(data_dir))
        _unpack(archive, staging)
        _publish(staging, data_dir, was_there)
    on_progress(1.0)
    return RestoreReport(
        str(data_dir),
        len(archive.members),
        sum(member.bytes for member in archive.members),
        str(archive.about.get("created_at")),
        str(archive.about.get("release")),
    )


def _check_empty(data_dir: Path, parts: ExitStack) -> bool:
    """Refuse what holds anything; keep services away from what is there and empty. Returns whether it is there."""
    lock = layout.service_lock_path(data_dir)
    if not data_dir.exists():
        make_data_dir(data_dir.parent, 0o777)
        return False
    if not data_dir.is_dir():
        raise ConflictError(f"{data_dir} is no folder")
    is_used = lock.exists()
    if is_used:
        parts.enter_context(ServiceLock.take(data_dir, "restoring a backup"))
    left = {path.name for path in data_dir.iterdir()} - {lock.name, _MARK}
    if left:
        raise ConflictError(f"{data_dir} is not empty: restore into a new folder, and move it into place afterwards")
    if not is_used:  # only now: a folder that is none of ours gets no file of ours
        parts.enter_context(ServiceLock.take(data_dir, "restoring a backup"))
    return True


def _check_kind(file: Path, archive: ArchiveReader) -> None:
    if archive.about.get("format") != BACKUP_FORMAT or CATALOG not in {member.name for member in archive.members}:
        raise InvalidArchiveError(f"{file} is no backup of a data directory", file=str(file))
    if archive.about.get("format_version") != 1:
        raise InvalidArchiveError(f"{file} was written by a newer release: upgrade this one", file=str(file))


@contextmanager
def _staging(data_dir: Path) -> Iterator[Path]:
    """A folder to unpack into, on the same file system; it is gone afterwards, unless it became the data directory."""
    inside = data_dir.is_mount()  # a mounted folder cannot be replaced by another, and beside it is another disk
    staging = data_dir / _MARK if inside else data_dir.with_name(f"{data_dir.name}{_MARK}")
    staging.mkdir(PRIVATE, exist_ok=True)
    descriptor = os.open(staging, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConflictError(f"another restore into {data_dir} is at work") from error
        if any(staging.iterdir()) and not (staging / _MARK).exists():
            raise ConflictError(f"{staging} is in the way: move it away first")
        try:
            staging.chmod(PRIVATE)  # one that a killed restore left may be open to others
            (staging / _MARK).touch()
            for left in staging.iterdir():
                if left.is_dir():
                    shutil.rmtree(left)
                elif left.name != _MARK:
                    left.unlink()
            yield staging
        finally:
            if (staging / _MARK).exists():
                shutil.rmtree(staging, ignore_errors=True)
    finally:
        os.close(descriptor)


def _unpack(archive: ArchiveReader, staging: Path) -> None:
    for member in archive.members:
        target = staging / member.name
        target.parent.mkdir(parents=True, exist_ok=True)
        archive.copy(member, target)
        target.chmod(0o444 if target.parent.name == "maps" else 0o644)
        sync_file(target)
    catalog = staging / CATALOG
    with storage_faults(catalog):
        names = look_at(catalog, lambda db: _domains(db, catalog))
    for name in names:
        layout.traverses_folder(staging, name).mkdir(parents=True, exist_ok=True)
        layout.maps_folder(staging, name).mkdir(parents=True, exist_ok=True)
    for folder, _, _ in os.walk(staging, topdown=False):
        sync_folder(Path(folder))


def _domains(db: Database, path: Path) -> list[str]:
    check_integrity(db, path)
    with in_todays_schema(db, catalog_migrations, path) as current:
        return [record.name for record in domain_table.all_domains(current)]


def _publish(staging: Path, data_dir: Path, was_there: bool) -> None:
    """Let the unpacked files take their names: by one rename, or the catalog last."""
    if staging.parent == data_dir:
        names = (layout.domains_folder(data_dir).name, SESSIONS, CATALOG)
        if any((data_dir / name).exists() for name in names):  # a command takes no lock
            raise ConflictError(f"{data_dir} is not empty any more: somebody else has begun to use it")
        for name in names:
            if (staging / name).exists():
                (staging / name).rename(data_dir / name)
        sync_folder(data_dir)
        return
    (staging / _MARK).unlink()
    try:
        if was_there:  # else the lock that lies in it is not ours
            staging.chmod(stat.S_IMODE(data_dir.stat().st_mode))  # whoever made the folder chose who may enter it
            layout.service_lock_path(data_dir).unlink(missing_ok=True)
        staging.rename(data_dir)  # onto an empty folder at most
    except OSError as error:
        (staging / _MARK).touch()
        raise ConflictError(f"{data_dir} is not empty any more: somebody else has begun to use it") from error
    sync_folder(data_dir.parent)
