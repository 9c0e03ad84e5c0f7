"""Sessions fed back teach what training on the same moves would have."""

import numpy as np
import pytest

from deepsimbad.core.grid_filter import GridFilter
from deepsimbad.core.known_walk import KnownWalk, transitions_of
from deepsimbad.core.live_views import LiveViews
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.nnql import NnqlConfig, initial_q_values, learn
from deepsimbad.core.relevance import Query, Relevance, relevances
from deepsimbad.core.retrieval import build_retrieval_map
from deepsimbad.core.route import Route
from deepsimbad.core.training_world import TrainingWorld, Walk
from deepsimbad.core.update_rules import UpdateRule
from deepsimbad.errors import InvalidInputError

N, R = 60, 15
ACTIONS_M = (1.0, 2.0, 5.0)


@pytest.fixture
def world():
    rng = np.random.default_rng(2)
    places = rng.normal(size=(N, R))
    mapped, live = (places + 1.5 * rng.normal(size=(2, N, R))).astype(np.float32)
    built = build_retrieval_map(Relevance.STANDARDISED, mapped, 4)
    ranks = live.argsort(axis=1).argsort(axis=1).astype(np.float32) + 1
    return built, Route(np.arange(N, dtype=float)), ranks


def walk_of(ranks, frames, **changes):
    moved = np.r_[0.0, np.diff(frames)]
    parts = {
        "queries": [Query(ranks[frame]) for frame in frames],
        "action_m": moved,
        "true_position_m": np.array(frames, float),
    }
    return KnownWalk(**(parts | changes))


def test_rewards_and_neighbours_are_those_of_training_on_the_same_moves(world):
    built, route, ranks = world
    config = NnqlConfig(top_share=0.03, motion_std_m=0.33, n_neighbours=3)
    frames = [4, 9, 10, 12, 17, 22, 27, 28, 33]
    moves = transitions_of(built, route, ACTIONS_M, walk_of(ranks, frames), config)
    views = LiveViews(built, UpdateRule.LOG_LIKELIHOOD, 3, ranks)
    training = Walk(TrainingWorld.on(route, views, route, np.arange(N), ACTIONS_M, config), np.array([4]))
    for t, action in enumerate([2, 0, 1, 2, 2, 2, 0, 2]):
        assert moves.action[t] == action
        assert moves.nearest[t].tolist() == training.nearest[0].tolist()
        training.step(np.array([action]))
        assert moves.next_nearest[t].tolist() == training.nearest[0].tolist()
        assert moves.reward[t] == (100.0 if training.ranks[0] < 0.03 * N else 0.0)
        assert moves.next_allowed[t].tolist() == training.allowed[0].tolist()
    assert 0 < np.count_nonzero(moves.reward) < len(moves.reward)


def test_moves_that_are_no_action_or_lead_nobody_knows_where_teach_nothing(world):
    built, route, ranks = world
    frames = [4, 9, 12, 13, 23, 24, 24, 25]  # 5, 3 (nearer to 2 than half a step: no), 1, 10, 1, 0, 1
    known = np.array(frames, float)
    known[5] = np.nan
    moves = transitions_of(built, route, ACTIONS_M, walk_of(ranks, frames, true_position_m=known), NnqlConfig())
    assert moves.action.tolist() == [2, 0, 0]
    nothing = transitions_of(built, route, ACTIONS_M, walk_of(ranks, [7]), NnqlConfig())
    assert nothing.action.size == 0
    empty = KnownWalk([], np.empty(0), np.empty(0))
    assert transitions_of(built, route, ACTIONS_M, empty, NnqlConfig()).nearest.shape == (0, 4)
    q_values = initial_q_values(N, 3, NnqlConfig())
    learn(q_values, nothing, NnqlConfig())
    assert (q_values == np.float32(1e-4)).all()


def test_the_end_of_the_route(world):
    built, route, ranks = world
    moves = transitions_of(built, route, ACTIONS_M, walk_of(ranks, [55, 57, 58, 59]), NnqlConfig())
    assert moves.next_allowed.tolist() == [[True, True, False], [True, False, False], [False, False, False]]


def test_a_belief_wholly_past_the_end_begins_anew(world):
    built, route, ranks = world
    frames = [10, 15, 20]
    odd = walk_of(ranks, frames, action_m=np.array([0.0, 300.0, 5.0]))
    moves = transitions_of(built, route, ACTIONS_M, odd, NnqlConfig(top_share=0.05))
    assert moves.action.tolist() == [2]
    live = built.statistics.observing(ranks[10]).observing(ranks[15])
    belief = GridFilter.uniform(route).updated(relevances(built, Query(ranks[15]), live), UpdateRule.LOG_LIKELIHOOD, 0)
    belief = belief.predicted(5.0, np.sqrt(0.05**2 + 0.01 * 5), 0)
    live = live.observing(ranks[20])
    belief = belief.updated(relevances(built, Query(ranks[20]), live), UpdateRule.LOG_LIKELIHOOD, 0)
    earned = rank_of_truth(belief.mass, np.array([20])) < 0.05 * N
    assert moves.reward.tolist() == [100.0 * earned]


def test_one_position_a_view(world):
    _, _, ranks = world
    with pytest.raises(InvalidInputError, match="2 true positions for 3 views"):
        walk_of(ranks, [1, 2, 3], true_position_m=np.zeros(2))
