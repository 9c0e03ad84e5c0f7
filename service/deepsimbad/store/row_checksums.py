"""A checksum in every row, so that a flipped bit on the disk is seen and not believed.

SQLite notices damage to its own structure, not to what is stored in it. Temporary triggers note which rows a connection
has changed; before the transaction ends their checksums are computed from what the file now holds. A file of an older
release has none at all, and is believed until they are filled in.
"""

import struct
import zlib
from collections.abc import Iterable, Sequence
from typing import Any

from sqlite_utils import Database

from deepsimbad.errors import DamagedFileError
from deepsimbad.store.connection import write_transaction

CATALOG_TABLES = ("domain", "map", "job", "api_key")
SESSION_TABLES = ("session", "journal", "snapshot", "true_positions", "clock")
SESSIONS_FILE = "sessions.sqlite"
_COLUMN = "checksum"


class RowChecksums:
    """Keeps the checksums of the rows that one connection writes.

    Args:
        db: The connection; every table has a column `checksum`.
        tables: The tables.
    """

    def __init__(self, db: Database, tables: Iterable[str]) -> None:
        self._db = db
        self._columns = {table: _columns(db, table) for table in tables}
        db.execute("PRAGMA temp_store = MEMORY")  # a full disk must not keep changes from being noted
        db.execute(
            "CREATE TEMP TABLE changed_row (name TEXT NOT NULL, row INTEGER NOT NULL, PRIMARY KEY (name, row)) "
            "WITHOUT ROWID"
        )
        for table, columns in self._columns.items():
            note = f"BEGIN INSERT OR IGNORE INTO changed_row VALUES ('{table}', NEW.rowid); END"  # noqa: S608 - ours
            for event, when in (("insert", "INSERT"), ("update", f"UPDATE OF {', '.join(columns)}")):
                db.execute(f"CREATE TEMP TRIGGER changed_{table}_{event} AFTER {when} ON main.{table} {note}")

    def note(self) -> None:
        """Compute the checksums of what was changed since; call it at the end of every write transaction."""
        changed = self._db.execute("SELECT name, row FROM changed_row").fetchall()
        if changed:
            self._db.execute("DELETE FROM changed_row")
            for table, row in changed:
                self._fill(table, "rowid = ?", (row,))

    def fill_if_new(self) -> None:
        """Compute the checksums of all rows of a file that an older release wrote."""
        if _has_none(self._db, self._columns):
            with write_transaction(self._db):
                for table in self._columns:
                    self._fill(table, f"{_COLUMN} IS NULL", ())
                self._db.execute("DELETE FROM changed_row")

    def _fill(self, table: str, where: str, parameters: Sequence[Any]) -> None:
        columns = self._columns[table]
        names = [column.encode() for column in columns]
        select = f"SELECT rowid, {', '.join(columns)} FROM {table} WHERE {where}"  # noqa: S608 - names of our own
        sums = [(_checksum(names, values), row) for row, *values in self._db.conn.execute(select, parameters)]
        self._db.conn.executemany(f"UPDATE {table} SET {_COLUMN} = ? WHERE rowid = ?", sums)  # noqa: S608


def verify_rows(db: Database, tables: Iterable[str], what: str) -> None:
    """Check every row of some tables.

    Args:
        db: The file.
        tables: The tables.
        what: What is damaged then, for the message.

    Raises:
        DamagedFileError: A row is not what was stored.
    """
    tables = list(tables)
    if not _has_none(db, tables):
        for table in tables:
            verify_some(db, table, "TRUE", (), what)


def verify_some(db: Database, table: str, where: str, parameters: Sequence[Any], what: str) -> None:
    """Check the rows of a table that fulfil a condition; otherwise as `verify_rows`."""
    columns = _columns(db, table)
    names = [column.encode() for column in columns]
    select = f"SELECT {_COLUMN}, {', '.join(columns)} FROM {table} WHERE {where}"  # noqa: S608 - names of our own
    for checksum, *values in db.conn.execute(select, parameters):
        if checksum != _checksum(names, values):
            raise DamagedFileError(f"{what} is damaged: a row of {table} does not match its checksum")


def _has_none(db: Database, tables: Iterable[str]) -> bool:
    """Whether no row of any of the tables has a checksum."""
    some = (f"SELECT 1 FROM {table} WHERE {_COLUMN} IS NOT NULL" for table in tables)  # noqa: S608 - names of our own
    return not any(db.execute(f"{query} LIMIT 1").fetchall() for query in some)


def _columns(db: Database, table: str) -> list[str]:
    """The columns of a table but the checksum's own."""
    return [row[1] for row in db.conn.execute(f"PRAGMA main.table_info({table})") if row[1] != _COLUMN]


def _checksum(names: Sequence[bytes], values: Sequence[Any]) -> int:
    """CRC-32 of what a row holds; a column that a later release adds, and is empty, changes nothing."""
    crc = 0
    for name, value in zip(names, values, strict=True):
        if value is None:
            continue
        if isinstance(value, bytes):
            kind, packed = b"b", value
        elif isinstance(value, str):
            kind, packed = b"s", value.encode()
        elif isinstance(value, float):
            kind, packed = b"f", struct.pack("<d", value)
        else:
            kind, packed = b"i", b"%d" % value
        crc = zlib.crc32(b"%b=%b%d:%b;" % (name, kind, len(packed), packed), crc)
    return crc
