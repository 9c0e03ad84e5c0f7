"""Every command, curl example and Python example of README and the pages beside it is run against a live service.

README's are run as printed, one after the other in a folder that holds a person's own images; only the server's address
is another. In the pages the folder of NCLT is a rendered campus in its layout, and fewer landmarks are asked for.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from deepsimbad_campus.season import PAPER_DATES
from deepsimbad_campus.writer import write_campus
from deepsimbad_client import Client
from deepsimbad_client.http.local_server import LocalServer
from deepsimbad_client.recordings.sources import open_source

from .conftest import PROJECT, Page

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
SEASONS = ("winter", "spring", "summer")
N_FRAMES = 36
NOT_RUN = ("make ", "pip install ")  # compared in test_references instead
EXPECTED_TO_FAIL = "problem.json"


@dataclass(frozen=True)
class Ran:
    command: str
    code: int
    out: str
    err: str


@dataclass
class Workplace:
    """A folder, a service of its own, and what was run there.

    Attributes:
        folder: Where a person works.
        words: What stands in the pages, and what it is here.
    """

    folder: Path
    words: dict[str, str] = field(default_factory=dict)
    ran: list[Ran] = field(default_factory=list)

    def serve(self, data_dir: str, stack: ExitStack) -> None:
        self.url = stack.enter_context(LocalServer(self.folder / data_dir)).url

    def run(self, page: Page, stack: ExitStack) -> None:
        """Do all that the page shows."""
        for language, text in page.steps():
            if text.startswith("deepsimbad serve"):
                self.serve(text.split()[-1], stack)
            elif language == "python":
                self._keep(text, self._process(sys.executable, "-W", "error", "-c", text))
            elif not text.startswith(NOT_RUN):
                failing = "" if EXPECTED_TO_FAIL in text else 'curl() { command curl -sS --fail-with-body "$@"; }\n'
                self._keep(text, self._process("bash", "-c", failing + text))

    def _keep(self, command: str, done: subprocess.CompletedProcess[str]) -> None:
        self.ran.append(Ran(command, done.returncode, done.stdout, done.stderr))

    def answer_of(self, part: str) -> Ran:
        """The one command that holds these words."""
        (ran,) = [ran for ran in self.ran if part in ran.command]
        return ran

    def _process(self, *command: str) -> subprocess.CompletedProcess[str]:
        url = getattr(self, "url", "http://127.0.0.1:1")
        words = [*command[:-1], command[-1].replace("http://127.0.0.1:8000", url)]
        for there, here in self.words.items():
            words[-1] = words[-1].replace(there, here)
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        environment = {**os.environ, "PATH": path, "DEEPSIMBAD_URL": url}
        return subprocess.run(
            words,
            cwd=self.folder,
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=400,
            check=False,
        )


@pytest.fixture(scope="module")
def nclt(tmp_path_factory) -> Path:
    if shutil.which("curl") is None or shutil.which("bash") is None:
        pytest.skip("the examples need curl and bash")
    folder = tmp_path_factory.mktemp("nclt")
    write_campus(folder, SEASONS, N_FRAMES, 3)
    return folder


def furnish(folder: Path, nclt: Path) -> None:
    """What a person has: pictures of three drives, and encodings of their own."""
    for season, name in zip(SEASONS, ("elsewhere", "summer", "winter"), strict=True):
        drive = open_source(f"nclt:{nclt / PAPER_DATES[season]}")
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


@pytest.fixture(scope="module")
def first_hour(readme, nclt, tmp_path_factory):
    """README, from top to bottom."""
    place = Workplace(tmp_path_factory.mktemp("first_hour"))
    furnish(place.folder, nclt)
    with ExitStack() as stack:
        place.run(readme, stack)
        yield place


@pytest.fixture(scope="module")
def workplace(nclt, tmp_path_factory):
    """The pages behind it."""
    words = {"/data/nclt": str(nclt), "--n-landmarks 500": "--n-landmarks 20", "--n-landmarks 300": "--n-landmarks 10"}
    place = Workplace(tmp_path_factory.mktemp("workplace"), words)
    furnish(place.folder, nclt)
    with ExitStack() as stack:
        place.serve("data", stack)
        for name in ("recordings", "methods", "http"):
            place.run(Page(PROJECT / "docs" / f"{name}.md"), stack)
        yield place


def all_succeeded(ran: list[Ran]) -> None:
    failed = [command for command in ran if command.code != 0]
    assert not failed, "\n".join(f"{command.command}\n{command.out}{command.err}" for command in failed)


def test_the_readme_runs_as_printed(first_hour):
    assert len(first_hour.ran) > 15
    all_succeeded(first_hour.ran)
    answer = json.loads(first_hour.answer_of("localizations?shortlist=3").out)
    assert len(answer["retrieval"]) == len(answer["belief"]["top"]) == 3
    left = {path.name for path in (first_hour.folder / "replays" / "summer").iterdir()}
    assert left >= {"steps.jsonl", "summary.json"}
    assert "standardised" in first_hour.answer_of("experiment vpr").out


def test_every_command_of_the_pages_succeeds(workplace):
    assert len(workplace.ran) > 20
    all_succeeded(workplace.ran)


def test_a_posted_image_is_answered_with_a_belief(workplace):
    answer = json.loads(workplace.answer_of("localizations?shortlist=3").out)
    assert len(answer["retrieval"]) == len(answer["belief"]["top"]) == 3
    assert {"mean_m", "mode_m", "credible_95_m", "entropy_bits", "histogram"} <= set(answer["belief"])
    assert answer["next_best_view"]["planner"] == "telling"
    assert json.loads(workplace.answer_of("ranked_landmarks").out)["map_version"] == 1
    domain = json.loads(workplace.answer_of("curl http://127.0.0.1:8000/v1/domains/nclt").out)
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
    assert workplace.answer_of("deepsimbad-client activate").out == "nclt serves map 2\n"
    assert workplace.answer_of("deepsimbad-client rollback").out == "nclt serves map 1\n"
    with Client(workplace.url) as client:
        second, first = client.admin.maps("nclt")
    assert (first.state, second.state) == ("active", "retired")
    assert second.check["traverse"] == "winter"
    assert hashlib.sha256((workplace.folder / "spring.sqlite").read_bytes()).hexdigest() == first.sha256


def test_the_experiments_leave_their_figures(workplace):
    assert json.loads((workplace.folder / "vpr.json").read_text())["n_queries"] == 50
    assert "telling" in json.loads((workplace.folder / "nbv.json").read_text())["anr"]
    assert "standardised" in workplace.answer_of("experiment vpr --landmarks nclt:/data").out


def test_the_map_asked_for_by_curl_is_made(workplace):
    with Client(workplace.url) as client:
        give_up = time.monotonic() + 30
        while not all(job.ended for job in client.admin.jobs("garden")):
            assert time.monotonic() < give_up
            time.sleep(0.05)
        assert [job.state for job in client.admin.jobs("garden")] == ["succeeded"]
        assert client.domain("garden").n_map_images == 1
        assert client.domain("nclt").map_version == 1


def test_every_python_example_says_where(first_hour, workplace):
    said = [ran.out for ran in (*first_hour.ran, *workplace.ran) if "import Client" in ran.command]
    assert len(said) > 2
    assert all("95 % within" in text for text in said)
