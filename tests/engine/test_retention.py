"""Which old maps keep their files: the newest, and those that a session lives on."""

import asyncio
import sqlite3
import threading
from contextlib import closing, suppress
from itertools import pairwise
from pathlib import Path

import pytest

from deepsimbad.engine.maps import Retention, beyond_keeping
from deepsimbad.engine.session import SessionConfig
from deepsimbad.errors import MapInUseError, RetiredMapError, UnavailableError, UnknownMapVersionError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.layout import catalog_path
from deepsimbad.store.records import KeptMap, MapState

from .conftest import add_domain, add_map
from .live_service import Live, running

DOMAIN = "d"


@pytest.fixture
def mapped(catalog: Catalog) -> Catalog:
    add_domain(catalog, DOMAIN)
    catalog.activate(DOMAIN, add_map(catalog, DOMAIN), ANY)
    return catalog


def next_map(catalog: Catalog) -> int:
    version = add_map(catalog, DOMAIN)
    catalog.activate(DOMAIN, version, ANY)
    return version


def retention_of(live: Live, keep_maps: int = 1) -> Retention:
    return Retention(live.catalog, live.store, live.maps, keep_maps)


def with_files(catalog: Catalog) -> list[int]:
    """The versions that have a file; the catalog says the same."""
    found = [one.version for one in catalog.maps(DOMAIN) if catalog.map_path(DOMAIN, one.version).is_file()]
    assert found == [one.version for one in catalog.maps(DOMAIN) if one.removed_at is None]
    return found


def kept(*versions: tuple[int, str, str | None]) -> list[KeptMap]:
    return [KeptMap("d", version, MapState(state), retired_at) for version, state, retired_at in versions]


def beyond(versions: list[KeptMap], keep_maps: int) -> list[int]:
    return sorted(one.version for one in beyond_keeping(versions, keep_maps))


def test_the_newest_retired_by_when_they_ceased_to_serve_are_kept() -> None:
    history = kept(
        (1, "retired", "2026-01-04"),  # rolled back to, and retired again
        (2, "retired", "2026-01-02"),
        (3, "retired", "2026-01-03"),
        (4, "active", None),
        (5, "retired", None),  # before times were noted
    )
    assert beyond(history, 2) == [2, 5]
    assert beyond(history, 3) == [5]
    assert beyond(history, 4) == []


def test_the_one_that_served_last_is_the_newest_though_the_clock_was_set_back(mapped: Catalog) -> None:
    next_map(mapped)
    with closing(sqlite3.connect(catalog_path(mapped.data_dir))) as db, db:  # as noted by a clock that ran ahead
        db.execute("UPDATE map SET retired_at = '2999-01-01T00:00:00.000Z' WHERE version = 1")
    next_map(mapped)
    assert beyond(mapped.kept_maps(), 1) == [1], "version 2 served last"


def test_of_sealed_ones_only_those_that_lost_are_beyond() -> None:
    history = kept((1, "sealed", None), (2, "sealed", None), (3, "active", None), (4, "sealed", None))
    assert beyond(history, 1) == [1, 2]
    assert beyond(history, 2) == [1]
    newer = kept((1, "active", None), (2, "sealed", None), (3, "sealed", None))
    assert beyond(newer, 1) == []
    assert beyond(kept((1, "sealed", None), (2, "sealed", None)), 1) == []


def test_one_domain_alone_can_be_pruned(mapped: Catalog) -> None:
    add_domain(mapped, "e")
    for domain in (DOMAIN, "e"):
        for _ in range(3):
            mapped.activate(domain, add_map(mapped, domain), ANY)
    with running(mapped) as live:
        assert retention_of(live).prune("e") == 1
        assert len(with_files(mapped)) == 4
        assert retention_of(live).prune() == 2


def test_what_serves_or_is_being_built_is_not_removed(mapped: Catalog) -> None:
    building = mapped.begin_map(DOMAIN, {})
    with running(mapped) as live:
        with pytest.raises(MapInUseError, match="map 1 of domain d serves"):
            retention_of(live).remove(DOMAIN, 1)
        with pytest.raises(MapInUseError, match="is being built"):
            retention_of(live).remove(DOMAIN, building)
        with pytest.raises(UnknownMapVersionError):
            retention_of(live).remove(DOMAIN, 9)
        assert mapped.map_path(DOMAIN, 1).is_file()


def test_a_beginning_session_keeps_its_map_from_the_first_moment(mapped: Catalog) -> None:
    """Begun on what the service last saw serve, though another process has activated another map since."""
    with running(mapped) as live:
        stale = live.maps.active(DOMAIN)
        next_map(mapped)
        with live.maps.beginning(stale.snapshot), pytest.raises(MapInUseError):
            retention_of(live).remove(DOMAIN, 1)
        retention_of(live).remove(DOMAIN, 1)
        with pytest.raises(UnavailableError, match="try again"):
            asyncio.run(live.sessions.begin(stale, SessionConfig()))
        assert live.store.pins() == set()
        assert asyncio.run(live.sessions.begin(live.maps.refresh(DOMAIN), SessionConfig())).snapshot.version == 2


def test_sessions_begun_while_maps_are_switched_and_removed(mapped: Catalog) -> None:
    """Whatever the order of things, the map of every session that was acknowledged is there."""
    with running(mapped, max_sessions=1000) as live:
        retention = retention_of(live)
        done = threading.Event()

        def switching() -> None:
            try:
                for before, after in pairwise([1, *(add_map(mapped, DOMAIN) for _ in range(12))]):
                    mapped.activate(DOMAIN, after, before)
                    with suppress(MapInUseError):
                        retention.remove(DOMAIN, before)  # at once, which `prune` never does
            finally:
                done.set()

        async def beginning() -> int:
            n_begun = 0
            while not done.is_set():
                stale = live.maps.active(DOMAIN)
                try:
                    await live.sessions.begin(stale, SessionConfig())
                    n_begun += 1
                except UnavailableError:
                    live.maps.refresh(DOMAIN)
            return n_begun

        thread = threading.Thread(target=switching)
        thread.start()
        n_begun = asyncio.run(beginning())
        thread.join()
        pinned = {version for _, version in live.store.pins()}
        assert n_begun > 0
        assert pinned <= set(with_files(mapped))


def test_a_crash_between_the_mark_and_the_file_is_finished_at_the_next_start(
    mapped: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    next_map(mapped)

    def dies(*_: object) -> None:
        raise KeyboardInterrupt

    with running(mapped) as live:
        with monkeypatch.context() as patched:
            patched.setattr("deepsimbad.store.catalog_maps.remove_database", dies)
            with pytest.raises(KeyboardInterrupt):
                retention_of(live).remove(DOMAIN, 1)
        assert mapped.map(DOMAIN, 1).removed_at is not None
        assert mapped.map_path(DOMAIN, 1).is_file()
        with pytest.raises(RetiredMapError):
            mapped.activate(DOMAIN, 1, ANY)
    assert mapped.discard_unfinished() == ["removed the file of the removed map 1 of domain d"]
    assert with_files(mapped) == [2]


def test_where_sessions_cannot_be_read_nothing_is_removed_and_nobody_stopped(
    mapped: Catalog, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(2):
        next_map(mapped)
    folder: Path = mapped.map_path(DOMAIN, 1).parent
    with running(mapped) as live:
        live.store.close()
        assert retention_of(live).prune() == 0
        assert "old maps could not be looked for" in caplog.text
    assert len(list(folder.glob("*.sqlite"))) == 3
