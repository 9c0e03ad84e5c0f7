"""Which old map versions keep their files, and removing the others.

A domain keeps its newest retired versions to roll back to, and every version that a living session is pinned to. Of
versions that were sealed but never served it keeps as many; older ones that lost to the version that serves go too.
"""

import logging
from collections.abc import Iterable

from deepsimbad.engine.pinned_maps import PinnedMaps
from deepsimbad.errors import DeepSimbadError, MapInUseError, NotFoundError, RetiredMapError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeptMap, MapState
from deepsimbad.store.sessions import SessionStore

log = logging.getLogger(__name__)


class Retention:
    """Removes the files of map versions; usable from any thread.

    Args:
        catalog: Says which versions there are.
        sessions: What versions living sessions are pinned to.
        maps: On which sessions are just beginning.
        keep_maps: How many retired versions a domain keeps, and how many sealed ones.
    """

    def __init__(self, catalog: Catalog, sessions: SessionStore, maps: PinnedMaps, keep_maps: int) -> None:
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
            kept = self._catalog.kept_maps()
            beyond = [one for one in beyond_keeping(kept, self._keep_maps) if domain in {None, one.domain}]
            pinned = self._sessions.pins() if beyond else set()
        except DeepSimbadError:
            log.exception("old maps could not be looked for")
            return 0
        n_removed = 0
        for one in beyond:
            if (one.domain, one.version) in pinned:
                continue
            try:
                self.remove(one.domain, one.version)
            except (MapInUseError, RetiredMapError, NotFoundError):
                continue  # somebody was faster
            except DeepSimbadError:
                log.exception("an old map could not be removed", extra=_named(one))
            else:
                n_removed += 1
                log.info("old map removed", extra=_named(one))
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
    """The versions beyond those that a domain keeps, whoever is pinned to them.

    Args:
        kept: The versions that have their files, of any domains.
        keep_maps: How many to keep.
    """
    domains: dict[str, list[KeptMap]] = {}
    for one in kept:
        domains.setdefault(one.domain, []).append(one)
    beyond: list[KeptMap] = []
    for versions in domains.values():
        retired = [one for one in versions if one.state is MapState.RETIRED]
        retired.sort(key=lambda one: (one.retired_at or "", one.version), reverse=True)
        sealed = [one for one in versions if one.state is MapState.SEALED]
        sealed.sort(key=lambda one: one.version, reverse=True)
        active = max((one.version for one in versions if one.state is MapState.ACTIVE), default=0)
        beyond += retired[keep_maps:]
        beyond += [one for one in sealed[keep_maps:] if one.version < active]  # a newer one may be about to serve
    return beyond


def _named(one: KeptMap) -> dict[str, object]:
    return {"domain": one.domain, "map_version": one.version}
