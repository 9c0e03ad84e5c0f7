"""README is run as printed, in a folder that is empty but for a part of the campus that it renders.

Its commands and examples follow one another; only the server's address is another.
"""

import json
import os
import shutil
from contextlib import ExitStack

import pytest

from .conftest import Workplace

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def first_hour(readme, nclt, tmp_path_factory):
    """README, from top to bottom."""
    place = Workplace(tmp_path_factory.mktemp("first_hour"))
    shutil.copytree(nclt, place.folder / "nclt", copy_function=os.link)  # `campus` adds the frames that are missing
    with ExitStack() as stack:
        place.follow(readme, stack)
        yield place


def test_the_readme_runs_as_printed(first_hour):
    assert len(first_hour.output) > 15
    answer = json.loads(first_hour.answer_of("localizations?shortlist=3"))
    assert len(answer["retrieval"]) == len(answer["belief"]["top"]) == 3
    left = {path.name for path in (first_hour.folder / "replays" / "summer").iterdir()}
    assert left >= {"steps.jsonl", "summary.json"}
    assert "standardised" in first_hour.answer_of("experiment vpr")


def test_the_python_example_says_where(first_hour):
    (printed,) = first_hour.printed_by_python()
    assert "95 % within" in printed
