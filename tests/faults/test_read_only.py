"""On a disk that may not be written reading commands answer, and writing ones say so in one line."""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ..commands import CommandResult
from ..killing import PROJECT
from .conftest import command

pytestmark = pytest.mark.slow
# Root may write everywhere, unless it gives that right up before it becomes another program.
UNPRIVILEGED = """
import ctypes, os, sys
DROP, DAC_OVERRIDE, DAC_READ_SEARCH, FOWNER = 24, 1, 2, 3
if os.geteuid() == 0:
    for capability in (DAC_OVERRIDE, DAC_READ_SEARCH, FOWNER):
        assert ctypes.CDLL(None).prctl(DROP, capability, 0, 0, 0) == 0
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""
COMMANDS = """
import dataclasses, json, sys
from tests.commands import run_command
results = (run_command(["deepsimbad", *words]) for words in json.loads(sys.argv[1]))
print(json.dumps([dataclasses.astuple(result) for result in results]))
"""


def unprivileged(*commands: tuple[object, ...]) -> list[CommandResult]:
    """Run commands of `deepsimbad`, one after the other, as somebody who may not write everywhere."""
    words = json.dumps([[str(word) for word in command] for command in commands])
    program = [sys.executable, "-c", UNPRIVILEGED, "-c", COMMANDS, words]
    process = subprocess.run(program, cwd=PROJECT, capture_output=True, text=True, check=False, timeout=120)
    assert process.returncode == 0, process.stderr
    return [CommandResult(*fields) for fields in json.loads(process.stdout)]


@pytest.fixture(scope="module")
def read_only(furnished: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A data directory that nobody may write."""
    data_dir = Path(shutil.copytree(furnished, tmp_path_factory.mktemp("read_only") / "data"))
    everything = (data_dir, *data_dir.rglob("*"))
    for path in everything:
        path.chmod(0o555 if path.is_dir() else 0o444)
    probe = [sys.executable, "-c", UNPRIVILEGED, "-c", "import sys; open(sys.argv[1], 'w')", str(data_dir / "probe")]
    if subprocess.run(probe, capture_output=True, check=False).returncode == 0:
        pytest.skip("whoever runs this may write everywhere, and cannot give that right up")
    yield data_dir
    for path in everything:
        path.chmod(0o755)


@pytest.fixture(scope="module")
def backup(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a backup may be written."""
    return tmp_path_factory.mktemp("backup") / "b.tar"


@pytest.fixture(scope="module")
def runs(read_only: Path, backup: Path) -> Iterator[dict[str, CommandResult]]:
    """What each command did, all in one process; none changes anything."""
    options = ("--data-dir", read_only)
    commands = {
        "info": ("info", "loop", *options),
        "check": ("check", *options),
        "backup": ("backup", backup, *options),
        "delete-domain": ("delete-domain", "loop", "--yes", *options),
        "keys": ("keys", "create", "--scope", "admin", *options),
        "backup into it": ("backup", read_only / "b.tar", *options),
        "export into it": ("export", "loop", read_only / "m.map", *options),
        "serve": ("serve", "--port", 0, *options),
        "serve a new one": ("serve", "--port", 0, "--create", "--data-dir", read_only / "new"),
    }
    times_ns = {path: path.stat().st_mtime_ns for path in (read_only, *read_only.rglob("*"))}
    yield dict(zip(commands, unprivileged(*commands.values()), strict=True))
    assert {path: path.stat().st_mtime_ns for path in (read_only, *read_only.rglob("*"))} == times_ns


@pytest.mark.parametrize(("name", "folder"), [("serve", "data"), ("serve a new one", "new")])
def test_the_service_does_not_start(runs: dict[str, CommandResult], name: str, folder: str) -> None:
    assert (runs[name].code, runs[name].out) == (1, "")
    assert runs[name].err.splitlines()[-1] == f"deepsimbad: unavailable: {folder}: it may not be written"


@pytest.mark.parametrize("name", ["delete-domain", "keys", "backup into it", "export into it"])
def test_who_would_write_is_told_in_one_line(runs: dict[str, CommandResult], name: str) -> None:
    assert "may not be written" in runs[name].line or "cannot be opened" in runs[name].line


def test_who_asks_is_answered_and_it_can_be_checked_and_backed_up(
    runs: dict[str, CommandResult], backup: Path, tmp_path: Path
) -> None:
    assert runs["info"].code == 0
    assert [(runs[name].code, runs[name].out) for name in ("check", "backup")] == [(0, "")] * 2, runs
    assert command("restore", backup, "--data-dir", tmp_path).code == 0
    assert command("check", "--data-dir", tmp_path).code == 0
