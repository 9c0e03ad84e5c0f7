"""What can be said of one file by reading all of it; nothing is changed. Every function gives one line a problem."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from sqlite_utils import Database

from deepsimbad.errors import DeepSimbadError
from deepsimbad.store import (
    clock_table,
    domain_table,
    frame_table,
    job_table,
    journal_table,
    key_table,
    map_table,
    session_table,
)
from deepsimbad.store.connection import in_todays_schema, look_at
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.map_file import read_map
from deepsimbad.store.records import MapRecord, MapState
from deepsimbad.store.row_checksums import CATALOG_TABLES, SESSION_TABLES, verify_rows
from deepsimbad.store.sealing import verify
from deepsimbad.store.write_ahead_log import check_log
from deepsimbad_migrations.catalog.migrations import migrations as catalog_migrations
from deepsimbad_migrations.session.migrations import migrations as session_migrations
from deepsimbad_migrations.traverse.migrations import migrations as traverse_migrations

_MOST_LINES = 20


@dataclass(frozen=True)
class CatalogListing:
    """What a catalog says there is: every domain's map versions, and the jobs that have not ended."""

    maps: dict[str, list[MapRecord]]
    unended_jobs: frozenset[str]


def catalog_listing(path: Path) -> CatalogListing:
    """Read a catalog whole.

    Raises:
        DamagedFileError: It cannot be read, or a newer release wrote it.
        UnavailableError: It is not there, ...
    """

    def read(db: Database) -> CatalogListing:
        with in_todays_schema(db, catalog_migrations, path) as current:
            verify_rows(current, CATALOG_TABLES, path.name)
            domains = [record.name for record in domain_table.all_domains(current)]
            job_table.list_jobs(current, None)
            key_table.all_keys(current)
            return CatalogListing(
                {name: map_table.of_domain(current, name) for name in domains},
                frozenset(job_id for job_id, _ in job_table.unfinished(current)),
            )

    check_log(path)
    with storage_faults(path):
        return look_at(path, read)


def catalog_problems(path: Path) -> list[str]:
    """Pages, references and rows of the catalog."""
    return _problems(path, lambda: catalog_listing(path))


def sessions_problems(path: Path) -> list[str]:
    """Pages, references and rows of the sessions."""

    def read(db: Database) -> list[str]:
        with in_todays_schema(db, session_migrations, path) as current:
            lines: list[str] = []
            verify_rows(current, SESSION_TABLES, path.name)
            clock_table.read(current)
            for session in session_table.living(current):
                rows = journal_table.read(current, session.number, 0, 2**62)
                if [row.sequence for row in rows] != list(range(1, len(rows) + 1)):
                    lines.append(f"the journal of session {session.session_id} has a gap")
                snapshot = journal_table.read_snapshot(current, session.number)
                if snapshot is not None and snapshot.sequence > len(rows):
                    lines.append(f"the snapshot of session {session.session_id} is of no row of its journal")
            return lines

    return _problems(path, lambda: look_at(path, read))


def traverse_problems(path: Path) -> list[str]:
    """Pages of a traverse, and the checksum of every frame."""

    def read(db: Database) -> list[str]:
        with in_todays_schema(db, traverse_migrations, path) as current:
            frame_table.verify(current, path)
        return []

    return _problems(path, lambda: look_at(path, read))


def map_problems(path: Path, record: MapRecord) -> list[str]:
    """Digest and content of a sealed map."""
    try:
        verify(path, record.sha256 or "")
        read_map(path)
    except DeepSimbadError as error:
        return [error.message]
    return []


def has_file(record: MapRecord) -> bool:
    """Whether a version's sealed file should be there."""
    return record.state is not MapState.BUILDING and record.removed_at is None


def _problems(path: Path, read: Callable[[], object]) -> list[str]:
    """What SQLite finds, then what reading the rows finds."""
    try:
        check_log(path)
        with storage_faults(path):
            lines = look_at(path, lambda db: list(_sqlite_problems(db)))
            found = read()
    except DeepSimbadError as error:
        return [error.message]
    return [*lines, *(found if isinstance(found, list) else [])]


def _sqlite_problems(db: Database) -> Iterator[str]:
    for (verdict,) in db.execute(f"PRAGMA integrity_check({_MOST_LINES})"):
        if verdict != "ok":
            yield " ".join(str(verdict).split())
    for table, row, parent, _ in db.execute("PRAGMA foreign_key_check").fetchmany(_MOST_LINES):
        yield f"row {row} of {table} refers to a row of {parent} that is not there"
