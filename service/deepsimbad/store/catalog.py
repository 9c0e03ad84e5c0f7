"""The catalog: which domains, map versions and jobs there are, and which version serves."""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any, Self

from sqlite_utils import Database

from deepsimbad.errors import (
    ConflictError,
    DamagedFileError,
    DamagedMapError,
    InvalidInputError,
    TraverseInUseError,
    UnknownMapVersionError,
)
from deepsimbad.store import domain_table, job_queue, job_table, key_table, layout, map_removal, map_table, unfinished
from deepsimbad.store.api_key import ApiKey
from deepsimbad.store.census import Census
from deepsimbad.store.census import take as take_census
from deepsimbad.store.checkpoints import sweep_checkpoints
from deepsimbad.store.connection import check_integrity, migrate, open_database, use_write_ahead_log, write_transaction
from deepsimbad.store.data_dir import make_data_dir
from deepsimbad.store.documents import after, from_json, to_json
from deepsimbad.store.durable import remove_folder, sync_folder
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.list_page import ListPage
from deepsimbad.store.map_table import AnyVersion
from deepsimbad.store.ownership import Owner, is_alive
from deepsimbad.store.records import DomainRecord, JobRecord, KeptMap, KeyRecord, KeyScope, MapRecord, MapState
from deepsimbad.store.row_checksums import CATALOG_TABLES, RowChecksums, verify_rows
from deepsimbad.store.write_ahead_log import check_log
from deepsimbad_migrations.catalog.migrations import migrations

_MAX_KEY_NAME = 100


class Catalog:
    """The one file that says what is true of a data directory; usable from any thread and several processes.

    Every change is one transaction: a crash at any moment leaves the state before it or after it. Every method raises
    UnavailableError (`hints["reason"]`: disk_full, read_only, busy, ...) or DamagedFileError where the file cannot be
    used, beside what it names itself.

    Args:
        data_dir: The data directory.
        db: The open catalog file.
        checksums: Of its rows.
    """

    def __init__(self, data_dir: Path, db: Database, checksums: RowChecksums) -> None:
        self.data_dir = data_dir
        self._path = layout.catalog_path(data_dir)
        self._db = db
        self._checksums = checksums
        self._lock = threading.RLock()
        self._owners = layout.owners_folder(data_dir)
        self._owner = Owner(self._owners)

    @classmethod
    def open(cls, data_dir: Path) -> Self:
        """Open the catalog of a data directory; makes both where they are missing."""
        path = layout.catalog_path(data_dir)
        make_data_dir(data_dir)
        with storage_faults(path), ExitStack() as on_error:
            domains = layout.domains_folder(data_dir)
            has_domains = domains.is_dir() and any(domains.iterdir())  # looked at before the rows: they come first
            check_log(path)
            db = open_database(path, create=True)
            on_error.callback(db.close)
            if has_domains and not db.table_names():
                raise DamagedFileError(
                    f"{path.name} is missing or empty beside a folder of domains: put a copy of it back, or move "
                    "the folder away",
                    file=path.name,
                )
            check_integrity(db, path)
            use_write_ahead_log(db)
            migrate(db, migrations, path)
            checksums = RowChecksums(db, CATALOG_TABLES)
            checksums.fill_if_new()
            verify_rows(db, CATALOG_TABLES, path.name)
            sync_folder(data_dir)
            on_error.pop_all()
        return cls(data_dir, db, checksums)

    def close(self) -> None:
        """Close the file. Unfinished work begun through this object counts as abandoned from here on."""
        with self._lock:
            self._owner.release()
            self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @contextmanager
    def _reading(self) -> Iterator[Database]:
        with self._lock, storage_faults(self._path), self._db.atomic() as db:
            yield db

    @contextmanager
    def _writing(self) -> Iterator[Database]:
        with self._lock, storage_faults(self._path), write_transaction(self._db) as db:
            yield db
            self._checksums.note()

    def check(self) -> None:
        """Raise what keeps the file from being read."""
        with self._reading() as db:
            db.execute("SELECT name FROM domain LIMIT 1").fetchall()
        if not self._path.exists():  # an open file goes on without its name, until it is closed
            raise DamagedFileError(f"{self._path.name} was removed under the running service", file=self._path.name)

    def census(self) -> Census:
        """What the catalog holds, counted."""
        with self._reading() as db:
            return take_census(db)

    # Domains

    def create_domain(
        self,
        name: str,
        evaluator: dict[str, Any],
        closed: bool,
        actions_m: Sequence[float],
        max_domains: int | None = None,
    ) -> tuple[DomainRecord, bool]:
        """Make a domain; the same again changes nothing.

        Args:
            name: What to call it.
            evaluator: Its evaluator's configuration.
            closed: Whether the route is a loop.
            actions_m: Moves in metres.
            max_domains: How many there may be, this one included; None: any number.

        Returns:
            The domain, and whether it is new.

        Raises:
            InvalidInputError: The name cannot be a name, or a value has no JSON form.
            DomainDiffersError: A domain of that name exists with another configuration.
            TooManyDomainsError: There are `max_domains` already, and it is none of them.
            ConflictError: Files that no domain owns lie where its files would.
        """
        folder = layout.domain_folder(self.data_dir, name)
        evaluator = from_json(to_json(evaluator))
        actions = tuple(float(action) for action in actions_m)
        with self._writing() as db:
            if max_domains is not None:
                domain_table.check_room(db, name, max_domains)
            record, created = domain_table.insert(db, name, evaluator, closed, actions)
            if created:
                self._finish_deletion(db, name)
                if any(path.is_file() for path in folder.rglob("*")):
                    raise ConflictError(
                        f"files of an unknown domain lie in {folder.parent.name}/{name}: move them away first"
                    )
                layout.traverses_folder(self.data_dir, name).mkdir(parents=True, exist_ok=True)
                layout.maps_folder(self.data_dir, name).mkdir(parents=True, exist_ok=True)
                for made in (folder, folder.parent, self.data_dir):
                    sync_folder(made)
        return record, created

    def domain(self, name: str) -> DomainRecord:
        """One domain; raises UnknownDomainError."""
        with self._reading() as db:
            return domain_table.get(db, name)

    def domains(self) -> list[DomainRecord]:
        """Every domain by name."""
        with self._reading() as db:
            return domain_table.all_domains(db)

    def delete_domain(self, name: str) -> None:
        """Delete a domain with its jobs, maps and traverses.

        Raises:
            UnknownDomainError: There is no such domain.
            TraverseInUseError: A job on it has not ended, or a living process builds a map of it.
        """
        with self._writing() as db:
            domain_table.get(db, name)
            builders = {owner for domain, _, owner in map_table.building(db) if domain == name}
            # A job whose process died counts as well: the next service goes on with it.
            if job_table.unfinished(db, name) or any(is_alive(self._owners, owner) for owner in builders):
                raise TraverseInUseError(f"a job on domain {name} has not ended: cancel it or wait for its end")
            domain_table.doom(db, name)
        with self._writing() as db:  # from here on a crash is finished at the next start
            self._finish_deletion(db, name)

    def _finish_deletion(self, db: Database, name: str) -> None:
        if name in domain_table.doomed(db):
            remove_folder(layout.domain_folder(self.data_dir, name))
            domain_table.forget_doomed(db, name)

    # Map versions

    def begin_map(self, domain: str, config: dict[str, Any]) -> int:
        """Take the next version number for a map to be built; raises UnknownDomainError."""
        with self._writing() as db:
            domain_table.get(db, domain)
            return map_table.begin(db, domain, config, self._owner.token())

    def seal_map(self, domain: str, version: int, sha256: str, file_bytes: int, metrics: dict[str, Any]) -> MapRecord:
        """Note that the sealed file of a version lies at `map_path`.

        Raises:
            UnknownMapVersionError: The version is not being built.
            DamagedMapError: The file is missing or has another size.
        """
        path = self.map_path(domain, version)
        with self._writing() as db:
            record = map_table.seal(db, domain, version, sha256, file_bytes, metrics)
            if not path.is_file() or path.stat().st_size != file_bytes:
                raise DamagedMapError(f"{path.name} is not the file that was sealed", file=path.name)
        return record

    def discard_map(self, domain: str, version: int) -> None:
        """Forget a version that was being built, files first; raises UnknownMapVersionError."""
        with self._writing() as db:
            if map_table.get(db, domain, version).state is not MapState.BUILDING:
                raise UnknownMapVersionError(
                    f"domain {domain} is not building a map version {version}", version=version
                )
            unfinished.remove_map_files(self.data_dir, domain, version)
            map_table.delete(db, domain, version)

    def activate(self, domain: str, version: int, expected: int | AnyVersion | None) -> MapRecord:
        """Let a version serve, forward or back, if the active one is still `expected` (None: none; `ANY`).

        Raises:
            UnknownDomainError: There is no such domain.
            UnknownMapVersionError: There is no such version, or it is still being built.
            RetiredMapError: Its file was removed.
            LostActivationError: Another version was activated meanwhile.
        """
        with self._writing() as db:
            domain_table.get(db, domain)
            return map_table.activate(db, domain, version, expected)

    def kept_maps(self) -> list[KeptMap]:
        """Every sealed version of all domains that still has its file."""
        with self._reading() as db:
            return map_removal.kept(db)

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
            domain_table.get(db, domain)
            map_removal.mark_removed(db, domain, version, is_pinned)
        with self._writing() as db:  # from here on a crash is finished at the next start
            map_removal.unlink_removed(db, self.data_dir, domain, version)

    def maps(self, domain: str) -> list[MapRecord]:
        """Every map version, oldest first; raises UnknownDomainError."""
        with self._reading() as db:
            domain_table.get(db, domain)
            return map_table.of_domain(db, domain)

    def newest_maps(self, domain: str, before: int | None, limit: int) -> ListPage[MapRecord, int]:
        """A page of a domain's map versions, newest first, behind version `before`; raises UnknownDomainError."""
        with self._reading() as db:
            domain_table.get(db, domain)
            return map_table.newest(db, domain, before, limit)

    def map(self, domain: str, version: int) -> MapRecord:
        """One map version; raises UnknownDomainError, UnknownMapVersionError."""
        with self._reading() as db:
            domain_table.get(db, domain)
            return map_table.get(db, domain, version)

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

    # Jobs

    def create_job(self, domain: str, kind: str, config: dict[str, Any]) -> JobRecord:
        """Note a queued job of this process; raises UnknownDomainError."""
        with self._writing() as db:
            domain_table.get(db, domain)
            return job_table.insert(db, domain, kind, config, self._owner.token())

    def update_job(self, job_id: str, **fields: Any) -> JobRecord:
        """Change state, stage, progress, eta_s, result or error of a job; one that has ended stays as it is.

        The times of start and end follow from the state.

        Returns:
            The job as it now stands.

        Raises:
            UnknownJobError: There is no such job.
            InvalidInputError: A field cannot be changed or cannot hold the value.
        """
        with self._writing() as db:
            return job_table.update(db, job_id, fields)

    def start_job(self, job_id: str) -> JobRecord:
        """Let a queued job run; one that is not queued any more stays as it is. Raises UnknownJobError."""
        with self._writing() as db:
            return job_queue.start(db, job_id)

    def cancel_queued_job(self, job_id: str) -> JobRecord:
        """Cancel a job that has not begun; any other stays as it is. Raises UnknownJobError."""
        with self._writing() as db:
            return job_queue.cancel_queued(db, job_id)

    def give_back_job(self, job_id: str) -> JobRecord:
        """Let a running job wait for the next service, as this one stops. Raises UnknownJobError."""
        with self._writing() as db:
            return job_queue.give_back(db, job_id)

    def waiting_jobs(self) -> list[str]:
        """The queued jobs of this process by id, oldest first; among them those it took over from dead ones."""
        with self._reading() as db:
            return job_queue.waiting(db, self._owner.mark)

    def job(self, job_id: str) -> JobRecord:
        """One job; raises UnknownJobError."""
        with self._reading() as db:
            return job_table.get(db, job_id)

    def jobs(self, domain: str | None = None) -> list[JobRecord]:
        """Every job, or every job of a domain, oldest first; raises UnknownDomainError."""
        with self._reading() as db:
            if domain is not None:
                domain_table.get(db, domain)
            return job_table.list_jobs(db, domain)

    def newest_jobs(self, domain: str | None, before: int | None, limit: int) -> ListPage[JobRecord, int]:
        """A page of jobs, newest first, behind the key `before`; raises UnknownDomainError."""
        with self._reading() as db:
            if domain is not None:
                domain_table.get(db, domain)
            return job_table.newest(db, domain, before, limit)

    # Keys

    def create_key(
        self, scope: KeyScope, name: str = "", lifetime: timedelta | None = None
    ) -> tuple[KeyRecord, ApiKey]:
        """Make an API key; its secret is returned here and can never be had again.

        Args:
            scope: What it opens.
            name: What to call it, at most 100 printable letters; may be empty.
            lifetime: From now on, above 0; None: it does not expire.

        Raises:
            InvalidInputError: The name or the lifetime cannot be kept.
        """
        if len(name) > _MAX_KEY_NAME or not name.isprintable():
            raise InvalidInputError(f"a key is named by at most {_MAX_KEY_NAME} printable letters")
        if lifetime is not None and lifetime <= timedelta(0):
            raise InvalidInputError("a key lives for more than no time at all")
        expires_at = None if lifetime is None else after(lifetime)
        key = ApiKey.new()
        with self._writing() as db:
            return key_table.insert(db, key, scope, name, expires_at), key

    def keys(self) -> list[KeyRecord]:
        """Every API key that was ever created, revoked ones too, oldest first."""
        with self._reading() as db:
            return key_table.all_keys(db)

    def revoke_key(self, key_id: str) -> KeyRecord:
        """Let a key open nothing any more; raises UnknownKeyError."""
        with self._writing() as db:
            return key_table.revoke(db, key_id)

    # Recovery

    def discard_unfinished(self) -> list[str]:
        """Clear away what dead processes left: call it once at start, before any work.

        Maps that were being built are discarded, jobs that were queued or running wait for this process
        (`waiting_jobs`), folders of deleted domains, checkpoints of ended jobs and files that no map version owns are
        removed. A job that was started too often, and its service died each time, fails (job_interrupted). Work of
        living processes, this one included, stays.

        Returns:
            One line for each thing done, for the log.
        """
        with self._writing() as db:
            lines = [
                *unfinished.take_over_abandoned_jobs(db, self._owners, self._owner.token),
                *unfinished.discard_abandoned_maps(db, self.data_dir, self._owners),
                *unfinished.remove_orphans(db, self.data_dir),
            ]
            unended = {job_id for job_id, _ in job_table.unfinished(db)}
            swept = sweep_checkpoints(self.data_dir, unended)
            lines += [f"removed the checkpoints of the ended job {job_id}" for job_id in swept]
            for name in domain_table.doomed(db):
                self._finish_deletion(db, name)
                lines.append(f"removed the folder of the deleted domain {name}")
        return lines

    def discard_abandoned_maps(self) -> list[str]:
        """Discard the maps that dead processes were building; returns one line for each."""
        with self._writing() as db:
            return list(unfinished.discard_abandoned_maps(db, self.data_dir, self._owners))
