"""The catalog's file: how it is opened, checked, read and written, and the domains in it."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from sqlite_utils import Database

from deepsimbad.errors import DamagedFileError, UnknownDomainError
from deepsimbad.store import layout
from deepsimbad.store.connection import (
    OpenFile,
    close_with_log,
    open_database,
    open_working_file,
    write_transaction,
)
from deepsimbad.store.data_dir import make_data_dir
from deepsimbad.store.durable import sync
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.records import DomainRecord, from_json
from deepsimbad_migrations.catalog.migrations import migrations

_DOMAINS = """
    SELECT domain.name, evaluator, closed, actions_m, active.version, domain.created_at
    FROM domain LEFT JOIN map AS active ON active.domain = domain.name AND active.state = 'active'
"""


class CatalogFile(OpenFile):
    """The open file; its parts say what stands in it. Usable from any thread and several processes.

    Args:
        data_dir: The data directory.
        db: The open catalog file.
    """

    def __init__(self, data_dir: Path, db: Database) -> None:
        super().__init__(layout.catalog_path(data_dir), db)
        self.data_dir = data_dir
        # Readers do not wait for who writes, nor for who waits to: a robot's answer needs the catalog.
        self._reader = open_database(self._path)
        self._reader_lock = threading.RLock()
        self._building: dict[tuple[str, int], int] = {}

    @classmethod
    def open(cls, data_dir: Path) -> Self:
        """Open the catalog of a data directory; makes both where they are missing."""
        path = layout.catalog_path(data_dir)
        make_data_dir(data_dir)
        with storage_faults(path):
            domains = layout.domains_folder(data_dir)
            has_domains = domains.is_dir() and any(domains.iterdir())  # looked at before the file, which comes first
            if has_domains and not path.exists():
                raise DamagedFileError(
                    f"{path.name} is missing beside a folder of domains: put a copy of it back, or move that folder",
                    file=path.name,
                )
            db = open_working_file(path, migrations, create=not has_domains)
            sync(data_dir)
        return cls(data_dir, db)

    def close(self) -> None:
        """Close the file. Maps that are being built through this object count as abandoned from here on."""
        with self._lock:
            for domain, version in list(self._building):
                self._give_up_building(domain, version)
            with self._reader_lock:
                self._reader.close()
            close_with_log(self._db, self._path)

    @contextmanager
    def _reading(self) -> Iterator[Database]:
        """What was committed before; inside a block of `_writing` too."""
        with self._reader_lock, storage_faults(self._path), self._reader.atomic() as db:
            yield db

    @contextmanager
    def _writing(self) -> Iterator[Database]:
        with self._lock, storage_faults(self._path):
            self.check_is_there()
            with write_transaction(self._db) as db:
                yield db

    def check(self) -> None:
        """Raise what keeps the file from being read."""
        with self._reading() as db:
            db.execute("SELECT name FROM domain LIMIT 1").fetchall()
        self.check_is_there()

    def _give_up_building(self, domain: str, version: int) -> None:
        descriptor = self._building.pop((domain, version), None)
        if descriptor is not None:
            os.close(descriptor)


def find_domain(db: Database, name: str) -> DomainRecord | None:
    """The domain of that name, if there is one."""
    if not layout.is_name(name):  # such a name cannot exist, and need not be valid Unicode either
        return None
    rows = db.execute(f"{_DOMAINS} WHERE domain.name = ?", [name])
    return next((_domain(row) for row in rows), None)


def get_domain(db: Database, name: str) -> DomainRecord:
    """The domain of that name; raises UnknownDomainError."""
    record = find_domain(db, name)
    if record is None:
        known = [row[0] for row in db.execute("SELECT name FROM domain ORDER BY name LIMIT 20")]
        raise UnknownDomainError(f"there is no domain {name!a}", known=known)
    return record


def all_domains(db: Database) -> list[DomainRecord]:
    """Every domain by name."""
    return [_domain(row) for row in db.execute(f"{_DOMAINS} ORDER BY domain.name")]


def _domain(row: tuple[Any, ...]) -> DomainRecord:
    name, evaluator, closed, actions_m, active_version, created_at = row
    return DomainRecord(
        name, from_json(evaluator), bool(closed), tuple(from_json(actions_m)), active_version, created_at
    )
