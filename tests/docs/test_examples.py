"""Every command, curl example and Python example of the README is run, as it stands, against a live service.

What differs from a person's machine is replaced word by word: the address, the folder of NCLT (here a rendered campus
in its layout) and the number of landmarks, which a small campus cannot give.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from deepsimbad_client import Client
from deepsimbad_client.campus import PAPER_DATES, write_campus
from deepsimbad_client.local_server import LocalServer
from deepsimbad_client.sources import open_source

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
SEASONS = ("winter", "spring", "summer")
N_FRAMES = 36
NOT_RUN = ("make ", "pip install ", "deepsimbad serve ")  # compared in test_references instead
EXPECTED_TO_FAIL = "problem.json"


@dataclass(frozen=True)
class Ran:
    command: str
    code: int
    out: str
    err: str


@dataclass(frozen=True)
class Workplace:
    folder: Path
    url: str
    ran: list[Ran]

    def answer_of(self, part: str) -> Ran:
        """The one command that holds these words."""
        (found,) = [each for each in self.ran if part in each.command]
        return found


@pytest.fixture(scope="module")
def workplace(readme, tmp_path_factory):
    """A folder with what the examples name, in which all of them were run in their order."""
    if shutil.which("curl") is None or shutil.which("bash") is None:
        pytest.skip("the examples need curl and bash")
    folder = tmp_path_factory.mktemp("workplace")
    _furnish(folder)
    with LocalServer(folder / "data") as server:
        ran = [
            _run(line, folder, server.url)
            for block in readme.blocks("bash")
            for line in block.splitlines()
            if not line.startswith(NOT_RUN)
        ]
        yield Workplace(folder, server.url, ran)


def _furnish(folder):
    write_campus(folder / "nclt", SEASONS, N_FRAMES, 3)
    for season, name in zip(SEASONS, ("elsewhere", "summer", "winter"), strict=True):
        drive = open_source(f"nclt:{folder / 'nclt' / PAPER_DATES[season]}")
        (folder / "drives" / name).mkdir(parents=True)
        for place, frame in enumerate(drive.frames):
            (folder / "drives" / name / f"{place:03}.jpg").write_bytes(drive.image(frame, (320, 320)).body)
    shutil.copy(folder / "drives" / "winter" / "010.jpg", folder / "view.jpg")
    (folder / "encodings").mkdir()
    rng = np.random.default_rng(0)
    places = rng.normal(size=(50, 16))
    np.save(folder / "encodings" / "elsewhere.npy", rng.normal(size=(40, 16)))
    for season in ("summer", "winter"):
        np.save(folder / "encodings" / f"{season}.npy", places + 0.3 * rng.normal(size=places.shape))


def _here(text, folder, url):
    for there, here in {
        "http://127.0.0.1:8000": url,
        "/data/nclt": str(folder / "nclt"),
        "--n-landmarks 500": "--n-landmarks 20",
        "--n-landmarks 300": "--n-landmarks 10",
    }.items():
        text = text.replace(there, here)
    return text


def _run(command, folder, url):
    failing = "" if EXPECTED_TO_FAIL in command else 'curl() { command curl -sS --fail-with-body "$@"; }\n'
    done = subprocess.run(
        ["bash", "-c", failing + _here(command, folder, url)],
        cwd=folder,
        env={
            **os.environ,
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "DEEPSIMBAD_URL": url,
        },
        capture_output=True,
        text=True,
        errors="replace",
        timeout=240,
        check=False,
    )
    return Ran(command, done.returncode, done.stdout, done.stderr)


def test_every_command_of_the_readme_succeeds(workplace):
    assert len(workplace.ran) > 20
    failed = [each for each in workplace.ran if each.code != 0]
    assert not failed, "\n".join(f"{each.command}\n{each.out}{each.err}" for each in failed)


def test_a_posted_image_is_answered_with_a_belief(workplace):
    answer = json.loads(workplace.answer_of("localizations?shortlist=3").out)
    assert len(answer["retrieval"]) == len(answer["belief"]["top"]) == 3
    assert {"mean_m", "mode_m", "credible_95_m", "entropy_bits", "histogram"} <= set(answer["belief"])
    assert answer["next_best_view"]["planner"] == "telling"
    assert json.loads(workplace.answer_of("ranked_landmarks").out)["map_version"] == 1
    domain = json.loads(workplace.answer_of("curl http://127.0.0.1:8000/v1/domains/campus").out)
    assert np.load(workplace.folder / "relevances.npy").shape == (domain["n_map_images"],)


def test_the_session_is_begun_moved_on_and_ended(workplace):
    session = (workplace.folder / "session").read_text().split()
    assert [len(word) for word in session] == [32]
    first = json.loads(workplace.answer_of('/observations"').out)
    second = json.loads(workplace.answer_of("observations?action_m=0").out)
    assert (first["n_observations"], second["n_observations"]) == (1, 2)
    assert second["belief"]["entropy_bits"] <= first["belief"]["entropy_bits"]
    assert second["belief"]["off_route"] is None, "36 frames are too short a route to learn from"
    assert json.loads(workplace.answer_of("/next-best-view").out) == second["next_best_view"]
    mass = np.load(workplace.folder / "belief.npy")
    assert mass.sum() == pytest.approx(1, abs=1e-3)
    carried = json.loads(workplace.answer_of("/prior").out)
    assert carried["belief"]["mean_m"] == pytest.approx(10, abs=1)
    assert workplace.answer_of("-X DELETE").code == 0


def test_an_error_is_a_problem_document(workplace):
    problem = json.loads((workplace.folder / "problem.json").read_text())
    assert problem["status"] == 404
    assert problem["code"] == "unknown_domain"


def test_the_replay_leaves_its_files(workplace):
    for replay in ("summer", "active"):
        left = {path.name for path in (workplace.folder / "replays" / replay).iterdir()}
        assert left >= {"steps.jsonl", "summary.json"}
        assert any(name.endswith(".png") for name in left)


def test_the_map_of_another_season_is_made_rolled_back_and_fetched(workplace):
    assert "active then" in workplace.answer_of("deepsimbad-client maps").out
    assert workplace.answer_of("deepsimbad-client activate").out == "campus serves map 2\n"
    assert workplace.answer_of("deepsimbad-client rollback").out == "campus serves map 1\n"
    with Client(workplace.url) as client:
        second, first = client.admin.maps("campus")
    assert (first.state, second.state) == ("active", "retired")
    assert second.check["traverse"] == "winter"
    assert hashlib.sha256((workplace.folder / "spring.sqlite").read_bytes()).hexdigest() == first.sha256


def test_the_experiments_leave_their_figures(workplace):
    assert json.loads((workplace.folder / "vpr.json").read_text())["n_queries"] == 50
    assert "telling" in json.loads((workplace.folder / "nbv.json").read_text())["anr"]
    assert "standardised" in workplace.answer_of("experiment vpr --landmarks nclt:").out


def test_the_map_asked_for_by_curl_is_made(workplace):
    with Client(workplace.url) as client:
        give_up = time.monotonic() + 30
        while not all(job.ended for job in client.admin.jobs("garden")):
            assert time.monotonic() < give_up
            time.sleep(0.05)
        assert [job.state for job in client.admin.jobs("garden")] == ["succeeded"]
        assert client.domain("garden").n_map_images == 1
        assert client.domain("campus").map_version == 1


def test_every_python_example_runs(readme, workplace):
    blocks = readme.blocks("python")
    assert blocks
    for block in blocks:
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", _here(block, workplace.folder, workplace.url)],
            cwd=workplace.folder,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert "95 % within" in done.stdout
