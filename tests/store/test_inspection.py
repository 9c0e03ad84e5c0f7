"""Every file is read; what is damaged or left over is named; nothing is changed."""

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deepsimbad.core.drive import Drive
from deepsimbad.core.map import Map
from deepsimbad.errors import CancelledError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.checkpoints import Checkpoints
from deepsimbad.store.inspection import Inspection, inspect
from deepsimbad.store.map_file import write_map
from deepsimbad.store.map_table import ANY
from deepsimbad.store.sealing import seal
from deepsimbad.store.session_records import ObservedRow, SessionRecord
from deepsimbad.store.sessions import SessionStore
from deepsimbad.store.traverses import Traverse

MakeMap = Callable[..., Map]
MakeFrames = Callable[..., Drive]
CATALOG, SESSIONS = "catalog.sqlite", "sessions.sqlite"
TRAVERSE = "domains/campus/traverses/summer.sqlite"
MAP = "domains/campus/maps/000001.sqlite"


def inspected(data_dir: Path) -> Inspection:
    return inspect(data_dir, lambda _: None)


def flip(path: Path, at: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.chmod(0o644)
    path.write_bytes(content)


@pytest.fixture
def furnished(campus: Catalog, make_map: MakeMap, make_frames: MakeFrames) -> Path:
    """A data directory with something of everything, closed."""
    for _ in range(2):
        version = campus.begin_map("campus", {})
        write_map(campus.building_path("campus", version), make_map(version=version))
        digest, n_bytes = seal(campus.building_path("campus", version), campus.map_path("campus", version))
        campus.seal_map("campus", version, digest, n_bytes, {})
    campus.activate("campus", 2, ANY)
    job = campus.create_job("campus", "remap", {})
    with Checkpoints.open(campus.data_dir, job.job_id) as checkpoints:
        checkpoints.save("train", "inputs", {"q": np.arange(10.0)}, {})
    with Traverse.create(campus.data_dir, "campus", "summer") as traverse:
        traverse.put_frames(make_frames(np.arange(300)))
    with SessionStore.open(campus.data_dir) as store:
        record = SessionRecord(0, "robot", "campus", 1, "0" * 64, {}, 0.0, 9e9, 0, None)
        number = store.create(record).result().number
        for sequence in range(1, 30):
            row = ObservedRow(sequence, 9e9, 1.0, None, np.arange(1, 301, dtype=np.float32))
            store.append(number, row, 0.0).result()
    campus.close()
    return campus.data_dir


def test_all_is_well_and_nothing_is_changed(furnished: Path) -> None:
    before = {path: path.read_bytes() for path in furnished.rglob("*") if path.is_file()}
    shares: list[float] = []
    found = inspect(furnished, shares.append)
    assert found == Inspection(6, (), ())
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert {path: path.read_bytes() for path in furnished.rglob("*") if path.is_file()} == before


def test_a_file_that_others_write_to_is_read_as_it_stands(furnished: Path, make_frames: MakeFrames) -> None:
    with Catalog.open(furnished) as catalog, Traverse.open(furnished, "campus", "summer") as traverse:
        catalog.create_domain("new", {}, False, [1])
        traverse.put_frames(make_frames(np.arange(300, 400)))
        assert (furnished / "catalog.sqlite-wal").stat().st_size > 0
        assert inspected(furnished) == Inspection(6, (), ())


@pytest.mark.parametrize("name", [CATALOG, SESSIONS, TRAVERSE, MAP])
def test_what_is_damaged_is_named_and_the_rest_is_read_all_the_same(furnished: Path, name: str) -> None:
    path = furnished / name
    whole = path.read_bytes()
    page = len(whole) // 4096 // 2 * 4096
    for damage in (
        whole[:100] + bytes(50) + whole[150:],
        whole[:page] + bytes(600) + whole[page + 600 :],
        whole[:4096],
    ):
        path.chmod(0o644)
        path.write_bytes(damage)
        found = inspected(furnished)
        assert {finding.file for finding in found.damaged} == {name}, damage[:16]
    path.unlink()
    found = inspected(furnished)
    if name in {CATALOG, MAP}:
        assert name in {finding.file for finding in found.damaged}
    else:
        assert found.damaged == (), "nothing says that there should be one"


def test_one_flipped_bit_in_a_frame_a_map_or_a_checkpoint_is_seen(furnished: Path, make_frames: MakeFrames) -> None:
    (checkpoint,) = furnished.glob("jobs/*/*.checkpoint")
    body = make_frames(np.arange(300)).encodings[200].tobytes()
    flip(furnished / TRAVERSE, (furnished / TRAVERSE).read_bytes().index(body) + 5)
    flip(furnished / MAP, 9999)
    flip(checkpoint, 99)
    found = {finding.file: finding.what for finding in inspected(furnished).damaged}
    assert set(found) == {TRAVERSE, MAP, checkpoint.relative_to(furnished).as_posix()}
    assert "frame 200" in found[TRAVERSE]
    assert "SHA-256 differs" in found[MAP]


def test_a_damaged_log_is_seen(furnished: Path) -> None:
    with Catalog.open(furnished) as catalog:
        catalog.create_domain("new", {}, False, [1])
        catalog.create_domain("newer", {}, False, [1])
        log = (furnished / "catalog.sqlite-wal").read_bytes()
    (furnished / "catalog.sqlite-wal").write_bytes(log[:100] + b"?" + log[101:])
    (finding,) = inspected(furnished).damaged
    assert finding.file == CATALOG
    assert "catalog.sqlite-wal is damaged at byte" in finding.what


def test_what_a_crash_leaves_is_no_damage(furnished: Path) -> None:
    left = [
        "domains/.removing-old",
        "domains/campus/maps/000001.sealing",
        "domains/campus/maps/000009.building-journal",
        "domains/campus/maps/000009.sqlite",
        "domains/campus/notes.txt",
        "domains/campus/traverses/autumn.new",
        "domains/campus/traverses/gone.sqlite-wal",
        "domains/empty",
        "domains/stranger",
        "jobs/" + "0" * 32,
        "what.is.this",
    ]
    for name in left:
        if "." in Path(name).name[1:]:
            (furnished / name).touch()
        else:
            (furnished / name).mkdir()
    (furnished / "domains/stranger/precious").touch()
    found = inspected(furnished)
    assert found.damaged == ()
    assert [finding.file for finding in found.left_over] == left
    with Catalog.open(furnished) as catalog:
        catalog.discard_unfinished()
    still = {finding.file for finding in inspected(furnished).left_over}
    assert still == {"domains/campus/notes.txt", "domains/stranger", "what.is.this"}


def test_a_removed_version_needs_no_file_and_a_building_one_may_have_some(furnished: Path) -> None:
    with Catalog.open(furnished) as catalog:
        catalog.remove_map("campus", 1, lambda: False)
        version = catalog.begin_map("campus", {})
        catalog.building_path("campus", version).write_bytes(b"half")
        assert inspected(furnished) == Inspection(5, (), ())


def test_a_cancel_ends_it(furnished: Path) -> None:
    def cancel(_: float) -> None:
        raise CancelledError("cancelled")

    with pytest.raises(CancelledError):
        inspect(furnished, cancel)


@pytest.mark.slow
def test_beside_work_that_goes_on_nothing_is_wrong(furnished: Path, make_map: MakeMap, make_frames: MakeFrames) -> None:
    ended = threading.Event()

    def work() -> None:
        with Catalog.open(furnished) as catalog:
            while not ended.is_set():
                version = catalog.begin_map("campus", {})
                write_map(catalog.building_path("campus", version), make_map(version=version))
                sealed = seal(catalog.building_path("campus", version), catalog.map_path("campus", version))
                catalog.seal_map("campus", version, *sealed, {})
                catalog.activate("campus", version, ANY)
                catalog.remove_map("campus", version - 1, lambda: False)
                catalog.create_domain("passing", {}, False, [1])
                with Traverse.create(furnished, "passing", "t") as traverse:
                    traverse.put_frames(make_frames(np.arange(20)))
                catalog.delete_domain("passing")

    thread = threading.Thread(target=work)
    thread.start()
    try:
        for _ in range(15):
            found = inspected(furnished)
            assert found.damaged == ()
            assert found.left_over == ()
    finally:
        ended.set()
        thread.join()
