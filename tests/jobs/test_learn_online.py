"""Live sessions fed back: the next map version knows more, the one that served stays as it was."""

import numpy as np
import pytest

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.experience.nnql import KnownWalk
from deepsimbad.core.relevance import Query
from deepsimbad.errors import CancelledError
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap import RemapConfig, remap
from deepsimbad.jobs.versions import LEARN_STAGES, learn_online
from deepsimbad.store.map_file import read_map, verify
from deepsimbad.store.records import MapState

DOMAIN = "route"


@pytest.fixture
def walk(catalog, drive, evaluator, quiet):
    """A session along a mapped route that saw just what the map saw."""
    drive("other", 30, seed=1)
    encodings = drive("drive", 40)
    config = RemapConfig("drive", "other", n_landmarks=8, training_episodes=0)
    remap(catalog, DOMAIN, config, evaluator, quiet)
    model = read_map(catalog.map_path(DOMAIN, 1)).landmark_model
    frames = np.arange(3, 33, 2)
    ranks = rank_landmarks(evaluator.dissimilarities(encodings[frames], model))
    return KnownWalk([Query(each) for each in ranks], np.full(frames.size, 2.0), frames.astype(float))


def test_the_next_version_knows_more(catalog, walk):
    before = catalog.map_path(DOMAIN, 1).read_bytes()
    stages = []
    progress = Progress(LEARN_STAGES, lambda state: stages.append(state.stage))
    result = learn_online(catalog, DOMAIN, [walk], progress)
    assert result["map_version"] == 2
    assert result["metrics"]["experience"] == {"from_version": 1, "n_walks": 1, "n_moves": 14}
    assert list(dict.fromkeys(stages)) == list(LEARN_STAGES)
    assert catalog.domain(DOMAIN).active_version == 2
    assert catalog.map_path(DOMAIN, 1).read_bytes() == before
    record = catalog.map(DOMAIN, 2)
    assert record.state is MapState.ACTIVE
    verify(catalog.map_path(DOMAIN, 2), record.sha256)
    first, second = (read_map(catalog.map_path(DOMAIN, version)) for version in (1, 2))
    assert first.q_values is None
    assert second.version == 2
    assert np.array_equal(second.lists, first.lists)
    assert second.q_values.max() > 9  # a tenth of the reward, at least once
    assert (second.q_values[:, 0] == second.q_values.min()).all(), "nobody moved one metre"
    third = learn_online(catalog, DOMAIN, [walk], Progress(LEARN_STAGES))["map_version"]
    assert read_map(catalog.map_path(DOMAIN, third)).q_values.sum() > second.q_values.sum()


def test_a_cancel_leaves_nothing(catalog, walk):
    with pytest.raises(CancelledError):
        learn_online(catalog, DOMAIN, [walk], Progress(LEARN_STAGES, is_cancelled=lambda: True))
    asked = iter([False, False, False, True])
    with pytest.raises(CancelledError):
        learn_online(catalog, DOMAIN, [walk], Progress(LEARN_STAGES, is_cancelled=lambda: next(asked)))
    assert [each.version for each in catalog.maps(DOMAIN)] == [1]
    assert catalog.domain(DOMAIN).active_version == 1
