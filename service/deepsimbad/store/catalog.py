"""The catalog: which domains, map versions, jobs and keys there are, and which version serves."""

import fcntl
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, Final, Self

from sqlite_utils import Database

from deepsimbad.errors import (
    ConflictError,
    DamagedFileError,
    DamagedMapError,
    DomainDiffersError,
    LostActivationError,
    MapInUseError,
    RetiredMapError,
    TooManyDomainsError,
    TraverseInUseError,
    UnknownMapVersionError,
    nearest_of,
)
from deepsimbad.store import layout
from deepsimbad.store.catalog_jobs import JobCatalog
from deepsimbad.store.catalog_keys import KeyCatalog
from deepsimbad.store.connection import open_database, open_working_file
from deepsimbad.store.durable import (
    bury,
    empty_graves,
    lock_folder,
    make_data_dir,
    remove_database,
    storage_faults,
    sync,
    verify,
)
from deepsimbad.store.records import (
    DomainRecord,
    KeptMap,
    ListPage,
    MapRecord,
    MapState,
    from_json,
    get_domain,
    now,
    read_domains,
    to_json,
)
from deepsimbad_migrations.catalog.migrations import migrations

_SELECT_MAP = """
    SELECT version, state, created_at, sha256, file_bytes, config, metrics, activated_at, retired_at, removed_at,
           domain
    FROM map
"""
_MAX_INTEGER = 2**63 - 1


class AnyVersion(Enum):
    """To activate a map whatever is active now."""

    ANY = "any"


ANY: Final = AnyVersion.ANY


class Catalog(JobCatalog, KeyCatalog):
    """The one file that says what is true of a data directory; usable from any thread and several processes.

    Every change is one transaction: a crash at any moment leaves the state before it or after it. Every method raises
    UnavailableError (`hints["reason"]`: disk_full, read_only, busy, ...) or DamagedFileError where the file cannot be
    used, beside what it names itself.
    """

    def __init__(self, data_dir: Path, db: Database) -> None:
        path = layout.catalog_path(data_dir)
        super().__init__(path, db, open_database(path))  # a robot's answer needs the catalog: it waits for no writer
        self.data_dir = data_dir
        self._building: dict[tuple[str, int], int] = {}  # descriptors of locked folders

    @classmethod
    def open(cls, data_dir: Path) -> Self:
        """Open the catalog of a data directory; makes both where they are missing."""
        path = layout.catalog_path(data_dir)
        make_data_dir(data_dir)
        with storage_faults(path):
            domains = layout.domains_folder(data_dir)
            has_domains = domains.is_dir() and any(domains.iterdir())  # looked at before the file, which comes first
            if has_domains and not path.exists():
                raise DamagedFileError(
                    f"{path.name} is missing beside a folder of domains: put a copy of it back, or move that folder",
                    file=path.name,
                )
            db = open_working_file(path, migrations, create=not has_domains)
            sync(data_dir)
            return cls(data_dir, db)

    def close(self) -> None:
        """Close the file. Maps that are being built through this object count as abandoned from here on."""
        with self._lock:
            for domain, version in list(self._building):
                self._give_up_building(domain, version)
            super().close()

    # Domains

    def create_domain(
        self,
        name: str,
        evaluator: dict[str, Any],
        closed: bool,
        actions_m: Sequence[float],
        max_domains: int | None = None,
    ) -> tuple[DomainRecord, bool]:
        """Make a domain, of at most `max_domains`; the same again changes nothing. Returns it and whether it is new.

        Raises:
            InvalidInputError: The name cannot be a name, or a value has no JSON form.
            DomainDiffersError: A domain of that name exists with another configuration.
            TooManyDomainsError: There are `max_domains` already, and it is none of them.
            ConflictError: Files that no domain owns lie where its files would.
        """
        folder = layout.domain_folder(self.data_dir, name)
        moves_m = [float(action) + 0.0 for action in actions_m]  # a zero has no sign
        wanted = to_json({"evaluator": evaluator, "closed": closed, "actions_m": moves_m})
        row = {"evaluator": to_json(evaluator), "closed": int(closed), "actions_m": to_json(moves_m)}
        with self._writing() as db:
            for record in read_domains(db, name):
                moves_m = list(record.actions_m)
                present = {"evaluator": record.evaluator, "closed": record.closed, "actions_m": moves_m}
                if to_json(present) != wanted:
                    raise DomainDiffersError(
                        f"domain {name} exists with another configuration: delete it first, or choose another name",
                        present=present,
                    )
                return record, False
            n_domains = db.table("domain").count
            if max_domains is not None and n_domains >= max_domains:
                raise TooManyDomainsError(
                    f"there are {n_domains} domains, as many as may be: delete one, or raise the setting max_domains",
                    max_domains=max_domains,
                )
            self._finish_deletion(db, name)
            if any(path.is_file() for path in folder.rglob("*")):
                raise ConflictError(
                    f"files of an unknown domain lie in {folder.parent.name}/{name}: move them away first"
                )
            db.table("domain").insert({"name": name, **row, "created_at": now()})
            layout.traverses_folder(self.data_dir, name).mkdir(parents=True, exist_ok=True)
            layout.maps_folder(self.data_dir, name).mkdir(parents=True, exist_ok=True)
            for changed in (folder, folder.parent, self.data_dir):
                sync(changed)
            record = get_domain(db, name)
        empty_graves(folder.parent)
        return record, True

    def set_options(self, name: str, options: Mapping[str, Any]) -> DomainRecord:
        """Change what of a domain is shown and how; what is not named stays. Raises UnknownDomainError."""
        with self._writing() as db:
            before = get_domain(db, name)
            db.execute("UPDATE domain SET options = ? WHERE name = ?", [to_json({**before.options, **options}), name])
            return get_domain(db, name)

    def domain(self, name: str) -> DomainRecord:
        """One domain; raises UnknownDomainError."""
        with self._reading() as db:
            return get_domain(db, name)

    def domains(self) -> list[DomainRecord]:
        """Every domain by name."""
        with self._reading() as db:
            return read_domains(db)

    def domain_page(self, after: str | None, limit: int) -> ListPage[DomainRecord, str]:
        """A page of domains by name, behind the name `after`."""
        with self._reading() as db:
            records = read_domains(db, after=after or "", limit=limit + 1)
            return ListPage.of(((record.name, record) for record in records), limit)

    @property
    def n_domains(self) -> int:
        """How many there are."""
        with self._reading() as db:
            return int(db.table("domain").count)

    def domain_names(self) -> set[str]:
        """Of every domain: of a hundred thousand in some 50 ms, where `domains` takes seconds."""
        with self._reading() as db:
            return {name for (name,) in db.execute("SELECT name FROM domain")}

    def serving_domains(self) -> list[str]:
        """The domains that have an active map, those whose was activated last first."""
        with self._reading() as db:
            rows = db.execute("SELECT domain FROM map WHERE state = 'active' ORDER BY activated_at DESC, domain")
            return [domain for (domain,) in rows]

    def serving_versions(self, domains: Sequence[str]) -> dict[str, tuple[str, int]]:
        """When each of these domains was made, and its active version; those that have none are left out."""
        with self._reading() as db:
            rows = db.execute(
                """
                SELECT name, domain.created_at, version FROM json_each(?) JOIN domain ON name = value
                JOIN map ON map.domain = name AND state = 'active'
                """,
                [to_json(domains)],
            )
            return {name: (created_at, version) for name, created_at, version in rows}

    def evaluators(self) -> dict[str, dict[str, Any]]:
        """Every configuration of an evaluator that is in use, by the first domain that has it."""
        with self._reading() as db:
            rows = db.execute("SELECT min(name), evaluator FROM domain GROUP BY evaluator ORDER BY 1")
            return {name: from_json(evaluator) for name, evaluator in rows}

    def delete_domain(self, name: str, *, only_empty: bool = False) -> None:
        """Delete a domain with its jobs, maps and traverses, or leave it where it has any and `only_empty`.

        Raises:
            UnknownDomainError: There is no such domain.
            TraverseInUseError: A job on it has not ended, or a living process builds a map of it.
        """
        with self._writing() as db:
            get_domain(db, name)
            traverses = layout.traverses_folder(self.data_dir, name)
            if only_empty and (db.table("map").count_where("domain = ?", [name]) or any(traverses.glob("*.sqlite"))):
                return
            n_jobs = db.table("job").count_where("domain = ? AND state IN ('queued', 'running')", [name])
            if n_jobs or self._is_built(name):
                raise TraverseInUseError(f"a job on domain {name} has not ended: cancel it or wait for its end")
            db.table("domain").delete(name)
            db.table("doomed_folder").insert({"domain": name}, ignore=True)
        with self._writing() as db:  # from here on a crash is finished at the next start
            self._finish_deletion(db, name)
        empty_graves(layout.domains_folder(self.data_dir))  # gigabytes take seconds, in which others may write

    def _finish_deletion(self, db: Database, name: str) -> None:
        if db.table("doomed_folder").count_where("domain = ?", [name]):
            bury(layout.domain_folder(self.data_dir, name))
            db.table("doomed_folder").delete(name)

    def discard_unfinished(self) -> list[str]:
        """Clear away what dead processes left: the service calls it once at its start, before any work.

        Maps that were being built are discarded, jobs that ran wait again (`waiting_jobs`), files of removed maps and
        folders of deleted domains go. Returns one line for each thing done, for the log.
        """
        lines = [*self.take_over_jobs(), *self.discard_abandoned_maps()]
        with self._writing() as db:
            removed_maps = db.execute("SELECT domain, version FROM map WHERE removed_at IS NOT NULL").fetchall()
            for domain, version in removed_maps:
                if self._unlink(domain, version):
                    lines.append(f"removed the file of the removed map {version} of domain {domain}")
            for (name,) in db.execute("SELECT domain FROM doomed_folder").fetchall():
                self._finish_deletion(db, name)
                lines.append(f"removed the folder of the deleted domain {name}")
        empty_graves(layout.domains_folder(self.data_dir))
        return lines

    # Map versions

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
            _check_is_building(db, domain, version)
            if not path.is_file() or path.stat().st_size != file_bytes:
                raise DamagedMapError(f"{path.name} is not the file that was sealed", file=path.name)
            sealed = {"state": MapState.SEALED, "sha256": sha256, "file_bytes": file_bytes, "metrics": to_json(metrics)}
            db.table("map").update((domain, version), sealed)
            record = _get_map(db, domain, version)
        self._give_up_building(domain, version)
        return record

    def discard_map(self, domain: str, version: int) -> None:
        """Forget a version that was being built, files first; raises UnknownMapVersionError."""
        with self._writing() as db:
            _check_is_building(db, domain, version)
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
        for file in (self.building_path(domain, version), path.with_suffix(".sealing"), path):
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

    def _give_up_building(self, domain: str, version: int) -> None:
        descriptor = self._building.pop((domain, version), None)
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
            active = get_domain(db, domain).active_version
            chosen = _get_map(db, domain, version)
            if chosen.removed_at is not None:
                raise removed(domain, version)
            if chosen.state is MapState.BUILDING:
                raise UnknownMapVersionError(
                    f"map version {version} of domain {domain} is still being built", version=version
                )
            if expected is not ANY and active != expected:
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
            return _get_map(db, domain, version)

    def kept_maps(self, domain: str | None = None, more_than: int = -1) -> list[KeptMap]:
        """The sealed versions that still have their files, by domain, oldest first.

        Args:
            domain: Of this one; None: of all.
            more_than: Only of domains that have more than so many beside the one that serves.
        """
        with self._reading() as db:
            rows = db.execute(
                """
                SELECT domain, version, state, retired_at FROM map
                WHERE state != 'building' AND removed_at IS NULL AND domain IN (
                    SELECT domain FROM map
                    WHERE state != 'building' AND removed_at IS NULL AND domain = coalesce(?, domain)
                    GROUP BY domain HAVING sum(state != 'active') > ?
                ) ORDER BY domain, version
                """,
                [domain, more_than],
            )
            return [KeptMap(domain, version, MapState(state), *times) for domain, version, state, *times in rows]

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
                raise removed(domain, version)
            named, why = f"map {version} of domain {domain}", None
            if record.state is MapState.ACTIVE:
                why = f"{named} serves: activate another version first"
            elif record.state is MapState.BUILDING:
                why = f"{named} is being built: cancel the job that builds it"
            elif is_pinned():
                why = f"a session lives on {named}: end it or wait for its end"
            if why is not None:
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

    def newest_maps(self, domain: str, before: int | None, limit: int) -> ListPage[MapRecord, int]:
        """A page of a domain's map versions, newest first, behind version `before`; raises UnknownDomainError."""
        with self._reading() as db:
            get_domain(db, domain)
            rows = db.execute(
                f"{_SELECT_MAP} WHERE domain = ? AND version < ? ORDER BY version DESC LIMIT ?",
                [domain, _MAX_INTEGER if before is None else before, limit + 1],
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

    def settled_map(self, domain: str, version: int) -> MapRecord:
        """As `map`, behind every change that this process is about to make: a removal is done, or has not begun."""
        with self._lock:
            return self.map(domain, version)

    def serving_maps(self, domains: Collection[str]) -> dict[str, MapRecord]:
        """The active versions of these domains, as far as there are any."""
        with self._reading() as db:
            rows = db.execute(
                f"{_SELECT_MAP} WHERE state = 'active' AND domain IN (SELECT value FROM json_each(?))",  # noqa: S608
                [to_json(list(domains))],
            )
            return {row[-1]: _map(row) for row in rows}

    def map_of_job(self, domain: str, job_id: str) -> MapRecord | None:
        """The version that a job has sealed, whatever became of it since; raises UnknownDomainError."""
        records = [record for record in self.maps(domain) if record.metrics.get("job_id") == job_id]
        return records[-1] if records else None

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
        known = db.execute("SELECT version FROM map WHERE domain = ? ORDER BY version DESC", [domain]).fetchall()
        there = nearest_of("", (str(version) for (version,) in known))
        raise UnknownMapVersionError(f"domain {domain} has no map version {version}{there}", version=version)
    return _map(row)


def _map(row: Sequence[Any]) -> MapRecord:
    version, state, created_at, sha256, file_bytes, config, metrics, *times, _ = row
    return MapRecord(
        version, MapState(state), created_at, sha256, file_bytes, from_json(config), from_json(metrics), *times
    )


def _check_is_building(db: Database, domain: str, version: int) -> None:
    if _get_map(db, domain, version).state is not MapState.BUILDING:
        raise UnknownMapVersionError(f"domain {domain} is not building a map version {version}", version=version)


def removed(domain: str, version: int) -> RetiredMapError:
    """What is said of a version whose file is no more."""
    return RetiredMapError(
        f"map {version} of domain {domain} was retired and its file removed: it cannot serve again",
        domain=domain,
        map_version=version,
    )


def _named(version: object) -> str:
    return "no map" if version is None else f"map version {version}"
