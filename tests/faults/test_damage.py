"""Damage in each kind of file is named to whoever needs the file, and everything else goes on."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from .conftest import Service, begin, check_is_clean, command

pytestmark = pytest.mark.slow
VIEW = {"ranked_landmarks": [1, 2, 3]}


def flip(path: Path, at: int) -> Callable[[], None]:
    """Flip a bit of a file; returns a function that flips it back."""
    mode = path.stat().st_mode
    content = bytearray(path.read_bytes())
    content[at] ^= 4
    path.chmod(0o644)
    path.write_bytes(content)
    path.chmod(mode)

    def undo() -> None:
        flip(path, at)

    return undo


def place_of(path: Path, text: bytes) -> int:
    """The offset of the first occurrence of some bytes in a file."""
    at = path.read_bytes().find(text)
    assert at > 0, f"{text!r} is not in {path.name}"
    return at


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
    last = ran.err.splitlines()[-1]
    assert re.match(r"deepsimbad: [a-z_]+: ", last)
    assert f"{name} is damaged" in last
    assert "Traceback" not in ran.err
    assert damaged_files(data_dir) == {name}
    path.write_bytes(content)
    check_is_clean(data_dir)


def test_in_the_map_that_serves_another_version_helps_or_the_file_itself(data_dir: Path, tmp_path: Path) -> None:
    path = data_dir / "domains/loop/maps/000002.sqlite"
    undo = flip(path, path.stat().st_size // 2)
    assert damaged_files(data_dir) == {"domains/loop/maps/000002.sqlite"}
    for arguments in (("backup", tmp_path / "b.tar"), ("export", "loop", tmp_path / "m.map")):
        assert "map 2 of domain loop is damaged" in command(*arguments, "--data-dir", data_dir).line
    ran = command("serve", "--data-dir", data_dir, "--port", 0, "--config", "/nowhere")
    assert "there is no settings file" in ran.err.splitlines()[-1]
    with damaged_service(data_dir) as service:
        problem = service.problem_of("POST", "/v1/domains/loop/localizations", json=VIEW)
        assert (problem["status"], problem["code"]) == (503, "damaged_map")
        assert service.answer_to("POST", "/v1/domains/yard/localizations", json=VIEW)["map_version"] == 1
        assert service.answer_to("PUT", "/v1/admin/domains/loop/active-map", json={"version": 1})["state"] == "active"
        assert service.answer_to("POST", "/v1/domains/loop/localizations", json=VIEW)["map_version"] == 1
        assert (
            service.problem_of("PUT", "/v1/admin/domains/loop/active-map", json={"version": 2})["code"] == "damaged_map"
        )
        undo()  # the operator puts a copy of the file in its place
        assert service.answer_to("PUT", "/v1/admin/domains/loop/active-map", json={"version": 2})["state"] == "active"
        assert service.answer_to("POST", "/v1/domains/loop/localizations", json=VIEW)["map_version"] == 2
    check_is_clean(data_dir)


def damaged_service(data_dir: Path) -> Service:
    """A service that is up though one of its maps is damaged."""
    return Service(data_dir, ready=False)


def test_in_a_backup_or_an_exported_map(data_dir: Path, tmp_path: Path) -> None:
    backup, exported, new_dir = tmp_path / "b.tar", tmp_path / "m.map", tmp_path / "there"
    assert command("backup", backup, "--data-dir", data_dir).code == 0
    assert command("export", "loop", exported, "--data-dir", data_dir).code == 0
    for at in (70, 3000, backup.stat().st_size // 2):
        undo = flip(backup, at)
        assert "cannot be restored" in command("restore", backup, "--data-dir", new_dir).line
        undo()
    undo = flip(exported, place_of(exported, np.arange(20.0, 40.0).tobytes()) + 9)
    assert "no map that can serve here" in command("import", exported, "--data-dir", new_dir).line
    undo()
    assert not list(new_dir.glob("domains/*")) if new_dir.exists() else True
    for path in new_dir.glob("*"):
        path.rmdir() if path.is_dir() else path.unlink()
    assert command("restore", backup, "--data-dir", new_dir).code == 0
    assert command("import", exported, "--domain", "twin", "--data-dir", new_dir).code == 0
    check_is_clean(new_dir)
