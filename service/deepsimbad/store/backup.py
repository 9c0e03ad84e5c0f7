"""A whole data directory: copied into one tar file beside a service that goes on writing, restored, and inspected.

The last member, the manifest, holds the size and the SHA-256 of every other one. Any tar program can unpack it.
"""

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
from typing import Any

from sqlite_utils import Database, Migrations

from deepsimbad.errors import ConflictError, DamagedMapError, DeepSimbadError, InvalidArchiveError, UnavailableError
from deepsimbad.store import layout
from deepsimbad.store.connection import check_integrity, in_todays_schema, look_at, pending_migrations
from deepsimbad.store.durable import PRIVATE, service_lock, sha256_of, storage_faults, sync, verify, written_aside
from deepsimbad.store.layout import NAME_PATTERN
from deepsimbad.store.map_file import read_map
from deepsimbad.store.records import current_moment
from deepsimbad_migrations.catalog.migrations import migrations as catalog_migrations
from deepsimbad_migrations.map.migrations import migrations as map_migrations
from deepsimbad_migrations.session.migrations import migrations as session_migrations
from deepsimbad_migrations.thumbnail.migrations import migrations as thumbnail_migrations
from deepsimbad_migrations.traverse.migrations import migrations as traverse_migrations

Progress = Callable[[float], None]
"""Called with 0..1; what it raises (a cancel) ends the work and leaves nothing of it."""

_FORMAT = {"format": "deepsimbad-backup", "format_version": 1}
_MANIFEST = "manifest.json"
_CATALOG, _SESSIONS = "catalog.sqlite", "sessions.sqlite"
_MEMBERS: dict[str, Migrations] = {
    r"catalog\.sqlite": catalog_migrations,
    r"sessions\.sqlite": session_migrations,
    rf"domains/{NAME_PATTERN}/traverses/{NAME_PATTERN}\.sqlite": traverse_migrations,
    rf"domains/{NAME_PATTERN}/maps/\d{{6,16}}\.sqlite": map_migrations,
    rf"domains/{NAME_PATTERN}/thumbnails\.sqlite": thumbnail_migrations,
}
_MAX_TRIES = 10
_MAX_LINES = 20
_STAGING = ".restoring"

Inventory = frozenset[tuple[str, int, str]]
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


@dataclass(frozen=True)
class Finding:
    """One problem: the file, from the data directory on, and what is wrong with it."""

    file: str
    what: str


@dataclass(frozen=True)
class Inspection:
    """How many files were read, and which are damaged or missing."""

    n_files: int
    damaged: tuple[Finding, ...]


def migrations_of(name: str) -> Migrations | None:
    """The schema of a file, by its name in a data directory; None: a backup holds no such file."""
    return next((migrations for pattern, migrations in _MEMBERS.items() if re.fullmatch(pattern, name)), None)


def _inventory(path: Path, data_dir: Path) -> Inventory:
    """Read a catalog; of maps that a store keeps, those that have their files here. Raises DamagedFileError."""

    def read(db: Database) -> Inventory:
        with in_todays_schema(db, catalog_migrations, path) as current_db:
            rows = current_db.execute(
                "SELECT domain, version, sha256, shared FROM map WHERE state != 'building' AND removed_at IS NULL"
            ).fetchall()
            maps = [
                (domain, version, digest)
                for domain, version, digest, is_shared in rows
                if not is_shared or layout.map_path(data_dir, domain, version).exists()
            ]
            return frozenset([*maps, *current_db.execute("SELECT name, 0, created_at FROM domain").fetchall()])

    with storage_faults(path):
        return look_at(path, read)


def back_up(data_dir: Path, file: Path, release: str, on_progress: Progress) -> BackupReport:
    """Copy a data directory into one file, whether a service runs on it or not.

    Whatever was acknowledged before it began is in it, and everything that its sessions and its catalog speak of:
    sessions are copied first, the catalog after them, maps and traverses last. Every SQLite file is copied as of one
    moment; what is damaged is not copied, but named (DamagedFileError, DamagedMapError). The new file appears when it
    is whole; it replaces none (ConflictError).
    """
    catalog = layout.catalog_path(data_dir)
    with storage_faults(file), written_aside(file, "a backup") as new_path:
        for _ in range(_MAX_TRIES):
            created_at, problem = current_moment(), None
            members: list[dict[str, Any]] = []
            with tarfile.open(new_path, "w:", format=tarfile.PAX_FORMAT) as tar:
                new_path.chmod(0o600)  # it holds the hashes of keys and where robots were
                if layout.sessions_path(data_dir).exists():
                    members.append(_add_copy(tar, data_dir, layout.sessions_path(data_dir), new_path.parent))
                    (new_path.parent / _SESSIONS).unlink()
                members.append(_add_copy(tar, data_dir, catalog, new_path.parent))
                inventory = _inventory(new_path.parent / _CATALOG, data_dir)
                try:
                    for n_done, (domain, version, digest) in enumerate(sorted(inventory)):
                        on_progress(n_done / len(inventory))
                        if version > 0:
                            members.append(_add_map(tar, data_dir, domain, version, digest))
                        else:
                            members += _add_files(tar, data_dir, domain, new_path.parent)
                except UnavailableError as error:
                    problem = error
                manifest = {**_FORMAT, "release": release, "created_at": created_at, "files": members}
                content = json.dumps(manifest, indent=1).encode()
                info = tarfile.TarInfo(_MANIFEST)
                info.size, info.mode, info.mtime = len(content), 0o600, int(time.time())
                tar.addfile(info, io.BytesIO(content))
            if inventory <= _inventory(catalog, data_dir):  # else a damaged or missing file may have gone meanwhile
                break
        else:
            raise UnavailableError("maps come and go faster than they can be copied: try again", reason="busy")
        if problem is not None:
            raise problem
        on_progress(1.0)
        digest, n_bytes = sha256_of(new_path), new_path.stat().st_size
    n_maps = sum(version > 0 for _, version, _ in inventory)
    n_traverses = sum("/traverses/" in member["name"] for member in members)
    return BackupReport(str(file), n_bytes, digest, created_at, len(inventory) - n_maps, n_maps, n_traverses)


def _add_copy(tar: tarfile.TarFile, data_dir: Path, path: Path, folder: Path) -> dict[str, Any]:
    """Copy a SQLite file as of one moment into a folder, check the copy and add it."""
    copy = folder / path.name

    def write(db: Database) -> None:
        copy.unlink(missing_ok=True)
        db.execute("VACUUM INTO CAST(? AS TEXT)", [os.fsencode(copy)])  # UTF-8 or not

    with storage_faults(path):
        look_at(path, write)
        look_at(copy, lambda db: check_integrity(db, path))
    return _add(tar, path.relative_to(data_dir).as_posix(), copy)


def _add_files(tar: tarfile.TarFile, data_dir: Path, domain: str, folder: Path) -> Iterator[dict[str, Any]]:
    """Copy a domain's traverses and pictures; yields their entries for the manifest."""
    pictures = layout.thumbnails_path(data_dir, domain)
    traverses = sorted(layout.traverses_folder(data_dir, domain).glob("*.sqlite"))
    for path in [*traverses, pictures] if pictures.exists() else traverses:
        try:
            yield _add_copy(tar, data_dir, path, folder)
        except UnavailableError:
            if path.exists():
                raise  # else it was deleted meanwhile, and needs no copy
        (folder / path.name).unlink(missing_ok=True)


def _add_map(tar: tarfile.TarFile, data_dir: Path, domain: str, version: int, digest: str) -> dict[str, Any]:
    path = layout.map_path(data_dir, domain, version)
    try:
        verify(path, digest)
    except DamagedMapError as error:
        raise DamagedMapError(
            f"map {version} of domain {domain} is damaged or missing ({error.message}): nothing was backed up. Restore "
            "its file, or activate another version and delete this one",
            domain=domain,
            map_version=version,
        ) from error
    return _add(tar, path.relative_to(data_dir).as_posix(), path)


def _add(tar: tarfile.TarFile, name: str, path: Path) -> dict[str, Any]:
    info = tarfile.TarInfo(name)
    info.size, info.mode, info.mtime = path.stat().st_size, 0o600, int(time.time())
    with path.open("rb") as stream:
        tar.addfile(info, stream)
    return {"name": name, "bytes": info.size, "sha256": sha256_of(path)}


def restore(file: Path, data_dir: Path, on_progress: Progress) -> RestoreReport:
    """Make a data directory, absent or empty before, of a backup; nothing takes its name before all was checked.

    Raises:
        InvalidArchiveError: It is not a backup, was cut short or changed, or would write elsewhere.
        DataDirInUseError: A service runs on the data directory, or another restore is at work on it.
        ConflictError: The data directory is not empty.
        DamagedFileError: A newer release made it, or it holds triggers or views.
        UnavailableError: The disk is full, ...
    """
    data_dir = Path(os.path.realpath(data_dir))
    try:
        tar = tarfile.open(file, "r:")  # noqa: SIM115 - closed below
    except (OSError, tarfile.TarError) as error:
        raise _invalid_archive(file, f"it cannot be read, or is no backup: {error}") from error
    with tar, storage_faults(data_dir):
        manifest, members = _manifest(tar, file)
        with _staging(data_dir) as staging:
            for n_done, member in enumerate(members):
                on_progress(n_done / len(members))
                _unpack(tar, file, member, staging)
            for domain, _, _ in _inventory(staging / _CATALOG, staging):  # of those without files too
                layout.traverses_folder(staging, domain).mkdir(parents=True, exist_ok=True)
                layout.maps_folder(staging, domain).mkdir(parents=True, exist_ok=True)
            for folder, _, _ in os.walk(staging, topdown=False):
                sync(Path(folder))
            _publish(staging, data_dir)
    on_progress(1.0)
    n_bytes = sum(member["bytes"] for member in members)
    return RestoreReport(
        str(data_dir), len(members), n_bytes, str(manifest.get("created_at")), str(manifest.get("release"))
    )


def _manifest(tar: tarfile.TarFile, file: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Read the manifest and its members, which must be those that the backup holds; raises InvalidArchiveError."""
    try:
        infos = [info for info in tar.getmembers() if info.name != _MANIFEST]
        stream = tar.extractfile(_MANIFEST)
        manifest = json.load(stream) if stream else {}
        members = [
            {"name": member["name"], "bytes": int(member["bytes"]), "sha256": member["sha256"]}
            for member in manifest["files"]
        ]
    except (tarfile.TarError, OSError, AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise _invalid_archive(file, f"it is no backup, or was cut short or changed: {error}") from error
    if manifest.get("format") != _FORMAT["format"] or _CATALOG not in {member["name"] for member in members}:
        raise _invalid_archive(file, "it is no backup of a data directory")
    if manifest.get("format_version") != _FORMAT["format_version"]:
        raise _invalid_archive(file, "it was written by a newer release: upgrade this one")
    for info in infos:  # no links, devices, folders or files of other names
        if info.type != tarfile.REGTYPE or info.sparse is not None or migrations_of(info.name) is None:
            raise _invalid_archive(file, f"{info.name!a} has no place in it")
    sizes = sorted((info.name, info.size) for info in infos)
    if sizes != sorted((member["name"], member["bytes"]) for member in members):
        raise _invalid_archive(file, "its manifest does not list what is in it")
    return manifest, members


@contextmanager
def _staging(data_dir: Path) -> Iterator[Path]:
    """A folder to unpack into, inside the data directory, which is made or found empty, and held meanwhile."""
    is_new = not data_dir.exists()
    try:
        with service_lock(data_dir, "restoring a backup"):
            staging = data_dir / _STAGING
            paths = {path.name: path for path in data_dir.iterdir() if path != layout.service_lock_path(data_dir)}
            if _STAGING in paths and _CATALOG not in paths:  # a restore that was cut short
                for name in {_STAGING, _SESSIONS, layout.domains_folder(data_dir).name} & set(paths):
                    path = paths.pop(name)
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
            if paths:
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


def _unpack(tar: tarfile.TarFile, file: Path, member: dict[str, Any], staging: Path) -> None:
    """Copy a member into a new file; raises InvalidArchiveError where it is not what the manifest says."""
    name = member["name"]
    target = staging / name
    target.parent.mkdir(parents=True, exist_ok=True)
    stream, migrations = tar.extractfile(name), migrations_of(name)
    if stream is None or migrations is None:
        raise _invalid_archive(file, f"{name!a} has no place in it")
    with target.open("xb") as output:
        try:
            shutil.copyfileobj(stream, output)
        except tarfile.TarError as error:
            raise _invalid_archive(file, "it was cut short") from error
    if sha256_of(target) != member["sha256"]:
        raise _invalid_archive(file, f"{name} does not match its SHA-256")
    with storage_faults(target):
        look_at(target, lambda db: pending_migrations(db, migrations, target))
    target.chmod(0o444 if target.parent.name == "maps" else 0o644)
    sync(target)


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


def _invalid_archive(file: Path, reason: str) -> InvalidArchiveError:
    return InvalidArchiveError(f"{file} cannot be restored: {reason}", file=str(file))


def inspect(data_dir: Path, on_progress: Progress) -> Inspection:
    """Read every file and compare it with what the catalog says of it, beside a running service or without one.

    Nothing is changed. What looks wrong is looked at a second time against the catalog as it is then, since files come
    and go meanwhile.
    """
    files = _files(data_dir)
    problems = {}
    for n_read, (path, digest) in enumerate(files.items(), start=1):
        problems[path] = _problems(data_dir, path, digest)
        on_progress(n_read / len(files))
    new_files = _files(data_dir) if any(problems.values()) else {}
    findings = [
        Finding(path.relative_to(data_dir).as_posix(), line)
        for path in new_files
        if problems.get(path)
        for line in _problems(data_dir, path, new_files[path])
        if line in problems[path]
    ]
    return Inspection(len(files), tuple(findings))


def _files(data_dir: Path) -> dict[Path, str | None]:
    """The files that there are now, with the digests of those that are sealed maps."""
    catalog, sessions = layout.catalog_path(data_dir), layout.sessions_path(data_dir)
    files: dict[Path, str | None] = {catalog: None}
    if sessions.exists():
        files[sessions] = None
    for pattern in ("traverses/*.sqlite", "thumbnails.sqlite"):
        files |= dict.fromkeys(sorted(data_dir.glob(f"domains/*/{pattern}")), None)
    with suppress(DeepSimbadError):
        for domain, version, digest in sorted(_inventory(catalog, data_dir)):
            if version > 0:
                files[layout.map_path(data_dir, domain, version)] = digest
    return files


def _problems(data_dir: Path, path: Path, digest: str | None) -> list[str]:
    """What is wrong with a file: its digest and content where it is a sealed map, else pages, references and schema."""

    def look(db: Database) -> list[str]:
        lines = [line for (line,) in db.execute(f"PRAGMA integrity_check({_MAX_LINES})") if line != "ok"]
        for table, row, parent, _ in db.execute("PRAGMA foreign_key_check").fetchmany(_MAX_LINES):
            lines.append(f"row {row} of {table} refers to a row of {parent} that is not there")
        migrations = migrations_of(path.relative_to(data_dir).as_posix())
        if migrations is None:
            lines.append("no file of a data directory has such a name")
        else:
            pending_migrations(db, migrations, path)
        return [" ".join(line.split()) for line in lines]

    try:
        if digest is None:
            with storage_faults(path):
                return look_at(path, look)
        verify(path, digest)
        read_map(path)
    except DeepSimbadError as error:
        return [error.message]
    return []
