"""Views in batches say what the served code says of each."""

from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.live_views import LiveViews, of_episodes
from deepsimbad.core.relevance import Query, Relevance, relevances
from deepsimbad.core.retrieval import SecondSeason, build_retrieval_map, shortlist
from deepsimbad.core.update_rules import UpdateRule, evidence

N, R, D = 40, 12, 5


def views(relevance: Relevance, rule: UpdateRule) -> LiveViews:
    rng = np.random.default_rng(1)
    place = rng.normal(size=(N, R))
    mapped = (place + 0.3 * rng.normal(size=(N, R))).astype(np.float32)
    live = (place + 0.3 * rng.normal(size=(N, R))).astype(np.float32)
    encodings = rng.normal(size=(2, N, D)).astype(np.float32)
    second = SecondSeason(live, np.repeat(np.arange(N)[:, np.newaxis], 2, axis=1))
    built = build_retrieval_map(relevance, mapped, 4, encodings[0], second)
    return LiveViews(built, rule, 3, rank_landmarks(live), live, encodings[1])


@pytest.mark.parametrize("rule", list(UpdateRule))
@pytest.mark.parametrize("relevance", list(Relevance))
def test_every_relevance_and_rule(relevance, rule):
    live_views = views(relevance, rule)
    frames = np.array([3, 17, 17, 39])
    live = None
    each = [live_views.built.statistics] * frames.size
    for _ in range(3):
        live = live_views.observing(live, frames)
        seen, nearest = live_views.look(frames, live)
        for e, frame in enumerate(frames):
            ranks = live_views.ranks[frame]
            each[e] = None if each[e] is None else each[e].observing(ranks)
            query = Query(ranks, live_views.dissimilarities[frame], live_views.encodings[frame])
            expected = relevances(live_views.built, query, each[e])
            assert np.allclose(live_views.relevance(frames, live)[e], expected, atol=1e-5)
            assert nearest[e].tolist() == shortlist(expected, 3).tolist()
            assert np.allclose(seen[e], evidence(expected, rule), atol=1e-5)
        frames = (frames + 1) % N


def test_a_part_of_the_episodes_sees_the_same():
    live_views = views(Relevance.CALIBRATED, UpdateRule.LOG_LIKELIHOOD)
    frames = np.array([3, 17, 39])
    live = live_views.observing(None, frames)
    whole, _ = live_views.look(frames, live)
    part, _ = live_views.look(frames[1:], of_episodes(live, slice(1, 3)))
    assert np.array_equal(whole[1:], part)


def test_fewer_map_images_than_neighbours():
    live_views = replace(views(Relevance.RRF, UpdateRule.ADDITIVE_RELEVANCE), n_neighbours=100)
    _, nearest = live_views.look(np.array([0]), None)
    assert sorted(nearest[0]) == list(range(N))
