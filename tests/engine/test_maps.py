"""Maps that serve are loaded when needed and switched at once; of old ones some keep their files."""

import asyncio
import errno
import sqlite3
import threading
from contextlib import closing, suppress
from itertools import pairwise
from pathlib import Path

import pytest

from deepsimbad.engine import maps as maps_module
from deepsimbad.engine.maps import Maps, Retention, surplus_versions
from deepsimbad.engine.session import SessionConfig
from deepsimbad.errors import DamagedMapError, MapInUseError, NoActiveMapError, RetiredMapError, UnavailableError
from deepsimbad.store import catalog_maps
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.layout import catalog_path
from deepsimbad.store.records import MapRecord, MapState

from .conftest import N_IMAGES, Clock, Service, add_domain, add_map, map_contents, open_service


@pytest.fixture
def maps(mapped_catalog: Catalog, clock: Clock) -> Maps:
    return Maps(mapped_catalog, clock)


def test_a_switch_is_seen_at_once_when_told_and_soon_when_not(catalog: Catalog, maps: Maps, clock: Clock) -> None:
    first = maps.active("d").snapshot
    assert (first.version, first.n_images, maps.n_loaded) == (1, N_IMAGES, 1)
    clock.now_s += 10
    assert maps.active("d").snapshot is first  # an unchanged version is not read again
    add_map(catalog)
    assert maps.active("d").snapshot is first  # trusted for a second
    assert maps.refresh("d").snapshot.version == 2
    catalog.activate("d", 1, 2)
    clock.now_s += 1.1
    assert maps.peek("d") is None
    assert maps.active("d").snapshot.version == 1


def test_a_domain_made_anew_under_an_old_name_gets_its_own_map(catalog: Catalog, maps: Maps, clock: Clock) -> None:
    old_snapshot = maps.active("d").snapshot
    catalog.delete_domain("d")
    add_domain(catalog, "d", closed=True)
    clock.now_s += 2
    with pytest.raises(NoActiveMapError):
        maps.active("d")
    assert maps.n_loaded == 0, "what cannot serve any more is not held"
    add_map(catalog, contents=map_contents(closed=True))
    assert maps.active("d").snapshot is not old_snapshot


def test_damage_is_named_and_remembered_for_a_while(catalog: Catalog, maps: Maps, clock: Clock) -> None:
    path = catalog.map_path("d", 1)
    sound = path.read_bytes()
    path.chmod(0o644)
    path.write_bytes(sound[:-100] + bytes(100))
    with pytest.raises(DamagedMapError, match="map 1 of domain d") as caught:
        maps.active("d")
    assert caught.value.__cause__ is not None
    path.write_bytes(sound)
    with pytest.raises(DamagedMapError):
        maps.active("d")  # not digested again for every request
    clock.now_s += 6
    assert maps.active("d").snapshot.version == 1


def test_a_map_that_cannot_be_read_now_is_not_called_damaged_nor_keeps_others_from_loading(
    catalog: Catalog, maps: Maps, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    for domain in ("e", "f"):
        add_domain(catalog, domain)
        add_map(catalog, domain)
    add_domain(catalog, "unmapped")
    verify = catalog_maps.verify

    def failing(path: Path, digest: str) -> None:
        if path.parent == catalog.map_path("d", 1).parent:
            raise OSError(errno.EIO, "Input/output error")
        verify(path, digest)

    catalog.map_path("e", 1).unlink()
    with monkeypatch.context() as patched:
        patched.setattr(catalog_maps, "verify", failing)
        assert maps.load_all() == ["e"]
        assert maps.active("f").snapshot.domain == "f"
        with pytest.raises(UnavailableError) as caught:
            maps.active("d")
        assert (caught.value.code, caught.value.hints["reason"]) == ("unavailable", "io_error")
        assert maps.damaged() == {"e": 1}
    assert maps.active("d").snapshot.version == 1, "and it is not remembered"
    maps.forget("d")
    assert [mapped_catalog.record.name for mapped_catalog in maps.loaded()] == ["f"]
    monkeypatch.setattr(catalog_maps, "verify", lambda path, digest: failing(catalog.map_path("d", 1), digest))
    clock.now_s += 10
    assert maps.damaged() == {"e": 1}, "a damaged one stays so while it cannot be read"


def test_domain_and_version_are_the_catalogs_and_not_the_files(catalog: Catalog, maps: Maps) -> None:
    """A map that was moved here from another server keeps its bytes, and with them its old name."""
    add_map(catalog, contents=map_contents("elsewhere", 7))
    snapshot = maps.active("d").snapshot
    assert (snapshot.domain, snapshot.version) == ("d", 2)


# Which are kept


def retention_of(service: Service, keep_maps: int = 1) -> Retention:
    return Retention(service.catalog, service.store, service.maps, keep_maps)


def with_files(catalog: Catalog) -> list[int]:
    """The versions that have a file; the catalog says the same."""
    versions = [record.version for record in catalog.maps("d") if catalog.map_path("d", record.version).is_file()]
    assert versions == [record.version for record in catalog.maps("d") if record.removed_at is None]
    return versions


def surplus_of(history: str, keep_maps: int) -> list[int]:
    """The numbers of surplus versions, of versions 1, 2, ...

    Args:
        history: A letter a version: s(ealed), a(ctive), or the year's last digit when it retired, 0: not noted.
        keep_maps: How many of each kind are kept.
    """
    states = {"s": MapState.SEALED, "a": MapState.ACTIVE}
    versions = []
    for version, word in enumerate(history, 1):
        state, retired_at = states.get(word, MapState.RETIRED), f"200{word}" if word in "123456789" else None
        versions.append(MapRecord("d", version, state, "2000", None, None, {}, {}, None, retired_at, None))
    return sorted(version.version for version in surplus_versions(versions, keep_maps))


@pytest.mark.parametrize(
    ("history", "keep_maps", "expected"),
    [
        ("423a0", 2, [2, 5]),  # by when they ceased to serve: 1 was rolled back to, and retired again
        ("423a0", 3, [5]),
        ("423a0", 4, []),
        ("ssas", 2, [1]),  # of sealed ones those alone that lost: a newer one may soon serve
        ("ssas", 1, [1, 2]),
        ("ass", 1, []),
        ("ss", 1, []),
    ],
)
def test_what_is_beyond_keeping(history: str, keep_maps: int, expected: list[int]) -> None:
    assert surplus_of(history, keep_maps) == expected


def test_the_one_that_served_last_is_the_newest_though_the_clock_was_set_back(mapped_catalog: Catalog) -> None:
    add_map(mapped_catalog)
    with closing(sqlite3.connect(catalog_path(mapped_catalog.data_dir))) as db, db:  # as a clock ahead would note it
        db.execute("UPDATE map SET retired_at = '2999-01-01T00:00:00.000Z' WHERE version = 1")
    add_map(mapped_catalog)
    surplus = surplus_versions(mapped_catalog.kept_maps(), 1)
    assert [version.version for version in surplus] == [1], "version 2 served last"


def test_one_domain_alone_can_be_pruned(service: Service) -> None:
    add_domain(service.catalog, "e")
    for domain in ("d", "e", "d", "e", "d", "e"):
        add_map(service.catalog, domain)
    assert retention_of(service).prune("e") == 1
    assert len(with_files(service.catalog)) == 4
    assert retention_of(service).prune() == 2


def test_a_beginning_session_keeps_its_map_from_the_first_moment(service: Service) -> None:
    """A session begins on the map that the service last saw serve, though another process has activated another."""
    mapped_domain, retention = service.maps.active("d"), retention_of(service)
    add_map(service.catalog)
    with service.maps.beginning(mapped_domain.snapshot), pytest.raises(MapInUseError):
        retention.remove("d", 1)
    retention.remove("d", 1)
    with pytest.raises(UnavailableError, match="try again"):
        asyncio.run(service.sessions.begin(mapped_domain, SessionConfig()))
    assert service.store.pins() == set()
    assert asyncio.run(service.sessions.begin(service.maps.refresh("d"), SessionConfig())).snapshot.version == 2


def test_sessions_begun_while_maps_are_switched_and_removed(mapped_catalog: Catalog) -> None:
    """Whatever the order of things, the map of every session that was acknowledged is there."""
    with open_service(mapped_catalog, max_sessions=1000) as service:
        retention, is_over = retention_of(service), threading.Event()

        def switching() -> None:
            versions = [1, *(add_map(mapped_catalog, activate=False) for _ in range(12))]
            try:
                for old_version, new_version in pairwise(versions):
                    mapped_catalog.activate("d", new_version, old_version)
                    with suppress(MapInUseError):
                        retention.remove("d", old_version)  # at once, which `prune` never does
            finally:
                is_over.set()

        async def beginning() -> int:
            n_begun = 0
            while not is_over.is_set():
                mapped_domain = service.maps.active("d")
                try:
                    await service.sessions.begin(mapped_domain, SessionConfig())
                    n_begun += 1
                except UnavailableError:
                    service.maps.refresh("d")
            return n_begun

        thread = threading.Thread(target=switching)
        thread.start()
        n_begun = asyncio.run(beginning())
        thread.join()
        assert n_begun > 0
        assert {version for _, version in service.store.pins()} <= set(with_files(mapped_catalog))


def test_a_crash_between_the_mark_and_the_file_is_finished_at_the_next_start(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    catalog = service.catalog
    add_map(catalog)

    def dies(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("deepsimbad.store.catalog_maps.remove_database", dies)
        with pytest.raises(KeyboardInterrupt):
            retention_of(service).remove("d", 1)
    assert catalog.map("d", 1).removed_at is not None
    assert catalog.map_path("d", 1).is_file()
    with pytest.raises(RetiredMapError):
        catalog.activate("d", 1, ANY)
    assert catalog.discard_unfinished() == ["removed the file of the removed map 1 of domain d"]
    assert with_files(catalog) == [2]


def test_where_sessions_cannot_be_read_nothing_is_removed_and_nobody_stopped(
    service: Service, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(2):
        add_map(service.catalog)
    service.store.close()
    assert retention_of(service).prune() == 0
    assert "old maps could not be looked for" in caplog.text
    assert with_files(service.catalog) == [1, 2, 3]


# How many are in memory


def test_maps_that_were_asked_longest_ago_give_way_and_are_read_again(catalog: Catalog, clock: Clock) -> None:
    names = ("d", "e", "f")
    for name in names:
        add_domain(catalog, name)
        add_map(catalog, name)
    n_bytes = Maps(catalog).active("d").snapshot.n_bytes
    maps = Maps(catalog, clock, cache_bytes=2 * n_bytes + n_bytes // 2)
    assert maps.load_all() == []
    assert (maps.n_loaded, maps.n_bytes) == (2, 2 * n_bytes), "a start loads what has room"
    for name in names:
        snapshot = maps.active(name).snapshot
        assert maps.active("d").snapshot.domain == "d", "who is asked stays"
    assert [mapped_catalog.record.name for mapped_catalog in maps.loaded()] == ["d", "f"]
    assert maps.n_bytes == 2 * n_bytes
    maps.active("e")
    maps.active("d")
    assert maps.active("f").snapshot is snapshot, "a map that somebody holds is not read again"
    maps.forget("f")
    assert (maps.n_loaded, maps.n_bytes) == (1, n_bytes)
    tiny = Maps(catalog, clock, cache_bytes=1)
    assert tiny.active("d").snapshot is tiny.active("d").snapshot, "one always has room"
    tiny.active("e")
    assert tiny.n_loaded == 1


def test_a_cold_map_is_read_once_however_many_ask_for_it(
    mapped_catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps, paths, barrier = Maps(mapped_catalog), [], threading.Barrier(8)
    read_map = maps_module.read_map
    monkeypatch.setattr(maps_module, "read_map", lambda path: paths.append(path) or read_map(path))
    snapshots = []

    def ask() -> None:
        barrier.wait()
        snapshots.append(maps.active("d").snapshot)

    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(paths) == 1
    assert len({id(snapshot) for snapshot in snapshots}) == 1


def test_a_start_stops_loading_when_its_time_is_up(mapped_catalog: Catalog, clock: Clock) -> None:
    add_domain(mapped_catalog, "e")
    add_map(mapped_catalog, "e")
    maps = Maps(mapped_catalog, lambda: clock() + 10 * maps.n_loaded)
    assert maps.load_all(within_s=5.0) == []
    assert maps.n_loaded == 1
