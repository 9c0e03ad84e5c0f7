"""Map versions in memory: those that serve, those that sessions are pinned to, and which old files are kept."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from weakref import WeakValueDictionary

from deepsimbad.core.map import Map
from deepsimbad.errors import (
    DamagedMapError,
    DeepSimbadError,
    MapInUseError,
    NoActiveMapError,
    NotFoundError,
    RetiredMapError,
    UnavailableError,
    UnknownDomainError,
    UnknownMapVersionError,
)
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import removed
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.map_file import read_map
from deepsimbad.store.records import DomainRecord, KeptMap, MapState
from deepsimbad.store.sealing import verify
from deepsimbad.store.sessions import SessionStore

log = logging.getLogger(__name__)

_TRUSTED_S = 1.0  # another process (the command line) may activate a map: the catalog is asked again after this
_DAMAGE_REMEMBERED_S = 5.0  # digesting a large damaged file for every request would be a gift to its sender


@dataclass(frozen=True)
class MappedDomain:
    """A domain and one of its maps, as of one moment."""

    record: DomainRecord
    snapshot: Map


@dataclass(frozen=True)
class _Damage:
    version: int
    error: DamagedMapError
    noticed_at: float


class Maps:
    """Map versions, loaded at first need and each once; usable from any thread.

    The active map of a domain is held and switched by one reference assignment; requests read one dict entry. Whoever
    holds a snapshot keeps it whatever is activated or removed meanwhile.

    Args:
        catalog: Says which versions there are, and which serve.
        clock: Monotonic seconds.
    """

    def __init__(self, catalog: Catalog, clock: Callable[[], float] = time.monotonic) -> None:
        self._catalog = catalog
        self._clock = clock
        self._active: dict[str, MappedDomain] = {}
        self._checked_at: dict[str, float] = {}
        self._damaged: dict[str, _Damage] = {}
        self._announced: dict[str, int] = {}
        # By domain, version and digest: a domain that was deleted and made anew has other maps.
        self._held: WeakValueDictionary[tuple[str, int, str | None], Map] = WeakValueDictionary()
        self._loading = threading.RLock()
        self._n_beginning: Counter[tuple[str, int]] = Counter()
        self._counting = threading.Lock()

    # Those that serve

    @property
    def n_loaded(self) -> int:
        """How many active maps are in memory."""
        return len(self._active)

    def loaded(self) -> list[MappedDomain]:
        """The domains whose active maps are in memory, by name."""
        return sorted(self._active.copy().values(), key=lambda mapped: mapped.record.name)

    def damaged(self) -> dict[str, int]:
        """The active versions that cannot be loaded, by domain; each is tried again, which reads its file."""
        still_damaged = {}
        for domain, damage in sorted(self._damaged.copy().items()):
            try:
                self.refresh(domain)
            except UnavailableError as error:  # a disk that fails to read it now has not made it whole
                still_damaged[domain] = int(error.hints.get("map_version", damage.version))
            except DeepSimbadError:  # deleted, or has no active map any more
                self._damaged.pop(domain, None)
        return still_damaged

    def peek(self, domain: str) -> MappedDomain | None:
        """The domain and its active map if that is known without touching a file, else None."""
        if self._clock() - self._checked_at.get(domain, float("-inf")) > _TRUSTED_S:
            return None
        return self._active.get(domain)

    def active(self, domain: str) -> MappedDomain:
        """The domain and its active map; may read files.

        Raises:
            UnknownDomainError, NoActiveMapError: There is no such domain, or it has no map yet.
            DamagedMapError: The map's file is missing, fails its digest or contradicts itself.
            UnavailableError: The disk failed, no memory is left, ...: another try may read it.
        """
        return self.peek(domain) or self.refresh(domain)

    def refresh(self, domain: str) -> MappedDomain:
        """Ask the catalog now, and load the map it names if another is held; raises as `active` does."""
        with self._loading:
            try:
                record = self._catalog.domain(domain)
                active = MappedDomain(record, self._current(record))
            except DeepSimbadError:
                self._let_go(domain)
                raise
            self._active[domain] = active
            self._damaged.pop(domain, None)
            self._announce(domain, active.snapshot.version)
            self._checked_at[domain] = self._clock()
            return active

    def forget(self, domain: str) -> None:
        """Let go of a deleted domain's map."""
        with self._loading:
            self._let_go(domain)
            self._damaged.pop(domain, None)
            self._announced.pop(domain, None)

    def load_all(self) -> dict[str, DamagedMapError]:
        """Load the active maps of all domains; answers what is damaged, by domain.

        That is logged, and so is what could not be read; neither keeps the service from starting.
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

    def _let_go(self, domain: str) -> None:
        self._active.pop(domain, None)
        self._checked_at.pop(domain, None)

    def _current(self, record: DomainRecord) -> Map:
        domain, version = record.name, record.active_version
        if version is None:
            raise NoActiveMapError(
                f"domain {domain} has no active map: upload traverses and start a remap", domain=domain
            )
        damage = self._damaged.get(domain)
        is_same = damage is not None and damage.version == version
        if damage is not None and is_same and self._clock() - damage.noticed_at < _DAMAGE_REMEMBERED_S:
            raise DamagedMapError(damage.error.message, **damage.error.hints) from damage.error
        try:
            return self._once(domain, version, self._catalog.map(domain, version).sha256)
        except DamagedMapError as error:
            self._damaged[domain] = _Damage(version, error, self._clock())
            log.error("damaged map", extra={"domain": domain, "map_version": version}, exc_info=error)
            raise

    def _once(self, domain: str, version: int, digest: str | None) -> Map:
        snapshot = self._held.get((domain, version, digest))
        if snapshot is None:
            snapshot = load_snapshot(self._catalog, domain, version)
            self._held[domain, version, digest] = snapshot
        return snapshot

    def _announce(self, domain: str, version: int) -> None:
        """Say in the log that another version serves than before, whoever switched it."""
        before = self._announced.get(domain)
        if before != version:
            log.info(
                "map activated" if before is None or version > before else "map rolled back",
                extra={"domain": domain, "map_version": version, "before": before},
            )
            self._announced[domain] = version

    # Those that sessions are pinned to

    @contextmanager
    def beginning(self, snapshot: Map) -> Iterator[None]:
        """A session is about to begin on a version, which keeps its file until the session's own row says that it must.

        Entered before the catalog is asked in `digest`; who removes a version notes that in the catalog and asks here
        then, so that one of the two sees the other.
        """
        version = snapshot.domain, snapshot.version
        with self._counting:
            self._n_beginning[version] += 1
        try:
            yield
        finally:
            with self._counting:
                self._n_beginning[version] -= 1
                if not self._n_beginning[version]:
                    del self._n_beginning[version]

    def is_beginning(self, domain: str, version: int) -> bool:
        """Whether a session is about to begin on a version. Waits for nobody who reads a file."""
        with self._counting:
            return (domain, version) in self._n_beginning

    def digest(self, snapshot: Map) -> str:
        """The digest of a map that a session begins on, inside `beginning`; may read files.

        Raises:
            UnknownMapVersionError: The domain was deleted meanwhile.
            UnavailableError: Another map serves by now, and this one was removed: ask for the active map again.
        """
        record = self._catalog.settled_map(snapshot.domain, snapshot.version)
        if record.removed_at is not None:
            raise UnavailableError(f"domain {snapshot.domain} was given another map this moment: try again")
        return record.sha256 or ""

    def pinned(self, domain: str, version: int, digest: str) -> MappedDomain:
        """The version that a session was begun on; may read files.

        Raises:
            RetiredMapError: The version is no more.
            DamagedMapError: Its file is damaged, or missing though the version serves.
        """
        with self._loading:
            try:
                record, its_map = self._catalog.domain(domain), self._catalog.map(domain, version)
            except (UnknownDomainError, UnknownMapVersionError) as error:
                raise retired(domain, version) from error
            is_removed = its_map.state is not MapState.ACTIVE and not self._catalog.map_path(domain, version).exists()
            if its_map.sha256 != digest or (is_removed and (domain, version, digest) not in self._held):
                raise retired(domain, version)
            return MappedDomain(record, self._once(domain, version, digest))

    def snapshot(self, domain: str, version: int) -> Map:
        """A sealed map version that need not serve, as a session may be pinned to one; may read files.

        Raises:
            UnknownDomainError, UnknownMapVersionError: There is none, or it is still being built.
            RetiredMapError: It was removed.
            DamagedMapError: Its file is damaged, or missing though the version serves.
        """
        record = self._catalog.settled_map(domain, version)
        if record.removed_at is not None:
            raise removed(domain, version)
        if record.sha256 is None:
            raise UnknownMapVersionError(f"map {version} of domain {domain} is still being built", version=version)
        return self.pinned(domain, version, record.sha256).snapshot


class Retention:
    """Removes the files of old map versions; usable from any thread.

    A domain keeps its newest retired versions to roll back to, and every version that a living session is pinned to. Of
    versions that were sealed but never served it keeps as many; older ones that lost to the version that serves go too.

    Args:
        catalog: Says which versions there are.
        sessions: What versions living sessions are pinned to.
        maps: On which sessions are just beginning.
        keep_maps: How many retired versions a domain keeps, and how many sealed ones.
    """

    def __init__(self, catalog: Catalog, sessions: SessionStore, maps: Maps, keep_maps: int) -> None:
        self._catalog = catalog
        self._sessions = sessions
        self._maps = maps
        self._keep_maps = keep_maps

    def prune(self, domain: str | None = None) -> int:
        """Remove what is beyond keeping, of one domain or all; answers how many versions it was.

        What cannot be removed now, because of a session or the disk, is tried again the next time: whoever asks has
        something else to do that must not fail for it.
        """
        try:
            kept = [version for version in self._catalog.kept_maps() if domain in {None, version.domain}]
            beyond = beyond_keeping(kept, self._keep_maps)
            pinned = self._sessions.pins() if beyond else set()
        except DeepSimbadError:
            log.exception("old maps could not be looked for")
            return 0
        n_removed = 0
        for old in beyond:
            if (old.domain, old.version) in pinned:
                continue
            named = {"domain": old.domain, "map_version": old.version}
            try:
                self.remove(old.domain, old.version)
            except (MapInUseError, RetiredMapError, NotFoundError):
                continue  # somebody was faster
            except DeepSimbadError:
                log.exception("an old map could not be removed", extra=named)
            else:
                n_removed += 1
                log.info("old map removed", extra=named)
        return n_removed

    def remove(self, domain: str, version: int) -> None:
        """Remove the file of a version; its row stays.

        Raises:
            UnknownDomainError, UnknownMapVersionError: There is no such version.
            RetiredMapError: It was removed before.
            MapInUseError: It serves, is being built, or a living session is pinned to it.
        """
        self._catalog.remove_map(domain, version, lambda: self._is_pinned(domain, version))

    def _is_pinned(self, domain: str, version: int) -> bool:
        # A session begins in memory first and is in its file then: asked in this order, it is in one of them.
        return self._maps.is_beginning(domain, version) or (domain, version) in self._sessions.pins()


def beyond_keeping(kept: Iterable[KeptMap], keep_maps: int) -> list[KeptMap]:
    """Of the versions that have their files, of any domains, those beyond what a domain keeps, pinned or not."""
    domains: dict[str, list[KeptMap]] = {}
    for version in kept:
        domains.setdefault(version.domain, []).append(version)
    beyond: list[KeptMap] = []
    for versions in domains.values():
        retired = [version for version in versions if version.state is MapState.RETIRED]
        retired.sort(key=lambda version: (version.retired_at or "", version.version), reverse=True)
        sealed = [version for version in versions if version.state is MapState.SEALED]
        sealed.sort(key=lambda version: version.version, reverse=True)
        active = max((version.version for version in versions if version.state is MapState.ACTIVE), default=0)
        beyond += retired[keep_maps:]
        beyond += [version for version in sealed[keep_maps:] if version.version < active]  # a newer one may soon serve
    return beyond


def load_snapshot(catalog: Catalog, domain: str, version: int) -> Map:
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
            snapshot = replace(read_map(path), domain=domain, version=version)
            _ = snapshot.relevance  # without one it can answer nothing
            return snapshot
    except UnavailableError as error:
        if isinstance(error, DamagedMapError):
            raise unreadable(catalog, domain, version) from error
        if catalog.map(domain, version).removed_at is not None:  # just now
            raise removed(domain, version) from error
        reason = error.hints.get("reason")
        raise UnavailableError(
            f"map {version} of domain {domain} could not be read ({reason}): try again",
            reason=reason,
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


def retired(domain: str, version: int) -> RetiredMapError:
    """What is said to a session whose map is no more."""
    return RetiredMapError(
        f"map {version} of domain {domain}, which the session was begun on, is no more: begin a new session",
        domain=domain,
        map_version=version,
    )
