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
from deepsimbad.store.records import DomainRecord, KeptMap, MapState, current_moment
from deepsimbad.store.sessions import SessionStore

log = logging.getLogger(__name__)

CACHE_BYTES = 1 << 30  # of active maps in memory, where nobody chose
_N_LOCKS = 64  # of loading: of two domains seldom the same
_TRUSTED_S = 1.0  # another process (the command line) may activate a map: the catalog is asked again after this
_DAMAGE_REMEMBERED_S = 5.0  # digesting a large damaged file for every request would be a gift to its sender


@dataclass(frozen=True)
class MappedDomain:
    """A domain and one of its maps, as of one moment."""

    record: DomainRecord
    snapshot: Map


class Maps:
    """Map versions, loaded at first need and each once; usable from any thread.

    The active map of a domain is held and switched by one reference assignment; requests read one dict entry. Whoever
    holds a snapshot keeps it whatever is activated or removed meanwhile, or gives way to others: of active maps those
    that were asked last stay in memory, as many as `cache_bytes` hold, and one at least.

    Args:
        catalog: Says which versions there are, and which serve.
        clock: Monotonic seconds.
        cache_bytes: Of the arrays of active maps in memory.
    """

    def __init__(
        self, catalog: Catalog, clock: Callable[[], float] = time.monotonic, cache_bytes: int = CACHE_BYTES
    ) -> None:
        self._catalog = catalog
        self._clock = clock
        self._cache_bytes = cache_bytes
        self._n_bytes = 0
        self._confirmed_at = -math.inf
        self._active: OrderedDict[str, MappedDomain] = OrderedDict()  # who was asked last is last
        self._checked_at: dict[str, float] = {}
        self._damaged: dict[str, tuple[int, DamagedMapError, float]] = {}  # version, why, and when that was noticed
        self._announced: dict[str, int] = {}
        self._began_at = current_moment()  # what was activated before is no news
        # By domain, version and digest: a domain that was deleted and made anew has other maps.
        self._held: WeakValueDictionary[tuple[str, int, str | None], Map] = WeakValueDictionary()
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
        """And how many bytes their arrays have."""
        return self._n_bytes

    @property
    def is_full(self) -> bool:
        """Whether a further map would hardly have room without another's giving way."""
        return self._n_bytes + self._n_bytes // max(len(self._active), 1) > self._cache_bytes

    def loaded(self) -> list[MappedDomain]:
        """The domains whose active maps are in memory, by name."""
        return sorted(self._active.copy().values(), key=lambda mapped: mapped.record.name)

    def damaged(self) -> dict[str, int]:
        """The active versions that cannot be loaded, by domain; each is tried again, which reads its file."""
        still_damaged = {}
        for domain, (version, *_) in sorted(self._damaged.copy().items()):
            try:
                self.refresh(domain)
            except UnavailableError as error:  # a disk that fails to read it now has not made it whole
                still_damaged[domain] = int(error.hints.get("map_version", version))
            except DeepSimbadError:  # deleted, or has no active map any more
                self._damaged.pop(domain, None)
        return still_damaged

    def peek(self, domain: str) -> MappedDomain | None:
        """The domain and its active map if that is known without touching a file, else None."""
        if self._clock() - self._checked_at.get(domain, float("-inf")) > _TRUSTED_S:
            return None
        mapped = self._active.get(domain)
        if mapped is not None:
            with suppress(KeyError):  # it gave way this moment
                self._active.move_to_end(domain)
        return mapped

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
            self._damaged.pop(domain, None)
            self._checked_at[domain] = self._clock()
            return active

    def confirm(self) -> None:
        """Ask the catalog once, at most once a second, which maps in memory still serve: for who looks at many."""
        at = self._clock()
        if at - self._confirmed_at <= _TRUSTED_S:
            return
        self._confirmed_at = at
        held = self._active.copy()
        serving = self._catalog.serving_versions(list(held))
        for domain, mapped in held.items():
            if serving.get(domain) == (mapped.record.created_at, mapped.snapshot.version):
                self._checked_at[domain] = at

    def forget(self, domain: str) -> None:
        """Let go of a deleted domain's map."""
        with self._lock_of(domain):
            self._let_go(domain)
            self._damaged.pop(domain, None)
            self._announced.pop(domain, None)

    def load_all(self, within_s: float = math.inf) -> list[str]:
        """Load active maps, those activated last first, and answer which domains' are damaged.

        Those are logged, and so are those that could not be read; neither keeps the service from starting. What has
        no room, or no time, is loaded when it is asked for.
        """
        damaged, until = [], self._clock() + within_s
        for domain in self._catalog.serving_domains():
            if self.is_full or self._clock() > until:
                break
            try:
                self.refresh(domain)
            except DamagedMapError:
                damaged.append(domain)
            except UnavailableError as error:
                log.warning("an active map could not be read", extra={"domain": domain, "why": error.message})
            except NotFoundError:
                continue  # deleted this moment
        return damaged

    def _lock_of(self, domain: str) -> threading.RLock:
        return self._loading[hash(domain) % _N_LOCKS]

    def _keep(self, mapped: MappedDomain) -> None:
        """Hold a map; those asked longest ago give way to it."""
        with self._counting:
            before = self._active.pop(mapped.record.name, None)
            self._active[mapped.record.name] = mapped
            self._n_bytes += mapped.snapshot.n_bytes - (before.snapshot.n_bytes if before else 0)
            while self._n_bytes > self._cache_bytes and len(self._active) > 1:
                domain, oldest = self._active.popitem(last=False)
                self._checked_at.pop(domain, None)
                self._n_bytes -= oldest.snapshot.n_bytes

    def _let_go(self, domain: str) -> None:
        with self._counting:
            mapped = self._active.pop(domain, None)
            self._n_bytes -= mapped.snapshot.n_bytes if mapped else 0
        self._checked_at.pop(domain, None)

    def _current_or_last(self, record: DomainRecord) -> Map:
        """The active map, or while its file cannot be had (a map store is away, ...) the one that served before."""
        try:
            return self._current(record)
        except DamagedMapError:
            raise
        except UnavailableError:
            last = self._active.get(record.name)
            if last is None or last.record.created_at != record.created_at:
                raise
            return last.snapshot

    def _current(self, record: DomainRecord) -> Map:
        domain, version = record.name, record.active_version
        if version is None:
            raise no_active_map(domain)
        if domain in self._damaged:
            damaged_version, why, noticed_at = self._damaged[domain]
            if damaged_version == version and self._clock() - noticed_at < _DAMAGE_REMEMBERED_S:
                raise DamagedMapError(why.message, **why.hints) from why
        try:
            its_map = self._catalog.map(domain, version)
            snapshot = self._load(domain, version, its_map.sha256)
        except DamagedMapError as error:
            self._damaged[domain] = version, error, self._clock()
            log.error("damaged map", extra={"domain": domain, "map_version": version}, exc_info=error)
            raise
        self._announce(domain, version, its_map.activated_at or "")
        return snapshot

    def _load(self, domain: str, version: int, digest: str | None) -> Map:
        snapshot = self._held.get((domain, version, digest))
        if snapshot is None:
            snapshot = self._held[domain, version, digest] = load_snapshot(self._catalog, domain, version)
        return snapshot

    def _announce(self, domain: str, version: int, activated_at: str) -> None:
        """Say in the log that another version serves than before, whoever switched it."""
        before = self._announced.get(domain)
        if before != version and activated_at >= self._began_at:
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

    def is_beginning(self, domain: str, version: int) -> bool:
        """Whether a session is about to begin on a version. Waits for nobody who reads a file."""
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
                record, its_map = self._catalog.domain(domain), self._catalog.map(domain, version)
            except (UnknownDomainError, UnknownMapVersionError) as error:
                raise retired(domain, version) from error
            is_removed = its_map.state is not MapState.ACTIVE and not self._catalog.has_file(domain, version)
            if its_map.sha256 != digest or (is_removed and (domain, version, digest) not in self._held):
                raise retired(domain, version)
            return MappedDomain(record, self._load(domain, version, digest))

    def serves(self, domain: str) -> bool:
        """Whether the active map of a domain is in memory."""
        return domain in self._active

    def holds(self, domain: str, version: int, digest: str) -> bool:
        """Whether a version is in memory."""
        return (domain, version, digest) in self._held

    def snapshot(self, domain: str, version: int) -> Map:
        """A sealed map version that need not serve, as a session may be pinned to one; may read files.

        Raises:
            UnknownDomainError, UnknownMapVersionError: There is none, or it is still being built.
            RetiredMapError: It was removed.
            DamagedMapError: Its file is damaged, or missing though the version serves.
        """
        record = self._catalog.settled_map(domain, version)
        if record.removed_at is not None:
            raise removal_error(domain, version)
        if record.sha256 is None:
            raise UnknownMapVersionError(f"map {version} of domain {domain} is still being built", version=version)
        return self.pinned(domain, version, record.sha256).snapshot


class Retention:
    """Removes the files of old map versions; usable from any thread.

    A domain keeps its newest `keep_maps` retired versions to roll back to, and every version that a living session is
    pinned to. Of versions that were sealed but never served it keeps as many; older ones that lost to the version that
    serves go too.
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
            beyond = beyond_keeping(self._catalog.kept_maps(domain, self._keep_maps), self._keep_maps)
            pins = self._sessions.pins() if beyond else set()
        except DeepSimbadError:
            log.exception("old maps could not be looked for")
            return 0
        n_removed = 0
        for old in beyond:
            if (old.domain, old.version) in pins:
                continue
            labels = {"domain": old.domain, "map_version": old.version}
            try:
                self.remove(old.domain, old.version)
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
            RetiredMapError: It was removed before.
            MapInUseError: It serves, is being built, or a living session is pinned to it.
        """

        def is_pinned() -> bool:
            # A session begins in memory first and is in its file then: asked in this order, it is in one of them.
            return self._maps.is_beginning(domain, version) or (domain, version) in self._sessions.pins()

        self._catalog.remove_map(domain, version, is_pinned)


def beyond_keeping(versions: Iterable[KeptMap], keep_maps: int) -> list[KeptMap]:
    """Of the versions that have their files, ordered by domain, those beyond what a domain keeps, pinned or not."""
    beyond: list[KeptMap] = []
    for _, of_domain in groupby(versions, lambda version: version.domain):
        newest_first = sorted(of_domain, key=lambda version: (version.retired_at or "", version.version), reverse=True)
        retired = [version for version in newest_first if version.state is MapState.RETIRED]
        sealed = [version for version in newest_first if version.state is MapState.SEALED]
        active = max((version.version for version in newest_first if version.state is MapState.ACTIVE), default=0)
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
        raise removal_error(domain, version)
    try:
        with storage_faults(catalog.map_path(domain, version), DamagedMapError):
            path = catalog.map_file(domain, version)
            # A map moved here from another server says in its file what it was called there.
            snapshot = replace(read_map(path), domain=domain, version=version)
            _ = snapshot.relevance  # without one it can answer nothing
            return snapshot
    except (DeepSimbadError, KeyError, TypeError, ValueError) as error:
        answer = unreadable(catalog, domain, version)
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


def unreadable(catalog: Catalog, domain: str, version: int) -> DeepSimbadError:
    """The cause names a file of the server's; this names what a person can act on."""
    if catalog.map(domain, version).removed_at is not None:  # just now
        return removal_error(domain, version)
    return DamagedMapError(
        f"map {version} of domain {domain} is damaged: activate another version or start a remap",
        domain=domain,
        map_version=version,
    )


def no_active_map(domain: str) -> NoActiveMapError:
    """What is said of a domain before its first map."""
    return NoActiveMapError(f"domain {domain} has no active map: upload traverses and start a remap", domain=domain)


def retired(domain: str, version: int) -> RetiredMapError:
    """What is said to a session whose map is no more."""
    return RetiredMapError(
        f"map {version} of domain {domain}, which the session was begun on, is no more: begin a new session",
        domain=domain,
        map_version=version,
    )
