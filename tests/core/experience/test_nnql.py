"""NNQL against slow and obvious references; sessions fed back teach what training on the same moves would have."""

from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.belief.evidence import ViewEvidence
from deepsimbad.core.belief.grid import GridFilter
from deepsimbad.core.experience.nnql import KnownWalk, NnqlConfig, Transitions, initial_q_values, learn, transitions_of
from deepsimbad.core.experience.training import TrainingWorld, Walk
from deepsimbad.core.index.retrieval import relevances, shortlist
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.relevance import Query, Relevance, UpdateRule
from deepsimbad.errors import InvalidInputError, InvalidMapConfigError
from tests.core.conftest import a_map


def some_moves(rng, n, a, k, t):
    return Transitions(
        nearest=np.array([rng.choice(n, k, replace=False) for _ in range(t)]),
        action=rng.integers(0, a, t),
        reward=100.0 * rng.integers(0, 2, t),
        next_nearest=np.array([rng.choice(n, k, replace=False) for _ in range(t)]),
        next_allowed=rng.random((t, a)) < 0.7,
    )


def test_learning_is_the_textbook_update_on_each_of_the_k_entries():
    rng = np.random.default_rng(1)
    config = NnqlConfig(learning_rate=0.3, discount=0.8)
    q_values = (100 * rng.random((20, 6))).astype(np.float32)
    moves = some_moves(rng, 20, 6, 4, 200)
    slow = q_values.astype(np.float64)
    for t in range(200):
        values = [slow[moves.next_nearest[t], a].mean() for a in range(6) if moves.next_allowed[t, a]]
        target = moves.reward[t] + 0.8 * max(values, default=0.0)
        for image in moves.nearest[t]:
            slow[image, moves.action[t]] += 0.3 * (target - slow[image, moves.action[t]])
    learn(q_values, moves, config)
    assert np.allclose(q_values, slow, rtol=1e-4)


def test_exploration_falls_in_a_straight_line():
    config = NnqlConfig(n_episodes=11, exploration=1.0, final_exploration=0.5)
    assert np.allclose(config.exploration_at(np.arange(11)), 1.0 - 0.05 * np.arange(11))
    assert NnqlConfig(n_episodes=1, exploration=0.4).exploration_at(np.array([0])).tolist() == [0.4]


def test_the_defaults_are_the_papers():
    config = NnqlConfig()
    assert (config.n_episodes, config.n_actions_per_episode, config.n_neighbours) == (10_000, 10, 4)
    assert (config.learning_rate, config.discount, config.initial_q) == (0.1, 0.9, 1e-4)
    assert (config.reward, config.top_share) == (100.0, 0.10)


@pytest.mark.parametrize(
    "bad",
    [
        *({"n_episodes": -1}, {"n_neighbours": 0}, {"batch_episodes": 0}, {"exploration": 1.5}),
        *({"learning_rate": float("nan")}, {"reward": float("inf")}, {"motion_std_m": -1.0}, {"seed": -1}),
    ],
)
def test_impossible_hyperparameters(bad):
    with pytest.raises(InvalidMapConfigError):
        NnqlConfig(**bad)


# --- live sessions -------------------------------------------------------------------------------------------------

N, R = 60, 15
ACTIONS_M = (1.0, 2.0, 5.0)


@pytest.fixture
def world():
    rng = np.random.default_rng(2)
    places = rng.normal(size=(N, R))
    map_dissimilarities, live_dissimilarities = (places + 1.5 * rng.normal(size=(2, N, R))).astype(np.float32)
    map_ = a_map(Relevance.STANDARDISED, map_dissimilarities, 4, actions_m=ACTIONS_M)
    ranks = live_dissimilarities.argsort(axis=1).argsort(axis=1).astype(np.float32) + 1
    return map_, ranks


def walk_of(ranks, frames, **changes):
    action_m = np.r_[0.0, np.diff(frames)]
    parts = {
        "queries": [Query(ranks[frame]) for frame in frames],
        "action_m": action_m,
        "true_position_m": np.array(frames, float),
    }
    return KnownWalk(**(parts | changes))


def test_rewards_and_neighbours_are_those_of_training_on_the_same_moves(world):
    map_, ranks = world
    config = NnqlConfig(top_share=0.03, motion_std_m=0.33, n_neighbours=3, update=UpdateRule.LOG_LIKELIHOOD)
    frames = [4, 9, 10, 12, 17, 22, 27, 28, 33]
    moves = transitions_of(map_, walk_of(ranks, frames), config)
    training = Walk(TrainingWorld.on(map_, Query(ranks), map_.route, np.arange(N), config), np.array([4]))
    rewards = []
    for t, action in enumerate([2, 0, 1, 2, 2, 2, 0, 2]):
        assert moves.action[t] == action
        assert moves.nearest[t].tolist() == training.nearest[0].tolist()
        training.step(np.array([action]))
        assert moves.next_nearest[t].tolist() == training.nearest[0].tolist()
        rewards.append((moves.reward[t] > 0) == (training.ranks[0] < 0.03 * N))
        assert moves.next_allowed[t].tolist() == training.allowed[0].tolist()
    assert all(rewards)
    assert 0 < np.count_nonzero(moves.reward) < len(moves.reward)


def test_a_robot_that_stands_jitters_or_sees_nothing_is_followed_as_its_session_was(world):
    map_, ranks = world
    queries = [Query(ranks[frame]) for frame in (4, 9, 9, 9, 10)]
    queries[3] = Query.uninformative(R)
    action_m = np.array([0.0, 5.0, 0.0, -0.1, 1.0])
    walk = KnownWalk(queries, action_m, np.array([4.0, 9.0, 9.0, 9.0, 10.0]))
    moves = transitions_of(map_, walk, NnqlConfig(top_share=0.05))
    localizer, steps = ActiveLocalizer(map_, LocalizerConfig()), []
    for query, moved_m in zip(queries, action_m.tolist(), strict=True):
        steps.append(localizer.step(steps[-1].state if steps else localizer.start(), query, moved_m))
    assert moves.action.tolist() == [2, 0]
    near = [shortlist(step.relevance, 4).tolist() for step in steps]
    assert (moves.nearest.tolist(), moves.next_nearest.tolist()) == ([near[0], near[3]], [near[1], near[4]])
    is_rewarded = [
        rank_of_truth(steps[t].state.belief.mass, np.array([frame])) < 0.05 * N for t, frame in ((1, 9), (4, 10))
    ]
    assert moves.reward.tolist() == [100.0 * earned for earned in is_rewarded]


def test_a_rank_counts_from_0_and_must_lie_below_the_share(world):
    map_, ranks = world
    walk = walk_of(ranks, [4, 9, 10, 12, 17, 22, 27, 28, 33])
    first_rewards, no_rewards = (
        transitions_of(map_, walk, NnqlConfig(top_share=share)).reward for share in (1 / N, 0.0)
    )
    assert first_rewards.any()
    assert not no_rewards.any()


def test_moves_that_are_no_action_or_lead_nobody_knows_where_teach_nothing(world):
    map_, ranks = world
    frames = [4, 9, 12, 13, 23, 24, 24, 25]  # 5, 3 (nearer to 2 than half a step: no), 1, 10, 1, 0, 1
    true_m = np.array(frames, float)
    true_m[5] = np.nan
    moves = transitions_of(map_, walk_of(ranks, frames, true_position_m=true_m), NnqlConfig())
    assert moves.action.tolist() == [2, 0, 0]
    true_m[1], true_m[3] = N + 8.9, N + 9.1  # 10 m past the end are of a place of the map still
    moves = transitions_of(map_, walk_of(ranks, frames, true_position_m=true_m), NnqlConfig())
    assert moves.action.tolist() == [2, 0]
    for action_m, actions in ((2.5, [1]), (2.51, [])):  # half a step is near enough
        walk = walk_of(ranks, [4, 6], action_m=np.array([0.0, action_m]))
        assert transitions_of(map_, walk, NnqlConfig()).action.tolist() == actions
    no_moves = transitions_of(map_, walk_of(ranks, [7]), NnqlConfig())
    assert no_moves.action.size == 0
    empty = KnownWalk([], np.empty(0), np.empty(0))
    assert transitions_of(map_, empty, NnqlConfig()).nearest.shape == (0, 4)
    q_values = initial_q_values(N, 3, NnqlConfig())
    learn(q_values, no_moves, NnqlConfig())
    assert (q_values == np.float32(1e-4)).all()


def test_the_end_of_the_route(world):
    map_, ranks = world
    moves = transitions_of(map_, walk_of(ranks, [55, 57, 58, 59]), NnqlConfig())
    assert moves.next_allowed.tolist() == [[True, True, False], [True, False, False], [False, False, False]]


def test_on_a_loop_a_truth_of_a_later_round_is_that_of_the_first(world):
    map_, ranks = world
    loop, frames = replace(map_, closed=True), [4, 9, 10, 12, 17, 22, 27, 28, 33]
    first_round, third_round = (
        transitions_of(loop, walk_of(ranks, frames, true_position_m=frames + turns_m), NnqlConfig(top_share=0.03))
        for turns_m in (np.zeros(9), np.full(9, 2 * loop.route.length_m))
    )
    assert first_round.reward.any()
    assert third_round.reward.tolist() == first_round.reward.tolist()


def test_a_belief_wholly_past_the_end_begins_anew(world):
    """To the paper's updates, which know nobody who is lost."""
    map_, ranks = world
    walk = walk_of(ranks, [10, 15, 20], action_m=np.array([0.0, 300.0, 5.0]))
    config = NnqlConfig(top_share=0.05, update=UpdateRule.LOG_LIKELIHOOD)
    moves = transitions_of(map_, walk, config)
    assert moves.action.tolist() == [2]
    live, belief = map_.live_statistics.observing(Query(ranks[10])), GridFilter.uniform(map_.route, config.update)
    for t, frame in enumerate((15, 20)):
        live = live.observing(Query(ranks[frame]))
        belief = belief.predicted(5.0, np.sqrt(0.05**2 + 0.01 * 5), 0) if t else belief
        relevance = relevances(map_, Query(ranks[frame]), live)
        belief = belief.updated(ViewEvidence.of(relevance, config.update, 0.3), 0)
    is_rewarded = rank_of_truth(belief.mass, np.array([20])) < 0.05 * N
    assert moves.reward.tolist() == [100.0 * is_rewarded]


def test_one_position_a_view(world):
    _, ranks = world
    with pytest.raises(InvalidInputError, match="2 true positions for 3 views"):
        walk_of(ranks, [1, 2, 3], true_position_m=np.zeros(2))
