"""Turning a built map into the file that serves, checking later that it is still that file, and carrying it away."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from deepsimbad.errors import ConflictError, DamagedMapError, NoActiveMapError, UnknownMapVersionError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import removed
from deepsimbad.store.connection import check_integrity, open_database
from deepsimbad.store.durable import remove_database, sha256_of, sync, written_aside
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.layout import SEALING_SUFFIX
from deepsimbad.store.map_file import read_map


def seal(building_path: Path, final_path: Path) -> tuple[str, int]:
    """Seal a built map: check it, compact it, sync it, name it, make it read-only.

    The final name appears in one rename, after everything under it is on the disk; a crash before leaves no such file.
    The building file is gone afterwards.

    Returns:
        (SHA-256 in hex, bytes) of the sealed file.

    Raises:
        DamagedMapError: What was built cannot be read back.
        ConflictError: A file of the final name is there.
        UnavailableError: The disk is full, read-only, ...
    """
    with _taking_its_name(final_path) as sealing_path:
        with open_database(building_path) as db:
            check_integrity(db, building_path, DamagedMapError)
            db.conn.execute("VACUUM INTO ?", [str(sealing_path)])
        read_map(sealing_path)
        digest, n_bytes = sha256_of(sealing_path), sealing_path.stat().st_size
    with storage_faults(building_path):
        remove_database(building_path)
    return digest, n_bytes


def adopt(source: Path, final_path: Path, sha256: str) -> int:
    """Let the copy of a file that was sealed elsewhere take a final name; made as `seal` makes one.

    Returns:
        Its bytes.

    Raises:
        DamagedMapError: The copy does not match its digest.
        ConflictError: A file of the final name is there.
        UnavailableError: The disk is full, read-only, ...
    """
    with _taking_its_name(final_path) as sealing_path:
        shutil.copyfile(source, sealing_path)
        verify(sealing_path, sha256)
    return final_path.stat().st_size


@contextmanager
def _taking_its_name(final_path: Path) -> Iterator[Path]:
    """Where to write what, at the end of the block, is made read-only, synced and given its final name, or removed."""
    sealing_path = final_path.with_suffix(SEALING_SUFFIX)
    with storage_faults(final_path, DamagedMapError):
        if final_path.exists():
            raise ConflictError(f"{final_path.name} is sealed already; a sealed map never changes")
        remove_database(sealing_path)
        try:
            yield sealing_path
            sealing_path.chmod(0o444)
            sync(sealing_path)
            sealing_path.rename(final_path)
        except BaseException:
            remove_database(sealing_path)
            raise
        sync(final_path.parent)


def verify(path: Path, sha256: str) -> None:
    """Check a sealed file against the digest the catalog keeps.

    Raises:
        DamagedMapError: The file is missing or not the one that was sealed.
        UnavailableError: The disk failed, ...
    """
    if not path.is_file():
        raise DamagedMapError(f"{path.name} is missing", file=path.name)
    with storage_faults(path, DamagedMapError):
        digest = sha256_of(path)
    if digest != sha256:
        raise DamagedMapError(
            f"{path.name} is not the file that was sealed: its SHA-256 differs", file=path.name, sha256=digest
        )


@dataclass(frozen=True)
class ExportReport:
    """What was written where."""

    domain: str
    map_version: int
    file: str
    bytes: int
    sha256: str


def export_map(catalog: Catalog, domain: str, version: int | None, file: Path) -> ExportReport:
    """Copy a sealed map, byte for byte.

    Args:
        catalog: Of the data directory.
        domain: Whose map.
        version: Which; None: the active one.
        file: The new file; it appears when it is whole.

    Raises:
        UnknownDomainError, UnknownMapVersionError, NoActiveMapError: There is no such map.
        RetiredMapError: Its file was removed.
        DamagedMapError: Its file is not what was sealed; nothing is written.
        ConflictError: There is a file of that name.
        InvalidInputError: There is no folder for it.
        UnavailableError: The disk is full, ...
    """
    if version is None:
        version = catalog.domain(domain).active_version
        if version is None:
            raise NoActiveMapError(f"domain {domain} has no active map: name another with --version", domain=domain)
    record = catalog.map(domain, version)
    if record.removed_at is not None:
        raise removed(domain, version)
    if record.sha256 is None:
        raise UnknownMapVersionError(f"map {version} of domain {domain} is still being built", version=version)
    source = catalog.map_path(domain, version)
    if not source.is_file():
        raise DamagedMapError(f"map {version} of domain {domain} is damaged: its file is missing", map_version=version)
    try:
        with storage_faults(file), written_aside(file, "an export") as new:
            shutil.copyfile(source, new)
            verify(new, record.sha256)
            new.chmod(0o444)
    except DamagedMapError as error:
        raise DamagedMapError(
            f"map {version} of domain {domain} is damaged: it was not exported", domain=domain, map_version=version
        ) from error
    return ExportReport(domain, version, str(file), file.stat().st_size, record.sha256)
