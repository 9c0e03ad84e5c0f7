"""What the catalog says of map versions: which there are, and which one serves."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from sqlite_utils import Database

from deepsimbad.errors import (
    DamagedMapError,
    LostActivationError,
    MapInUseError,
    RetiredMapError,
    UnknownMapVersionError,
)
from deepsimbad.store import layout
from deepsimbad.store.catalog_file import CatalogFile, get_domain
from deepsimbad.store.durable import lock_folder, remove_database, sync
from deepsimbad.store.records import KeptMap, ListPage, MapRecord, MapState, from_json, now, to_json

_SELECT = """
    SELECT version, state, created_at, sha256, file_bytes, config, metrics, activated_at, retired_at, removed_at
    FROM map
"""
_MAX_INTEGER = 2**63 - 1


class AnyVersion:
    """The type of `ANY`."""

    def __repr__(self) -> str:
        """As it is written."""
        return "ANY"


ANY: Final = AnyVersion()
"""Activate whatever is active now."""


class MapCatalog(CatalogFile):
    """The map versions of all domains."""

    def begin_map(self, domain: str, config: dict[str, Any]) -> int:
        """Take the next version number for a map to be built; raises UnknownDomainError.

        Numbers count from 1 and are never used again. Until the version is sealed or discarded the domain's folder of
        maps is locked, shared: the kernel ends that with the process, so that others can tell what was abandoned.
        """
        with self._writing() as db:
            get_domain(db, domain)
            (version,) = db.execute("SELECT next_version FROM domain WHERE name = ?", [domain]).fetchone()
            db.table("domain").update(domain, {"next_version": version + 1})
            row = {"domain": domain, "version": version, "state": MapState.BUILDING, "created_at": now()}
            db.table("map").insert({**row, "config": to_json(config), "metrics": "{}"})
            descriptor = lock_folder(layout.maps_folder(self.data_dir, domain), fcntl.LOCK_SH)
            assert descriptor is not None
            self._building[domain, version] = descriptor
        return int(version)

    def seal_map(self, domain: str, version: int, sha256: str, file_bytes: int, metrics: dict[str, Any]) -> MapRecord:
        """Note that the sealed file of a version lies at `map_path`.

        Raises:
            UnknownMapVersionError: The version is not being built.
            DamagedMapError: The file is missing or has another size.
        """
        path = self.map_path(domain, version)
        with self._writing() as db:
            _get_building(db, domain, version)
            if not path.is_file() or path.stat().st_size != file_bytes:
                raise DamagedMapError(f"{path.name} is not the file that was sealed", file=path.name)
            sealed = {"state": MapState.SEALED, "sha256": sha256, "file_bytes": file_bytes, "metrics": to_json(metrics)}
            db.table("map").update((domain, version), sealed)
            record = get_map(db, domain, version)
        self._give_up_building(domain, version)
        return record

    def discard_map(self, domain: str, version: int) -> None:
        """Forget a version that was being built, files first; raises UnknownMapVersionError."""
        with self._writing() as db:
            _get_building(db, domain, version)
            self._discard(db, domain, version)
        self._give_up_building(domain, version)

    def discard_abandoned_maps(self) -> list[str]:
        """Discard the maps that dead processes were building; returns one line for each.

        Those of a domain wait for the next time while a living process builds one of it.
        """
        with self._writing() as db:
            building = db.execute("SELECT domain, version FROM map WHERE state = 'building'").fetchall()
            alive = {domain for domain, _ in building if self._is_built(domain)}
            abandoned = [(domain, version) for domain, version in building if domain not in alive]
            for domain, version in abandoned:
                self._discard(db, domain, version)
        return [f"discarded the unfinished map {version} of domain {domain}" for domain, version in abandoned]

    def _discard(self, db: Database, domain: str, version: int) -> None:
        path = self.map_path(domain, version)
        for file in (self.building_path(domain, version), path.with_suffix(layout.SEALING_SUFFIX), path):
            remove_database(file)
        db.table("map").delete((domain, version))

    def _is_built(self, domain: str) -> bool:
        """Whether a living process builds a map of a domain."""
        try:
            descriptor = lock_folder(layout.maps_folder(self.data_dir, domain), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except FileNotFoundError:
            return False
        if descriptor is not None:
            os.close(descriptor)
        return descriptor is None

    def activate(self, domain: str, version: int, expected: int | AnyVersion | None) -> MapRecord:
        """Let a version serve, forward or back, if the active one is still `expected` (None: none; `ANY`).

        Raises:
            UnknownDomainError: There is no such domain.
            UnknownMapVersionError: There is no such version, or it is still being built.
            RetiredMapError: Its file was removed.
            LostActivationError: Another version was activated meanwhile.
        """
        with self._writing() as db:
            active = get_domain(db, domain).active_version
            chosen = get_map(db, domain, version)
            if chosen.removed_at is not None:
                raise removed(domain, version)
            if chosen.state is MapState.BUILDING:
                raise UnknownMapVersionError(
                    f"map version {version} of domain {domain} is still being built", version=version
                )
            if not isinstance(expected, AnyVersion) and active != expected:
                raise LostActivationError(
                    f"domain {domain} serves {_named(active)}, not {_named(expected)}: look again before you swap",
                    active=active,
                    expected=expected,
                )
            if active != version:
                # Which one served last must be known though the clock was set back: it is the one to roll back to.
                (latest,) = db.execute("SELECT max(retired_at) FROM map WHERE domain = ?", [domain]).fetchone()
                if active is not None:
                    retired = {"state": MapState.RETIRED, "retired_at": now(behind=latest)}
                    db.table("map").update((domain, active), retired)
                db.table("map").update((domain, version), {"state": MapState.ACTIVE, "activated_at": now()})
            return get_map(db, domain, version)

    def kept_maps(self) -> list[KeptMap]:
        """Every sealed version of all domains that still has its file, oldest first."""
        with self._reading() as db:
            rows = db.execute(
                """
                SELECT domain, version, state, retired_at FROM map
                WHERE state != 'building' AND removed_at IS NULL ORDER BY domain, version
                """
            )
            return [KeptMap(domain, version, MapState(state), *times) for domain, version, state, *times in rows]

    def remove_map(self, domain: str, version: int, is_pinned: Callable[[], bool]) -> None:
        """Remove the file of a version; its row stays, retired.

        Args:
            domain: Of the version.
            version: Its number.
            is_pinned: Asked while nothing changes in this catalog: who pins a version first, and then finds it here
                without `removed_at`, keeps it. It must not wait for anyone who waits for the catalog.

        Raises:
            UnknownDomainError, UnknownMapVersionError: There is no such version.
            RetiredMapError: It was removed before.
            MapInUseError: It serves, is being built, or is pinned.
        """
        with self._writing() as db:
            get_domain(db, domain)
            record = get_map(db, domain, version)
            if record.removed_at is not None:
                raise removed(domain, version)
            if record.state is MapState.ACTIVE:
                why = f"map {version} of domain {domain} serves: activate another version first"
            elif record.state is MapState.BUILDING:
                why = f"map {version} of domain {domain} is being built: cancel the job that builds it"
            elif is_pinned():
                why = f"a session lives on map {version} of domain {domain}: end it or wait for its end"
            else:
                why = ""
            if why:
                raise MapInUseError(why, map_version=version)
            db.table("map").update((domain, version), {"state": MapState.RETIRED, "removed_at": now()})
        with self._lock:  # marked first: after a crash between the two the next start removes the file
            self._unlink(domain, version)

    def _unlink(self, domain: str, version: int) -> bool:
        path = self.map_path(domain, version)
        was_there = path.parent.is_dir() and remove_database(path)
        if was_there:
            sync(path.parent)
        return was_there

    def maps(self, domain: str) -> list[MapRecord]:
        """Every map version, oldest first; raises UnknownDomainError."""
        with self._reading() as db:
            get_domain(db, domain)
            return [_map(row) for row in db.execute(f"{_SELECT} WHERE domain = ? ORDER BY version", [domain])]

    def newest_maps(self, domain: str, before: int | None, limit: int) -> ListPage[MapRecord, int]:
        """A page of a domain's map versions, newest first, behind version `before`; raises UnknownDomainError."""
        with self._reading() as db:
            get_domain(db, domain)
            rows = db.execute(
                f"{_SELECT} WHERE domain = ? AND version < ? ORDER BY version DESC LIMIT ?",
                [domain, _MAX_INTEGER if before is None else before, limit + 1],
            )
            return ListPage.of(((record.version, record) for record in map(_map, rows)), limit)

    def map(self, domain: str, version: int) -> MapRecord:
        """One map version; raises UnknownDomainError, UnknownMapVersionError."""
        with self._reading() as db:
            get_domain(db, domain)
            return get_map(db, domain, version)

    def settled_map(self, domain: str, version: int) -> MapRecord:
        """As `map`, behind every change that this process is about to make: a removal is done, or has not begun."""
        with self._lock:
            return self.map(domain, version)

    def map_of_job(self, domain: str, job_id: str) -> MapRecord | None:
        """The version that a job has sealed, whatever became of it since; raises UnknownDomainError."""
        made = [record for record in self.maps(domain) if record.metrics.get("job_id") == job_id]
        return made[-1] if made else None

    def map_path(self, domain: str, version: int) -> Path:
        """Where the sealed file of a version lies, or will; raises InvalidInputError."""
        return layout.map_path(self.data_dir, domain, version)

    def building_path(self, domain: str, version: int) -> Path:
        """Where a version is to be built before it is sealed; raises InvalidInputError."""
        return layout.building_path(self.data_dir, domain, version)


def get_map(db: Database, domain: str, version: int) -> MapRecord:
    """One version; raises UnknownMapVersionError."""
    row = None
    if 1 <= version <= _MAX_INTEGER:
        row = db.execute(f"{_SELECT} WHERE domain = ? AND version = ?", [domain, version]).fetchone()
    if row is None:
        raise UnknownMapVersionError(f"domain {domain} has no map version {version}", version=version)
    return _map(row)


def removed(domain: str, version: int) -> RetiredMapError:
    """What is said of a version whose file is no more."""
    return RetiredMapError(
        f"map {version} of domain {domain} was retired and its file removed: it cannot serve again",
        domain=domain,
        map_version=version,
    )


def _get_building(db: Database, domain: str, version: int) -> None:
    if get_map(db, domain, version).state is not MapState.BUILDING:
        raise UnknownMapVersionError(f"domain {domain} is not building a map version {version}", version=version)


def _map(row: tuple[Any, ...]) -> MapRecord:
    version, state, created_at, sha256, file_bytes, config, metrics, *times = row
    return MapRecord(
        version, MapState(state), created_at, sha256, file_bytes, from_json(config), from_json(metrics), *times
    )


def _named(version: int | None) -> str:
    return "no map" if version is None else f"map version {version}"
