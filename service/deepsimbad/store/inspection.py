"""Every file of a data directory read and compared with what the catalog says of it; nothing is changed."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sqlite_utils import Database

from deepsimbad.errors import DeepSimbadError
from deepsimbad.store import layout
from deepsimbad.store.backup import Progress, listed_in, migrations_of
from deepsimbad.store.connection import look_at, pending_migrations
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.map_file import read_map
from deepsimbad.store.sealing import verify

_MOST_LINES = 20


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


def inspect(data_dir: Path, on_progress: Progress) -> Inspection:
    """Read everything, beside a running service or without one.

    What looks wrong is looked at a second time against the catalog as it is then, since files come and go meanwhile.

    Args:
        data_dir: The data directory.
        on_progress: Told how far it is; what it raises (a cancel) ends the inspection.
    """
    files = _files(data_dir)
    n_bytes, n_read = max(1, sum(_size(path) for path in files)), 0
    damaged = []
    for path, problems in files.items():
        damaged += [Finding(path.relative_to(data_dir).as_posix(), line) for line in problems(path)]
        n_read += _size(path)
        on_progress(min(1.0, n_read / n_bytes))
    if damaged:
        again = _files(data_dir)
        suspects = {data_dir / finding.file for finding in damaged}
        lasting = {path: set(again[path](path)) for path in suspects if path in again}
        damaged = [finding for finding in damaged if finding.what in lasting.get(data_dir / finding.file, ())]
    return Inspection(len(files), tuple(damaged))


def _files(data_dir: Path) -> dict[Path, Callable[[Path], list[str]]]:
    """What there is to read, as of now, and what finds its problems."""
    catalog = layout.catalog_path(data_dir)
    files: dict[Path, Callable[[Path], list[str]]] = {catalog: _database_problems}
    if layout.sessions_path(data_dir).exists():
        files[layout.sessions_path(data_dir)] = _database_problems
    files |= dict.fromkeys(sorted(data_dir.glob("domains/*/traverses/*.sqlite")), _database_problems)
    try:
        with storage_faults(catalog):
            listed = look_at(catalog, lambda db: listed_in(db, catalog))
    except DeepSimbadError:
        return files
    for domain, version, digest in sorted(listed):
        if version > 0:
            files[layout.map_path(data_dir, domain, version)] = partial(_map_problems, digest=digest)
    return files


def _database_problems(path: Path) -> list[str]:
    """Pages, references and schema of a SQLite file."""
    data_dir = path.parents[3] if path.parent.name == "traverses" else path.parent
    migrations = migrations_of(path.relative_to(data_dir).as_posix())
    assert migrations is not None

    def look(db: Database) -> list[str]:
        lines = list(_sqlite_problems(db))
        pending_migrations(db, migrations, path)
        return lines

    try:
        with storage_faults(path):
            return look_at(path, look)
    except DeepSimbadError as error:
        return [error.message]


def _map_problems(path: Path, digest: str) -> list[str]:
    """Digest and content of a sealed map."""
    try:
        verify(path, digest)
        read_map(path)
    except DeepSimbadError as error:
        return [error.message]
    return []


def _sqlite_problems(db: Database) -> Iterator[str]:
    for (verdict,) in db.execute(f"PRAGMA integrity_check({_MOST_LINES})"):
        if verdict != "ok":
            yield " ".join(str(verdict).split())
    for table, row, parent, _ in db.execute("PRAGMA foreign_key_check").fetchmany(_MOST_LINES):
        yield f"row {row} of {table} refers to a row of {parent} that is not there"


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
