"""The commands of docs/operations.md are run in their order, as they stand, against a live service with keys.

What differs from an operator's machine is replaced word by word: the address and the folders.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from deepsimbad_campus.season import PAPER_DATES
from deepsimbad_campus.writer import write_campus
from deepsimbad_client import Client
from deepsimbad_client.http.local_server import LocalServer

from .conftest import Page

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

PROJECT = Path(__file__).resolve().parents[2]
N_FRAMES = 36
NOT_RUN = ("pip install ",)


class Workplace:
    """A folder in which the page was followed.

    Attributes:
        folder: The folder.
        url: Of the service in it.
        said: What every command said, by the command.
    """

    def __init__(self, folder: Path, url: str) -> None:
        self.folder = folder
        self.url = url
        self.said: dict[str, str] = {}

    def run(self, command: str) -> str:
        done = subprocess.run(
            ["bash", "-c", self._here(command)],
            cwd=self.folder,
            env={
                **os.environ,
                "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
                "DEEPSIMBAD_URL": self.url,
                **self._key(),
            },
            capture_output=True,
            text=True,
            errors="replace",
            timeout=240,
            check=False,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        self.said[command] = done.stdout
        return done.stdout

    def _here(self, text: str) -> str:
        for there in ("/var/lib/deepsimbad", "/backups", "/tmp/tried", "/data/nclt"):
            text = text.replace(there, str(self.folder / there.rsplit("/", 1)[1]))
        return text

    def _key(self) -> dict[str, str]:
        key = self.folder / "operator.key"
        return {"DEEPSIMBAD_API_KEY": key.read_text().strip()} if key.is_file() else {}


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workplace]:
    if shutil.which("bash") is None:
        pytest.skip("the commands need bash")
    folder = tmp_path_factory.mktemp("operations")
    write_campus(folder / "nclt", ("winter", "spring", "summer", "autumn"), N_FRAMES, 4)
    (folder / "backups").mkdir()
    commands = [
        line
        for block in Page(PROJECT / "docs" / "operations.md").blocks("bash")
        for line in block.splitlines()
        if not line.startswith(NOT_RUN)
    ]
    assert len(commands) > 15
    with LocalServer(folder / "deepsimbad") as server:
        place = Workplace(folder, server.url)
        for season in ("winter", "spring"):  # what an operator has when the page begins
            drive = f"nclt:/data/nclt/{PAPER_DATES[season]}"
            place.run(f"deepsimbad-client upload {drive} --domain campus --traverse {season}")
        place.run("deepsimbad-client remap --domain campus --landmarks winter --training spring --n-landmarks 20")
        for command in commands:
            place.run(command)
        yield place


def test_keys_are_asked_from_the_first_on(workplace: Workplace) -> None:
    with Client(workplace.url, api_key="") as nobody, pytest.raises(Exception, match="key"):
        nobody.domains()
    keys = json.loads(workplace.run("deepsimbad keys list --json --data-dir /var/lib/deepsimbad"))
    assert [(key["name"], key["scope"]) for key in keys] == [("operator", "admin"), ("robot-1", "localize")]


def test_the_seasons_passed_as_the_page_says(workplace: Workplace) -> None:
    """A map of another season, one with a stretch added, and back."""
    maps = json.loads(workplace.run("deepsimbad-client maps campus --json"))
    versions = maps["maps"] if isinstance(maps, dict) else maps
    assert [one["version"] for one in versions] == [3, 2, 1]
    assert [one["version"] for one in versions if one["state"] == "active"] == [1]
    checked = versions[1]["metrics"]["check"]
    assert (checked["traverse"], checked["gate_margin"]) == ("autumn", 2)
    assert checked["n_queries"] > 0


def test_what_was_restored_holds_what_was_backed_up_and_the_imported_map(workplace: Workplace) -> None:
    restored = workplace.run("deepsimbad info elsewhere --json --data-dir /tmp/tried")
    assert json.loads(restored)["name"] == "elsewhere"
    assert (workplace.folder / "backups" / "campus.map").stat().st_size > 10_000
    assert (workplace.folder / "backups" / "campus-over-http.map").stat().st_size > 10_000
