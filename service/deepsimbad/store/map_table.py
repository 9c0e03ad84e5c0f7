"""The catalog's statements on map versions. Every function stands inside a transaction of its caller."""

from typing import Any, Final

from sqlite_utils import Database

from deepsimbad.errors import LostActivationError, RetiredMapError, UnknownMapVersionError
from deepsimbad.store.documents import from_json, now, now_behind, row_reader, to_json
from deepsimbad.store.list_page import ListPage
from deepsimbad.store.records import MapRecord, MapState


class AnyVersion:
    """The type of `ANY`."""

    def __repr__(self) -> str:
        """As it is written."""
        return "ANY"


ANY: Final = AnyVersion()
"""Activate whatever is active now."""

_SELECT = """
    SELECT version, state, created_at, sha256, file_bytes, config, metrics, activated_at, retired_at, removed_at
    FROM map
"""
_MAX_INTEGER = 2**63 - 1


@row_reader
def _record(row: tuple[Any, ...]) -> MapRecord:
    version, state, created_at, sha256, file_bytes, config, metrics, *times = row
    return MapRecord(
        version, MapState(state), created_at, sha256, file_bytes, from_json(config), from_json(metrics), *times
    )


def begin(db: Database, domain: str, config: dict[str, Any], owner: str) -> int:
    """Insert a version that is being built; numbers count from 1 and are never used again."""
    (version,) = db.execute("SELECT next_version FROM domain WHERE name = ?", [domain]).fetchone()
    db.execute("UPDATE domain SET next_version = next_version + 1 WHERE name = ?", [domain])
    db.execute(
        """
        INSERT INTO map (domain, version, state, owner, created_at, config, metrics)
        VALUES (?, ?, 'building', ?, ?, ?, '{}')
        """,
        [domain, version, owner, now(), to_json(config)],
    )
    return int(version)


def get(db: Database, domain: str, version: int) -> MapRecord:
    """One version; raises UnknownMapVersionError."""
    row = None
    if 1 <= version <= _MAX_INTEGER:
        row = db.execute(f"{_SELECT} WHERE domain = ? AND version = ?", [domain, version]).fetchone()
    if row is None:
        raise UnknownMapVersionError(f"domain {domain} has no map version {version}", version=version)
    return _record(row)


def of_domain(db: Database, domain: str) -> list[MapRecord]:
    """Every version of the domain, oldest first."""
    return [_record(row) for row in db.execute(f"{_SELECT} WHERE domain = ? ORDER BY version", [domain])]


def newest(db: Database, domain: str, before: int | None, limit: int) -> ListPage[MapRecord, int]:
    """Versions of the domain, newest first, from the one after version `before` on."""
    found = db.execute(
        f"{_SELECT} WHERE domain = ? AND version < ? ORDER BY version DESC LIMIT ?",
        [domain, _MAX_INTEGER if before is None else before, limit + 1],
    )
    return ListPage.of(((record.version, record) for record in map(_record, found)), limit)


def seal(db: Database, domain: str, version: int, sha256: str, file_bytes: int, metrics: dict[str, Any]) -> MapRecord:
    """Note that a version is built; raises UnknownMapVersionError where it is not being built."""
    n_changed = db.execute(
        """
        UPDATE map SET state = 'sealed', sha256 = ?, file_bytes = ?, metrics = ?
        WHERE domain = ? AND version = ? AND state = 'building'
        """,
        [sha256, file_bytes, to_json(metrics), domain, version],
    ).rowcount
    if n_changed != 1:
        raise UnknownMapVersionError(f"domain {domain} is not building a map version {version}", version=version)
    return get(db, domain, version)


def delete(db: Database, domain: str, version: int) -> None:
    """Delete the row of a version."""
    db.execute("DELETE FROM map WHERE domain = ? AND version = ?", [domain, version])


def activate(db: Database, domain: str, version: int, expected: int | AnyVersion | None) -> MapRecord:
    """Swap the active version, if it is still the expected one (None: there is none).

    Raises:
        UnknownMapVersionError: There is no such version, or it is still being built.
        RetiredMapError: Its file was removed.
        LostActivationError: Another version is active than the expected one.
    """
    chosen = get(db, domain, version)
    if chosen.removed_at is not None:
        raise removed(domain, version)
    if chosen.state is MapState.BUILDING:
        raise UnknownMapVersionError(f"map version {version} of domain {domain} is still being built", version=version)
    row = db.execute("SELECT version FROM map WHERE domain = ? AND state = 'active'", [domain]).fetchone()
    active = None if row is None else int(row[0])
    if not isinstance(expected, AnyVersion) and active != expected:
        raise LostActivationError(
            f"domain {domain} serves {_named(active)}, not {_named(expected)}: look again before you swap",
            active=active,
            expected=expected,
        )
    # Which one served last must be known though the clock was set back meanwhile: it is the one to roll back to.
    (latest,) = db.execute("SELECT max(retired_at) FROM map WHERE domain = ?", [domain]).fetchone()
    db.execute(
        "UPDATE map SET state = 'retired', retired_at = ? WHERE domain = ? AND state = 'active' AND version != ?",
        [now_behind(latest), domain, version],
    )
    db.execute(
        "UPDATE map SET state = 'active', activated_at = ? WHERE domain = ? AND version = ? AND state != 'active'",
        [now(), domain, version],
    )
    return get(db, domain, version)


def removed(domain: str, version: int) -> RetiredMapError:
    """What is said of a version whose file is no more."""
    return RetiredMapError(
        f"map {version} of domain {domain} was retired and its file removed: it cannot serve again",
        domain=domain,
        map_version=version,
    )


def _named(version: int | None) -> str:
    return "no map" if version is None else f"map version {version}"


def building(db: Database) -> list[tuple[str, int, str]]:
    """Every version being built: domain, version, owner."""
    return list(db.execute("SELECT domain, version, owner FROM map WHERE state = 'building'"))
