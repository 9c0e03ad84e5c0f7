import hashlib
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from deepsimbad.core.map import Map
from deepsimbad.errors import ConflictError, DamagedMapError, UnavailableError
from deepsimbad.store.map_file import read_map, seal, verify, write_map

MakeMap = Callable[..., Map]


def test_a_sealed_map_is_whole_alone_and_read_only(make_map: MakeMap, tmp_path: Path) -> None:
    building, final = tmp_path / "000001.building", tmp_path / "000001.sqlite"
    write_map(building, make_map())
    digest, n_bytes = seal(building, final)
    assert [path.name for path in tmp_path.iterdir()] == ["000001.sqlite"]
    assert digest == hashlib.sha256(final.read_bytes()).hexdigest()
    assert n_bytes == final.stat().st_size
    assert stat.S_IMODE(final.stat().st_mode) == 0o444
    verify(final, digest)
    assert read_map(final).domain == "campus"
    assert [path.name for path in tmp_path.iterdir()] == ["000001.sqlite"]  # reading leaves nothing beside it
    assert digest == hashlib.sha256(final.read_bytes()).hexdigest()


def test_sealing_is_reproducible(make_map: MakeMap, tmp_path: Path) -> None:
    contents = []
    for name in ("a", "b"):
        write_map(tmp_path / name, make_map())
        seal(tmp_path / name, tmp_path / f"{name}.sqlite")
        contents.append(read_map(tmp_path / f"{name}.sqlite"))
    assert (contents[0].lists == contents[1].lists).all()


def test_a_sealed_map_is_never_replaced(make_map: MakeMap, tmp_path: Path) -> None:
    building, final = tmp_path / "000001.building", tmp_path / "000001.sqlite"
    write_map(building, make_map())
    digest, _ = seal(building, final)
    write_map(building, make_map(seed=1))
    with pytest.raises(ConflictError):
        seal(building, final)
    verify(final, digest)
    assert building.exists()


def test_a_changed_file_fails_its_digest(make_map: MakeMap, tmp_path: Path) -> None:
    write_map(tmp_path / "a", make_map())
    final = tmp_path / "a.sqlite"
    digest, n_bytes = seal(tmp_path / "a", final)
    whole = final.read_bytes()
    for at in range(0, n_bytes, 997):
        final.chmod(0o644)
        final.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises(DamagedMapError):
            verify(final, digest)
    final.write_bytes(whole[:-1])
    with pytest.raises(DamagedMapError):
        verify(final, digest)
    final.unlink()
    with pytest.raises(DamagedMapError, match="missing"):
        verify(final, digest)


def test_what_cannot_be_read_back_is_not_sealed(make_map: MakeMap, tmp_path: Path) -> None:
    building, final = tmp_path / "000001.building", tmp_path / "000001.sqlite"
    with pytest.raises(UnavailableError):
        seal(building, final)
    write_map(building, make_map())
    whole = building.read_bytes()
    damaged_at = whole.index(make_map().position_m.tobytes()) + 100
    for content in (b"nothing of the kind" * 500, whole[: len(whole) // 2], _flipped(whole, damaged_at)):
        building.write_bytes(content)
        with pytest.raises(DamagedMapError):
            seal(building, final)
        assert not final.exists()
        assert not final.with_suffix(".sealing").exists()


def _flipped(whole: bytes, at: int) -> bytes:
    return whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]


def test_a_disk_that_takes_no_more_is_named_and_leaves_nothing(make_map: MakeMap, tmp_path: Path) -> None:
    """The kernel's limit on file sizes stands for the full disk, in a process of its own."""
    write_map(tmp_path / "000001.building", make_map())
    script = """
import resource, sys
from pathlib import Path
from deepsimbad.errors import UnavailableError
from deepsimbad.store.map_file import seal
folder = Path(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
try:
    seal(folder / "000001.building", folder / "000001.sqlite")
except UnavailableError as error:
    print(error.hints["reason"])
"""
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], check=True, capture_output=True, text=True)
    assert done.stdout.strip() in ("disk_full", "io_error")
    assert [path.name for path in tmp_path.iterdir()] == ["000001.building"]
    seal(tmp_path / "000001.building", tmp_path / "000001.sqlite")
