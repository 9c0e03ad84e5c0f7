"""A disk that may not be written: who asks is answered, who would write is told, and nothing is tried twice."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ..commands import Ran
from .conftest import command

pytestmark = pytest.mark.slow
# Root may write everywhere, unless it gives that right up before it becomes the command.
UNPRIVILEGED = """
import ctypes, os, sys
DROP, DAC_OVERRIDE, DAC_READ_SEARCH, FOWNER = 24, 1, 2, 3
if os.geteuid() == 0:
    for capability in (DAC_OVERRIDE, DAC_READ_SEARCH, FOWNER):
        assert ctypes.CDLL(None).prctl(DROP, capability, 0, 0, 0) == 0
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""


def unprivileged(*arguments: object) -> Ran:
    """Run `deepsimbad` as somebody who may not write everywhere."""
    done = subprocess.run(
        [sys.executable, "-c", UNPRIVILEGED, "-m", "deepsimbad", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    return Ran(done.returncode, done.stdout, done.stderr)


@pytest.fixture
def read_only(data_dir: Path) -> Iterator[Path]:
    """A data directory that nobody may write."""
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
    ran = unprivileged("serve", "--port", 0, "--data-dir", read_only)
    assert (ran.code, ran.out) == (1, "")
    assert ran.err.splitlines()[-1] == f"deepsimbad: unavailable: {read_only.name}: it may not be written"


def test_a_data_directory_that_cannot_be_made_is_named(read_only: Path) -> None:
    ran = unprivileged("serve", "--create", "--port", 0, "--data-dir", read_only / "new")
    assert ran.code == 1
    assert ran.err.splitlines()[-1] == "deepsimbad: unavailable: new: it may not be written"


@pytest.mark.parametrize("arguments", [("delete-domain", "loop", "--yes"), ("keys", "create", "--scope", "admin")])
def test_who_would_write_is_told_in_one_line(read_only: Path, arguments: tuple[str, ...]) -> None:
    ran = unprivileged(*arguments, "--data-dir", read_only)
    assert "may not be written" in ran.line or "cannot be opened" in ran.line


def test_who_asks_is_answered(read_only: Path) -> None:
    assert unprivileged("info", "loop", "--data-dir", read_only).code == 0


def test_it_can_be_checked_and_backed_up(read_only: Path, tmp_path: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in read_only.rglob("*")}
    ran = unprivileged("check", "--data-dir", read_only)
    assert (ran.code, ran.out) == (0, ""), ran
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    ran = unprivileged("backup", elsewhere / "b.tar", "--data-dir", read_only)
    assert (ran.code, ran.out) == (0, ""), ran
    assert {path: path.stat().st_mtime_ns for path in read_only.rglob("*")} == before
    assert command("restore", elsewhere / "b.tar", "--data-dir", elsewhere / "there").code == 0
    assert command("check", "--data-dir", elsewhere / "there").code == 0


def test_a_backup_to_where_nothing_may_be_written_is_one_line(read_only: Path) -> None:
    for arguments in (("backup", read_only / "b.tar"), ("export", "loop", read_only / "m.map")):
        ran = unprivileged(*arguments, "--data-dir", read_only)
        assert "may not be written" in ran.line or "cannot be opened" in ran.line
    assert not list(read_only.glob("*b.tar*"))
    assert not list(read_only.glob("*m.map*"))
