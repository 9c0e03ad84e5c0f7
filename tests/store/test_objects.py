"""Objects in a bucket and in a folder behave alike, and a store that fails is told by name."""

import shutil
import sys
from collections.abc import Iterator
from functools import partial
from itertools import compress
from pathlib import Path

import pytest

from deepsimbad.errors import MissingPackageError, SettingsError, UnavailableError
from deepsimbad.store import objects as objects_module
from deepsimbad.store.objects import Objects

from .bucket import Bucket, served_bucket
from .conftest import at_once


@pytest.fixture
def bucket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bucket]:
    root = tmp_path / "s3"
    root.mkdir()
    with served_bucket(root) as new_bucket:
        for name, value in new_bucket.environment.items():
            monkeypatch.setenv(name, value)
        yield new_bucket


@pytest.fixture(params=["s3", "folder"])
def objects(request: pytest.FixtureRequest, tmp_path: Path) -> Objects:
    if request.param == "s3":
        return Objects.open(request.getfixturevalue("bucket").url)
    return Objects.open(f"file://{tmp_path}/a store")


def test_an_object_is_written_whole_and_read_as_it_was(objects: Objects, tmp_path: Path) -> None:
    assert objects.get("domains/a") is None
    assert objects.size("domains/a") is None
    objects.put("domains/a", b"one")
    objects.put("domains/a", b"other")
    assert objects.get("domains/a") == b"other"
    assert objects.size("domains/a") == 5
    big = tmp_path / "big"
    big.write_bytes(bytes(range(256)) * 50_000)  # in several parts
    objects.put("maps/big", big)
    assert b"".join(objects.stream("maps/big")) == big.read_bytes()
    with pytest.raises(FileNotFoundError):
        list(objects.stream("maps/none"))
    assert sorted(objects.names("domains/")) == ["domains/a"]
    objects.put("domains/b", b"")
    assert sorted(objects.names("domains/", "domains/a")) == ["domains/b"]
    assert list(objects.names("nothing/")) == []
    for _ in range(2):
        objects.delete("domains/b")
        assert objects.get("domains/b") is None


def test_what_was_written_in_a_folder_outlives_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    objects, synced_paths = Objects.open(f"file://{tmp_path}/store"), []
    monkeypatch.setattr(objects_module, "sync", synced_paths.append)
    for write in (objects.create, objects.put):
        assert write("log/1", b"1") is not False
        assert synced_paths == [tmp_path / "store/log/1", tmp_path / "store/log"]
        synced_paths.clear()


def test_of_many_who_create_an_object_at_once_one_does(objects: Objects) -> None:
    contents = [b"%d" % number for number in range(8)]
    is_written = at_once([partial(objects.create, "log/1", content) for content in contents])
    assert list(compress(contents, is_written)) == [objects.get("log/1")]


def test_a_bucket_that_is_gone_and_credentials_that_are_refused_are_named(
    bucket: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "stranger")
    stranger = Objects.open(bucket.url)
    for ask in (lambda: stranger.get("a"), lambda: stranger.create("a", b""), lambda: list(stranger.names("maps/"))):
        with pytest.raises(UnavailableError, match="refuses the credentials") as refused:
            ask()
        assert refused.value.hints["reason"] == "refused"
    monkeypatch.undo()
    for name, value in bucket.environment.items():
        monkeypatch.setenv(name, value)
    objects = Objects.open(bucket.url)
    objects.put("a", b"1")
    shutil.rmtree(bucket.folder)
    for ask in (lambda: objects.get("a"), lambda: objects.create("b", b""), lambda: list(objects.names("maps/"))):
        with pytest.raises(UnavailableError, match="no such bucket") as failure:
            ask()
        assert failure.value.hints["reason"] == "no_bucket"


def test_a_store_that_nobody_listens_for_is_unreachable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "s3"
    root.mkdir()
    with served_bucket(root) as bucket:
        for name, value in bucket.environment.items():
            monkeypatch.setenv(name, value)
        objects = Objects.open(bucket.url)
    with pytest.raises(UnavailableError) as unreachable:
        objects.get("a")
    assert unreachable.value.hints["reason"] == "unreachable"


@pytest.mark.parametrize("url", ["nonsense", "ftp://host/folder", "s3://", ""])
def test_a_url_of_no_store_is_refused(url: str) -> None:
    with pytest.raises(SettingsError) as refused:
        Objects.open(url)
    assert refused.value.hints["setting"] == "map_store"


def test_a_missing_library_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "obstore"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'deep-simbad\[objects\]'"):
        Objects.open(f"file://{tmp_path}/store")
