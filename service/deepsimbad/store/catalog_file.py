"""The catalog's file: how it is opened, checked, read and written."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Self

from sqlite_utils import Database

from deepsimbad.errors import DamagedFileError
from deepsimbad.store import layout
from deepsimbad.store.connection import check_integrity, migrate, open_database, use_write_ahead_log, write_transaction
from deepsimbad.store.data_dir import make_data_dir
from deepsimbad.store.durable import sync_folder
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.open_file import OpenFile
from deepsimbad.store.ownership import Owner
from deepsimbad.store.row_checksums import CATALOG_TABLES, RowChecksums, verify_rows
from deepsimbad.store.write_ahead_log import check_log
from deepsimbad_migrations.catalog.migrations import migrations


class CatalogFile(OpenFile):
    """The open file; its parts say what stands in it. Usable from any thread and several processes.

    Args:
        data_dir: The data directory.
        db: The open catalog file.
        checksums: Of its rows.
    """

    def __init__(self, data_dir: Path, db: Database, checksums: RowChecksums) -> None:
        super().__init__(layout.catalog_path(data_dir), db)
        self.data_dir = data_dir
        self._checksums = checksums
        # Readers do not wait for who writes, nor for who waits to: a robot's answer needs the catalog.
        self._reader = open_database(self._path)
        self._reader_lock = threading.RLock()
        self._owners = layout.owners_folder(data_dir)
        self._owner = Owner(self._owners)

    @classmethod
    def open(cls, data_dir: Path) -> Self:
        """Open the catalog of a data directory; makes both where they are missing."""
        path = layout.catalog_path(data_dir)
        make_data_dir(data_dir)
        with storage_faults(path), ExitStack() as on_error:
            domains = layout.domains_folder(data_dir)
            has_domains = domains.is_dir() and any(domains.iterdir())  # looked at before the rows: they come first
            check_log(path)
            db = open_database(path, create=True)
            on_error.callback(db.close)
            if has_domains and not db.table_names():
                raise DamagedFileError(
                    f"{path.name} is missing or empty beside a folder of domains: put a copy of it back, or move "
                    "the folder away",
                    file=path.name,
                )
            check_integrity(db, path)
            use_write_ahead_log(db)
            migrate(db, migrations, path)
            checksums = RowChecksums(db, CATALOG_TABLES)
            checksums.fill_if_new()
            verify_rows(db, CATALOG_TABLES, path.name)
            sync_folder(data_dir)
            on_error.pop_all()
        return cls(data_dir, db, checksums)

    def close(self) -> None:
        """Close the file. Unfinished work begun through this object counts as abandoned from here on."""
        with self._lock:
            self._owner.release()
            with self._reader_lock:
                self._reader.close()
            super().close()

    @contextmanager
    def _reading(self) -> Iterator[Database]:
        """What was committed before; inside a block of `_writing` too."""
        with self._reader_lock, storage_faults(self._path), self._reader.atomic() as db:
            yield db

    @contextmanager
    def _writing(self) -> Iterator[Database]:
        with self._lock, storage_faults(self._path), write_transaction(self._db) as db:
            yield db
            self._checksums.note()

    def check(self) -> None:
        """Raise what keeps the file from being read."""
        with self._reading() as db:
            db.execute("SELECT name FROM domain LIMIT 1").fetchall()
        if not self._path.exists():  # an open file goes on without its name, until it is closed
            raise DamagedFileError(f"{self._path.name} was removed under the running service", file=self._path.name)
