"""The active map of every domain, held in memory and switched by one reference assignment."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.errors import DamagedMapError, DeepSimbadError, NoActiveMapError, UnavailableError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.map_file import index_bytes, read_map
from deepsimbad.store.map_table import removed
from deepsimbad.store.records import DomainRecord
from deepsimbad.store.sealing import verify

log = logging.getLogger(__name__)

_TRUSTED_S = 1.0  # another process (the command line) may activate a map: the catalog is asked again after this
_DAMAGE_REMEMBERED_S = 5.0  # digesting a large damaged file for every request would be a gift to its sender


@dataclass(frozen=True)
class ActiveDomain:
    """A domain and its active map, as of one moment."""

    record: DomainRecord
    snapshot: MapSnapshot


@dataclass(frozen=True)
class _Damage:
    version: int
    error: DamagedMapError
    found_at: float


class ActiveMaps:
    """Active maps by domain, loaded at first need.

    Requests read one dict entry; whoever holds a snapshot keeps it whatever is activated meanwhile.

    Args:
        catalog: Says which version is active.
        clock: Monotonic seconds.
    """

    def __init__(self, catalog: Catalog, clock: Callable[[], float] = time.monotonic) -> None:
        self._catalog = catalog
        self._clock = clock
        self._active: dict[str, ActiveDomain] = {}
        self._checked_at: dict[str, float] = {}
        self._damaged: dict[str, _Damage] = {}
        self._announced: dict[str, int] = {}
        self._loading = threading.Lock()

    @property
    def n_loaded(self) -> int:
        """How many maps are in memory."""
        return len(self._active)

    def loaded(self) -> list[ActiveDomain]:
        """The domains whose maps are in memory, by name."""
        return sorted(self._active.copy().values(), key=lambda one: one.record.name)

    def damaged(self) -> dict[str, int]:
        """The active versions that cannot be loaded, by domain; each is tried again, which reads its file."""
        still = {}
        for domain, known in sorted(self._damaged.copy().items()):
            try:
                self.refresh(domain)
            except UnavailableError as error:  # a disk that fails to read it now has not made it whole
                still[domain] = int(error.hints.get("map_version", known.version))
            except DeepSimbadError:  # deleted, or has no active map any more
                self._damaged.pop(domain, None)
        return still

    def peek(self, domain: str) -> ActiveDomain | None:
        """The domain and its active map if that is known without touching a file, else None."""
        if self._clock() - self._checked_at.get(domain, float("-inf")) > _TRUSTED_S:
            return None
        return self._active.get(domain)

    def active(self, domain: str) -> ActiveDomain:
        """The domain and its active map; may read files.

        Raises:
            UnknownDomainError: No such domain.
            NoActiveMapError: It has no map yet.
            DamagedMapError: The map's file is missing, fails its digest or contradicts itself.
            UnavailableError: The disk failed, no memory is left, ...: another try may read it.
        """
        known = self.peek(domain)
        if known is not None:
            return known
        return self.refresh(domain)

    def snapshot(self, domain: str) -> MapSnapshot:
        """The domain's active map; raises as `active` does."""
        return self.active(domain).snapshot

    def refresh(self, domain: str) -> ActiveDomain:
        """Ask the catalog now, and load the map it names if another is held; raises as `active` does."""
        with self._loading:
            try:
                record = self._catalog.domain(domain)
                active = ActiveDomain(record, self._current(record))
            except DeepSimbadError:
                self._forget(domain)
                raise
            self._active[domain] = active
            self._damaged.pop(domain, None)
            self._announce(domain, active.snapshot.version)
            self._checked_at[domain] = self._clock()
            return active

    def forget(self, domain: str) -> None:
        """Let go of a deleted domain's map."""
        with self._loading:
            self._forget(domain)
            self._damaged.pop(domain, None)
            self._announced.pop(domain, None)

    def load_all(self) -> dict[str, DamagedMapError]:
        """Load the active maps of all domains.

        Returns:
            What is damaged, by domain; each is logged, and so is what could not be read; neither keeps the service
            from starting.
        """
        damaged = {}
        for record in self._catalog.domains():
            if record.active_version is None:
                continue
            self._announced[record.name] = record.active_version  # it served before, which is no news
            try:
                self.refresh(record.name)
            except DamagedMapError as error:
                damaged[record.name] = error
            except UnavailableError as error:
                log.warning("an active map could not be read", extra={"domain": record.name, "why": error.message})
        return damaged

    def _forget(self, domain: str) -> None:
        self._active.pop(domain, None)
        self._checked_at.pop(domain, None)

    def _current(self, record: DomainRecord) -> MapSnapshot:
        version = record.active_version
        if version is None:
            raise NoActiveMapError(
                f"domain {record.name} has no active map: upload traverses and start a remap", domain=record.name
            )
        held = self._active.get(record.name)
        if held is not None and held.snapshot.version == version and held.record.created_at == record.created_at:
            return held.snapshot
        found = self._damaged.get(record.name)
        if found is not None and found.version == version and self._clock() - found.found_at < _DAMAGE_REMEMBERED_S:
            raise DamagedMapError(found.error.message, **found.error.hints) from found.error
        try:
            return load_snapshot(self._catalog, record.name, version)
        except DamagedMapError as error:
            self._damaged[record.name] = _Damage(version, error, self._clock())
            log.error("damaged map", extra={"domain": record.name, "map_version": version}, exc_info=error)
            raise

    def _announce(self, domain: str, version: int) -> None:
        """Say in the log that another version serves than before, whoever switched it."""
        before = self._announced.get(domain)
        if before != version:
            log.info(
                "map activated" if before is None or version > before else "map rolled back",
                extra={"domain": domain, "map_version": version, "before": before},
            )
            self._announced[domain] = version


def load_snapshot(catalog: Catalog, domain: str, version: int) -> MapSnapshot:
    """Check a map file's digest and read it; domain and version are the catalog's, whatever the file calls them.

    Raises:
        UnknownMapVersionError: No such version.
        RetiredMapError: Its file was removed.
        DamagedMapError: The file is missing, fails its digest or contradicts itself.
        UnavailableError: The disk failed, no memory is left, ...: the file may be whole.
    """
    record = catalog.map(domain, version)
    if record.removed_at is not None:
        raise removed(domain, version)
    path = catalog.map_path(domain, version)
    try:
        with storage_faults(path, DamagedMapError):
            if record.sha256 is not None:
                verify(path, record.sha256)
            # A map moved here from another server says in its file what it was called there.
            contents = replace(read_map(path), domain=domain, version=version)
            return MapSnapshot.from_contents(contents, index_bytes(path))
    except DamagedMapError as error:
        raise unreadable(catalog, domain, version) from error
    except UnavailableError as error:
        if catalog.map(domain, version).removed_at is not None:  # just now
            raise removed(domain, version) from error
        raise UnavailableError(
            f"map {version} of domain {domain} could not be read ({error.hints.get('reason')}): try again",
            reason=error.hints.get("reason"),
            domain=domain,
            map_version=version,
        ) from error
    except (DeepSimbadError, KeyError, TypeError, ValueError) as error:
        raise unreadable(catalog, domain, version) from error


def unreadable(catalog: Catalog, domain: str, version: int) -> DeepSimbadError:
    """The cause names a file of the server's; this names what a person can act on."""
    if catalog.map(domain, version).removed_at is not None:  # just now
        return removed(domain, version)
    return DamagedMapError(
        f"map {version} of domain {domain} is damaged: activate another version or start a remap",
        domain=domain,
        map_version=version,
    )
