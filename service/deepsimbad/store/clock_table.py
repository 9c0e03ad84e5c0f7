"""The statements on the clock of sessions. Every function stands inside a transaction of its caller."""

from sqlite_utils import Database

from deepsimbad.store.row_checksums import SESSIONS_FILE, verify_rows
from deepsimbad.store.session_records import ClockRecord


def save(db: Database, record: ClockRecord) -> None:
    """Put a moment in place of the one before."""
    db.execute(
        "INSERT OR REPLACE INTO clock (number, boot, booted_at, seen_at) VALUES (1, ?, ?, ?)",
        [record.boot, record.booted_at, record.seen_at],
    )


def read(db: Database) -> ClockRecord | None:
    """The moment noted last; None in a file that never noted one. Raises DamagedFileError where it is damaged."""
    verify_rows(db, ["clock"], SESSIONS_FILE)
    row = db.execute("SELECT boot, booted_at, seen_at FROM clock").fetchone()
    return None if row is None else ClockRecord(*row)


def latest_event(db: Database) -> float | None:
    """When the last thing happened that the sessions tell of; the journals of ended ones are not looked at."""
    (latest,) = db.execute(
        """
        SELECT max(moment) FROM (
            SELECT max(created_at) AS moment FROM session
            UNION ALL
            SELECT max(ended_at) FROM session
            UNION ALL
            SELECT max(written_at) FROM session JOIN journal
              ON journal.session = session.number
             AND journal.sequence = (SELECT max(sequence) FROM journal WHERE session = session.number)
             WHERE session.ended_at IS NULL
        )
        """
    ).fetchone()
    return None if latest is None else float(latest)
