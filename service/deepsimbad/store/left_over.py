"""What lies in a data directory though nothing needs it: left by a crash, or put there by somebody."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from deepsimbad.store import layout
from deepsimbad.store.file_checks import CatalogListing
from deepsimbad.store.records import MapRecord, MapState

_AT_THE_TOP = {"catalog.sqlite", "sessions.sqlite", "service.lock", "owners", "jobs", "domains", "lost+found"}
_OF_A_DOMAIN = {"traverses", "maps"}
_SIDE_FILE = re.compile(r"(.+\.sqlite)-(?:wal|shm|journal)")
_MAP_WORK = re.compile(r"(\d{6,})\.(?:building|sealing)(?:-journal|-wal|-shm)?")
_STRANGE = "nothing of this name belongs here"


class Entry(NamedTuple):
    """A file or folder as it was once seen: another one of its name is another entry."""

    path: Path
    inode: int
    modified_ns: int


def entries(data_dir: Path) -> list[Entry]:
    """Everything that a data directory and its folders of jobs and domains hold."""
    domains = list(_inside(layout.domains_folder(data_dir)))
    parts = [part for domain in domains for part in _inside(domain.path)]
    files = [file for part in parts if part.path.name in _OF_A_DOMAIN for file in _inside(part.path)]
    return [*_inside(data_dir), *_inside(layout.jobs_folder(data_dir)), *domains, *parts, *files]


def left_over(data_dir: Path, present: list[Entry], listing: CatalogListing | None) -> dict[Entry, str]:
    """Which of the entries nothing needs, and why.

    Args:
        data_dir: The data directory.
        present: What lies there.
        listing: What the catalog says, read after the entries; None: it cannot be read.
    """
    paths = {entry.path for entry in present}

    def why(path: Path) -> str | None:
        side = _SIDE_FILE.fullmatch(path.name)
        main = side[1] if side is not None and path.with_name(side[1]) in paths else None
        match path.relative_to(data_dir).parts:
            case [name]:
                return None if name in _AT_THE_TOP or main in _AT_THE_TOP else _STRANGE
            case ["domains", domain]:
                return _why_no_domain(domain, listing)
            case ["jobs", job_id]:
                return None if listing is None or job_id in listing.unended_jobs else "its job has ended"
            case ["domains", domain, *rest] if listing is not None and domain in listing.maps:
                return _why_not_of_domain(rest, main is not None, listing.maps[domain])
        return None  # what can be said is said of its folder

    reasons = {entry: why(entry.path) for entry in present}
    return {entry: reason for entry, reason in reasons.items() if reason is not None}


def _why_no_domain(name: str, listing: CatalogListing | None) -> str | None:
    if listing is None:
        return None if layout.is_name(name) else "the catalog cannot be read, so nobody knows whether it is needed"
    return None if name in listing.maps else "it belongs to no domain"


def _why_not_of_domain(parts: list[str], is_side_file: bool, maps: list[MapRecord]) -> str | None:
    match parts:
        case ["traverses", name]:
            return None if is_side_file or name.endswith(".sqlite") else "no traverse owns it"
        case ["maps", name]:
            return None if _is_of_a_map(name, maps) else "no map version owns it"
        case [name]:
            return None if name in _OF_A_DOMAIN else _STRANGE
    return None


def _is_of_a_map(name: str, maps: list[MapRecord]) -> bool:
    work = _MAP_WORK.fullmatch(name)
    if work is not None:
        return any(record.version == int(work[1]) and record.state is MapState.BUILDING for record in maps)
    return any(name == f"{record.version:06d}.sqlite" and record.removed_at is None for record in maps)


def _inside(folder: Path) -> Iterator[Entry]:
    try:
        with os.scandir(folder) as found:
            for entry in found:
                try:
                    status = entry.stat(follow_symlinks=False)
                except FileNotFoundError:  # gone meanwhile
                    continue
                yield Entry(Path(entry.path), status.st_ino, status.st_mtime_ns)
    except (FileNotFoundError, NotADirectoryError):
        return
