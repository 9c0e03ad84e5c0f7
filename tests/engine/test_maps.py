"""Active maps: loaded when needed, switched at once, never half."""

import errno
from dataclasses import dataclass
from pathlib import Path

import pytest

from deepsimbad.engine import maps as maps_module
from deepsimbad.engine.maps import Maps
from deepsimbad.errors import DamagedMapError, NoActiveMapError, UnavailableError, UnknownDomainError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.map_file import write_map
from deepsimbad.store.sealing import seal

from .conftest import N_IMAGES, add_domain, add_map, map_contents


@dataclass
class Clock:
    now: float = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def maps(catalog: Catalog, clock: Clock) -> Maps:
    add_domain(catalog, "d")
    return Maps(catalog, clock)


def test_nothing_to_serve(maps: Maps) -> None:
    with pytest.raises(UnknownDomainError):
        maps.active("other")
    with pytest.raises(NoActiveMapError, match="remap"):
        maps.active("d")
    assert maps.peek("d") is None
    assert maps.n_loaded == 0


def test_the_active_version_is_loaded_once(catalog: Catalog, maps: Maps) -> None:
    catalog.activate("d", add_map(catalog, "d"), ANY)
    snapshot = maps.active("d").snapshot
    assert (snapshot.version, snapshot.n_images) == (1, N_IMAGES)
    assert snapshot.index_bits_per_map_image > 0
    assert maps.active("d").snapshot is snapshot
    assert maps.n_loaded == 1


def test_a_switch_is_seen_at_once_when_told_and_soon_when_not(catalog: Catalog, maps: Maps, clock: Clock) -> None:
    for _ in range(2):
        add_map(catalog, "d")
    catalog.activate("d", 1, ANY)
    held = maps.active("d").snapshot
    catalog.activate("d", 2, 1)
    assert maps.active("d").snapshot.version == 1  # trusted for a second
    assert maps.refresh("d").snapshot.version == 2
    assert held.version == 1  # whoever held the old one keeps it
    catalog.activate("d", 1, 2)
    clock.now += 1.1
    assert maps.peek("d") is None
    assert maps.active("d").snapshot.version == 1


def test_an_unchanged_version_is_not_read_again(catalog: Catalog, maps: Maps, clock: Clock) -> None:
    catalog.activate("d", add_map(catalog, "d"), ANY)
    held = maps.active("d").snapshot
    clock.now += 10
    assert maps.active("d").snapshot is held


def test_a_domain_made_anew_under_an_old_name_gets_its_own_map(catalog: Catalog, maps: Maps, clock: Clock) -> None:
    catalog.activate("d", add_map(catalog, "d"), ANY)
    held = maps.active("d").snapshot
    catalog.delete_domain("d")
    add_domain(catalog, "d", closed=True)
    clock.now += 2
    with pytest.raises(NoActiveMapError):
        maps.active("d")
    catalog.activate("d", add_map(catalog, "d"), ANY)
    assert maps.active("d").snapshot is not held


def test_damage_is_named_and_remembered_for_a_while(
    catalog: Catalog, maps: Maps, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    catalog.activate("d", add_map(catalog, "d"), ANY)
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
    clock.now += 6
    assert maps.active("d").snapshot.version == 1


def test_a_damaged_map_does_not_keep_others_from_loading(catalog: Catalog, maps: Maps) -> None:
    catalog.activate("d", add_map(catalog, "d"), ANY)
    add_domain(catalog, "e")
    catalog.activate("e", add_map(catalog, "e"), ANY)
    add_domain(catalog, "f")
    catalog.map_path("d", 1).unlink()
    assert list(maps.load_all()) == ["d"]
    assert maps.active("e").snapshot.domain == "e"
    maps.forget("e")
    assert maps.n_loaded == 0


def test_a_map_that_cannot_be_read_now_is_not_called_damaged(
    catalog: Catalog, maps: Maps, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    for domain in ("d", "e"):
        if domain == "e":
            add_domain(catalog, "e")
        catalog.activate(domain, add_map(catalog, domain), ANY)
    verify = maps_module.verify

    def failing(path: Path, digest: str) -> None:
        if path == catalog.map_path("d", 1):
            raise OSError(errno.EIO, "Input/output error")
        verify(path, digest)

    with monkeypatch.context() as patched:
        patched.setattr(maps_module, "verify", failing)
        assert maps.load_all() == {}
        assert maps.peek("e") is not None, "another domain's map is loaded all the same"
        with pytest.raises(UnavailableError) as caught:
            maps.active("d")
        assert (caught.value.code, caught.value.hints["reason"]) == ("unavailable", "io_error")
        assert maps.damaged() == {}
    assert maps.active("d").snapshot.version == 1, "and it is not remembered"


def test_a_damaged_map_stays_damaged_while_it_cannot_be_read(
    catalog: Catalog, maps: Maps, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(path: Path, digest: str) -> None:
        raise OSError(errno.EIO, "Input/output error")

    catalog.activate("d", add_map(catalog, "d"), ANY)
    catalog.map_path("d", 1).unlink()
    assert list(maps.load_all()) == ["d"]
    clock.now += 10
    monkeypatch.setattr(maps_module, "verify", failing)
    assert maps.damaged() == {"d": 1}


def test_domain_and_version_are_the_catalogs_and_not_the_files(catalog: Catalog, maps: Maps) -> None:
    """A map that was moved here from another server keeps its bytes, and with them its old name."""
    version = catalog.begin_map("d", {})
    write_map(catalog.building_path("d", version), map_contents("elsewhere", 7))
    digest, n_bytes = seal(catalog.building_path("d", version), catalog.map_path("d", version))
    catalog.seal_map("d", version, digest, n_bytes, {})
    catalog.activate("d", version, ANY)
    snapshot = maps.active("d").snapshot
    assert (snapshot.domain, snapshot.version) == ("d", 1)
