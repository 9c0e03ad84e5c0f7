"""The commands of docs/operations.md are run in their order, as they stand, against a live service with keys.

What differs from an operator's machine is replaced word by word: the address and the folders.
"""

import json
from contextlib import ExitStack

import pytest

from deepsimbad_campus.season import PAPER_DATES
from deepsimbad_client import Client, errors

from .conftest import PROJECT, Page, Workplace

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def workplace(nclt, tmp_path_factory):
    folder = tmp_path_factory.mktemp("operations")
    (folder / "backups").mkdir()
    folders = {
        "/var/lib/deepsimbad": folder / "deepsimbad",
        "/backups": folder / "backups",
        "/tmp/tried": folder / "tried",
    }
    place = Workplace(folder, **folders, **{"/data/nclt": nclt})
    with ExitStack() as stack:
        place.serve("deepsimbad", stack)
        for season in ("winter", "spring"):  # what an operator has when the page begins
            drive = f"nclt:/data/nclt/{PAPER_DATES[season]}"
            place.run(f"deepsimbad-client upload {drive} --domain campus --traverse {season}")
        place.run("deepsimbad-client remap --domain campus --landmarks winter --training spring")
        place.follow(Page(PROJECT / "docs" / "operations.md"), stack)
        assert len(place.output) > 15
        yield place


def test_keys_are_asked_from_the_first_on(workplace):
    with Client(workplace.url, api_key="") as nobody, pytest.raises(errors.UnauthorizedError):
        nobody.domains()
    keys = json.loads(workplace.run("deepsimbad keys list --json --data-dir /var/lib/deepsimbad"))
    assert [(key["name"], key["scope"]) for key in keys] == [("operator", "admin"), ("robot-1", "localize")]


def test_the_seasons_passed_as_the_page_says(workplace):
    """A map of another season, one with a stretch added, and back."""
    maps = json.loads(workplace.run("deepsimbad-client maps campus --json"))
    assert [(version["version"], version["state"] == "active") for version in maps] == [
        (3, False),
        (2, False),
        (1, True),
    ]
    check = maps[1]["metrics"]["check"]
    assert (check["traverse"], check["gate_margin"]) == ("autumn", 2)
    assert check["n_queries"] > 0


def test_what_was_restored_holds_what_was_backed_up_and_the_imported_map(workplace):
    restored = workplace.run("deepsimbad info elsewhere --json --data-dir /tmp/tried")
    assert json.loads(restored)["name"] == "elsewhere"
    for name in ("campus.map", "campus-over-http.map"):
        assert (workplace.folder / "backups" / name).stat().st_size > 10_000
