"""What the catalog says of map versions: which are built, sealed, active, retired, and where their files lie."""

import fcntl
import os
import threading
from collections.abc import Callable, Collection, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, Final

from sqlite_utils import Database

from deepsimbad.errors import (
    DamagedMapError,
    LostActivationError,
    MapInUseError,
    RetiredMapError,
    UnknownMapVersionError,
    nearest_of,
)
from deepsimbad.store import layout
from deepsimbad.store.connection import OpenFile, open_database
from deepsimbad.store.durable import lock_folder, remove_database, sync, verify
from deepsimbad.store.records import (
    ListPage,
    MapRecord,
    MapState,
    current_moment,
    from_json,
    get_domain,
    to_json,
)

_SELECT_MAP = """
    SELECT domain, version, state, created_at, sha256, file_bytes, config, metrics, activated_at, retired_at, removed_at
    FROM map
"""
_MAX_INTEGER = 2**63 - 1


class AnyVersion(Enum):
    """What `activate` expects where any version, or none, may be active."""

    ANY = "any"


ANY: Final = AnyVersion.ANY


class MapCatalog(OpenFile):
    """The map versions of all domains, and the locks of those that this process builds."""

    is_in_use: Callable[[str, int, str], bool] = staticmethod(lambda _domain, _version, _sha256: False)
    """Whether a map, by its domain, version and digest, is in memory or pinned: where it is shared its file stays."""

    def __init__(self, data_dir: Path, db: Database) -> None:
        path = layout.catalog_path(data_dir)
        super().__init__(path, db, open_database(path))  # a robot's answer needs the catalog: it waits for no writer
        self.data_dir = data_dir
        self.follow_lock = threading.Lock()  # held by a caller of `follow` until the changes are served
        self._building_locks: dict[tuple[str, int], int] = {}  # descriptors of locked folders

    def close(self) -> None:
        """Close the file. Maps that are being built through this object count as abandoned from here on."""
        with self._lock:
            for domain, version in list(self._building_locks):
                self._unlock_building(domain, version)
            super().close()

    def begin_map(self, domain: str, config: dict[str, Any]) -> int:
        """Take the next version number for a map to be built; raises UnknownDomainError.

        Numbers count from 1 and are never used again. Until the version is sealed or discarded the domain's folder of
        maps is locked, shared: the kernel ends that with the process, so that others can tell what was abandoned.
        """
        with self._writing() as db:
            get_domain(db, domain)
            (version,) = db.execute("SELECT next_version FROM domain WHERE name = ?", [domain]).fetchone()
            db.table("domain").update(domain, {"next_version": version + 1})
            row = {"domain": domain, "version": version, "state": MapState.BUILDING, "created_at": current_moment()}
            db.table("map").insert({**row, "config": to_json(config), "metrics": "{}"})
            folder = layout.maps_folder(self.data_dir, domain)
            self._building_locks[domain, version] = lock_folder(folder, fcntl.LOCK_SH)
        return int(version)

    def seal_map(self, domain: str, version: int, sha256: str, file_bytes: int, metrics: dict[str, Any]) -> MapRecord:
        """Note that the sealed file of a version lies at `map_path`.

        Raises:
            UnknownMapVersionError: The version is not being built.
            DamagedMapError: The file is missing or has another size.
        """
        path = self.map_path(domain, version)
        with self._writing() as db:
            _check_is_building(db, domain, version)
            if not path.is_file() or path.stat().st_size != file_bytes:
                raise DamagedMapError(f"{path.name} is not the file that was sealed", file=path.name)
            row = {"state": MapState.SEALED, "sha256": sha256, "file_bytes": file_bytes, "metrics": to_json(metrics)}
            db.table("map").update((domain, version), row)
            record = _get_map(db, domain, version)
        self._unlock_building(domain, version)
        return record

    def discard_map(self, domain: str, version: int) -> None:
        """Forget a version that was being built, files first; raises UnknownMapVersionError."""
        with self._writing() as db:
            _check_is_building(db, domain, version)
            self._discard(db, domain, version)
        self._unlock_building(domain, version)

    def discard_abandoned_maps(self) -> list[str]:
        """Discard the maps that dead processes were building; returns one line for each.

        Those of a domain wait for the next time while a living process builds one of it.
        """
        with self._writing() as db:
            unfinished_maps = db.execute("SELECT domain, version FROM map WHERE state = 'building'").fetchall()
            living_domains = {domain for domain, _ in unfinished_maps if self._is_built(domain)}
            abandoned_maps = [(domain, version) for domain, version in unfinished_maps if domain not in living_domains]
            for domain, version in abandoned_maps:
                self._discard(db, domain, version)
        return [f"discarded the unfinished map {version} of domain {domain}" for domain, version in abandoned_maps]

    def _discard(self, db: Database, domain: str, version: int) -> None:
        path = self.map_path(domain, version)
        for file in (self.building_path(domain, version), path.with_suffix(".sealing"), path):
            remove_database(file)
        db.table("map").delete((domain, version))

    def _is_built(self, domain: str) -> bool:
        """Whether a living process builds a map of a domain."""
        try:
            descriptor = lock_folder(layout.maps_folder(self.data_dir, domain), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except FileNotFoundError:
            return False
        except BlockingIOError:
            return True
        os.close(descriptor)
        return False

    def _unlock_building(self, domain: str, version: int) -> None:
        descriptor = self._building_locks.pop((domain, version), None)
        if descriptor is not None:
            os.close(descriptor)

    def activate(self, domain: str, version: int, expected: int | AnyVersion | None) -> MapRecord:
        """Let a version serve, forward or back, if the active one is still `expected` (None: none; `ANY`).

        Raises:
            UnknownDomainError: There is no such domain.
            UnknownMapVersionError: There is no such version, or it is still being built.
            RetiredMapError: Its file was removed.
            LostActivationError: Another version was activated meanwhile.
        """
        with self._writing() as db:
            active_version = get_domain(db, domain).active_version
            record = _get_map(db, domain, version)
            if record.removed_at is not None:
                raise removal_error(domain, version)
            if record.state is MapState.BUILDING:
                raise UnknownMapVersionError(
                    f"map version {version} of domain {domain} is still being built", version=version
                )
            if expected is not ANY and active_version != expected:
                raise LostActivationError(
                    f"domain {domain} serves {_version_label(active_version)}, not {_version_label(expected)}: look "
                    "again before you swap",
                    active=active_version,
                    expected=expected,
                )
            if active_version != version:
                # Which one served last must be known though the clock was set back: it is the one to roll back to.
                (last_retired_at,) = db.execute("SELECT max(retired_at) FROM map WHERE domain = ?", [domain]).fetchone()
                if active_version is not None:
                    row = {"state": MapState.RETIRED, "retired_at": current_moment(behind=last_retired_at)}
                    db.table("map").update((domain, active_version), row)
                db.table("map").update((domain, version), {"state": MapState.ACTIVE, "activated_at": current_moment()})
            return _get_map(db, domain, version)

    def kept_maps(self, domain: str | None = None, min_beside: int = -1) -> list[MapRecord]:
        """The sealed versions that still have their files, by domain, oldest first.

        Args:
            domain: Whose versions; None: those of all.
            min_beside: Only those of domains that have more than so many beside the one that serves.
        """
        with self._reading() as db:
            rows = db.execute(
                f"""
                {_SELECT_MAP} WHERE state != 'building' AND removed_at IS NULL AND domain IN (
                    SELECT domain FROM map
                    WHERE state != 'building' AND removed_at IS NULL AND domain = coalesce(?, domain)
                    GROUP BY domain HAVING sum(state != 'active') > ?
                ) ORDER BY domain, version
                """,  # noqa: S608 - of our own words
                [domain, min_beside],
            )
            return list(map(_map, rows))

    def remove_map(self, domain: str, version: int, is_pinned: Callable[[], bool]) -> None:
        """Remove the file of a version; its row stays, retired.

        `is_pinned` is asked while nothing changes in this catalog: who pins a version first, and then finds it here
        without `removed_at`, keeps it. It must not wait for anyone who waits for the catalog.

        Raises:
            UnknownDomainError, UnknownMapVersionError: There is no such version.
            RetiredMapError: It was removed before.
            MapInUseError: It serves, is being built, or is pinned.
        """
        with self._writing() as db:
            get_domain(db, domain)
            record = _get_map(db, domain, version)
            if record.removed_at is not None:
                raise removal_error(domain, version)
            label, reason = f"map {version} of domain {domain}", None
            if record.state is MapState.ACTIVE:
                reason = f"{label} serves: activate another version first"
            elif record.state is MapState.BUILDING:
                reason = f"{label} is being built: cancel the job that builds it"
            elif is_pinned():
                reason = f"a session lives on {label}: end it or wait for its end"
            if reason is not None:
                raise MapInUseError(reason, map_version=version)
            db.table("map").update((domain, version), {"state": MapState.RETIRED, "removed_at": current_moment()})
        with self._lock:  # marked first: after a crash between the two the next start removes the file
            self._unlink(domain, version)

    def _unlink(self, domain: str, version: int) -> bool:
        path = self.map_path(domain, version)
        was_there = path.exists() and remove_database(path)
        if was_there:
            sync(path.parent)
        return was_there

    def newest_maps(self, domain: str, last_key: int | None, limit: int) -> ListPage[MapRecord, int]:
        """A page of a domain's map versions, newest first, behind version `last_key`; raises UnknownDomainError."""
        with self._reading() as db:
            get_domain(db, domain)
            rows = db.execute(
                f"{_SELECT_MAP} WHERE domain = ? AND version < ? ORDER BY version DESC LIMIT ?",
                [domain, _MAX_INTEGER if last_key is None else last_key, limit + 1],
            )
            return ListPage.of(((record.version, record) for record in map(_map, rows)), limit)

    def maps(self, domain: str) -> list[MapRecord]:
        """Every map version, oldest first; raises UnknownDomainError."""
        return list(reversed(self.newest_maps(domain, None, _MAX_INTEGER - 1).records))

    def map(self, domain: str, version: int) -> MapRecord:
        """One map version; raises UnknownDomainError, UnknownMapVersionError."""
        with self._reading() as db:
            get_domain(db, domain)
            return _get_map(db, domain, version)

    def map_anywhere(self, domain: str, version: int) -> MapRecord:
        """As `map`; a catalog that is shared also finds a version that another machine has published this moment."""
        return self.map(domain, version)

    def settled_map(self, domain: str, version: int) -> MapRecord:
        """As `map`, after any change that this process is making: a removal is done, or has not begun."""
        with self._lock:
            return self.map(domain, version)

    def sealed_digest(self, domain: str, version: int) -> str:
        """The digest of a version that was sealed and not removed, after any change that this process is making.

        Raises:
            UnknownDomainError, UnknownMapVersionError: There is no such version, or it is still being built.
            RetiredMapError: Its file was removed.
        """
        record = self.settled_map(domain, version)
        if record.removed_at is not None:
            raise removal_error(domain, version)
        if record.sha256 is None:
            raise UnknownMapVersionError(f"map {version} of domain {domain} is still being built", version=version)
        return record.sha256

    def serving_maps(self, domains: Collection[str]) -> dict[str, MapRecord]:
        """The active versions of these domains, as far as there are any."""
        with self._reading() as db:
            rows = db.execute(
                f"{_SELECT_MAP} WHERE state = 'active' AND domain IN (SELECT value FROM json_each(?))",  # noqa: S608
                [to_json(list(domains))],
            )
            return {record.domain: record for record in map(_map, rows)}

    def map_of_job(self, domain: str, job_id: str) -> MapRecord | None:
        """The version that a job has sealed, whatever became of it since; raises UnknownDomainError."""
        with self._reading() as db:
            get_domain(db, domain)
            condition = "domain = ? AND metrics ->> 'job_id' = ? ORDER BY version DESC LIMIT 1"
            return next(map(_map, db.execute(f"{_SELECT_MAP} WHERE {condition}", [domain, job_id])), None)

    def map_path(self, domain: str, version: int) -> Path:
        """Where the sealed file of a version lies, or will; raises InvalidInputError."""
        return layout.map_path(self.data_dir, domain, version)

    def map_file(self, domain: str, version: int) -> Path:
        """The sealed file of a version, to be read; it is what was sealed.

        Raises:
            UnknownDomainError, UnknownMapVersionError: There is no such version.
            DamagedMapError: The file is missing, or another one.
            UnavailableError: The disk failed, ...
        """
        path, digest = self.map_path(domain, version), self.map(domain, version).sha256
        if digest is not None:
            verify(path, digest)
        return path

    def has_file(self, domain: str, version: int) -> bool:
        """Whether the file of a version was not removed."""
        return self.map_path(domain, version).exists()

    def building_path(self, domain: str, version: int) -> Path:
        """Where a version is to be built before it is sealed; raises InvalidInputError."""
        return self.map_path(domain, version).with_suffix(".building")


def _get_map(db: Database, domain: str, version: int) -> MapRecord:
    row = None
    if 1 <= version <= _MAX_INTEGER:
        row = db.execute(f"{_SELECT_MAP} WHERE domain = ? AND version = ?", [domain, version]).fetchone()
    if row is None:
        rows = db.execute("SELECT version FROM map WHERE domain = ? ORDER BY version DESC", [domain]).fetchall()
        suggestion = nearest_of("", (str(version) for (version,) in rows))
        raise UnknownMapVersionError(f"domain {domain} has no map version {version}{suggestion}", version=version)
    return _map(row)


def _map(row: Sequence[Any]) -> MapRecord:
    domain, version, state, created_at, sha256, file_bytes, config, metrics, *times = row
    documents = from_json(config), from_json(metrics)
    return MapRecord(domain, version, MapState(state), created_at, sha256, file_bytes, *documents, *times)


def _check_is_building(db: Database, domain: str, version: int) -> None:
    if _get_map(db, domain, version).state is not MapState.BUILDING:
        raise UnknownMapVersionError(f"domain {domain} is not building a map version {version}", version=version)


def removal_error(domain: str, version: int) -> RetiredMapError:
    """The error for a version whose file was removed."""
    return RetiredMapError(
        f"map {version} of domain {domain} was retired and its file removed: it cannot serve again",
        domain=domain,
        map_version=version,
    )


def _version_label(version: object) -> str:
    return "no map" if version is None else f"map version {version}"
