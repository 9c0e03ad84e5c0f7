"""The catalog's statements on map versions whose files are removed. Every function stands inside a transaction.

A version is marked first, in the catalog, and its file unlinked after that is on the disk: a crash between the two
leaves a file that no version owns, which the next start clears away.
"""

from collections.abc import Callable
from pathlib import Path

from sqlite_utils import Database

from deepsimbad.errors import MapInUseError
from deepsimbad.store import layout, map_table
from deepsimbad.store.documents import now
from deepsimbad.store.durable import remove_database, sync_folder
from deepsimbad.store.records import KeptMap, MapRecord, MapState


def kept(db: Database) -> list[KeptMap]:
    """Every sealed version of all domains that still has its file, oldest first."""
    rows = db.execute(
        """
        SELECT domain, version, state, retired_at FROM map
        WHERE state != 'building' AND removed_at IS NULL ORDER BY domain, version
        """
    )
    return [KeptMap(domain, version, MapState(state), retired_at) for domain, version, state, retired_at in rows]


def mark_removed(db: Database, domain: str, version: int, is_pinned: Callable[[], bool]) -> MapRecord:
    """Retire a version for good.

    Raises:
        UnknownMapVersionError: There is no such version.
        RetiredMapError: It was removed before.
        MapInUseError: It serves, is being built, or is pinned.
    """
    found = map_table.get(db, domain, version)
    if found.removed_at is not None:
        raise map_table.removed(domain, version)
    if found.state is MapState.ACTIVE:
        raise MapInUseError(
            f"map {version} of domain {domain} serves: activate another version first", map_version=version
        )
    if found.state is MapState.BUILDING:
        raise MapInUseError(
            f"map {version} of domain {domain} is being built: cancel the job that builds it", map_version=version
        )
    if is_pinned():
        raise MapInUseError(
            f"a session lives on map {version} of domain {domain}: end it or wait for its end", map_version=version
        )
    db.execute(
        "UPDATE map SET state = 'retired', removed_at = ? WHERE domain = ? AND version = ?", [now(), domain, version]
    )
    return map_table.get(db, domain, version)


def unlink_removed(db: Database, data_dir: Path, domain: str, version: int) -> None:
    """Remove the file of a version that was marked."""
    if map_table.get(db, domain, version).removed_at is not None:
        path = layout.map_path(data_dir, domain, version)
        remove_database(path)
        sync_folder(path.parent)
