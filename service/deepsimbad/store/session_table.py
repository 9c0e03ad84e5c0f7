"""The statements on sessions. Every function stands inside a transaction of its caller."""

from typing import Any

from sqlite_utils import Database

from deepsimbad.errors import UnknownSessionError
from deepsimbad.store.documents import from_json, row_reader, to_json
from deepsimbad.store.list_page import ListPage
from deepsimbad.store.row_checksums import SESSIONS_FILE, verify_some
from deepsimbad.store.session_records import SessionRecord

_MAX_NUMBER = 2**63 - 1

_SELECT = """
    SELECT session.number, session_id, domain, map_version, map_sha256, config, created_at,
           coalesce(latest.expires_at, session.expires_at), coalesce(latest.sequence, 0), ending
    FROM session LEFT JOIN journal AS latest
      ON latest.session = session.number
     AND latest.sequence = (SELECT max(sequence) FROM journal WHERE session = session.number)
"""


@row_reader
def _record(row: tuple[Any, ...]) -> SessionRecord:
    number, session_id, domain, map_version, map_sha256, config, *rest = row
    return SessionRecord(number, session_id, domain, map_version, map_sha256, from_json(config), *rest)


def insert(db: Database, record: SessionRecord) -> SessionRecord:
    """Insert a session, whose number is given by the file; where there is one of that id, it stays and is returned."""
    db.execute(
        """
        INSERT INTO session (session_id, domain, map_version, map_sha256, config, created_at, expires_at)
        VALUES (?, ?, ?, ?, ?, ?, ?)
        ON CONFLICT (session_id) DO NOTHING
        """,
        [
            record.session_id,
            record.domain,
            record.map_version,
            record.map_sha256,
            to_json(record.config),
            record.created_at,
            record.expires_at,
        ],
    )
    return _get(db, record.session_id)  # its checksum comes with the end of the transaction


def get(db: Database, session_id: str) -> SessionRecord:
    """One session, living or ended; raises UnknownSessionError, DamagedFileError."""
    if session_id.isascii():
        verify_some(db, "session", "session_id = ?", [session_id], SESSIONS_FILE)
    return _get(db, session_id)


def _get(db: Database, session_id: str) -> SessionRecord:
    row = None
    if session_id.isascii():
        row = db.execute(f"{_SELECT} WHERE session_id = ?", [session_id]).fetchone()
    if row is None:
        raise UnknownSessionError(f"there is no session {session_id!a}")
    return _record(row)


def living(db: Database) -> list[SessionRecord]:
    """Every session that has not ended, oldest first; raises DamagedFileError where one is not what was stored."""
    verify_some(db, "session", "ended_at IS NULL", (), SESSIONS_FILE)
    return [_record(row) for row in db.execute(f"{_SELECT} WHERE session.ended_at IS NULL ORDER BY session.number")]


def newest_living(
    db: Database, domain: str | None, before: int | None, limit: int, at: float
) -> ListPage[SessionRecord, int]:
    """Sessions of a domain or all that live at a moment, newest first, from the one after number `before` on."""
    found = db.execute(
        f"""
        {_SELECT}
        WHERE session.ended_at IS NULL AND session.number < ? AND domain = coalesce(?, domain)
          AND coalesce(latest.expires_at, session.expires_at) > ?
        ORDER BY session.number DESC LIMIT ?
        """,
        [_MAX_NUMBER if before is None else before, domain, at, limit + 1],
    )
    return ListPage.of(((record.number, record) for record in map(_record, found)), limit)


def pins(db: Database) -> set[tuple[str, int]]:
    """Domain and map version of every session that has not ended."""
    return set(db.execute("SELECT DISTINCT domain, map_version FROM session WHERE ended_at IS NULL"))


def end(db: Database, number: int, ending: str, ended_at: float) -> bool:
    """End a session; its journal stays until it is purged.

    Returns:
        Whether it has ended by this: it had not before, and has indeed expired where that is to be its ending.
    """
    ended = db.execute(
        """
        UPDATE session SET ended_at = :at, ending = :ending
        WHERE number = :number AND ended_at IS NULL AND (:ending != 'expired' OR :at >= coalesce(
            (SELECT expires_at FROM journal WHERE session = :number ORDER BY sequence DESC LIMIT 1), expires_at))
        """,
        {"at": ended_at, "ending": ending, "number": number},
    ).rowcount
    if ended:
        db.execute("DELETE FROM snapshot WHERE session = ?", [number])
    return bool(ended)


def purge(db: Database, ended_before: float, max_rows: int) -> bool:
    """Forget sessions that ended before a moment, journals first, a limited number of rows at a time.

    Returns:
        Whether there is more to forget.
    """
    n_rows = db.execute(
        """
        DELETE FROM journal WHERE rowid IN (
            SELECT journal.rowid FROM session JOIN journal ON journal.session = session.number
            WHERE ended_at < ? LIMIT ?
        )
        """,
        [ended_before, max_rows],
    ).rowcount
    if n_rows >= max_rows:
        return True
    db.execute("DELETE FROM session WHERE ended_at < ?", [ended_before])
    return False
