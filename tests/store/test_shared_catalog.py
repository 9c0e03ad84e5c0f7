"""Machines that share maps: what one publishes all have, of two at once one wins, and a failing store loses nothing."""

import gzip
import json
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from deepsimbad.core.map import Map
from deepsimbad.errors import (
    ConflictError,
    DamagedMapError,
    DomainDiffersError,
    LostActivationError,
    UnavailableError,
    UnknownDomainError,
    UnknownMapVersionError,
)
from deepsimbad.store import map_store, shared_catalog
from deepsimbad.store.backup import back_up, inspect, restore
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.layout import map_path
from deepsimbad.store.map_file import read_map, seal, write_map
from deepsimbad.store.records import MapRecord, MapState
from deepsimbad.store.shared_catalog import SharedCatalog, inspect_objects, open_catalog
from deepsimbad.store.traverses import Traverse
from tests.store.bucket import served_bucket

MakeMap = Callable[..., Map]
MakeNode = Callable[..., SharedCatalog]
EVALUATOR = {"kind": "feature_l2", "extractor": "none"}


@pytest.fixture(params=["s3", "folder"])
def store(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[str, Path]]:
    """A store's URL, and the folder in which its objects can be looked at."""
    root = tmp_path / "objects"
    root.mkdir()
    if request.param == "folder":
        yield f"file://{root}/maps", root / "maps"
        return
    with served_bucket(root) as bucket:
        for name, value in bucket.environment.items():
            monkeypatch.setenv(name, value)
        yield bucket.url, bucket.folder / "maps-of/fleet"


@pytest.fixture
def node(store: tuple[str, Path], tmp_path: Path) -> Iterator[MakeNode]:
    with ExitStack() as opened:

        def start(name: str, **options: Any) -> SharedCatalog:
            catalog = opened.enter_context(open_catalog(tmp_path / name, store[0], **options))
            assert isinstance(catalog, SharedCatalog)
            catalog.catch_up()
            return catalog

        yield start


@pytest.fixture
def add_map(make_map: MakeMap) -> Callable[..., MapRecord]:
    def add(catalog: Catalog, domain: str = "campus", seed: int = 0, n: int = 60) -> MapRecord:
        version = catalog.begin_map(domain, {"seed": seed})
        building = catalog.building_path(domain, version)
        write_map(building, make_map(n=n, version=version, seed=seed, domain=domain))
        digest, n_bytes = seal(building, catalog.map_path(domain, version))
        return catalog.seal_map(domain, version, digest, n_bytes, {"anr": 4.25})

    return add


@pytest.fixture
def pair(node: MakeNode, add_map: Callable[..., MapRecord]) -> tuple[SharedCatalog, SharedCatalog]:
    """Two nodes; the first has made a map that serves, and the second has heard of it."""
    here, there = node("here"), node("there")
    make_domain(here)
    add_map(here)
    here.activate("campus", 1, None)
    there.follow()
    return here, there


def make_domain(catalog: Catalog, name: str = "campus", **changes: Any) -> None:
    catalog.create_domain(name, **{"evaluator": EVALUATOR, "closed": False, "actions_m": [1.0, 2.0], **changes})


def test_domains_and_what_serves_appear_at_others_and_files_are_fetched_by_need(
    node: MakeNode, add_map: Callable[..., MapRecord]
) -> None:
    here, there = node("here"), node("there")
    make_domain(here)
    assert there.follow() == ["campus"]
    assert there.domain("campus").active_version is None
    first = add_map(here)
    assert there.follow() == []  # sealed maps are nobody else's business
    here.activate("campus", 1, None)
    here.set_options("campus", {"thumbnails": True})
    assert there.follow() == ["campus", "campus"]
    assert there.domain("campus") == here.domain("campus")
    mirrored = there.map("campus", 1)
    assert (mirrored.sha256, mirrored.config, mirrored.metrics) == (first.sha256, first.config, first.metrics)
    assert not there.map_path("campus", 1).exists()
    path = there.map_file("campus", 1)
    assert path == map_path(there.data_dir, "campus", 1)
    assert path.read_bytes() == here.map_path("campus", 1).read_bytes()
    assert path.stat().st_mode & 0o777 == 0o444
    add_map(here, seed=1)
    here.activate("campus", 2, 1)
    there.follow()
    there.map_file("campus", 2)
    there.activate("campus", 1, 2)  # anybody may roll back
    here.follow()
    add_map(here, seed=2)
    here.activate("campus", 3, 1)
    there.activate("campus", 3, 3)  # though nobody has told it yet that there is one
    there.activate("campus", 1, 3)
    here.follow()
    assert here.domain("campus").active_version == there.domain("campus").active_version == 1
    assert [record.state for record in there.maps("campus")] == [MapState.ACTIVE, MapState.RETIRED, MapState.RETIRED]
    there.delete_domain("campus")
    assert not there.map_path("campus", 1).exists()
    here.follow()
    with pytest.raises(UnknownDomainError):
        here.domain("campus")
    assert not here.map_path("campus", 1).exists()
    make_domain(here, actions_m=[3.0])  # and another of its name
    there.follow()
    assert there.domain("campus").actions_m == (3.0,)


def test_all_know_which_of_several_that_administer_made_a_domain(node: MakeNode) -> None:
    here, there = node("here"), node("there", administrator=3)
    make_domain(here)
    make_domain(there, "city")
    make_domain(there)  # which is there already
    here.follow()
    for options in ({"thumbnails": True}, {"thumbnails": False}):
        here.set_options("city", options)
        there.follow()
        for catalog in (here, there):
            assert [catalog.administrator_of(name) for name in ("campus", "city")] == [0, 3]
    with pytest.raises(UnknownDomainError):
        here.administrator_of("nowhere")


def test_a_data_directory_keeps_the_number_of_who_administers_it(node: MakeNode, tmp_path: Path) -> None:
    with Catalog.open(tmp_path / "there") as before:  # of a service that followed no store yet
        make_domain(before)
    node("there", administrator=3).close()
    command = node("there")
    make_domain(command, "city")
    here = node("here")
    assert [here.administrator_of(name) for name in ("campus", "city")] == [3, 3]
    command.close()
    make_domain(node("there", administrator=1), "port")
    here.follow()
    assert [here.administrator_of(name) for name in ("city", "port")] == [3, 1]


def test_of_two_activations_at_once_one_is_lost(node: MakeNode, add_map: Callable[..., MapRecord]) -> None:
    here, there = node("here"), node("there")
    make_domain(here)
    for seed in range(3):
        add_map(here, seed=seed)
        here.activate("campus", seed + 1, ANY)
    there.follow()
    start, outcomes = threading.Barrier(2), []

    def activate(catalog: Catalog, version: int) -> None:
        start.wait()
        try:
            outcomes.append(catalog.activate("campus", version, 3).version)
        except LostActivationError as error:
            outcomes.append(error.hints["active"])

    threads = [threading.Thread(target=activate, args=given) for given in ((here, 1), (there, 2))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    here.follow()
    there.follow()
    winner = here.domain("campus").active_version
    assert winner in {1, 2}
    assert outcomes == [winner, winner]
    assert there.domain("campus").active_version == winner


def test_a_number_that_two_nodes_gave_belongs_to_who_published_first(
    node: MakeNode, add_map: Callable[..., MapRecord]
) -> None:
    here, there = node("here"), node("there")
    make_domain(here)
    there.follow()
    mine, theirs = add_map(here, seed=1), add_map(there, seed=2)
    assert mine.version == theirs.version == 1
    unfinished = there.begin_map("campus", {})
    here.activate("campus", 1, ANY)
    with pytest.raises(LostActivationError):
        there.activate("campus", 1, ANY)
    moved = there.maps("campus")[-1]
    assert (moved.sha256, moved.state, moved.version) == (theirs.sha256, MapState.SEALED, 3)
    assert read_map(there.map_file("campus", 3)).n_images == 60
    assert there.map("campus", 1).sha256 == mine.sha256
    assert there.map_file("campus", 1).read_bytes() == here.map_path("campus", 1).read_bytes()
    there.activate("campus", 3, 1)
    here.follow()
    add_map(here, seed=3)
    assert here.begin_map("campus", {}) == 5
    here.activate("campus", 4, 3)
    there.follow()
    assert unfinished == 2
    there.discard_map("campus", unfinished)


def test_a_version_being_built_whose_number_was_published_is_given_up(
    node: MakeNode, add_map: Callable[..., MapRecord], make_map: MakeMap
) -> None:
    here, there = node("here"), node("there")
    make_domain(here)
    there.follow()
    version = there.begin_map("campus", {})
    write_map(there.building_path("campus", version), make_map(seed=9))
    add_map(here)
    here.activate("campus", 1, ANY)
    there.follow()
    digest, n_bytes = seal(there.building_path("campus", version), there.map_path("campus", version))
    with pytest.raises(UnknownMapVersionError):
        there.seal_map("campus", version, digest, n_bytes, {})
    assert there.map_file("campus", 1).read_bytes() == here.map_path("campus", 1).read_bytes()


def test_a_data_directory_with_domains_publishes_them_when_it_begins_to_follow(
    node: MakeNode, add_map: Callable[..., MapRecord], tmp_path: Path, store: tuple[str, Path]
) -> None:
    with Catalog.open(tmp_path / "old") as old:
        make_domain(old)
        add_map(old)
        old.activate("campus", 1, None)
        make_domain(old, "empty")
    node("old").close()
    with open_catalog(tmp_path / "old") as again:  # remembered
        assert isinstance(again, SharedCatalog)
        there = node("there")
        assert [record.name for record in there.domains()] == ["campus", "empty"]
        assert there.map_file("campus", 1).read_bytes() == again.map_path("campus", 1).read_bytes()
    with Catalog.open(tmp_path / "other") as other:
        make_domain(other, actions_m=[9.0])
    with pytest.raises(DomainDiffersError):
        node("other")
    other = open_catalog(tmp_path / "other")
    other.delete_domain("campus")  # its own alone
    other.close()
    assert node("other").domain("campus").actions_m == (1.0, 2.0)
    with pytest.raises(ConflictError, match="follows the map store"):
        open_catalog(tmp_path / "old", f"file://{tmp_path}/another")


def test_a_new_node_begins_with_all_domains_in_one_object(
    node: MakeNode, add_map: Callable[..., MapRecord], store: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_catalog, "_LEAST_BETWEEN_STATES", 4)
    here = node("here")
    make_domain(here, "domain-0")
    make_domain(here)
    for seed in range(2):
        add_map(here, seed=seed)
        here.activate("campus", seed + 1, ANY)
    make_domain(here, "domain-1")
    state = json.loads(gzip.decompress((store[1] / "state.json.gz").read_bytes()))
    assert (state["position"], sorted(state["domains"])) == (4, ["campus", "domain-0"])
    asked = []
    parsed = map_store._parse
    monkeypatch.setattr(map_store, "_parse", lambda content, name: asked.append(name) or parsed(content, name))
    there = node("there")
    assert there.domains() == here.domains()
    assert asked[1:] == ["state.json.gz", "log/000000000005.json"]
    for version, state in ((1, MapState.RETIRED), (2, MapState.ACTIVE)):  # sessions may live on the first
        record = there.map("campus", version)
        assert (record.state, record.sha256) == (state, here.map("campus", version).sha256)
        assert there.map_file("campus", version).is_file()
    with Traverse.create(there.data_dir, "domain-0", "drive"):  # it can build there too
        assert there.begin_map("domain-0", {}) == 1
    there.discard_map("domain-0", 1)


@pytest.mark.parametrize("step", ["put_map", "append", "_apply"])
def test_a_crash_between_two_steps_is_mended_by_the_next_look(
    node: MakeNode, add_map: Callable[..., MapRecord], monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    here, there = node("here"), node("there")
    make_domain(here)
    add_map(here)

    class PowerCutError(Exception):
        pass

    def cut(*_: object) -> None:
        raise PowerCutError

    owner = SharedCatalog if step == "_apply" else map_store.MapStore
    with monkeypatch.context() as patched:
        patched.setattr(owner, step, cut)
        with pytest.raises(PowerCutError):
            here.activate("campus", 1, None)
    here.follow()
    there.follow()
    is_published = step == "_apply"
    assert (
        here.domain("campus").active_version == there.domain("campus").active_version == (1 if is_published else None)
    )
    here.activate("campus", 1, ANY)
    there.follow()
    assert there.map_file("campus", 1).is_file()


def test_a_domain_whose_creation_was_cut_short_is_published_at_the_next_start(node: MakeNode, tmp_path: Path) -> None:
    here = node("here")
    with Catalog.open(tmp_path / "here") as plain:
        make_domain(plain)
    here.catch_up()
    there = node("there")
    assert there.domain("campus").name == "campus"


def test_a_change_that_cannot_be_published_is_not_made(
    node: MakeNode, add_map: Callable[..., MapRecord], store: tuple[str, Path]
) -> None:
    here = node("here")
    make_domain(here)
    add_map(here)
    here.activate("campus", 1, None)
    before = here.domain("campus")
    shutil.move(store[1], store[1].with_name("elsewhere"))
    for change in (
        lambda: make_domain(here, "other"),
        lambda: here.set_options("campus", {"thumbnails": True}),
        lambda: here.activate("campus", 1, 1),
        lambda: here.delete_domain("campus"),
    ):
        with pytest.raises(UnavailableError, match="lost its log"):
            change()
    assert here.domains() == [before]
    assert here.map_file("campus", 1).is_file()  # what is here is served
    shutil.move(store[1].with_name("elsewhere"), store[1])
    assert here.set_options("campus", {"thumbnails": True}).options == {"thumbnails": True}


def test_a_damaged_object_is_refused_and_a_damaged_file_is_fetched_again(
    pair: tuple[SharedCatalog, SharedCatalog], store: tuple[str, Path]
) -> None:
    here, there = pair
    digest = here.map("campus", 1).sha256
    path, stored = there.map_path("campus", 1), store[1] / f"maps/{digest}.sqlite"
    whole = stored.read_bytes()
    for broken in (whole[:1000], whole[:-1] + b"x"):
        stored.unlink()
        stored.write_bytes(broken)
        with pytest.raises(DamagedMapError):
            there.map_file("campus", 1)
        assert list(path.parent.iterdir()) == []
    (finding,) = inspect_objects(there.data_dir, lambda _: None).damaged
    assert finding.file.endswith(f"maps/{digest}.sqlite")
    assert "SHA-256" in finding.what
    stored.unlink()
    with pytest.raises(DamagedMapError, match="has no maps/"):
        there.map_file("campus", 1)
    (finding,) = inspect_objects(there.data_dir, lambda _: None).damaged
    assert finding.what == "is missing"
    stored.write_bytes(whole)
    assert not inspect_objects(there.data_dir, lambda _: None).damaged
    assert there.map_file("campus", 1).read_bytes() == whole
    path.chmod(0o644)
    path.write_bytes(whole[:-1] + b"x")
    assert there.map_file("campus", 1).read_bytes() == whole


def test_a_file_is_fetched_once_however_many_ask(
    pair: tuple[SharedCatalog, SharedCatalog], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, there = pair
    n_fetched, pieces = [], map_store.MapStore.map_pieces
    monkeypatch.setattr(map_store.MapStore, "map_pieces", lambda *given: n_fetched.append(1) or pieces(*given))
    threads = [threading.Thread(target=there.map_file, args=("campus", 1)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(n_fetched) == 1


def test_the_cache_holds_its_size_and_keeps_what_is_in_use(node: MakeNode, add_map: Callable[..., MapRecord]) -> None:
    here = node("here")
    make_domain(here)
    sizes = []
    for seed in range(5):
        sizes.append(add_map(here, seed=seed).file_bytes or 0)
        here.activate("campus", seed + 1, ANY)
    there = node("there", cache_bytes=3 * max(sizes))
    versions = range(1, 6)
    here.activate("campus", 1, ANY)
    for version in versions:  # mirrored in turn, as versions served
        here.activate("campus", version, ANY)
    there.follow()

    def present() -> list[int]:
        return [version for version in versions if there.map_path("campus", version).exists()]

    for moment, version in enumerate((1, 2, 3)):
        os.utime(there.map_file("campus", version), ns=(moment, moment))
    there.map_file("campus", 1)  # asked for again: 2 is the oldest
    there.map_file("campus", 4)
    assert present() == [1, 3, 4]
    there.is_in_use = lambda domain, version, digest: version in {1, 3}
    there.map_file("campus", 5)
    assert present() == [1, 3, 5]
    there.is_in_use = lambda domain, version, digest: True
    with pytest.raises(UnavailableError, match="map_cache_disk_bytes") as full:
        there.map_file("campus", 4)
    assert full.value.hints["reason"] == "cache_full"
    assert present() == [1, 3, 5]
    assert there.has_file("campus", 4)


def test_a_full_disk_is_named_and_leaves_no_half_file(
    pair: tuple[SharedCatalog, SharedCatalog], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, there = pair

    def full(*_: object) -> Iterator[bytes]:
        yield b"half"
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(map_store.MapStore, "map_pieces", full)
        with pytest.raises(UnavailableError) as refused:
            there.map_file("campus", 1)
    assert refused.value.hints["reason"] == "disk_full"
    assert list(there.map_path("campus", 1).parent.iterdir()) == []
    assert there.map_file("campus", 1).is_file()


def test_backups_and_checks_want_no_file_that_the_store_keeps(
    node: MakeNode, pair: tuple[SharedCatalog, SharedCatalog], tmp_path: Path
) -> None:
    here, there = pair
    assert not inspect(there.data_dir, lambda _: None).damaged
    assert back_up(there.data_dir, tmp_path / "backup.tar", "0", lambda _: None).n_maps == 0
    restore(tmp_path / "backup.tar", tmp_path / "restored", lambda _: None)
    restored = node("restored")
    assert restored.map_file("campus", 1).read_bytes() == here.map_path("campus", 1).read_bytes()
    assert back_up(here.data_dir, tmp_path / "whole.tar", "0", lambda _: None).n_maps == 1
