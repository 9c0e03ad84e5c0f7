"""Every command, curl example and Python example of the pages beside README is run against a live service.

The folder of NCLT is a rendered campus in its layout.
"""

import hashlib
import json
import shutil
import time
from contextlib import ExitStack

import numpy as np
import pytest

from deepsimbad_campus.season import PAPER_DATES
from deepsimbad_client import Client
from deepsimbad_client.recordings.sources import open_source

from .conftest import PROJECT, Page, Workplace

pytestmark = pytest.mark.slow
DRIVES = {"winter": "elsewhere", "spring": "summer", "summer": "winter"}


def furnished(folder, nclt):
    """What a person has: pictures of three drives, and encodings of their own."""
    for season, name in DRIVES.items():
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
    return folder


@pytest.fixture(scope="module")
def workplace(nclt, tmp_path_factory):
    """All of them, from top to bottom."""
    place = Workplace(furnished(tmp_path_factory.mktemp("workplace"), nclt), **{"/data/nclt": nclt})
    with ExitStack() as stack:
        place.serve("data", stack)
        for name in ("recordings", "methods", "http"):
            place.follow(Page(PROJECT / "docs" / f"{name}.md"), stack)
        yield place


def test_a_posted_image_is_answered_with_a_belief(workplace):
    assert len(workplace.output) > 20
    answer = json.loads(workplace.answer_of("localizations?shortlist=3"))
    assert len(answer["retrieval"]) == len(answer["belief"]["top"]) == 3
    assert {"mean_m", "mode_m", "credible_95_m", "entropy_bits", "histogram"} <= set(answer["belief"])
    assert answer["next_best_view"]["planner"] == "informed"
    assert json.loads(workplace.answer_of("ranked_landmarks"))["map_version"] == 1
    domain = json.loads(workplace.answer_of("curl http://127.0.0.1:8000/v1/domains/nclt"))
    assert np.load(workplace.folder / "relevances.npy").shape == (domain["n_map_images"],)
    problem = json.loads((workplace.folder / "problem.json").read_text())
    assert (problem["status"], problem["code"]) == (404, "unknown_domain")


def test_the_session_is_begun_moved_on_and_ended(workplace):
    session = (workplace.folder / "session").read_text().split()
    assert [len(word) for word in session] == [32]
    first = json.loads(workplace.answer_of('/observations"'))
    second = json.loads(workplace.answer_of("observations?action_m=0"))
    assert (first["n_observations"], second["n_observations"]) == (1, 2)
    first_bits = pytest.approx(first["belief"]["entropy_bits"], abs=0.3)
    assert second["belief"]["entropy_bits"] == first_bits, "the same view again, standing still, tells nothing new"
    assert 0 < second["belief"]["off_route"] < 0.5
    assert second["next_best_view"]["stop"] == second["belief"]["confident"]
    assert json.loads(workplace.answer_of("/next-best-view")) == second["next_best_view"]
    mass = np.load(workplace.folder / "belief.npy")
    assert mass.sum() == pytest.approx(1, abs=1e-3)
    carried = json.loads(workplace.answer_of("/prior"))
    assert carried["belief"]["mean_m"] == pytest.approx(10, abs=1)
    assert workplace.answer_of("-X DELETE") == ""


def test_replays_and_experiments_leave_their_files(workplace):
    for replay in ("summer", "active"):
        left = {path.name for path in (workplace.folder / "replays" / replay).iterdir()}
        assert left >= {"steps.jsonl", "summary.json"}
        assert any(name.endswith(".png") for name in left)
    assert json.loads((workplace.folder / "vpr.json").read_text())["n_queries"] == 50
    assert "informed" in json.loads((workplace.folder / "nbv.json").read_text())["anr"]
    assert "standardised" in workplace.answer_of("experiment vpr --landmarks nclt:/data")


def test_the_map_of_another_season_is_made_rolled_back_and_fetched(workplace):
    assert "active then" in workplace.answer_of("deepsimbad-client maps")
    assert workplace.answer_of("deepsimbad-client activate") == "nclt serves map 2\n"
    assert workplace.answer_of("deepsimbad-client rollback") == "nclt serves map 1\n"
    with Client(workplace.url) as client:
        second, first = client.admin.maps("nclt")
    assert (first.state, second.state) == ("active", "retired")
    assert (second.check["traverse"], second.check["warnings"]) == ("autumn", [])
    assert hashlib.sha256((workplace.folder / "spring.sqlite").read_bytes()).hexdigest() == first.sha256


def test_the_map_asked_for_by_curl_is_made(workplace):
    with Client(workplace.url) as client:
        give_up = time.monotonic() + 300
        while not all(job.ended for job in client.admin.jobs("garden")):
            assert time.monotonic() < give_up
            time.sleep(0.05)
        assert [job.state for job in client.admin.jobs("garden")] == ["succeeded"]
        assert client.domain("garden").n_map_images == 1
        assert client.domain("nclt").map_version == 1


def test_every_python_example_says_where(workplace):
    printed = workplace.printed_by_python()
    assert len(printed) > 1
    assert all("95 % within" in text for text in printed)
