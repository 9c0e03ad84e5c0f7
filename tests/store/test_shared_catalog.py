"""Machines that share maps: what one publishes all have, of two at once one wins, and a failing store loses nothing."""

import gzip
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from deepsimbad.errors import (
    ConflictError,
    DamagedFileError,
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
from deepsimbad.store.layout import domains_folder, map_path
from deepsimbad.store.map_file import read_map, seal, write_map
from deepsimbad.store.records import MapState
from deepsimbad.store.shared_catalog import SharedCatalog, inspect_objects, open_catalog
from deepsimbad.store.traverses import Traverse

from .bucket import served_bucket
from .conftest import AddMap, MakeMap, at_once

MakeNode = Callable[..., SharedCatalog]
EVALUATOR = {"kind": "feature_l2", "extractor": "none"}


@pytest.fixture(params=["folder"])
def store(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[str, Path]]:
    """A store's URL, and the folder in which its objects can be looked at; buckets do as folders (test_objects)."""
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
    with ExitStack() as stack:

        def start(name: str, **options: Any) -> SharedCatalog:
            catalog = stack.enter_context(open_catalog(tmp_path / name, store[0], **options))
            assert isinstance(catalog, SharedCatalog)
            catalog.catch_up()
            return catalog

        yield start


@pytest.fixture
def pair(node: MakeNode, add_map: AddMap) -> tuple[SharedCatalog, SharedCatalog]:
    """Two nodes; the first has made a map that serves, and the second has heard of it."""
    node_a, node_b = node("here"), node("there")
    make_domain(node_a)
    add_map(node_a)
    node_a.activate("campus", 1, None)
    node_b.follow()
    return node_a, node_b


def make_domain(catalog: Catalog, name: str = "campus", **changes: Any) -> None:
    catalog.create_domain(name, **{"evaluator": EVALUATOR, "closed": False, "actions_m": [1.0, 2.0], **changes})


@pytest.mark.parametrize("store", ["s3", "folder"], indirect=True)
def test_domains_and_what_serves_appear_at_others_and_files_are_fetched_by_need(
    node: MakeNode, add_map: AddMap
) -> None:
    node_a, node_b = node("here"), node("there")
    make_domain(node_a)
    assert node_b.follow() == ["campus"]
    assert node_b.domain("campus").active_version is None
    first = add_map(node_a)
    assert node_b.follow() == []  # sealed maps are nobody else's business
    node_a.activate("campus", 1, None)
    node_a.set_options("campus", {"thumbnails": True})
    assert node_b.follow() == ["campus", "campus"]
    assert node_b.domain("campus") == node_a.domain("campus")
    mirrored = node_b.map("campus", 1)
    assert (mirrored.sha256, mirrored.config, mirrored.metrics) == (first.sha256, first.config, first.metrics)
    assert not node_b.map_path("campus", 1).exists()
    path = node_b.map_file("campus", 1)
    assert path == map_path(node_b.data_dir, "campus", 1)
    assert path.read_bytes() == node_a.map_path("campus", 1).read_bytes()
    assert path.stat().st_mode & 0o777 == 0o444
    add_map(node_a, seed=1)
    node_a.activate("campus", 2, 1)
    node_b.follow()
    node_b.map_file("campus", 2)
    node_b.activate("campus", 1, 2)  # anybody may roll back
    node_a.follow()
    add_map(node_a, seed=2)
    node_a.activate("campus", 3, 1)
    node_b.activate("campus", 3, 3)  # though nobody has told it yet that there is one
    node_b.activate("campus", 1, 3)
    node_a.follow()
    assert node_a.domain("campus").active_version == node_b.domain("campus").active_version == 1
    assert [record.state for record in node_b.maps("campus")] == [MapState.ACTIVE, MapState.RETIRED, MapState.RETIRED]
    node_b.delete_domain("campus")
    assert not node_b.map_path("campus", 1).exists()
    node_a.follow()
    with pytest.raises(UnknownDomainError):
        node_a.domain("campus")
    assert not node_a.map_path("campus", 1).exists()
    make_domain(node_a, actions_m=[3.0])  # and another of its name
    node_b.follow()
    assert node_b.domain("campus").actions_m == (3.0,)


def test_all_know_which_of_several_that_administer_made_a_domain(node: MakeNode) -> None:
    node_a, node_b = node("here"), node("there", administrator=3)
    make_domain(node_a)
    make_domain(node_b, "city")
    make_domain(node_b)  # which is there already
    node_a.follow()
    for options in ({"thumbnails": True}, {"thumbnails": False}):
        node_a.set_options("city", options)
        node_b.follow()
        for catalog in (node_a, node_b):
            assert [catalog.administrator_of(name) for name in ("campus", "city")] == [0, 3]
    with pytest.raises(UnknownDomainError):
        node_a.administrator_of("nowhere")


def test_a_data_directory_keeps_the_number_of_who_administers_it(node: MakeNode, tmp_path: Path) -> None:
    with Catalog.open(tmp_path / "there") as lone_catalog:  # of a service that followed no store yet
        make_domain(lone_catalog)
    node("there", administrator=3).close()
    command = node("there")
    make_domain(command, "city")
    node_a = node("here")
    assert [node_a.administrator_of(name) for name in ("campus", "city")] == [3, 3]
    command.close()
    make_domain(node("there", administrator=1), "port")
    node_a.follow()
    assert [node_a.administrator_of(name) for name in ("city", "port")] == [3, 1]


def test_of_two_activations_at_once_one_is_lost(node: MakeNode, add_map: AddMap) -> None:
    node_a, node_b = node("here"), node("there")
    make_domain(node_a)
    for seed in range(3):
        add_map(node_a, seed=seed)
        node_a.activate("campus", seed + 1, ANY)
    node_b.follow()

    def active_after(catalog: Catalog, version: int) -> object:
        try:
            return catalog.activate("campus", version, 3).version
        except LostActivationError as error:
            return error.hints["active"]

    outcomes = at_once([partial(active_after, node_a, 1), partial(active_after, node_b, 2)])
    node_a.follow()
    node_b.follow()
    winner = node_a.domain("campus").active_version
    assert winner in {1, 2}
    assert outcomes == [winner, winner]
    assert node_b.domain("campus").active_version == winner


def test_a_number_that_two_nodes_gave_belongs_to_who_published_first(node: MakeNode, add_map: AddMap) -> None:
    node_a, node_b = node("here"), node("there")
    make_domain(node_a)
    node_b.follow()
    first_map, second_map = add_map(node_a, seed=1), add_map(node_b, seed=2)
    assert first_map.version == second_map.version == 1
    unfinished = node_b.begin_map("campus", {})
    node_a.activate("campus", 1, ANY)
    with pytest.raises(LostActivationError):
        node_b.activate("campus", 1, ANY)
    moved_map = node_b.maps("campus")[-1]
    assert (moved_map.sha256, moved_map.state, moved_map.version) == (second_map.sha256, MapState.SEALED, 3)
    assert read_map(node_b.map_file("campus", 3)).n_images == 60
    assert node_b.map("campus", 1).sha256 == first_map.sha256
    assert node_b.map_file("campus", 1).read_bytes() == node_a.map_path("campus", 1).read_bytes()
    node_b.activate("campus", 3, 1)
    node_a.follow()
    add_map(node_a, seed=3)
    assert node_a.begin_map("campus", {}) == 5
    node_a.activate("campus", 4, 3)
    node_b.follow()
    assert unfinished == 2
    node_b.discard_map("campus", unfinished)


def test_a_version_being_built_whose_number_was_published_is_given_up(
    node: MakeNode, add_map: AddMap, make_map: MakeMap
) -> None:
    node_a, node_b = node("here"), node("there")
    make_domain(node_a)
    node_b.follow()
    version = node_b.begin_map("campus", {})
    write_map(node_b.building_path("campus", version), make_map(seed=9))
    add_map(node_a)
    node_a.activate("campus", 1, ANY)
    node_b.follow()
    digest, n_bytes = seal(node_b.building_path("campus", version), node_b.map_path("campus", version))
    with pytest.raises(UnknownMapVersionError):
        node_b.seal_map("campus", version, digest, n_bytes, {})
    assert node_b.map_file("campus", 1).read_bytes() == node_a.map_path("campus", 1).read_bytes()


def test_a_data_directory_with_domains_publishes_them_when_it_begins_to_follow(
    node: MakeNode, add_map: AddMap, tmp_path: Path, store: tuple[str, Path]
) -> None:
    with Catalog.open(tmp_path / "old") as old:
        make_domain(old)
        add_map(old)
        old.activate("campus", 1, None)
        make_domain(old, "empty")
    node("old").close()
    with open_catalog(tmp_path / "old") as again:  # remembered
        assert isinstance(again, SharedCatalog)
        node_b = node("there")
        assert [record.name for record in node_b.domains()] == ["campus", "empty"]
        assert node_b.map_file("campus", 1).read_bytes() == again.map_path("campus", 1).read_bytes()
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
    node: MakeNode, add_map: AddMap, store: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_catalog, "_LEAST_BETWEEN_STATES", 4)
    node_a = node("here")
    make_domain(node_a, "domain-0")
    make_domain(node_a)
    for seed in range(2):
        add_map(node_a, seed=seed)
        node_a.activate("campus", seed + 1, ANY)
    make_domain(node_a, "domain-1")
    state = json.loads(gzip.decompress((store[1] / "state.json.gz").read_bytes()))
    assert (state["position"], sorted(state["domains"])) == (4, ["campus", "domain-0"])
    names = []
    parse = map_store._parse
    monkeypatch.setattr(map_store, "_parse", lambda content, name: names.append(name) or parse(content, name))
    with monkeypatch.context() as patch:
        synced_paths, sync = [], shared_catalog.sync
        patch.setattr(shared_catalog, "sync", lambda path: synced_paths.append(path) or sync(path))
        node_b = node("there")
    assert synced_paths == [domains_folder(node_b.data_dir)], "the log is not read again for what a power cut takes"
    assert node_b.domains() == node_a.domains()
    assert names[1:] == ["state.json.gz", "log/000000000005.json"]
    for version, state in ((1, MapState.RETIRED), (2, MapState.ACTIVE)):  # sessions may live on the first
        record = node_b.map("campus", version)
        assert (record.state, record.sha256) == (state, node_a.map("campus", version).sha256)
        assert node_b.map_file("campus", version).is_file()
    with Traverse.create(node_b.data_dir, "domain-0", "drive"):  # it can build there too
        assert node_b.begin_map("domain-0", {}) == 1
    node_b.discard_map("domain-0", 1)


def test_a_change_that_is_published_is_made_whatever_becomes_of_the_one_object(
    node: MakeNode, store: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_catalog, "_LEAST_BETWEEN_STATES", 1)
    node_a, node_b = node("here"), node("there")
    (store[1] / "state.json.gz").mkdir()  # where no object can be written
    make_domain(node_a)
    node_b.follow()
    assert node_b.domains() == node_a.domains() != []


@pytest.mark.parametrize("step", ["put_map", "append", "_apply"])
def test_a_crash_between_two_steps_is_mended_by_the_next_look(
    node: MakeNode, add_map: AddMap, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    node_a, node_b = node("here"), node("there")
    make_domain(node_a)
    add_map(node_a)

    class PowerCutError(Exception):
        pass

    def cut(*_: object) -> None:
        raise PowerCutError

    owner = SharedCatalog if step == "_apply" else map_store.MapStore
    with monkeypatch.context() as patched:
        patched.setattr(owner, step, cut)
        with pytest.raises(PowerCutError):
            node_a.activate("campus", 1, None)
    node_a.follow()
    node_b.follow()
    is_published = step == "_apply"
    assert (
        node_a.domain("campus").active_version
        == node_b.domain("campus").active_version
        == (1 if is_published else None)
    )
    node_a.activate("campus", 1, ANY)
    node_b.follow()
    assert node_b.map_file("campus", 1).is_file()


def test_a_domain_whose_creation_was_cut_short_is_published_at_the_next_start(node: MakeNode, tmp_path: Path) -> None:
    node_a = node("here")
    with Catalog.open(tmp_path / "here") as plain:
        make_domain(plain)
    node_a.catch_up()
    node_b = node("there")
    assert node_b.domain("campus").name == "campus"


def test_a_change_that_cannot_be_published_is_not_made(
    node: MakeNode, add_map: AddMap, store: tuple[str, Path]
) -> None:
    node_a = node("here")
    make_domain(node_a)
    add_map(node_a)
    node_a.activate("campus", 1, None)
    domain = node_a.domain("campus")
    shutil.move(store[1], store[1].with_name("elsewhere"))
    for change in (
        lambda: make_domain(node_a, "other"),
        lambda: node_a.set_options("campus", {"thumbnails": True}),
        lambda: node_a.activate("campus", 1, 1),
        lambda: node_a.delete_domain("campus"),
    ):
        with pytest.raises(UnavailableError, match="lost its log"):
            change()
    assert node_a.domains() == [domain]
    assert node_a.map_file("campus", 1).is_file()  # what is here is served
    shutil.move(store[1].with_name("elsewhere"), store[1])
    assert node_a.set_options("campus", {"thumbnails": True}).options == {"thumbnails": True}


def test_a_damaged_object_is_refused_and_a_damaged_file_is_fetched_again(
    pair: tuple[SharedCatalog, SharedCatalog], store: tuple[str, Path]
) -> None:
    node_a, node_b = pair
    digest = node_a.map("campus", 1).sha256
    path, object_path = node_b.map_path("campus", 1), store[1] / f"maps/{digest}.sqlite"
    content = object_path.read_bytes()
    for damaged_content in (content[:1000], content[:-1] + b"x"):
        object_path.unlink()
        object_path.write_bytes(damaged_content)
        with pytest.raises(DamagedMapError):
            node_b.map_file("campus", 1)
        assert list(path.parent.iterdir()) == []
    (finding,) = inspect_objects(node_b.data_dir, lambda _: None).damaged
    assert finding.file.endswith(f"maps/{digest}.sqlite")
    assert "SHA-256" in finding.what
    object_path.unlink()
    with pytest.raises(DamagedMapError, match="has no maps/"):
        node_b.map_file("campus", 1)
    (finding,) = inspect_objects(node_b.data_dir, lambda _: None).damaged
    assert finding.what == "is missing"
    object_path.write_bytes(content)
    assert not inspect_objects(node_b.data_dir, lambda _: None).damaged
    assert node_b.map_file("campus", 1).read_bytes() == content
    path.chmod(0o644)
    path.write_bytes(content[:-1] + b"x")
    assert node_b.map_file("campus", 1).read_bytes() == content


def test_an_entry_of_another_release_is_named_and_nothing_of_it_is_taken_over(node: MakeNode, add_map: AddMap) -> None:
    node_a, node_b = node("here"), node("there")
    make_domain(node_a)
    add_map(node_a)
    node_a.activate("campus", 1, ANY)
    node_b.follow()
    *_, (position, entry) = node_a.store.entries(0)
    entry["state"]["map"]["tomorrow"] = 1
    assert node_a.store.append(position + 1, entry)
    for _ in range(2):
        with pytest.raises(DamagedFileError, match=f"entry {position + 1} of the map store's log.*tomorrow"):
            node_b.follow()
    assert node_b.domain("campus").active_version == 1


def test_a_file_is_fetched_once_however_many_ask(
    pair: tuple[SharedCatalog, SharedCatalog], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, node_b = pair
    n_fetched, pieces = [], map_store.MapStore.map_pieces
    monkeypatch.setattr(map_store.MapStore, "map_pieces", lambda *arguments: n_fetched.append(1) or pieces(*arguments))
    at_once(8 * [partial(node_b.map_file, "campus", 1)])
    assert len(n_fetched) == 1


def test_the_cache_holds_its_size_and_keeps_what_is_in_use(node: MakeNode, add_map: AddMap) -> None:
    node_a = node("here")
    make_domain(node_a)
    sizes = []
    for seed in range(5):
        sizes.append(add_map(node_a, seed=seed).file_bytes or 0)
        node_a.activate("campus", seed + 1, ANY)
    node_b = node("there", cache_bytes=3 * max(sizes))
    versions = range(1, 6)
    node_a.activate("campus", 1, ANY)
    for version in versions:  # mirrored in turn, as versions served
        node_a.activate("campus", version, ANY)
    node_b.follow()

    def present() -> list[int]:
        return [version for version in versions if node_b.map_path("campus", version).exists()]

    for moment, version in enumerate((1, 2, 3)):
        os.utime(node_b.map_file("campus", version), ns=(moment, moment))
    node_b.map_file("campus", 1)  # asked for again: 2 is the oldest
    node_b.map_file("campus", 4)
    assert present() == [1, 3, 4]
    node_b.is_in_use = lambda domain, version, digest: version in {1, 3}
    node_b.map_file("campus", 5)
    assert present() == [1, 3, 5]
    node_b.is_in_use = lambda domain, version, digest: True
    with pytest.raises(UnavailableError, match="map_cache_disk_bytes") as full:
        node_b.map_file("campus", 4)
    assert full.value.hints["reason"] == "cache_full"
    assert present() == [1, 3, 5]
    assert node_b.has_file("campus", 4)


def test_a_full_disk_is_named_and_leaves_no_half_file(
    pair: tuple[SharedCatalog, SharedCatalog], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, node_b = pair

    def full(*_: object) -> Iterator[bytes]:
        yield b"half"
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(map_store.MapStore, "map_pieces", full)
        with pytest.raises(UnavailableError) as refused:
            node_b.map_file("campus", 1)
    assert refused.value.hints["reason"] == "disk_full"
    assert list(node_b.map_path("campus", 1).parent.iterdir()) == []
    assert node_b.map_file("campus", 1).is_file()


def test_backups_and_checks_want_no_file_that_the_store_keeps(
    node: MakeNode, pair: tuple[SharedCatalog, SharedCatalog], tmp_path: Path
) -> None:
    node_a, node_b = pair
    assert not inspect(node_b.data_dir, lambda _: None).damaged
    assert back_up(node_b.data_dir, tmp_path / "backup.tar", "0", lambda _: None).n_maps == 0
    restore(tmp_path / "backup.tar", tmp_path / "restored", lambda _: None)
    restored = node("restored")
    assert restored.map_file("campus", 1).read_bytes() == node_a.map_path("campus", 1).read_bytes()
    assert back_up(node_a.data_dir, tmp_path / "whole.tar", "0", lambda _: None).n_maps == 1
