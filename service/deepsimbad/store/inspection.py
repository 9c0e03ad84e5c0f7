"""Every file of a data directory read and compared with what the catalog says of it; nothing is changed."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from deepsimbad.errors import DeepSimbadError
from deepsimbad.store import layout
from deepsimbad.store.checkpoints import is_whole
from deepsimbad.store.file_checks import (
    CatalogListing,
    catalog_listing,
    catalog_problems,
    has_file,
    map_problems,
    sessions_problems,
    traverse_problems,
)
from deepsimbad.store.records import MapRecord, MapState

_SIDE_FILE = re.compile(r"(.+\.sqlite)-(?:wal|shm|journal)")
_MAP_WORK = re.compile(r"(\d{6,})\.(?:building|sealing)(?:-journal|-wal|-shm)?")
_NO_CATALOG = "the catalog cannot be read, so nobody knows whether it is needed"


@dataclass(frozen=True)
class Finding:
    """One problem: the file, from the data directory on, and what is wrong with it."""

    file: str
    what: str


@dataclass(frozen=True)
class Inspection:
    """What was found.

    Attributes:
        n_files: How many files were read.
        damaged: Files that are damaged or missing.
        left_over: Files that nothing needs; the next start of the service removes what a crash left.
    """

    n_files: int
    damaged: tuple[Finding, ...]
    left_over: tuple[Finding, ...]


@dataclass(frozen=True)
class _Task:
    """A file to read, and what gives its problems."""

    path: Path
    problems: Callable[[], list[str]]


def inspect(data_dir: Path, on_progress: Callable[[float], None]) -> Inspection:
    """Read everything, beside a running service or without one.

    What looks wrong is looked at a second time against the catalog as it is then, since files come and go meanwhile.

    Args:
        data_dir: The data directory.
        on_progress: Called with 0..1; what it raises (a cancel) ends the inspection.
    """
    tasks, left_over = _look(data_dir)
    sizes = [_size(task.path) for task in tasks]
    n_bytes, n_read = max(1, sum(sizes)), 0
    suspects = []
    for task, size in zip(tasks, sizes, strict=True):
        if task.problems():
            suspects.append(task.path)
        n_read += size
        on_progress(n_read / n_bytes)
    again, left_again = _look(data_dir) if suspects or left_over else (tasks, left_over)
    damaged = [
        Finding(_named(data_dir, task.path), line)
        for task in again
        if task.path in suspects
        for line in dict.fromkeys(task.problems())
    ]
    confirmed = [finding for finding in left_again if finding in left_over]
    return Inspection(len(tasks), tuple(damaged), tuple(confirmed))


def _look(data_dir: Path) -> tuple[list[_Task], list[Finding]]:
    """What there is to read, and what is there though nothing needs it, as of now."""
    catalog, sessions = layout.catalog_path(data_dir), layout.sessions_path(data_dir)
    tasks = [_Task(catalog, lambda: catalog_problems(catalog))]
    if sessions.exists():
        tasks.append(_Task(sessions, lambda: sessions_problems(sessions)))
    try:
        listing = catalog_listing(catalog)
    except DeepSimbadError:
        listing = None
    domains = layout.domains_folder(data_dir)
    present = {path.name for path in domains.iterdir()} if domains.is_dir() else set()
    known = set(listing.maps) if listing else {name for name in present if layout.is_name(name)}
    for name in sorted(known):
        maps = listing.maps[name] if listing else None
        tasks += [_map_task(data_dir, name, record) for record in maps or [] if has_file(record)]
        folder = layout.traverses_folder(data_dir, name)
        tasks += [_traverse_task(path) for path in sorted(folder.glob("*.sqlite"))]
    tasks += [_Task(path, _checkpoint_problems(path)) for path in sorted(data_dir.glob("jobs/*/*.checkpoint"))]
    return tasks, sorted(_left_over(data_dir, listing, present - known), key=lambda finding: finding.file)


def _map_task(data_dir: Path, domain: str, record: MapRecord) -> _Task:
    path = layout.map_path(data_dir, domain, record.version)
    return _Task(path, lambda: map_problems(path, record))


def _traverse_task(path: Path) -> _Task:
    return _Task(path, lambda: traverse_problems(path))


def _checkpoint_problems(path: Path) -> Callable[[], list[str]]:
    return lambda: [] if is_whole(path) else [f"{path.name} is damaged: the job will do this stage anew"]


def _left_over(data_dir: Path, listing: CatalogListing | None, strangers: set[str]) -> Iterator[Finding]:
    known = {"catalog.sqlite", "sessions.sqlite", "service.lock", "owners", "jobs", "domains", "lost+found"}
    for path in _entries(data_dir):
        side = _SIDE_FILE.fullmatch(path.name)
        if path.name not in known and not (side and side[1] in known and (data_dir / side[1]).exists()):
            yield Finding(_named(data_dir, path), "nothing of this name belongs here")
    for name in strangers:
        why = "it belongs to no domain" if listing else _NO_CATALOG
        yield Finding(_named(data_dir, layout.domains_folder(data_dir) / name), why)
    if listing is None:
        return
    for path in _entries(layout.jobs_folder(data_dir)):
        if path.name not in listing.unended_jobs:
            yield Finding(_named(data_dir, path), "its job has ended")
    for name, maps in listing.maps.items():
        yield from _left_over_of_domain(data_dir, name, maps)


def _left_over_of_domain(data_dir: Path, domain: str, maps: list[MapRecord]) -> Iterator[Finding]:
    for path in _entries(layout.domain_folder(data_dir, domain)):
        if path.name not in {"traverses", "maps"}:
            yield Finding(_named(data_dir, path), "nothing of this name belongs here")
    for path in _entries(layout.traverses_folder(data_dir, domain)):
        side = _SIDE_FILE.fullmatch(path.name)
        if path.suffix != ".sqlite" and not (side and path.with_name(side[1]).exists()):
            yield Finding(_named(data_dir, path), "no traverse owns it")
    for path in _entries(layout.maps_folder(data_dir, domain)):
        if not _is_owned(path, maps):
            yield Finding(_named(data_dir, path), "no map version owns it")


def _is_owned(path: Path, maps: list[MapRecord]) -> bool:
    work = _MAP_WORK.fullmatch(path.name)
    if work is not None:
        return any(record.version == int(work[1]) and record.state is MapState.BUILDING for record in maps)
    return any(path.name == f"{record.version:06d}.sqlite" and record.removed_at is None for record in maps)


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _named(data_dir: Path, path: Path) -> str:
    return path.relative_to(data_dir).as_posix()


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
