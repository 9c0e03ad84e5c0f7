"""A copy of a whole data directory in one tar file, taken beside a service that goes on writing; and back.

The last member, the manifest, holds the size and the SHA-256 of every other one. Any tar program can unpack it.
"""

import hashlib
import io
import json
import os
import re
import shutil
import tarfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from sqlite_utils import Database, Migrations

from deepsimbad.errors import ConflictError, DamagedMapError, InvalidArchiveError, UnavailableError
from deepsimbad.store import layout
from deepsimbad.store.connection import check_integrity, in_todays_schema, look_at, pending_migrations
from deepsimbad.store.data_dir import PRIVATE, ServiceLock
from deepsimbad.store.durable import sha256_of, sync, written_aside
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.layout import NAME_PATTERN
from deepsimbad.store.records import now
from deepsimbad_migrations.catalog.migrations import migrations as of_catalog
from deepsimbad_migrations.map.migrations import migrations as of_map
from deepsimbad_migrations.session.migrations import migrations as of_sessions
from deepsimbad_migrations.traverse.migrations import migrations as of_traverse

Progress = Callable[[float], None]
"""Called with 0..1; what it raises (a cancel) ends the work and leaves nothing of it."""

_FORMAT = {"format": "deepsimbad-backup", "format_version": 1}
_MANIFEST = "manifest.json"
_CATALOG, _SESSIONS = "catalog.sqlite", "sessions.sqlite"
_OF_OLDER_RELEASES = "archive.sha256"  # a digest of all before it, which the members' own make needless
_MEMBERS: dict[str, Migrations] = {
    r"catalog\.sqlite": of_catalog,
    r"sessions\.sqlite": of_sessions,
    rf"domains/{NAME_PATTERN}/traverses/{NAME_PATTERN}\.sqlite": of_traverse,
    rf"domains/{NAME_PATTERN}/maps/\d{{6,16}}\.sqlite": of_map,
}
_MOST_TRIES = 10
_STAGING = ".restoring"

Listed = frozenset[tuple[str, int, str]]
"""What a catalog says there is: (domain, version, SHA-256) of sealed maps; (domain, 0, created_at) of domains."""


@dataclass(frozen=True)
class BackupReport:
    """What was copied: `sha256` is that of the whole file, times are ISO 8601 in UTC."""

    file: str
    bytes: int
    sha256: str
    created_at: str
    n_domains: int
    n_maps: int
    n_traverses: int


@dataclass(frozen=True)
class RestoreReport:
    """What was restored: `created_at` and `release` are the backup's."""

    data_dir: str
    n_files: int
    bytes: int
    created_at: str
    release: str


def migrations_of(name: str) -> Migrations | None:
    """The schema of a file, by its name in a data directory; None: a backup holds no such file."""
    return next((migrations for pattern, migrations in _MEMBERS.items() if re.fullmatch(pattern, name)), None)


def back_up(data_dir: Path, file: Path, release: str, on_progress: Progress) -> BackupReport:
    """Copy a data directory into one file, whether a service runs on it or not.

    Whatever was acknowledged before it began is in it, and everything that its sessions and its catalog speak of:
    sessions are copied first, the catalog after them, maps and traverses last. Every SQLite file is copied as of one
    moment; what is damaged is not copied, but named.

    Args:
        data_dir: The data directory.
        file: The new file; it appears when it is whole.
        release: Which release makes it.
        on_progress: Told how far it is.

    Raises:
        ConflictError: There is a file of that name.
        InvalidInputError: There is no folder for it.
        DamagedFileError, DamagedMapError: What is damaged, by name.
        UnavailableError: The disk is full, ...
    """
    with storage_faults(file), written_aside(file, "a backup") as new:
        for _ in range(_MOST_TRIES):
            backup, created_at, problem = _Backup(data_dir, new, on_progress), now(), None
            try:
                backup.run({**_FORMAT, "release": release, "created_at": created_at})
            except UnavailableError as error:
                problem = error
                if error.hints.get("reason") == "disk_full":
                    problem = UnavailableError(f"{file}: no space is left to write it", reason="disk_full")
            if backup.is_of_today():  # else a damaged or missing file may be one that went meanwhile
                break
        else:
            raise UnavailableError("maps come and go faster than they can be copied: try again", reason="busy")
        if problem is not None:
            raise problem
        on_progress(1.0)
        digest, n_bytes = sha256_of(new), new.stat().st_size
    n_maps = sum(version > 0 for _, version, _ in backup.listed)
    n_traverses = sum("/traverses/" in member["name"] for member in backup.members)
    return BackupReport(str(file), n_bytes, digest, created_at, len(backup.listed) - n_maps, n_maps, n_traverses)


class _Backup:
    """One try: the catalog may move on meanwhile, and the files with it."""

    def __init__(self, data_dir: Path, file: Path, on_progress: Progress) -> None:
        self.listed: Listed = frozenset()
        self.members: list[dict[str, Any]] = []
        self._data_dir = data_dir
        self._file = file
        self._copy = file.with_name("copy.sqlite")
        self._counter = _Counter(sum(_sizes(data_dir)), on_progress)

    def run(self, about: dict[str, Any]) -> None:
        with tarfile.open(self._file, "w:", format=tarfile.PAX_FORMAT) as tar:
            self._file.chmod(0o600)  # it holds the hashes of keys and where robots were
            if layout.sessions_path(self._data_dir).exists():
                self._add_copy(tar, _SESSIONS)
            self._add_copy(tar, _CATALOG)
            for domain, version, digest in sorted(self.listed):
                if version > 0:
                    self._add_map(tar, domain, version, digest)
                    continue
                folder = layout.traverses_folder(self._data_dir, domain)
                for path in sorted(folder.glob("*.sqlite")) if folder.is_dir() else []:
                    try:
                        self._add_copy(tar, path.relative_to(self._data_dir).as_posix())
                    except UnavailableError:
                        if path.exists():
                            raise  # else it was deleted meanwhile, and needs no copy
            manifest = json.dumps({**about, "files": self.members}, indent=1).encode()
            tar.addfile(_info(_MANIFEST, len(manifest)), io.BytesIO(manifest))

    def is_of_today(self) -> bool:
        """Whether everything that the copied catalog lists is still there."""
        path = layout.catalog_path(self._data_dir)
        with storage_faults(path):
            return self.listed <= look_at(path, lambda db: listed_in(db, path))

    def _add_copy(self, tar: tarfile.TarFile, name: str) -> None:
        """Copy a SQLite file as of one moment, and check the copy."""
        path = self._data_dir / name

        def copy(db: Database) -> None:
            self._copy.unlink(missing_ok=True)
            db.execute("VACUUM INTO ?", [str(self._copy)])

        with storage_faults(path):
            look_at(path, copy)
            look_at(self._copy, lambda db: check_integrity(db, path))
            if name == _CATALOG:
                self.listed = look_at(self._copy, lambda db: listed_in(db, path))
        self._add(tar, name, self._copy)

    def _add_map(self, tar: tarfile.TarFile, domain: str, version: int, digest: str) -> None:
        path = layout.map_path(self._data_dir, domain, version)
        is_there = path.exists()
        if is_there:
            self._add(tar, path.relative_to(self._data_dir).as_posix(), path)
        if not is_there or self.members[-1]["sha256"] != digest:
            why = "is damaged: its SHA-256 differs" if is_there else "is missing"
            raise DamagedMapError(
                f"map {version} of domain {domain} {why}: nothing was backed up. Restore its file, or activate "
                "another version and delete this one",
                domain=domain,
                map_version=version,
            )

    def _add(self, tar: tarfile.TarFile, name: str, path: Path) -> None:
        with path.open("rb") as stream:
            source = _Hashing(stream, self._counter)
            n_bytes = path.stat().st_size
            tar.addfile(_info(name, n_bytes), source)
            self.members.append({"name": name, "bytes": n_bytes, "sha256": source.digest.hexdigest()})


def listed_in(db: Database, path: Path) -> Listed:
    """Read a catalog; raises DamagedFileError."""
    with in_todays_schema(db, of_catalog, path) as current:
        maps = current.execute(
            "SELECT domain, version, sha256 FROM map WHERE state != 'building' AND removed_at IS NULL"
        ).fetchall()
        return frozenset([*maps, *current.execute("SELECT name, 0, created_at FROM domain").fetchall()])


def restore(file: Path, data_dir: Path, on_progress: Progress) -> RestoreReport:
    """Make a data directory of a backup; nothing takes its name before every digest was checked.

    Args:
        file: The backup.
        data_dir: Where; absent or empty.
        on_progress: Told how far it is.

    Raises:
        InvalidArchiveError: It is not a backup, was cut short or changed, or would write elsewhere.
        DataDirInUseError: A service runs on the data directory, or another restore is at work on it.
        ConflictError: The data directory is not empty.
        DamagedFileError: A newer release made it, or it holds triggers or views.
        UnavailableError: The disk is full, ...
    """
    data_dir = Path(os.path.realpath(data_dir))
    with storage_faults(data_dir), _opened(file) as tar:
        about, members = _manifest(tar, file)
        n_bytes = sum(member["bytes"] for member in members)
        counter = _Counter(n_bytes, on_progress)
        with _staging(data_dir) as staging:
            for member in members:
                _unpack(tar, file, member, staging, counter)
            _complete(staging)
            _publish(staging, data_dir)
    on_progress(1.0)
    return RestoreReport(str(data_dir), len(members), n_bytes, str(about.get("created_at")), str(about.get("release")))


@contextmanager
def _opened(file: Path) -> Iterator[tarfile.TarFile]:
    try:
        tar = tarfile.open(file, "r:")  # noqa: SIM115 - closed below
    except OSError as error:
        raise InvalidArchiveError(f"{file} cannot be read: {error.strerror}", file=str(file)) from error
    except tarfile.TarError as error:
        raise _wrong(file, f"it is no backup: {error}") from error
    with tar:
        yield tar


def _manifest(tar: tarfile.TarFile, file: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """What a backup says of itself and of its members, which are those that it holds."""
    try:
        infos = [info for info in tar.getmembers() if info.name != _OF_OLDER_RELEASES]
        stream = tar.extractfile(_MANIFEST)
        about = json.load(stream) if stream else {}
        members = [{"name": one["name"], "bytes": int(one["bytes"]), "sha256": one["sha256"]} for one in about["files"]]
    except (tarfile.TarError, OSError, AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise _wrong(file, f"it is no backup, or was cut short or changed: {error}") from error
    if about.get("format") != _FORMAT["format"] or _CATALOG not in {member["name"] for member in members}:
        raise InvalidArchiveError(f"{file} is no backup of a data directory", file=str(file))
    if about.get("format_version") != _FORMAT["format_version"]:
        raise InvalidArchiveError(f"{file} was written by a newer release: upgrade this one", file=str(file))
    for info in infos:
        if info.type != tarfile.REGTYPE or info.sparse is not None:  # no links, devices or folders
            raise _wrong(file, f"{info.name!a} is no plain file")
        if info.name != _MANIFEST and migrations_of(info.name) is None:
            raise _wrong(file, f"{info.name!a} has no place in it")
    sizes = sorted((info.name, info.size) for info in infos if info.name != _MANIFEST)
    if sizes != sorted((member["name"], member["bytes"]) for member in members):
        raise _wrong(file, "its manifest does not list what is in it")
    return about, members


@contextmanager
def _staging(data_dir: Path) -> Iterator[Path]:
    """A folder to unpack into, inside the data directory, which is made or found empty, and held meanwhile."""
    is_new = not data_dir.exists()
    if not is_new and not data_dir.is_dir():
        raise ConflictError(f"{data_dir} is no folder")
    try:
        with ServiceLock.take(data_dir, "restoring a backup"):
            staging = data_dir / _STAGING
            present = {path.name: path for path in data_dir.iterdir() if path != layout.service_lock_path(data_dir)}
            if _STAGING in present and _CATALOG not in present:  # a restore that was cut short
                for name in {_STAGING, _SESSIONS, layout.domains_folder(data_dir).name} & set(present):
                    path = present.pop(name)
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
            if present:
                raise ConflictError(
                    f"{data_dir} is not empty: restore into a new folder, and move it into place afterwards"
                )
            try:
                staging.mkdir(PRIVATE)
                yield staging
            finally:
                shutil.rmtree(staging, ignore_errors=True)
    finally:
        if is_new:
            with suppress(OSError):  # it holds what was restored
                data_dir.rmdir()


def _unpack(tar: tarfile.TarFile, file: Path, member: dict[str, Any], staging: Path, counter: "_Counter") -> None:
    """Copy a member into a new file; raises InvalidArchiveError where it is not what the manifest says."""
    name = member["name"]
    target = staging / name
    target.parent.mkdir(parents=True, exist_ok=True)
    stream = tar.extractfile(name)
    assert stream is not None
    source = _Hashing(stream, counter)
    with target.open("xb") as into:
        try:
            shutil.copyfileobj(source, into)
        except tarfile.TarError as error:
            raise _wrong(file, "it was cut short") from error
    if source.digest.hexdigest() != member["sha256"]:
        raise _wrong(file, f"{name} does not match its SHA-256")
    migrations = migrations_of(name)
    assert migrations is not None
    with storage_faults(target):
        look_at(target, lambda db: pending_migrations(db, migrations, target))
    target.chmod(0o444 if target.parent.name == "maps" else 0o644)
    sync(target)


def _complete(staging: Path) -> None:
    """Make the folders that hold no file yet, and sync all of them."""
    catalog = staging / _CATALOG
    with storage_faults(catalog):
        listed = look_at(catalog, lambda db: listed_in(db, catalog))
    for domain in {domain for domain, _, _ in listed}:
        layout.traverses_folder(staging, domain).mkdir(parents=True, exist_ok=True)
        layout.maps_folder(staging, domain).mkdir(parents=True, exist_ok=True)
    for folder, _, _ in os.walk(staging, topdown=False):
        sync(Path(folder))


def _publish(staging: Path, data_dir: Path) -> None:
    """Let the unpacked files take their names, the catalog last: without it no service starts."""
    names = (layout.domains_folder(data_dir).name, _SESSIONS, _CATALOG)
    if any((data_dir / name).exists() for name in names):  # a command takes no lock
        raise ConflictError(f"{data_dir} is not empty any more: somebody else has begun to use it")
    for name in names:
        if (staging / name).exists():
            (staging / name).rename(data_dir / name)
    sync(data_dir)
    sync(data_dir.parent)


class _Counter:
    """Tells how far the work is, by bytes."""

    def __init__(self, n_expected: int, on_progress: Progress) -> None:
        self._n_expected = max(1, n_expected)
        self._on_progress = on_progress
        self._n_done = 0

    def add(self, n_bytes: int) -> None:
        self._n_done += n_bytes
        self._on_progress(min(1.0, self._n_done / self._n_expected))


class _Hashing:
    """A stream whose digest is that of what was read of it."""

    def __init__(self, stream: IO[bytes], counter: _Counter) -> None:
        self._stream = stream
        self._counter = counter
        self.digest = hashlib.sha256()

    def read(self, n_bytes: int = -1) -> bytes:
        piece = self._stream.read(n_bytes)
        self.digest.update(piece)
        self._counter.add(len(piece))
        return piece


def _info(name: str, n_bytes: int) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.size, info.mode, info.mtime = n_bytes, 0o600, int(time.time())
    return info


def _sizes(data_dir: Path) -> Iterator[int]:
    for pattern in ("*.sqlite*", "domains/*/*/*.sqlite*"):
        for path in data_dir.glob(pattern):
            with suppress(FileNotFoundError):
                yield path.stat().st_size


def _wrong(file: Path, why: str) -> InvalidArchiveError:
    return InvalidArchiveError(f"{file} cannot be restored: {why}", file=str(file))
