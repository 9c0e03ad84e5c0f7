"""What the catalog says of map versions: which there are, and which one serves."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from deepsimbad.errors import DamagedMapError, UnknownMapVersionError
from deepsimbad.store import domain_table, layout, map_removal, map_table, unfinished
from deepsimbad.store.catalog_file import CatalogFile
from deepsimbad.store.list_page import ListPage
from deepsimbad.store.map_table import AnyVersion
from deepsimbad.store.records import KeptMap, MapRecord, MapState


class MapCatalog(CatalogFile):
    """The map versions of all domains."""

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
