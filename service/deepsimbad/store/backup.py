"""A copy of a whole data directory, taken beside a service that goes on writing to it."""

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlite_utils import Database

from deepsimbad.errors import ConflictError, DamagedMapError, InvalidInputError, UnavailableError
from deepsimbad.store import domain_table, frame_table, layout, map_table
from deepsimbad.store.archive import ArchiveWriter
from deepsimbad.store.connection import check_integrity, in_todays_schema, look_at
from deepsimbad.store.documents import now
from deepsimbad.store.durable import written_aside
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.layout import NAME_PATTERN
from deepsimbad.store.records import DomainRecord, MapRecord, MapState
from deepsimbad.store.write_ahead_log import check_log
from deepsimbad_migrations.catalog.migrations import migrations as catalog_migrations

BACKUP_FORMAT = "deepsimbad-backup"
CATALOG, SESSIONS = "catalog.sqlite", "sessions.sqlite"
_MEMBER = re.compile(
    rf"catalog\.sqlite|sessions\.sqlite|domains/{NAME_PATTERN}/(?:traverses/{NAME_PATTERN}\.sqlite|maps/\d{{6,16}}\.sqlite)"
)
_MOST_TRIES = 10


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
class _Listed:
    """What a catalog says there is: domains, and the versions of each that have a file."""

    domains: dict[str, DomainRecord]
    maps: list[tuple[str, MapRecord]]


class _MovedOnError(Exception):
    """The catalog has changed since it was copied, and the files with it."""


def is_member(name: str) -> bool:
    """Whether a backup may hold a file of that name; none leads out of its folder."""
    return _MEMBER.fullmatch(name) is not None


def back_up(data_dir: Path, file: Path, release: str, on_progress: Callable[[float], None]) -> BackupReport:
    """Copy a data directory into one file, whether a service runs on it or not.

    Whatever was acknowledged before it began is in it, and everything that its sessions and its catalog speak of:
    sessions are copied first, the catalog after them, maps and traverses last. Every SQLite file is copied as of one
    moment; what is damaged is not copied, but named.

    Args:
        data_dir: The data directory.
        file: The new file; it appears when it is whole.
        release: Which release makes it.
        on_progress: Called with 0..1; what it raises (a cancel) ends the backup and leaves nothing.

    Raises:
        ConflictError: There is a file of that name.
        InvalidInputError: There is no folder for it.
        DamagedFileError, DamagedMapError: What is damaged, by name.
        UnavailableError: The disk is full, ...
    """
    if not file.parent.is_dir():
        raise InvalidInputError(f"there is no folder {file.parent} for the backup")
    try:
        with storage_faults(file), written_aside(file) as new:
            return _Backup(data_dir, file, new, on_progress).run(release)
    except UnavailableError as error:
        if isinstance(error.__cause__, FileExistsError):
            raise ConflictError(f"{file} exists: a backup never replaces a file, choose another name") from error
        raise


class _Backup:
    def __init__(self, data_dir: Path, file: Path, new: Path, on_progress: Callable[[float], None]) -> None:
        self._data_dir = data_dir
        self._file = file
        self._new = new
        self._copy = new.with_name("copy.sqlite")
        self._on_progress = on_progress
        self._n_expected = max(1, sum(_sizes(data_dir)))
        self._n_copied = 0

    def run(self, release: str) -> BackupReport:
        created_at = now()
        with self._new.open("xb") as stream:
            self._new.chmod(0o600)  # it holds the hashes of keys and where robots were
            archive = ArchiveWriter(stream, self._copied)
            if layout.sessions_path(self._data_dir).exists():
                self._add(archive, SESSIONS, layout.sessions_path(self._data_dir), _whole)
            mark = archive.mark()
            for _ in range(_MOST_TRIES):
                try:
                    listed = self._add_the_rest(archive)
                    break
                except _MovedOnError:
                    archive.rewind(mark)
            else:
                raise UnavailableError("maps come and go faster than they can be copied: try again", reason="busy")
            n_maps, n_domains = len(listed.maps), len(listed.domains)
            n_traverses = sum("/traverses/" in member.name for member in archive.members)
            about = {"format": BACKUP_FORMAT, "format_version": 1, "release": release, "created_at": created_at}
            digest = archive.finish(about)
        self._on_progress(1.0)
        n_bytes = self._new.stat().st_size
        return BackupReport(str(self._file), n_bytes, digest, created_at, n_domains, n_maps, n_traverses)

    def _add_the_rest(self, archive: ArchiveWriter) -> _Listed:
        """The catalog, and the files it speaks of; raises _MovedOnError where one of them went away meanwhile."""
        listed: _Listed = self._add(archive, CATALOG, layout.catalog_path(self._data_dir), _list)
        for domain, record in listed.maps:
            self._add_map(archive, domain, record)
        for domain in listed.domains:
            folder = layout.traverses_folder(self._data_dir, domain)
            for path in sorted(folder.glob("*.sqlite")) if folder.is_dir() else []:
                try:
                    self._add(archive, f"domains/{domain}/traverses/{path.name}", path, frame_table.verify)
                except UnavailableError:
                    if path.exists():
                        raise  # else it was deleted meanwhile, and needs no copy
        present = self._present()
        for name, listed_as in listed.domains.items():
            if name not in present.domains or present.domains[name].created_at != listed_as.created_at:
                raise _MovedOnError
        return listed

    def _add_map(self, archive: ArchiveWriter, domain: str, record: MapRecord) -> None:
        path = layout.map_path(self._data_dir, domain, record.version)
        try:
            member = archive.add(f"domains/{domain}/maps/{path.name}", path)
        except FileNotFoundError as error:
            self._still_listed(domain, record)
            raise self._damaged(domain, record, "is missing") from error
        if member.sha256 != record.sha256:
            self._still_listed(domain, record)
            raise self._damaged(domain, record, "is damaged: its SHA-256 differs")

    def _still_listed(self, domain: str, record: MapRecord) -> None:
        if (domain, record.version, record.sha256) not in {
            (name, one.version, one.sha256) for name, one in self._present().maps
        }:
            raise _MovedOnError

    def _damaged(self, domain: str, record: MapRecord, why: str) -> DamagedMapError:
        return DamagedMapError(
            f"map {record.version} of domain {domain} {why}: nothing was backed up. Restore its file, or activate "
            "another version and delete this one",
            domain=domain,
            map_version=record.version,
        )

    def _present(self) -> _Listed:
        path = layout.catalog_path(self._data_dir)
        with storage_faults(path):
            return look_at(path, lambda db: _list(db, path))

    def _add(self, archive: ArchiveWriter, name: str, path: Path, ask: Callable[[Database, Path], Any]) -> Any:
        """Copy a SQLite file as of one moment, and ask the copy something (which raises where it is damaged)."""

        def copy(db: Database) -> None:
            self._copy.unlink(missing_ok=True)
            db.execute("VACUUM INTO ?", [str(self._copy)])

        check_log(path)
        try:
            with storage_faults(path):
                look_at(path, copy)
                answer = look_at(self._copy, lambda db: ask(db, path))
        except UnavailableError as error:
            if error.hints.get("reason") == "disk_full":
                raise UnavailableError(f"{self._file}: no space is left to write it", reason="disk_full") from error
            raise
        archive.add(name, self._copy)
        self._copy.unlink()
        return answer

    def _copied(self, n_bytes: int) -> None:
        self._n_copied += n_bytes
        self._on_progress(min(1.0, self._n_copied / self._n_expected))


def _list(db: Database, path: Path) -> _Listed:
    check_integrity(db, path)
    with in_todays_schema(db, catalog_migrations, path) as current:
        domains = {record.name: record for record in domain_table.all_domains(current)}
        maps = [
            (domain, record)
            for domain in domains
            for record in map_table.of_domain(current, domain)
            if record.state is not MapState.BUILDING and record.removed_at is None
        ]
    return _Listed(domains, maps)


def _whole(db: Database, path: Path) -> None:
    check_integrity(db, path)


def _sizes(data_dir: Path) -> Iterator[int]:
    for pattern in ("*.sqlite*", "domains/*/*/*.sqlite*"):
        for path in data_dir.glob(pattern):
            with suppress(FileNotFoundError):
                yield path.stat().st_size
