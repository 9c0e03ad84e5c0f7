"""The catalog's statements on API keys. Every function stands inside a transaction of its caller.

Rows are never deleted: whether a key was ever created decides whether the service runs open.
"""

from typing import Any

from sqlite_utils import Database

from deepsimbad.errors import UnknownKeyError
from deepsimbad.store.api_key import ApiKey, is_key_id
from deepsimbad.store.documents import now, row_reader
from deepsimbad.store.records import KeyRecord, KeyScope

_SELECT = "SELECT key_id, name, scope, secret_sha256, created_at, expires_at, revoked_at FROM api_key"


@row_reader
def _record(row: tuple[Any, ...]) -> KeyRecord:
    key_id, name, scope, secret_sha256, *times = row
    return KeyRecord(key_id, name, KeyScope(scope), secret_sha256, *times)


def insert(db: Database, key: ApiKey, scope: KeyScope, name: str, expires_at: str | None) -> KeyRecord:
    """Insert a key; of its secret only the digest."""
    db.execute(
        "INSERT INTO api_key (key_id, name, scope, secret_sha256, created_at, expires_at) VALUES (?, ?, ?, ?, ?, ?)",
        [key.key_id, name, scope.value, key.secret_sha256, now(), expires_at],
    )
    return get(db, key.key_id)


def get(db: Database, key_id: str) -> KeyRecord:
    """One key; raises UnknownKeyError."""
    row = None
    if is_key_id(key_id):  # other text cannot be one, and need not be valid Unicode either
        row = db.execute(f"{_SELECT} WHERE key_id = ?", [key_id]).fetchone()
    if row is None:
        raise UnknownKeyError(f"there is no key {key_id!a}: `deepsimbad keys list` shows them")
    return _record(row)


def all_keys(db: Database) -> list[KeyRecord]:
    """Every key that was ever created, oldest first."""
    return [_record(row) for row in db.execute(f"{_SELECT} ORDER BY rowid")]


def revoke(db: Database, key_id: str) -> KeyRecord:
    """Let a key open nothing any more; one that was revoked stays so since then. Raises UnknownKeyError."""
    get(db, key_id)
    db.execute("UPDATE api_key SET revoked_at = coalesce(revoked_at, ?) WHERE key_id = ?", [now(), key_id])
    return get(db, key_id)
