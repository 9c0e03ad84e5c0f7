"""The schema of the file of live sessions, one frozen step after another.

A step that has shipped is never edited: a change is a new step. Run by the service when it opens the file, or by
`sqlite-utils migrate sessions.sqlite migrations/deepsimbad_migrations/session`.
"""

from sqlite_utils import Database, Migrations

migrations = Migrations("deepsimbad_session")


@migrations()
def m001_sessions_and_journal(db: Database) -> None:
    """Sessions, the journal of what happened to each, a snapshot of each one's state, and true positions fed back.

    Times are seconds since 1970. `ranks` holds twice the ranks as unsigned integers of 2 bytes (4 where there are more
    than 32,767 landmarks), `dissimilarities` and `encoding` are float32; all little-endian.
    """
    db.executescript(
        """
        CREATE TABLE session (
            number INTEGER PRIMARY KEY,
            session_id TEXT NOT NULL UNIQUE,
            domain TEXT NOT NULL,
            map_version INTEGER NOT NULL CHECK (map_version >= 1),
            map_sha256 TEXT NOT NULL,
            config TEXT NOT NULL,
            created_at REAL NOT NULL,
            expires_at REAL NOT NULL,
            ended_at REAL,
            ending TEXT CHECK (ending IN ('deleted', 'expired')),
            CHECK ((ended_at IS NULL) = (ending IS NULL))
        );
        CREATE INDEX session_ended ON session (ended_at);
        CREATE TABLE journal (
            session INTEGER NOT NULL REFERENCES session (number) ON DELETE CASCADE,
            sequence INTEGER NOT NULL CHECK (sequence >= 1),
            kind TEXT NOT NULL CHECK (kind IN ('observation', 'prior')),
            written_at REAL NOT NULL,
            expires_at REAL NOT NULL,
            idempotency_key TEXT,
            request_digest BLOB,
            action_m REAL,
            action_std_m REAL,
            ranks BLOB,
            dissimilarities BLOB,
            encoding BLOB,
            position_m REAL,
            std_m REAL,
            CHECK ((idempotency_key IS NULL) = (request_digest IS NULL)),
            CHECK (kind = 'prior' OR (action_m IS NOT NULL AND ranks IS NOT NULL)),
            CHECK (kind = 'observation' OR (position_m IS NOT NULL AND std_m IS NOT NULL))
        );
        CREATE UNIQUE INDEX journal_sequence ON journal (session, sequence);
        CREATE UNIQUE INDEX journal_key ON journal (session, idempotency_key) WHERE idempotency_key IS NOT NULL;
        CREATE TABLE snapshot (
            session INTEGER NOT NULL REFERENCES session (number) ON DELETE CASCADE,
            name TEXT NOT NULL,
            sequence INTEGER NOT NULL CHECK (sequence >= 1),
            dtype TEXT NOT NULL,
            shape TEXT NOT NULL,
            body BLOB NOT NULL,
            PRIMARY KEY (session, name)
        );
        CREATE TABLE true_positions (
            session INTEGER PRIMARY KEY REFERENCES session (number) ON DELETE CASCADE,
            received_at REAL NOT NULL,
            position_m BLOB NOT NULL
        );
        """
    )


@migrations()
def m002_clock(db: Database) -> None:
    """The one moment that the sessions' clock is carried on from; seconds since 1970.

    `boot` names the run of the operating system, `booted_at` when it began by the sessions' clock, `seen_at` the latest
    moment noted.
    """
    db.executescript(
        """
        CREATE TABLE clock (
            number INTEGER PRIMARY KEY CHECK (number = 1),
            boot TEXT,
            booted_at REAL NOT NULL,
            seen_at REAL NOT NULL
        );
        """
    )


@migrations()
def m003_row_checksums(db: Database) -> None:
    """A checksum in every row; NULL where none was computed yet."""
    for table in ("session", "journal", "snapshot", "true_positions", "clock"):
        db.execute(f"ALTER TABLE {table} ADD COLUMN checksum INTEGER")


@migrations()
def m004_without_clock_and_row_checksums(db: Database) -> None:
    """Sessions live by the computer's clock; SQLite is trusted with rows."""
    db.execute("DROP TABLE clock")
    for table in ("session", "journal", "snapshot", "true_positions"):
        db.execute(f"ALTER TABLE {table} DROP COLUMN checksum")


@migrations()
def m005_key(db: Database) -> None:
    """The API key that a session was begun with; NULL where none was asked, or nobody noted it."""
    db.execute("ALTER TABLE session ADD COLUMN key_id TEXT")
