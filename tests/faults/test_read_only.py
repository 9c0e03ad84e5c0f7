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


def test_the_service_does_not_start(read_only: Path) -> None:
    new_dir = ("--create", "--data-dir", read_only / "new")
    old_dir_run, new_dir_run = unprivileged(
        *(("serve", "--port", 0, *options) for options in (("--data-dir", read_only), new_dir))
    )
    assert (old_dir_run.code, old_dir_run.out, new_dir_run.code, new_dir_run.out) == (1, "", 1, "")
    assert old_dir_run.err.splitlines()[-1] == f"deepsimbad: unavailable: {read_only.name}: it may not be written"
    assert new_dir_run.err.splitlines()[-1] == "deepsimbad: unavailable: new: it may not be written"


def test_who_would_write_is_told_in_one_line(read_only: Path) -> None:
    """The commands would change the data directory, or write a backup or an export into it."""
    changes = (("delete-domain", "loop", "--yes"), ("keys", "create", "--scope", "admin"))
    exports = (("backup", read_only / "b.tar"), ("export", "loop", read_only / "m.map"))
    for ran in unprivileged(*((*words, "--data-dir", read_only) for words in changes + exports)):
        assert "may not be written" in ran.line or "cannot be opened" in ran.line
    assert not [*read_only.glob("*b.tar*"), *read_only.glob("*m.map*")]


def test_who_asks_is_answered_and_it_can_be_checked_and_backed_up(read_only: Path, tmp_path: Path) -> None:
    times_ns = {path: path.stat().st_mtime_ns for path in read_only.rglob("*")}
    commands = (("info", "loop"), ("check",), ("backup", tmp_path / "b.tar"))
    info, *other_runs = unprivileged(*((*words, "--data-dir", read_only) for words in commands))
    assert info.code == 0
    assert [(ran.code, ran.out) for ran in other_runs] == [(0, "")] * 2, other_runs
    assert {path: path.stat().st_mtime_ns for path in read_only.rglob("*")} == times_ns
    assert command("restore", tmp_path / "b.tar", "--data-dir", tmp_path / "there").code == 0
    assert command("check", "--data-dir", tmp_path / "there").code == 0
