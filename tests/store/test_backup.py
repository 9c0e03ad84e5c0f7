"""A backup holds everything acknowledged before it began; a restore is whole or not at all; a check reads all."""

import hashlib
import io
import json
import shutil
import sqlite3
import stat
import tarfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepsimbad.errors import (
    CancelledError,
    ConflictError,
    DamagedFileError,
    DamagedMapError,
    DataDirInUseError,
    InvalidArchiveError,
    InvalidInputError,
    UnavailableError,
)
from deepsimbad.store.backup import Inspection, back_up, inspect, migrations_of, restore
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.durable import service_lock
from deepsimbad.store.map_file import read_map, verify
from deepsimbad.store.sessions import ObservedRow, SessionRecord, SessionStore
from deepsimbad.store.traverses import Traverse

from .conftest import AddMap, MakeFrames


def silent(_: float) -> None:
    pass


def contents_of(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def altered(path: Path, *statements: str) -> None:
    with closing(sqlite3.connect(path)) as connection, connection:
        for statement in statements:
            connection.execute(statement)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, add_map: AddMap, make_frames: MakeFrames) -> Path:
    """Two maps, one active, one being built; two traverses; an empty domain; a session. A backup of it beside it."""
    data_dir = tmp_path_factory.mktemp("original") / "data"
    with Catalog.open(data_dir) as catalog, SessionStore.open(data_dir) as store:
        for name in ("campus", "empty"):
            catalog.create_domain(name, {}, False, [1, 2, 3])
        for seed in range(2):
            add_map(catalog, seed=seed)
        catalog.activate("campus", 1, ANY)
        catalog.activate("campus", 2, 1)
        catalog.building_path("campus", catalog.begin_map("campus", {})).write_bytes(b"half")
        for seed, name in enumerate(("summer", "winter")):
            with Traverse.create(data_dir, "campus", name) as traverse:
                traverse.put_frames(make_frames(np.arange(50), seed=seed))
        digest = catalog.map("campus", 1).sha256 or ""
        number = store.create(SessionRecord(0, "robot", "campus", 1, digest, {}, 0.0, 9e9, 0, None)).result().number
        for sequence in range(1, 4):
            row = ObservedRow(sequence, 9e9, 1.0, None, np.arange(1, 21, dtype=np.float32))
            store.append(number, row, 0.0).result()
    back_up(data_dir, data_dir.with_name("backup.tar"), "1.2", silent)
    return data_dir


@pytest.fixture
def furnished(original: Path, tmp_path: Path) -> Iterator[Catalog]:
    shutil.copytree(original, tmp_path / "data")
    (tmp_path / "data").chmod(0o700)
    with Catalog.open(tmp_path / "data") as catalog:
        yield catalog


@pytest.fixture
def archive(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(original.with_name("backup.tar"), tmp_path))


def test_everything_comes_back(furnished: Catalog, archive: Path, tmp_path: Path) -> None:
    restored_dir = tmp_path / "there"
    shares: list[float] = []
    report = restore(archive, restored_dir, shares.append)
    assert (report.n_files, report.release) == (6, "1.2")
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    with Catalog.open(restored_dir) as catalog, SessionStore.open(restored_dir) as store:
        assert catalog.domains() == furnished.domains()
        assert len(catalog.discard_unfinished()) == 1, "the map that was being built"
        assert catalog.maps("campus") == furnished.maps("campus")[:2]
        for record in catalog.maps("campus"):
            path = catalog.map_path("campus", record.version)
            verify(path, record.sha256 or "")
            assert stat.S_IMODE(path.stat().st_mode) == 0o444
            assert read_map(path).version == record.version
        for name in ("summer", "winter"):
            with (
                Traverse.open(restored_dir, "campus", name) as new,
                Traverse.open(furnished.data_dir, "campus", name) as old,
            ):
                assert (new.read().encodings == old.read().encodings).all()
        assert store.find("robot").n_events == 3
        Traverse.create(restored_dir, "empty", "new").close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["backup.tar", "data", "there"], "nothing is left beside"


def test_it_is_a_tar_file_with_a_manifest(archive: Path) -> None:
    with tarfile.open(archive) as tar:
        names = tar.getnames()
        packed = tar.extractfile("manifest.json")
        assert packed is not None
        manifest = json.loads(packed.read())
    assert names[:2] == ["sessions.sqlite", "catalog.sqlite"], "sessions are copied before what they speak of"
    assert names[-1] == "manifest.json"
    assert [member["name"] for member in manifest["files"]] == names[:-1]
    assert {"format", "format_version", "release", "created_at"} < set(manifest)
    assert stat.S_IMODE(archive.stat().st_mode) == 0o600


def test_the_data_directory_is_left_as_it_was_and_no_file_is_replaced(furnished: Catalog, tmp_path: Path) -> None:
    furnished.close()
    old_contents = contents_of(furnished.data_dir)
    (tmp_path / "mine").write_text("precious")
    for file, error in ((tmp_path / "mine", ConflictError), (tmp_path / "nowhere" / "x", InvalidInputError)):
        with pytest.raises(error):
            back_up(furnished.data_dir, file, "0", silent)
    back_up(furnished.data_dir, tmp_path / "backup.tar", "0", silent)
    assert inspect(furnished.data_dir, silent) == Inspection(6, ())
    assert contents_of(furnished.data_dir) == old_contents
    assert (tmp_path / "mine").read_text() == "precious"


def test_a_cancelled_backup_or_restore_leaves_nothing(furnished: Catalog, archive: Path, tmp_path: Path) -> None:
    def cancel(share: float) -> None:
        if share > 0.4:
            raise CancelledError("cancelled")

    old_paths = sorted(tmp_path.iterdir())
    with pytest.raises(CancelledError):
        back_up(furnished.data_dir, tmp_path / "other.tar", "0", cancel)
    with pytest.raises(CancelledError):
        restore(archive, tmp_path / "there", cancel)
    assert sorted(tmp_path.iterdir()) == old_paths


def test_what_is_damaged_is_named_and_not_backed_up(furnished: Catalog, tmp_path: Path) -> None:
    path = furnished.map_path("campus", 1)
    content = path.read_bytes()
    path.chmod(0o644)
    path.write_bytes(content[:5000] + bytes([content[5000] ^ 1]) + content[5001:])
    with pytest.raises(DamagedMapError, match=r"map 1 of domain campus .* SHA-256 differs"):
        back_up(furnished.data_dir, tmp_path / "backup.tar", "0", silent)
    path.unlink()
    with pytest.raises(DamagedMapError, match=r"map 1 of domain campus .*000001\.sqlite is missing"):
        back_up(furnished.data_dir, tmp_path / "backup.tar", "0", silent)
    path.write_bytes(content)
    traverse = furnished.data_dir / "domains/campus/traverses/winter.sqlite"
    traverse.write_bytes(traverse.read_bytes()[:8192])
    with pytest.raises(DamagedFileError, match=r"winter\.sqlite"):
        back_up(furnished.data_dir, tmp_path / "backup.tar", "0", silent)
    assert not (tmp_path / "backup.tar").exists()


def test_a_backup_that_was_changed_or_cut_short_is_refused(archive: Path, tmp_path: Path) -> None:
    content = archive.read_bytes()
    with tarfile.open(archive) as tar:
        members = [(info.offset_data, info.size) for info in tar if info.name != "manifest.json"]
        manifest_at = tar.getmember("manifest.json").offset
    rng = np.random.default_rng(0)
    places = [0, 100, *(offset + int(rng.integers(size)) for offset, size in members for _ in range(4))]
    for at in places:
        archive.write_bytes(content[:at] + bytes([content[at] ^ (1 << rng.integers(8))]) + content[at + 1 :])
        with pytest.raises(InvalidArchiveError):
            restore(archive, tmp_path / "there", silent)
    for length in (0, 1, 511, 1024, 2048, len(content) // 2, manifest_at, manifest_at + 600):
        archive.write_bytes(content[:length])
        with pytest.raises(InvalidArchiveError):
            restore(archive, tmp_path / "there", silent)
    archive.unlink()
    with pytest.raises(InvalidArchiveError):
        restore(archive, tmp_path / "there", silent)
    assert not (tmp_path / "there").exists()


def forged(tmp_path: Path, names: list[str], fields: dict[str, Any], kind: bytes = tarfile.REGTYPE) -> Path:
    """A backup whose digests are all right, by someone who means harm."""
    content = b"x" * 700
    members = [{"name": name, "bytes": 700, "sha256": hashlib.sha256(content).hexdigest()} for name in names]
    manifest = {"format": "deepsimbad-backup", "format_version": 1, **fields, "files": members}
    with tarfile.open(tmp_path / "forged.tar", "w") as tar:
        for name, packed in [*((name, content) for name in names), ("manifest.json", json.dumps(manifest).encode())]:
            info = tarfile.TarInfo(name)
            info.size = len(packed)
            if name != "manifest.json" and kind != tarfile.REGTYPE:
                info.type, info.linkname, info.size = kind, "/etc/passwd", 0
            tar.addfile(info, io.BytesIO(packed))
    return tmp_path / "forged.tar"


@pytest.mark.parametrize(
    "name",
    [
        "../evil",
        "/etc/evil",
        "domains/../../evil.sqlite",
        "domains/campus/traverses/../../../evil.sqlite",
        "domains/campus/maps/1.sqlite",
        "domains/.hidden/traverses/a.sqlite",
        "catalog.sqlite/../evil",
        "catalog.sqlite-wal",
        "domains/campus/traverses/a.sqlite\n",
        "owners/" + "0" * 32,
    ],
)
def test_a_name_that_leads_elsewhere_is_refused(tmp_path: Path, name: str) -> None:
    assert migrations_of(name) is None
    path = forged(tmp_path, ["catalog.sqlite", name], {})
    old_paths = sorted(tmp_path.rglob("*"))
    with pytest.raises(InvalidArchiveError, match="has no place in it"):
        restore(path, tmp_path / "there", silent)
    assert sorted(tmp_path.rglob("*")) == old_paths


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.DIRTYPE, tarfile.CHRTYPE])
def test_anything_but_a_plain_file_is_refused(tmp_path: Path, kind: bytes) -> None:
    with pytest.raises(InvalidArchiveError, match="has no place in it"):
        restore(forged(tmp_path, ["catalog.sqlite"], {}, kind), tmp_path / "there", silent)


def test_what_is_no_backup_is_refused(tmp_path: Path) -> None:
    wrong: list[tuple[list[str], dict[str, Any], str]] = [
        (["sessions.sqlite"], {}, "no backup of a data directory"),
        (["catalog.sqlite"], {"format": "other"}, "no backup of a data directory"),
        (["catalog.sqlite"], {"format_version": 2}, "newer release"),
    ]
    for names, fields, message in wrong:
        with pytest.raises(InvalidArchiveError, match=message):
            restore(forged(tmp_path, names, fields), tmp_path / "there", silent)
    with pytest.raises(DamagedFileError, match=r"catalog\.sqlite"):
        restore(forged(tmp_path, ["catalog.sqlite"], {}), tmp_path / "there", silent)
    with tarfile.open(tmp_path / "plain.tar", "w") as tar:
        tar.addfile(tarfile.TarInfo("catalog.sqlite"), io.BytesIO())
    with pytest.raises(InvalidArchiveError):
        restore(tmp_path / "plain.tar", tmp_path / "there", silent)
    assert not (tmp_path / "there").exists()


def repacked(archive: Path, name: str, change: Callable[[Path], None]) -> None:
    """A backup with one member changed, all digests right again."""
    folder = archive.with_name("unpacked")
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    change(folder / name)
    manifest = json.loads((folder / "manifest.json").read_text())
    with tarfile.open(archive, "w") as tar:
        for member in manifest["files"]:
            path = folder / member["name"]
            member |= {"bytes": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
            tar.add(path, member["name"])
        (folder / "manifest.json").write_text(json.dumps(manifest))
        tar.add(folder / "manifest.json", "manifest.json")
    shutil.rmtree(folder)


def test_a_backup_that_others_packed_comes_back(archive: Path, tmp_path: Path) -> None:
    repacked(archive, "catalog.sqlite", lambda path: None)
    assert restore(archive, tmp_path / "there", silent).n_files == 6


@pytest.mark.parametrize(
    ("name", "table"),
    [
        ("catalog.sqlite", "job"),
        ("sessions.sqlite", "journal"),
        ("domains/campus/traverses/summer.sqlite", "frame"),
        ("domains/campus/maps/000001.sqlite", "posting"),
    ],
)
@pytest.mark.parametrize(
    "definition", ["VIEW strange AS SELECT 1", "TRIGGER strange AFTER INSERT ON {} BEGIN SELECT 1; END"]
)
def test_a_backup_that_would_run_what_its_maker_wrote_is_refused(
    archive: Path, tmp_path: Path, name: str, table: str, definition: str
) -> None:
    repacked(archive, name, lambda path: altered(path, f"CREATE {definition.format(table)}"))
    with pytest.raises(DamagedFileError, match="no release writes"):
        restore(archive, tmp_path / "there", silent)
    assert not (tmp_path / "there").exists()


def test_only_an_empty_folder_is_restored_into(archive: Path, furnished: Catalog, tmp_path: Path) -> None:
    with pytest.raises(ConflictError, match="not empty"):
        restore(archive, furnished.data_dir, silent)
    data_dir = tmp_path / "there"
    with service_lock(data_dir, "127.0.0.1:8000"), pytest.raises(DataDirInUseError):
        restore(archive, data_dir, silent)
    (data_dir / "service.lock").touch()  # of a service that was killed
    restore(archive, data_dir, silent)
    (tmp_path / "file").write_text("x")
    with pytest.raises(UnavailableError, match="should be"):
        restore(archive, tmp_path / "file", silent)
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    restore(archive, tmp_path / "link", silent)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "catalog.sqlite").exists()


def at_half(act: Callable[[], None]) -> Callable[[float], None]:
    """Does something once, in the middle of a restore."""
    acts = [act]

    def progress(share: float) -> None:
        if share > 0.5 and acts:
            acts.pop()()

    return progress


def test_no_service_starts_in_a_folder_that_is_restored_into(archive: Path, tmp_path: Path) -> None:
    data_dir, refused = tmp_path / "there", []

    def start() -> None:
        with pytest.raises(DataDirInUseError), service_lock(data_dir, "127.0.0.1:8000"):
            pass
        refused.append(True)

    restore(archive, data_dir, at_half(start))
    assert refused
    with service_lock(data_dir, "127.0.0.1:8000"), Catalog.open(data_dir) as catalog:
        assert len(catalog.domains()) == 2


def test_a_folder_that_a_command_began_to_use_meanwhile_is_left_alone(archive: Path, tmp_path: Path) -> None:
    data_dir = tmp_path / "there"
    with pytest.raises(ConflictError, match="not empty any more"):
        restore(archive, data_dir, at_half(lambda: Catalog.open(data_dir).close()))
    assert not (data_dir / "domains").exists(), "nothing is published by half"
    assert not (data_dir / "sessions.sqlite").exists()
    with Catalog.open(data_dir) as catalog:
        assert catalog.domains() == []


def test_a_restore_that_was_killed_is_begun_anew(archive: Path, tmp_path: Path) -> None:
    data_dir = tmp_path / "there"
    (data_dir / ".restoring").mkdir(parents=True)
    (data_dir / "domains/campus").mkdir(parents=True)  # it had begun to publish; the catalog comes last
    with pytest.raises(DamagedFileError, match="missing beside a folder of domains"):
        Catalog.open(data_dir)
    (data_dir / "other").touch()
    with pytest.raises(ConflictError, match="not empty"):
        restore(archive, data_dir, silent)
    (data_dir / "other").unlink()
    restore(archive, data_dir, silent)
    assert not (data_dir / ".restoring").exists()
    with Catalog.open(data_dir) as catalog:
        assert len(catalog.domains()) == 2
    (data_dir / ".restoring").mkdir()
    with pytest.raises(ConflictError, match="not empty"):
        restore(archive, data_dir, silent)


def test_a_folder_that_is_made_is_its_owners_alone_and_one_that_was_there_keeps_its_rights(
    archive: Path, furnished: Catalog, tmp_path: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine").chmod(0o750)
    for data_dir in (tmp_path / "above" / "there", tmp_path / "mine"):
        restore(archive, data_dir, silent)
        Catalog.open(data_dir).close()
    folders = (tmp_path / "above" / "there", furnished.data_dir, tmp_path / "mine")
    assert [stat.S_IMODE(folder.stat().st_mode) for folder in folders] == [0o700, 0o700, 0o750]


def test_what_comes_and_goes_meanwhile_is_copied_as_it_is_now(furnished: Catalog, tmp_path: Path) -> None:
    n_pieces = 0

    def change(_: float) -> None:
        nonlocal n_pieces
        n_pieces += 1
        if n_pieces == 2:  # sessions and catalog are copied
            furnished.remove_map("campus", 1, lambda: False)
            furnished.delete_domain("empty")
            furnished.create_domain("empty", {}, True, [5])
            Traverse.create(furnished.data_dir, "empty", "t").close()

    report = back_up(furnished.data_dir, tmp_path / "backup.tar", "0", change)
    assert (report.n_maps, report.n_traverses) == (1, 3)
    restore(tmp_path / "backup.tar", tmp_path / "there", silent)
    with Catalog.open(tmp_path / "there") as catalog:
        assert catalog.map("campus", 1).removed_at is not None
        assert not catalog.map_path("campus", 1).exists()
        assert catalog.domain("empty").closed
        assert Traverse.list(tmp_path / "there", "empty") == ["t"]


# Check


def test_a_file_that_others_write_to_is_read_as_it_stands(furnished: Catalog, make_frames: MakeFrames) -> None:
    with Traverse.open(furnished.data_dir, "campus", "summer") as traverse:
        furnished.create_domain("new", {}, False, [1])
        furnished.remove_map("campus", 1, lambda: False)
        traverse.put_frames(make_frames(np.arange(300, 400)))
        assert (furnished.data_dir / "catalog.sqlite-wal").stat().st_size > 0
        assert inspect(furnished.data_dir, silent) == Inspection(5, ())


@pytest.mark.parametrize(
    "name",
    [
        "catalog.sqlite",
        "sessions.sqlite",
        "domains/campus/traverses/summer.sqlite",
        "domains/campus/maps/000001.sqlite",
    ],
)
def test_what_is_damaged_is_named_and_the_rest_is_read_all_the_same(furnished: Catalog, name: str) -> None:
    furnished.close()
    path = furnished.data_dir / name
    content = path.read_bytes()
    page = len(content) // 4096 // 2 * 4096
    for damage in (
        content[:100] + bytes(50) + content[150:],
        content[:page] + bytes(600) + content[page + 600 :],
        content[:4096],
    ):
        path.chmod(0o644)
        path.write_bytes(damage)
        assert {finding.file for finding in inspect(furnished.data_dir, silent).damaged} == {name}, damage[:16]
    path.unlink()
    is_known = name == "catalog.sqlite" or "maps" in name
    assert {finding.file for finding in inspect(furnished.data_dir, silent).damaged} == ({name} if is_known else set())
