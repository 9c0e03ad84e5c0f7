"""Live sessions fed back: the next map version knows more, the one that served stays as it was."""

import numpy as np
import pytest

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.experience.nnql import KnownWalk
from deepsimbad.core.relevance import Query
from deepsimbad.errors import CancelledError
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap import remap
from deepsimbad.jobs.remap_config import RemapConfig
from deepsimbad.jobs.versions import LEARN_STAGES, learn_online
from deepsimbad.store.map_file import read_map

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
    return KnownWalk([Query(row) for row in ranks], np.full(frames.size, 2.0), frames.astype(float))


def test_a_cancel_leaves_nothing(catalog, walk):
    with pytest.raises(CancelledError):
        learn_online(catalog, DOMAIN, [walk], Progress(LEARN_STAGES, is_cancelled=lambda: True))
    answers = iter([False, False, False, True])
    with pytest.raises(CancelledError):
        learn_online(catalog, DOMAIN, [walk], Progress(LEARN_STAGES, is_cancelled=lambda: next(answers)))
    assert [record.version for record in catalog.maps(DOMAIN)] == [1]
    assert catalog.domain(DOMAIN).active_version == 1
