"""Damage in each kind of file is named to whoever needs the file; what a service says of it, tests/contract asks."""

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest

from .conftest import Service, begin, check_is_clean, command

pytestmark = pytest.mark.slow


def flip(path: Path, at: int) -> None:
    """Flip a bit of a file; the second time it is as it was."""
    mode = path.stat().st_mode
    content = bytearray(path.read_bytes())
    content[at] ^= 4
    path.chmod(0o644)
    path.write_bytes(content)
    path.chmod(mode)


def damaged_files(data_dir: Path) -> set[str]:
    """The files that `check` calls damaged."""
    ran = command("check", "--data-dir", data_dir)
    assert ran.code == 1, ran
    return set(re.findall(r"^damaged: ([^:]+): ", ran.out, re.MULTILINE))


@pytest.mark.parametrize("name", ["catalog.sqlite", "sessions.sqlite"])
def test_a_damaged_page_keeps_the_service_from_starting(data_dir: Path, name: str) -> None:
    with Service(data_dir) as service:
        begin(service)
    path = data_dir / name
    content = path.read_bytes()
    path.write_bytes(content[:4096] + bytes(600) + content[4696:])
    ran = command("serve", "--port", 0, "--data-dir", data_dir)
    assert (ran.code, ran.out) == (1, "")
    assert re.match(rf"deepsimbad: [a-z_]+: .*{re.escape(name)} is damaged", ran.err.splitlines()[-1])
    assert "Traceback" not in ran.err
    assert damaged_files(data_dir) == {name}
    path.write_bytes(content)
    check_is_clean(data_dir)


def test_in_the_map_that_serves(data_dir: Path, tmp_path: Path) -> None:
    path = data_dir / "domains/loop/maps/000002.sqlite"
    flip(path, path.stat().st_size // 2)
    assert damaged_files(data_dir) == {"domains/loop/maps/000002.sqlite"}
    for arguments in (("backup", tmp_path / "b.tar"), ("export", "loop", tmp_path / "m.map")):
        assert "map 2 of domain loop is damaged" in command(*arguments, "--data-dir", data_dir).line


def test_in_a_backup_or_an_exported_map(data_dir: Path, tmp_path: Path) -> None:
    backup, exported, new_dir = tmp_path / "b.tar", tmp_path / "m.map", tmp_path / "there"
    assert command("backup", backup, "--data-dir", data_dir).code == 0
    assert command("export", "loop", exported, "--data-dir", data_dir).code == 0
    for at in (70, 3000, backup.stat().st_size // 2):
        flip(backup, at)
        assert "cannot be restored" in command("restore", backup, "--data-dir", new_dir).line
        flip(backup, at)
    in_positions = exported.read_bytes().index(np.arange(20.0, 40.0).tobytes()) + 9
    digest = hashlib.sha256(exported.read_bytes()).hexdigest()
    flip(exported, in_positions)
    assert "is another file" in command("import", exported, "--sha256", digest, "--data-dir", new_dir).line
    flip(exported, in_positions)
    assert not list(new_dir.glob("domains/*"))
    for path in new_dir.glob("*"):
        path.rmdir() if path.is_dir() else path.unlink()
    assert command("restore", backup, "--data-dir", new_dir).code == 0
    assert command("import", exported, "--domain", "twin", "--data-dir", new_dir).code == 0
    check_is_clean(new_dir)
