"""Every file of a data directory read and compared with what the catalog says of it; nothing is changed."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from deepsimbad.errors import DeepSimbadError
from deepsimbad.store import layout
from deepsimbad.store.checkpoints import is_whole
from deepsimbad.store.file_checks import (
    catalog_listing,
    catalog_problems,
    has_file,
    map_problems,
    sessions_problems,
    traverse_problems,
)
from deepsimbad.store.left_over import Entry, entries, left_over

_LASTING_S = 0.5  # what a living process makes or removes is soon owned or gone


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
    """A file to read, what gives its problems, and which file it was when it was looked for: its inode, if any."""

    path: Path
    problems: Callable[[], list[str]]
    inode: int | None


def inspect(data_dir: Path, on_progress: Callable[[float], None]) -> Inspection:
    """Read everything, beside a running service or without one.

    What looks wrong is looked at a second time against the catalog as it is then, since files come and go meanwhile.

    Args:
        data_dir: The data directory.
        on_progress: Called with 0..1; what it raises (a cancel) ends the inspection.
    """
    tasks, unneeded = _look(data_dir)
    looked_at = time.monotonic()
    sizes = [_size(task.path) for task in tasks]
    n_bytes, n_read = max(1, sum(sizes)), 0
    suspects = []
    for task, size in zip(tasks, sizes, strict=True):
        if task.problems():
            suspects.append(task.path)
        n_read += size
        on_progress(n_read / n_bytes)
    if unneeded:
        time.sleep(max(0.0, looked_at + _LASTING_S - time.monotonic()))
    again, still_unneeded = _look(data_dir) if suspects or unneeded else (tasks, unneeded)
    damaged = [
        Finding(_named(data_dir, task.path), line)
        for task in again
        if task.path in suspects
        for line in _lasting_problems(task)
    ]
    confirmed = [
        Finding(_named(data_dir, entry.path), what)
        for entry, what in sorted(still_unneeded.items())
        if entry in unneeded  # else it is another one of that name, on its way in or out
    ]
    return Inspection(len(tasks), tuple(damaged), tuple(confirmed))


def _look(data_dir: Path) -> tuple[list[_Task], dict[Entry, str]]:
    """What there is to read, and what is there though nothing needs it, as of now."""
    present = entries(data_dir)  # before the catalog is read: it knows of whatever is there before it is
    catalog, sessions = layout.catalog_path(data_dir), layout.sessions_path(data_dir)
    tasks = [_task(catalog, catalog_problems), *_tasks([sessions], sessions_problems)]
    try:
        listing = catalog_listing(catalog)
    except DeepSimbadError:
        listing = None
    domains = layout.domains_folder(data_dir)
    folders = (entry.path.name for entry in present if entry.path.parent == domains)
    known = set(listing.maps) if listing else {name for name in folders if layout.is_name(name)}
    for name in sorted(known):
        maps = listing.maps[name] if listing else None
        for record in maps or []:
            if has_file(record):
                path = layout.map_path(data_dir, name, record.version)
                tasks.append(_task(path, partial(map_problems, record=record)))
        tasks += _tasks(layout.traverses_folder(data_dir, name).glob("*.sqlite"), traverse_problems)
    tasks += _tasks(data_dir.glob("jobs/*/*.checkpoint"), _checkpoint_problems)
    return tasks, left_over(data_dir, present, listing)


def _task(path: Path, problems: Callable[[Path], list[str]]) -> _Task:
    return _Task(path, partial(problems, path), _inode(path))


def _tasks(found: Iterable[Path], problems: Callable[[Path], list[str]]) -> list[_Task]:
    """Files that may be there or not, in the order of their paths."""
    tasks = [_task(path, problems) for path in sorted(found)]
    return [task for task in tasks if task.inode is not None]


def _lasting_problems(task: _Task) -> list[str]:
    """None if the file went, or another took its place, while it was read."""
    lines = list(dict.fromkeys(task.problems()))
    return lines if _inode(task.path) == task.inode else []


def _checkpoint_problems(path: Path) -> list[str]:
    return [] if is_whole(path) else [f"{path.name} is damaged: the job will do this stage anew"]


def _named(data_dir: Path, path: Path) -> str:
    return path.relative_to(data_dir).as_posix()


def _inode(path: Path) -> int | None:
    try:
        return path.stat().st_ino
    except OSError:
        return None


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
