"""Map versions in memory: those that serve, those that sessions are pinned to, and which old files are kept."""

import logging
import math
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import groupby
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
from deepsimbad.store.catalog_maps import removal_error
from deepsimbad.store.durable import storage_faults
from deepsimbad.store.map_file import read_map
from deepsimbad.store.records import DomainRecord, MapRecord, MapState, current_moment
from deepsimbad.store.sessions import SessionStore

log = logging.getLogger(__name__)

CACHE_BYTES = 1 << 30  # of active maps in memory, where nobody chose
_N_LOCKS = 64  # of loading: two domains seldom share one
_TRUSTED_S = 1.0  # another process (the command line) may activate a map: the catalog is asked again after this
_DAMAGE_REMEMBERED_S = 5.0  # digesting a large damaged file for every request would be a gift to its sender


@dataclass(frozen=True)
class MappedDomain:
    """A domain and one of its maps, as of one moment."""

    record: DomainRecord
    snapshot: Map


class Maps:
    """Map versions, loaded at first need and each once; usable from any thread.

    The active map of a domain is held and switched by one reference assignment; requests read one dict entry. Of active
    maps those that were asked last stay in memory, as many as `cache_bytes` hold, and one at least. Whoever holds a
    snapshot keeps it, whatever is activated, removed or dropped from memory meanwhile.

    Args:
        catalog: Says which versions there are, and which serve.
        clock: Monotonic seconds.
        cache_bytes: Most bytes of arrays of active maps in memory; one map may have more.
    """

    def __init__(
        self, catalog: Catalog, clock: Callable[[], float] = time.monotonic, cache_bytes: int = CACHE_BYTES
    ) -> None:
        self._catalog = catalog
        self._clock = clock
        self._cache_bytes = cache_bytes
        self._n_bytes = 0
        self._confirmed_at = -math.inf
        self._active: OrderedDict[str, MappedDomain] = OrderedDict()  # by domain, the one asked last at the end
        self._checked_at: dict[str, float] = {}
        self._damages: dict[str, tuple[int, DamagedMapError, float]] = {}  # by domain: version, error, when noticed
        self._announced_versions: dict[str, int] = {}
        self._began_at = current_moment()  # maps activated before it are not logged
        # By domain, version and digest: a domain that was deleted and made anew has other maps.
        self._snapshots: WeakValueDictionary[tuple[str, int, str | None], Map] = WeakValueDictionary()
        self._loading = tuple(threading.RLock() for _ in range(_N_LOCKS))  # who asks for a map being read waits for it
        self._n_beginning: Counter[tuple[str, int]] = Counter()
        self._counting = threading.Lock()

    # Those that serve

    @property
    def n_loaded(self) -> int:
        """How many active maps are in memory."""
        return len(self._active)

    @property
    def n_bytes(self) -> int:
        """How many bytes the arrays of the active maps in memory have."""
        return self._n_bytes

    @property
    def is_full(self) -> bool:
        """Whether a further map of mean size would take the place of another."""
        return self._n_bytes + self._n_bytes // max(len(self._active), 1) > self._cache_bytes

    def loaded(self) -> list[MappedDomain]:
        """The domains whose active maps are in memory, by name."""
        return sorted(self._active.copy().values(), key=lambda mapped_domain: mapped_domain.record.name)

    def damaged(self) -> dict[str, int]:
        """The numbers of active versions that cannot be loaded, by domain; tries each again, which reads its file."""
        damaged_versions = {}
        for domain, (version, *_) in sorted(self._damages.copy().items()):
            try:
                self.refresh(domain)
            except UnavailableError as error:  # a disk that fails to read it now has not made it whole
                damaged_versions[domain] = int(error.hints.get("map_version", version))
            except DeepSimbadError:  # deleted, or has no active map any more
                self._damages.pop(domain, None)
        return damaged_versions

    def peek(self, domain: str) -> MappedDomain | None:
        """The domain and its active map if that is known without touching a file, else None."""
        if self._clock() - self._checked_at.get(domain, float("-inf")) > _TRUSTED_S:
            return None
        mapped_domain = self._active.get(domain)
        if mapped_domain is not None:
            with suppress(KeyError):  # it gave way this moment
                self._active.move_to_end(domain)
        return mapped_domain

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
        with self._lock_of(domain):
            try:
                record = self._catalog.domain(domain)
                active = MappedDomain(record, self._current_or_last(record))
            except DeepSimbadError:
                self._let_go(domain)
                raise
            self._keep(active)
            self._damages.pop(domain, None)
            self._checked_at[domain] = self._clock()
            return active

    def confirm(self) -> None:
        """Ask the catalog once for all maps in memory, at most once a second, which of them still serve."""
        now_s = self._clock()
        if now_s - self._confirmed_at <= _TRUSTED_S:
            return
        self._confirmed_at = now_s
        mapped_domains = self._active.copy()
        serving_versions = self._catalog.serving_versions(list(mapped_domains))
        for domain, mapped_domain in mapped_domains.items():
            if serving_versions.get(domain) == (mapped_domain.record.created_at, mapped_domain.snapshot.version):
                self._checked_at[domain] = now_s

    def forget(self, domain: str) -> None:
        """Let go of a deleted domain's map."""
        with self._lock_of(domain):
            self._let_go(domain)
            self._damages.pop(domain, None)
            self._announced_versions.pop(domain, None)

    def load_all(self, within_s: float = math.inf) -> list[str]:
        """Load active maps, those activated last first; the names of the domains whose maps are damaged.

        Damaged and unreadable maps are logged and keep no service from starting. A map for which there is no room or no
        time is loaded when it is asked for.
        """
        damaged_domains, deadline_s = [], self._clock() + within_s
        for domain in self._catalog.serving_domains():
            if self.is_full or self._clock() > deadline_s:
                break
            try:
                self.refresh(domain)
            except DamagedMapError:
                damaged_domains.append(domain)
            except UnavailableError as error:
                log.warning("an active map could not be read", extra={"domain": domain, "why": error.message})
            except NotFoundError:
                continue  # deleted this moment
        return damaged_domains

    def _lock_of(self, domain: str) -> threading.RLock:
        return self._loading[hash(domain) % _N_LOCKS]

    def _keep(self, mapped_domain: MappedDomain) -> None:
        """Hold an active map, and drop from memory those asked longest ago for which there is no room."""
        with self._counting:
            previous = self._active.pop(mapped_domain.record.name, None)
            self._active[mapped_domain.record.name] = mapped_domain
            self._n_bytes += mapped_domain.snapshot.n_bytes - (previous.snapshot.n_bytes if previous else 0)
            while self._n_bytes > self._cache_bytes and len(self._active) > 1:
                domain, oldest = self._active.popitem(last=False)
                self._checked_at.pop(domain, None)
                self._n_bytes -= oldest.snapshot.n_bytes

    def _let_go(self, domain: str) -> None:
        with self._counting:
            mapped_domain = self._active.pop(domain, None)
            self._n_bytes -= mapped_domain.snapshot.n_bytes if mapped_domain else 0
        self._checked_at.pop(domain, None)

    def _current_or_last(self, record: DomainRecord) -> Map:
        """The active map, or while its file cannot be had (a map store is away, ...) the one that served before."""
        try:
            return self._current(record)
        except DamagedMapError:
            raise
        except UnavailableError:
            mapped_domain = self._active.get(record.name)
            if mapped_domain is None or mapped_domain.record.created_at != record.created_at:
                raise
            return mapped_domain.snapshot

    def _current(self, record: DomainRecord) -> Map:
        domain, version = record.name, record.active_version
        if version is None:
            raise no_active_map_error(domain)
        if domain in self._damages:
            damaged_version, damage, noticed_at = self._damages[domain]
            if damaged_version == version and self._clock() - noticed_at < _DAMAGE_REMEMBERED_S:
                raise DamagedMapError(damage.message, **damage.hints) from damage
        try:
            map_record = self._catalog.map(domain, version)
            snapshot = self._load(domain, version, map_record.sha256)
        except DamagedMapError as error:
            self._damages[domain] = version, error, self._clock()
            log.error("damaged map", extra={"domain": domain, "map_version": version}, exc_info=error)
            raise
        self._announce(domain, version, map_record.activated_at or "")
        return snapshot

    def _load(self, domain: str, version: int, digest: str | None) -> Map:
        snapshot = self._snapshots.get((domain, version, digest))
        if snapshot is None:
            snapshot = self._snapshots[domain, version, digest] = load_snapshot(self._catalog, domain, version)
        return snapshot

    def _announce(self, domain: str, version: int, activated_at: str) -> None:
        """Log that another version serves than before, whoever activated it."""
        previous_version = self._announced_versions.get(domain)
        if previous_version != version and activated_at >= self._began_at:
            log.info(
                "map activated" if previous_version is None or version > previous_version else "map rolled back",
                extra={"domain": domain, "map_version": version, "before": previous_version},
            )
        self._announced_versions[domain] = version

    # Those that sessions are pinned to

    @contextmanager
    def beginning(self, snapshot: Map) -> Iterator[None]:
        """Keep a version's file inside the block, in which a session begins on it, until the session's row pins it.

        Enter it before `digest` asks the catalog: whoever removes a version first notes that in the catalog and then
        asks `is_beginning`, so that one of the two sees the other.
        """
        version = snapshot.domain, snapshot.version
        with self._counting:
            self._n_beginning[version] += 1
        try:
            yield
        finally:
            with self._counting:
                self._n_beginning[version] -= 1

    def is_beginning(self, domain: str, version: int) -> bool:
        """Whether a session is about to begin on a version; never waits for a file to be read."""
        with self._counting:
            return self._n_beginning[domain, version] > 0

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
        with self._lock_of(domain):
            try:
                record, map_record = self._catalog.domain(domain), self._catalog.map(domain, version)
            except (UnknownDomainError, UnknownMapVersionError) as error:
                raise retired_error(domain, version) from error
            is_removed = map_record.state is not MapState.ACTIVE and not self._catalog.has_file(domain, version)
            if map_record.sha256 != digest or (is_removed and (domain, version, digest) not in self._snapshots):
                raise retired_error(domain, version)
            return MappedDomain(record, self._load(domain, version, digest))

    def serves(self, domain: str) -> bool:
        """Whether the active map of a domain is in memory."""
        return domain in self._active

    def holds(self, domain: str, version: int, digest: str) -> bool:
        """Whether a version is in memory."""
        return (domain, version, digest) in self._snapshots

    def snapshot(self, domain: str, version: int) -> Map:
        """A sealed map version, whether or not it serves; may read files.

        Raises:
            UnknownDomainError, UnknownMapVersionError: There is no such version, or it is still being built.
            RetiredMapError: It was removed.
            DamagedMapError: Its file is damaged, or missing though the version serves.
        """
        return self.pinned(domain, version, self._catalog.sealed_digest(domain, version)).snapshot


class Retention:
    """Removes the files of old map versions; usable from any thread.

    A domain keeps its newest `keep_maps` retired versions to roll back to, and every version that a living session is
    pinned to. Of the versions that were sealed but never served, it keeps the newest `keep_maps`, and all that are
    newer than the version that serves.
    """

    def __init__(self, catalog: Catalog, sessions: SessionStore, maps: Maps, keep_maps: int) -> None:
        self._catalog = catalog
        self._sessions = sessions
        self._maps = maps
        self._keep_maps = keep_maps

    def prune(self, domain: str | None = None) -> int:
        """Remove the surplus versions of one domain, or of all; how many were removed.

        A version that cannot be removed now, because of a session or the disk, is left for the next time and raises
        nothing: the caller's own work must not fail for it.
        """
        try:
            surplus = surplus_versions(self._catalog.kept_maps(domain, self._keep_maps), self._keep_maps)
            pins = self._sessions.pins() if surplus else set()
        except DeepSimbadError:
            log.exception("old maps could not be looked for")
            return 0
        n_removed = 0
        for kept_map in surplus:
            if (kept_map.domain, kept_map.version) in pins:
                continue
            labels = {"domain": kept_map.domain, "map_version": kept_map.version}
            try:
                self.remove(kept_map.domain, kept_map.version)
            except (MapInUseError, RetiredMapError, NotFoundError):
                continue  # somebody was faster
            except DeepSimbadError:
                log.exception("an old map could not be removed", extra=labels)
            else:
                n_removed += 1
                log.info("old map removed", extra=labels)
        return n_removed

    def remove(self, domain: str, version: int) -> None:
        """Remove the file of a version; its row stays.

        Raises:
            UnknownDomainError, UnknownMapVersionError: There is no such version.
            RetiredMapError: It is removed already.
            MapInUseError: It serves, is being built, or a living session is pinned to it.
        """

        def is_pinned() -> bool:
            # A session begins in memory first and is in its file then: asked in this order, it is in one of them.
            return self._maps.is_beginning(domain, version) or (domain, version) in self._sessions.pins()

        self._catalog.remove_map(domain, version, is_pinned)


def surplus_versions(versions: Iterable[MapRecord], keep_maps: int) -> list[MapRecord]:
    """The versions that no domain keeps, pinned or not, of versions that have their files and are ordered by domain."""
    surplus: list[MapRecord] = []
    for _, of_domain in groupby(versions, lambda version: version.domain):
        newest_first = sorted(of_domain, key=lambda version: (version.retired_at or "", version.version), reverse=True)
        retired = [version for version in newest_first if version.state is MapState.RETIRED]
        sealed = [version for version in newest_first if version.state is MapState.SEALED]
        active = max((version.version for version in newest_first if version.state is MapState.ACTIVE), default=0)
        surplus += retired[keep_maps:]
        surplus += [version for version in sealed[keep_maps:] if version.version < active]  # a newer one may soon serve
    return surplus


def load_snapshot(catalog: Catalog, domain: str, version: int) -> Map:
    """Check a map file's digest and read it; domain and version are the catalog's, whatever the file calls them.

    Raises:
        UnknownMapVersionError: No such version.
        RetiredMapError: Its file was removed.
        DamagedMapError: The file is missing, fails its digest, contradicts itself or makes no sense (`Map.check`).
        UnavailableError: The disk failed, no memory is left, ...: the file may be whole.
    """
    record = catalog.map(domain, version)
    if record.removed_at is not None:
        raise removal_error(domain, version)
    try:
        with storage_faults(catalog.map_path(domain, version), DamagedMapError):
            path = catalog.map_file(domain, version)
            # A map moved here from another server says in its file what it was called there.
            snapshot = replace(read_map(path), domain=domain, version=version)
            _ = snapshot.relevance  # without one it can answer nothing
            snapshot.check()  # it may come from a map store, to which others write
            return snapshot
    except (DeepSimbadError, KeyError, TypeError, ValueError) as error:
        answer = unreadable_error(catalog, domain, version)
        is_damaged = not isinstance(error, UnavailableError) or isinstance(error, DamagedMapError)
        if isinstance(answer, RetiredMapError) or is_damaged:
            raise answer from error
        reason = getattr(error, "hints", {}).get("reason")
        raise UnavailableError(
            f"map {version} of domain {domain} could not be read ({reason}): try again",
            reason=reason,
            domain=domain,
            map_version=version,
        ) from error


def unreadable_error(catalog: Catalog, domain: str, version: int) -> DeepSimbadError:
    """The error for a map file that cannot be read: its cause names a file, this what a person can do."""
    if catalog.map(domain, version).removed_at is not None:  # just now
        return removal_error(domain, version)
    return DamagedMapError(
        f"map {version} of domain {domain} is damaged: activate another version or start a remap",
        domain=domain,
        map_version=version,
    )


def no_active_map_error(domain: str) -> NoActiveMapError:
    """The error for a domain before its first map."""
    return NoActiveMapError(f"domain {domain} has no active map: upload traverses and start a remap", domain=domain)


def retired_error(domain: str, version: int) -> RetiredMapError:
    """The error for a session whose map is no more."""
    return RetiredMapError(
        f"map {version} of domain {domain}, which the session was begun on, is no more: begin a new session",
        domain=domain,
        map_version=version,
    )
