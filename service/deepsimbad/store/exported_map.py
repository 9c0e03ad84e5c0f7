"""One sealed map version as a file to carry to another server."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from deepsimbad.errors import (
    ConflictError,
    DamagedMapError,
    InvalidInputError,
    NoActiveMapError,
    UnavailableError,
    UnknownMapVersionError,
)
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.durable import written_aside
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.map_table import removed
from deepsimbad.store.sealing import verify


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
    if not file.parent.is_dir():
        raise InvalidInputError(f"there is no folder {file.parent} for the map")
    source = catalog.map_path(domain, version)
    if not source.is_file():
        raise DamagedMapError(f"map {version} of domain {domain} is damaged: its file is missing", map_version=version)
    try:
        with storage_faults(file), written_aside(file) as new:
            shutil.copyfile(source, new)
            verify(new, record.sha256)
            new.chmod(0o444)
    except DamagedMapError as error:
        raise DamagedMapError(
            f"map {version} of domain {domain} is damaged: it was not exported", domain=domain, map_version=version
        ) from error
    except UnavailableError as error:
        if isinstance(error.__cause__, FileExistsError):
            raise ConflictError(f"{file} exists: an export never replaces a file, choose another name") from error
        raise
    return ExportReport(domain, version, str(file), file.stat().st_size, record.sha256)
