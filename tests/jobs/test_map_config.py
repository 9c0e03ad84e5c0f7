"""Parameters of a remap that contradict each other are refused before anything is read."""

import json

import pytest

from deepsimbad.core.relevance import Relevance
from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.jobs.map_config import RemapConfig


@pytest.mark.parametrize(
    "wrong",
    [
        {"list_length": 0},
        {"list_length": 5, "n_landmarks": 4},
        {"n_landmarks": 0},
        {"n_landmarks": 65_536},
        {"training_episodes": -1},
        {"seed": -1},
    ],
)
def test_contradictions_are_named(wrong):
    with pytest.raises(InvalidMapConfigError):
        RemapConfig("drive", **wrong)


def test_the_greatest_numbers_that_fit_are_taken():
    RemapConfig("drive", n_landmarks=65_535)
    RemapConfig("drive", n_landmarks=4, list_length=4)


def test_it_survives_its_json_form():
    config = RemapConfig("drive", "other", 40, 3, Relevance.RRF, 5, 6, activate=False, same_route=True)
    assert RemapConfig.from_dict(json.loads(json.dumps(config.as_dict()))) == config
