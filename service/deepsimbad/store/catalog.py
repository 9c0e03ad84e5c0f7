"""The catalog: which domains, map versions, jobs and keys there are, and which version serves."""

from collections.abc import Sequence
from typing import Any

from sqlite_utils import Database

from deepsimbad.errors import ConflictError, TraverseInUseError
from deepsimbad.store import domain_table, job_table, layout, map_table, unfinished
from deepsimbad.store.census import Census
from deepsimbad.store.census import take as take_census
from deepsimbad.store.checkpoints import sweep_checkpoints
from deepsimbad.store.documents import from_json, to_json
from deepsimbad.store.durable import bury, empty_graves, sync_folder
from deepsimbad.store.job_catalog import JobCatalog
from deepsimbad.store.key_catalog import KeyCatalog
from deepsimbad.store.map_catalog import MapCatalog
from deepsimbad.store.ownership import is_alive
from deepsimbad.store.records import DomainRecord
from deepsimbad.store.traverses import Traverse


class Catalog(MapCatalog, JobCatalog, KeyCatalog):
    """The one file that says what is true of a data directory.

    Every change is one transaction: a crash at any moment leaves the state before it or after it. Every method raises
    UnavailableError (`hints["reason"]`: disk_full, read_only, busy, ...) or DamagedFileError where the file cannot be
    used, beside what it names itself.
    """

    def census(self) -> Census:
        """What the catalog holds, counted."""
        with self._reading() as db:
            return take_census(db)

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
        empty_graves(folder.parent)
        return record, created

    def domain(self, name: str) -> DomainRecord:
        """One domain; raises UnknownDomainError."""
        with self._reading() as db:
            return domain_table.get(db, name)

    def domains(self) -> list[DomainRecord]:
        """Every domain by name."""
        with self._reading() as db:
            return domain_table.all_domains(db)

    def delete_domain(self, name: str, *, only_empty: bool = False) -> None:
        """Delete a domain with its jobs, maps and traverses.

        Args:
            name: The domain.
            only_empty: Leave it where it has a map or a traverse.

        Raises:
            UnknownDomainError: There is no such domain.
            TraverseInUseError: A job on it has not ended, or a living process builds a map of it.
        """
        with self._writing() as db:
            domain_table.get(db, name)
            if only_empty and (map_table.of_domain(db, name) or Traverse.list(self.data_dir, name)):
                return
            builders = {owner for domain, _, owner in map_table.building(db) if domain == name}
            # A job whose process died counts as well: the next service goes on with it.
            if job_table.unfinished(db, name) or any(is_alive(self._owners, owner) for owner in builders):
                raise TraverseInUseError(f"a job on domain {name} has not ended: cancel it or wait for its end")
            domain_table.doom(db, name)
        with self._writing() as db:  # from here on a crash is finished at the next start
            self._finish_deletion(db, name)
        empty_graves(layout.domains_folder(self.data_dir))  # gigabytes take seconds, in which others may write

    def _finish_deletion(self, db: Database, name: str) -> None:
        if name in domain_table.doomed(db):
            bury(layout.domain_folder(self.data_dir, name))
            domain_table.forget_doomed(db, name)

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
        domains = layout.domains_folder(self.data_dir)
        buried = empty_graves(domains)
        with self._writing() as db:
            lines = [
                *(f"removed {name}" for name in buried),
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
        empty_graves(domains)
        return lines

    def discard_abandoned_maps(self) -> list[str]:
        """Discard the maps that dead processes were building; returns one line for each."""
        with self._writing() as db:
            return list(unfinished.discard_abandoned_maps(db, self.data_dir, self._owners))
