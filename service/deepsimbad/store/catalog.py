"""The catalog: which domains, map versions, jobs and keys there are, and which version serves."""

import shutil
from collections.abc import Sequence
from typing import Any

from sqlite_utils import Database

from deepsimbad.errors import ConflictError, DomainDiffersError, TooManyDomainsError, TraverseInUseError
from deepsimbad.store import layout
from deepsimbad.store.catalog_file import all_domains, find_domain, get_domain
from deepsimbad.store.catalog_jobs import JobCatalog
from deepsimbad.store.catalog_keys import KeyCatalog
from deepsimbad.store.catalog_maps import MapCatalog
from deepsimbad.store.durable import bury, empty_graves, sync
from deepsimbad.store.records import DomainRecord, now, to_json
from deepsimbad.store.traverses import Traverse

_OF_OLDER_RELEASES = ("jobs", "owners")  # folders of what unfinished work needed then


class Catalog(MapCatalog, JobCatalog, KeyCatalog):
    """The one file that says what is true of a data directory.

    Every change is one transaction: a crash at any moment leaves the state before it or after it. Every method raises
    UnavailableError (`hints["reason"]`: disk_full, read_only, busy, ...) or DamagedFileError where the file cannot be
    used, beside what it names itself.
    """

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
        row = {
            "evaluator": to_json(evaluator),
            "closed": int(closed),
            "actions_m": to_json([float(action) for action in actions_m]),
        }
        with self._writing() as db:
            present = find_domain(db, name)
            if present is not None:
                _check_alike(present, row)
                return present, False
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

    def domain(self, name: str) -> DomainRecord:
        """One domain; raises UnknownDomainError."""
        with self._reading() as db:
            return get_domain(db, name)

    def domains(self) -> list[DomainRecord]:
        """Every domain by name."""
        with self._reading() as db:
            return all_domains(db)

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
            get_domain(db, name)
            has_maps = db.table("map").count_where("domain = ?", [name]) > 0
            if only_empty and (has_maps or Traverse.list(self.data_dir, name)):
                return
            n_jobs = db.table("job").count_where("domain = ? AND state IN ('queued', 'running')", [name])
            if n_jobs or self._is_built(name):
                raise TraverseInUseError(f"a job on domain {name} has not ended: cancel it or wait for its end")
            db.table("domain").delete(name)
            db.table("doomed_folder").insert({"domain": name}, ignore=True)
        with self._writing() as db:  # from here on a crash is finished at the next start
            self._finish_deletion(db, name)
        empty_graves(layout.domains_folder(self.data_dir))  # gigabytes take seconds, in which others may write

    def _finish_deletion(self, db: Database, name: str) -> bool:
        is_doomed = db.table("doomed_folder").count_where("domain = ?", [name]) > 0
        if is_doomed:
            bury(layout.domain_folder(self.data_dir, name))
            db.table("doomed_folder").delete(name)
        return is_doomed

    def discard_unfinished(self) -> list[str]:
        """Clear away what dead processes left: the service calls it once at its start, before any work.

        Maps that were being built are discarded, jobs that ran wait again (`waiting_jobs`), files of removed maps and
        folders of deleted domains go.

        Returns:
            One line for each thing done, for the log.
        """
        lines = [*self.take_over_jobs(), *self.discard_abandoned_maps()]
        with self._writing() as db:
            for domain, version in db.execute(
                "SELECT domain, version FROM map WHERE removed_at IS NOT NULL"
            ).fetchall():
                if self._unlink(domain, version):
                    lines.append(f"removed the file of the removed map {version} of domain {domain}")
            for (name,) in db.execute("SELECT domain FROM doomed_folder").fetchall():
                self._finish_deletion(db, name)
                lines.append(f"removed the folder of the deleted domain {name}")
        empty_graves(layout.domains_folder(self.data_dir))
        for folder in _OF_OLDER_RELEASES:
            shutil.rmtree(self.data_dir / folder, ignore_errors=True)
        return lines


def _check_alike(present: DomainRecord, row: dict[str, Any]) -> None:
    of_present = (to_json(present.evaluator), int(present.closed), to_json(present.actions_m))
    if of_present != (row["evaluator"], row["closed"], row["actions_m"]):
        raise DomainDiffersError(
            f"domain {present.name} exists with another configuration: delete it first, or choose another name",
            present={
                "evaluator": present.evaluator,
                "closed": present.closed,
                "actions_m": list(present.actions_m),
            },
        )
