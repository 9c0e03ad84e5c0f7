"""The schema of one map file, one frozen step after another.

A step that has shipped is never edited: a change is a new step. Run by the service when it builds a map, or by
`sqlite-utils migrate FILE migrations/deepsimbad_migrations/map`.
"""

from sqlite_utils import Database, Migrations

migrations = Migrations("deepsimbad_map")

_ARRAY_TABLES = (
    "landmark_model",
    "landmark_statistics",
    "route",
    "listed_dissimilarity",
    "map_image_encoding",
    "q_value",
)


@migrations()
def m001_postings_and_arrays(db: Database) -> None:
    """The inverted index as packed posting lists, and everything beside it as named arrays.

    `posting` has no rowid: its key is the clustered order, so a list costs its bytes and about eleven more. The array
    tables hold large bodies and therefore keep their rowid (a row may then fill a page).
    """
    db.executescript(
        """
        CREATE TABLE map (
            id INTEGER PRIMARY KEY CHECK (id = 1),
            domain TEXT NOT NULL,
            version INTEGER NOT NULL,
            created_at TEXT NOT NULL,
            config TEXT NOT NULL,
            evaluator TEXT NOT NULL,
            closed INTEGER NOT NULL CHECK (closed IN (0, 1)),
            actions_m TEXT NOT NULL,
            metrics TEXT NOT NULL,
            n_map_images INTEGER NOT NULL,
            n_landmarks INTEGER NOT NULL,
            list_length INTEGER NOT NULL,
            checksum INTEGER NOT NULL
        );
        CREATE TABLE posting (
            landmark INTEGER NOT NULL,
            rank INTEGER NOT NULL,
            image_ids BLOB NOT NULL,
            PRIMARY KEY (landmark, rank)
        ) WITHOUT ROWID;
        """
    )
    for table in _ARRAY_TABLES:
        db.execute(
            f"""
            CREATE TABLE {table} (
                name TEXT NOT NULL,
                part INTEGER NOT NULL,
                dtype TEXT NOT NULL,
                shape TEXT NOT NULL,
                body BLOB NOT NULL,
                PRIMARY KEY (name, part)
            )
            """
        )


@migrations()
def m002_packed_experience(db: Database) -> None:
    """The experience database in one small b-tree: Q-values as whole steps above the lowest, compressed.

    With `part` as the key there is no second b-tree. Rows of before, plain numbers, stay as they are: they have no
    `step`.
    """
    db.executescript(
        """
        CREATE TABLE q_value_packed (
            part INTEGER PRIMARY KEY,
            name TEXT NOT NULL,
            dtype TEXT NOT NULL,
            shape TEXT NOT NULL,
            lowest REAL,
            step REAL,
            body BLOB NOT NULL
        );
        INSERT INTO q_value_packed (part, name, dtype, shape, body) SELECT part, name, dtype, shape, body FROM q_value;
        DROP TABLE q_value;
        ALTER TABLE q_value_packed RENAME TO q_value;
        """
    )


@migrations()
def m003_calibration(db: Database) -> None:
    """What two seasons of the route taught: trust in landmarks, telling places, views from off the route."""
    db.execute(
        """
        CREATE TABLE calibration (
            name TEXT NOT NULL,
            part INTEGER NOT NULL,
            dtype TEXT NOT NULL,
            shape TEXT NOT NULL,
            body BLOB NOT NULL,
            PRIMARY KEY (name, part)
        )
        """
    )


@migrations()
def m004_coded_lists(db: Database) -> None:
    """The index as blocks of coded lists, in route order: rows without landmark and rank.

    Posting lists of before stay as they are. With `part` as the key a block fills whole pages.
    """
    db.executescript(
        """
        CREATE TABLE posting_coded (
            part INTEGER PRIMARY KEY,
            landmark INTEGER,
            rank INTEGER,
            body BLOB NOT NULL
        );
        INSERT INTO posting_coded (landmark, rank, body)
            SELECT landmark, rank, image_ids FROM posting ORDER BY landmark, rank;
        DROP TABLE posting;
        ALTER TABLE posting_coded RENAME TO posting;
        """
    )


@migrations()
def m005_without_checksum(db: Database) -> None:
    """SQLite is trusted with rows; a sealed file has its SHA-256 in the catalog."""
    db.execute("ALTER TABLE map DROP COLUMN checksum")
