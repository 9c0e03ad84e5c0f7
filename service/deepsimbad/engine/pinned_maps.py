"""The map versions that sessions are pinned to: held as long as a session holds them, loaded once for all of them."""

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from weakref import WeakValueDictionary

from deepsimbad.engine.active_maps import ActiveDomain, ActiveMaps, load_snapshot
from deepsimbad.engine.evaluator_pool import EvaluatorPool
from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.errors import (
    DeepSimbadError,
    RetiredMapError,
    UnavailableError,
    UnknownDomainError,
    UnknownMapVersionError,
)
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_table import removed
from deepsimbad.store.records import DomainRecord, MapState

_Key = tuple[str, int, str]  # domain, version, digest: a domain that was deleted and made anew has other maps


class PinnedMaps:
    """Map versions by what identifies them for ever; usable from any thread.

    Args:
        catalog: Says which versions there are.
        active_maps: The versions that serve, which are in memory anyway.
        evaluators: Of all domains.
    """

    def __init__(self, catalog: Catalog, active_maps: ActiveMaps, evaluators: EvaluatorPool) -> None:
        self._catalog = catalog
        self._active_maps = active_maps
        self._evaluators = evaluators
        self._held: WeakValueDictionary[_Key, MapSnapshot] = WeakValueDictionary()
        self._lock = threading.Lock()
        self._n_beginning: Counter[tuple[str, int]] = Counter()
        self._counting = threading.Lock()

    @contextmanager
    def beginning(self, snapshot: MapSnapshot) -> Iterator[None]:
        """A session is about to begin on a version, which keeps its file until the session's own row says that it must.

        Entered before the catalog is asked in `pin`; who removes a version notes that in the catalog and asks here
        then, so that one of the two sees the other.
        """
        key = snapshot.domain, snapshot.version
        with self._counting:
            self._n_beginning[key] += 1
        try:
            yield
        finally:
            with self._counting:
                self._n_beginning[key] -= 1
                if not self._n_beginning[key]:
                    del self._n_beginning[key]

    def is_beginning(self, domain: str, version: int) -> bool:
        """Whether a session is about to begin on a version. Waits for nobody who reads a file."""
        with self._counting:
            return (domain, version) in self._n_beginning

    def pin(self, active: ActiveDomain) -> tuple[str, Evaluator]:
        """Digest of a domain's active map, and the domain's evaluator; may read files.

        Called inside `beginning`.

        Raises:
            UnknownMapVersionError, UnknownDomainError: The domain was deleted meanwhile.
            UnavailableError: Another map serves by now, and this one was removed: ask for the active map again.
        """
        snapshot = active.snapshot
        known = self._catalog.settled_map(snapshot.domain, snapshot.version)
        if known.removed_at is not None:
            raise UnavailableError(f"domain {snapshot.domain} was given another map this moment: try again")
        digest = known.sha256 or ""
        with self._lock:
            self._held[snapshot.domain, snapshot.version, digest] = snapshot
        return digest, self._evaluators.evaluator(active.record.evaluator)

    def take(self, domain: str, version: int, digest: str) -> tuple[MapSnapshot, Evaluator]:
        """A map version and its domain's evaluator; may read files.

        Raises:
            RetiredMapError: The version is no more.
            DamagedMapError: Its file is damaged, or missing though the version serves.
        """
        record, snapshot = self._taken(domain, version, digest)
        return snapshot, self._evaluators.evaluator(record.evaluator)

    def snapshot(self, domain: str, version: int) -> MapSnapshot:
        """A sealed map version that need not serve, as a session may be pinned to one; may read files.

        Raises:
            UnknownDomainError, UnknownMapVersionError: There is none, or it is still being built.
            RetiredMapError: It was removed.
            DamagedMapError: Its file is damaged, or missing though the version serves.
        """
        known = self._catalog.settled_map(domain, version)
        if known.removed_at is not None:
            raise removed(domain, version)
        if known.sha256 is None:
            raise UnknownMapVersionError(f"map {version} of domain {domain} is still being built", version=version)
        return self._taken(domain, version, known.sha256)[1]

    def _taken(self, domain: str, version: int, digest: str) -> tuple[DomainRecord, MapSnapshot]:
        with self._lock:
            try:
                record = self._catalog.domain(domain)
                known = self._catalog.map(domain, version)
            except (UnknownDomainError, UnknownMapVersionError) as error:
                raise retired(domain, version) from error
            is_removed = known.state is not MapState.ACTIVE and not self._catalog.map_path(domain, version).exists()
            snapshot = self._held.get((domain, version, digest))
            if known.sha256 != digest or (is_removed and snapshot is None):
                raise retired(domain, version)
            if snapshot is None:
                snapshot = self._load(record, version)
                self._held[domain, version, digest] = snapshot
        return record, snapshot

    def _load(self, record: DomainRecord, version: int) -> MapSnapshot:
        if record.active_version == version:
            try:
                active = self._active_maps.snapshot(record.name)
            except DeepSimbadError:
                active = None
            if active is not None and active.version == version:
                return active
        return load_snapshot(self._catalog, record.name, version)


def retired(domain: str, version: int) -> RetiredMapError:
    """What is said to a session whose map is no more."""
    return RetiredMapError(
        f"map {version} of domain {domain}, which the session was begun on, is no more: begin a new session",
        domain=domain,
        map_version=version,
    )
