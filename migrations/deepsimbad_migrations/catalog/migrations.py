"""The catalog's schema, one frozen step after another.

A step that has shipped is never edited: a change is a new step. Run by the service when it opens the file, or by
`sqlite-utils migrate catalog.sqlite migrations/deepsimbad_migrations/catalog`.
"""

from sqlite_utils import Database, Migrations

migrations = Migrations("deepsimbad_catalog")


@migrations()
def m001_domains_maps_jobs(db: Database) -> None:
    """Domains, their map versions, jobs, and the folders of deleted domains that are still to be removed."""
    db.executescript(
        """
        CREATE TABLE domain (
            name TEXT NOT NULL PRIMARY KEY,
            evaluator TEXT NOT NULL,
            closed INTEGER NOT NULL CHECK (closed IN (0, 1)),
            actions_m TEXT NOT NULL,
            next_version INTEGER NOT NULL DEFAULT 1,
            created_at TEXT NOT NULL
        );
        CREATE TABLE map (
            domain TEXT NOT NULL REFERENCES domain (name) ON DELETE CASCADE,
            version INTEGER NOT NULL CHECK (version >= 1),
            state TEXT NOT NULL CHECK (state IN ('building', 'sealed', 'active', 'retired')),
            owner TEXT NOT NULL,
            created_at TEXT NOT NULL,
            sha256 TEXT,
            file_bytes INTEGER,
            config TEXT NOT NULL,
            metrics TEXT NOT NULL,
            PRIMARY KEY (domain, version),
            CHECK (state = 'building' OR (sha256 IS NOT NULL AND file_bytes IS NOT NULL))
        );
        CREATE UNIQUE INDEX map_one_active ON map (domain) WHERE state = 'active';
        CREATE TABLE job (
            job_id TEXT NOT NULL PRIMARY KEY,
            domain TEXT NOT NULL REFERENCES domain (name) ON DELETE CASCADE,
            kind TEXT NOT NULL,
            config TEXT NOT NULL,
            state TEXT NOT NULL CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
            owner TEXT NOT NULL,
            stage TEXT,
            progress REAL NOT NULL DEFAULT 0 CHECK (progress BETWEEN 0 AND 1),
            eta_s REAL,
            result TEXT,
            error TEXT,
            created_at TEXT NOT NULL,
            started_at TEXT,
            finished_at TEXT
        );
        CREATE INDEX job_domain ON job (domain);
        CREATE TABLE doomed_folder (domain TEXT NOT NULL PRIMARY KEY);
        """
    )


@migrations()
def m002_keys_served_times_job_starts(db: Database) -> None:
    """API keys' hashes, when a map version served and when its file was removed, how often a job was started."""
    db.executescript(
        """
        CREATE TABLE api_key (
            key_id TEXT NOT NULL PRIMARY KEY,
            name TEXT NOT NULL,
            scope TEXT NOT NULL CHECK (scope IN ('localize', 'admin')),
            secret_sha256 TEXT NOT NULL,
            created_at TEXT NOT NULL,
            expires_at TEXT,
            revoked_at TEXT
        );
        ALTER TABLE map ADD COLUMN activated_at TEXT;
        ALTER TABLE map ADD COLUMN retired_at TEXT;
        ALTER TABLE map ADD COLUMN removed_at TEXT;
        ALTER TABLE job ADD COLUMN n_starts INTEGER NOT NULL DEFAULT 0;
        """
    )


@migrations()
def m003_row_checksums(db: Database) -> None:
    """A checksum in every row; NULL where none was computed yet."""
    for table in ("domain", "map", "job", "api_key"):
        db.execute(f"ALTER TABLE {table} ADD COLUMN checksum INTEGER")


@migrations()
def m004_without_owners_and_row_checksums(db: Database) -> None:
    """A job belongs to the one service, a map being built to whoever locks its folder; SQLite is trusted with rows."""
    for table in ("domain", "map", "job", "api_key"):
        db.execute(f"ALTER TABLE {table} DROP COLUMN checksum")
    for table in ("map", "job"):
        db.execute(f"ALTER TABLE {table} DROP COLUMN owner")


@migrations()
def m005_domains_of_keys(db: Database) -> None:
    """The domains that a key opens, a JSON list; NULL: all."""
    db.execute("ALTER TABLE api_key ADD COLUMN domains TEXT")


@migrations()
def m006_options_of_domains(db: Database) -> None:
    """What of a domain is shown and how, a JSON object: `thumbnails`, `anchor`."""
    db.execute("ALTER TABLE domain ADD COLUMN options TEXT NOT NULL DEFAULT '{}'")


@migrations()
def m007_maps_shared_as_objects(db: Database) -> None:
    """The map store that is followed, as far as its log was read; which domains and map versions are in it."""
    db.executescript(
        """
        CREATE TABLE map_store (
            id INTEGER PRIMARY KEY CHECK (id = 1),
            url TEXT NOT NULL,
            store_id TEXT NOT NULL,
            position INTEGER NOT NULL
        );
        ALTER TABLE domain ADD COLUMN shared INTEGER NOT NULL DEFAULT 0;
        ALTER TABLE map ADD COLUMN shared INTEGER NOT NULL DEFAULT 0;
        """
    )


@migrations()
def m008_administrator_of_a_data_directory(db: Database) -> None:
    """Which of several that administer has the data directory, so that commands on it know; 0 where it is alone."""
    db.execute("ALTER TABLE map_store ADD COLUMN administrator INTEGER NOT NULL DEFAULT 0")
