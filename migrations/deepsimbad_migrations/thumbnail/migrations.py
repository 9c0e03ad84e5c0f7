"""The schema of a domain's thumbnails, one frozen step after another.

A step that has shipped is never edited: a change is a new step. Run by the service when it opens the file, or by
`sqlite-utils migrate thumbnails.sqlite migrations/deepsimbad_migrations/thumbnail`.
"""

from sqlite_utils import Database, Migrations

migrations = Migrations("deepsimbad_thumbnail")


@migrations()
def m001_thumbnails(db: Database) -> None:
    """A small JPEG of a frame, by the digest of its encoding, as a signed integer: so map images know theirs."""
    db.execute("CREATE TABLE thumbnail (frame_digest INTEGER PRIMARY KEY, body BLOB NOT NULL)")
