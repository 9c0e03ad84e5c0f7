"""The schema of one traverse file, one frozen step after another.

A step that has shipped is never edited: a change is a new step. Run by the service when it opens the file, or by
`sqlite-utils migrate FILE migrations/deepsimbad_migrations/traverse`.
"""

from sqlite_utils import Database, Migrations

migrations = Migrations("deepsimbad_traverse")


@migrations()
def m001_frames(db: Database) -> None:
    """Frames with their places, and their encodings apart, so that counting frames does not read encodings."""
    db.executescript(
        """
        CREATE TABLE traverse (
            id INTEGER PRIMARY KEY CHECK (id = 1),
            created_at TEXT NOT NULL,
            encoding_dim INTEGER CHECK (encoding_dim >= 1)
        );
        CREATE TABLE frame (
            frame_index INTEGER PRIMARY KEY CHECK (frame_index >= 0),
            position_m REAL NOT NULL,
            timestamp_us INTEGER,
            x_m REAL,
            y_m REAL
        );
        CREATE TABLE encoding (
            frame_index INTEGER PRIMARY KEY REFERENCES frame (frame_index) ON DELETE CASCADE,
            checksum INTEGER NOT NULL,
            body BLOB NOT NULL
        );
        """
    )


@migrations()
def m002_weights(db: Database) -> None:
    """By which weights the images of the traverse were encoded. From here on a body may hold float16 too."""
    db.execute("ALTER TABLE traverse ADD COLUMN weights_sha256 TEXT")


@migrations()
def m003_without_checksums(db: Database) -> None:
    """SQLite is trusted with rows."""
    db.execute("ALTER TABLE encoding DROP COLUMN checksum")


@migrations()
def m004_frame_names(db: Database) -> None:
    """What a frame is called in its recording."""
    db.execute("ALTER TABLE frame ADD COLUMN name TEXT")


@migrations()
def m005_content_digests(db: Database) -> None:
    """What a frame was made of, to tell it from another one: eight bytes of a digest, as a signed integer."""
    db.execute("ALTER TABLE frame ADD COLUMN content_digest INTEGER")


@migrations()
def m006_pictures(db: Database) -> None:
    """By which grey levels pictures of more than 8 bits are shown, and which frames show nothing (NULL: not known)."""
    db.execute("ALTER TABLE traverse ADD COLUMN black INTEGER")
    db.execute("ALTER TABLE traverse ADD COLUMN white INTEGER")
    db.execute("ALTER TABLE frame ADD COLUMN shows_nothing INTEGER")


@migrations()
def m007_cameras(db: Database) -> None:
    """Which camera took a frame's picture, and how large it is shown, upright."""
    db.execute("ALTER TABLE frame ADD COLUMN camera TEXT")
    db.execute("ALTER TABLE frame ADD COLUMN image_width INTEGER")
    db.execute("ALTER TABLE frame ADD COLUMN image_height INTEGER")


@migrations()
def m008_spool(db: Database) -> None:
    """Pictures that wait to be fitted, as they were sent, and encodings (float32) of augmented views of frames."""
    for table in ("spool", "view_encoding"):
        db.execute(
            f"""
            CREATE TABLE {table} (
                frame_index INTEGER PRIMARY KEY REFERENCES frame (frame_index) ON DELETE CASCADE,
                body BLOB NOT NULL
            )
            """
        )
