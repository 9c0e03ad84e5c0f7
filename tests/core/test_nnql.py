"""NNQL against slow and obvious references."""

import numpy as np
import pytest

from deepsimbad.core.nnql import (
    NnqlConfig,
    Transitions,
    append_images,
    initial_q_values,
    learn,
    learn_online,
    q_of_nearest,
    q_of_view,
)
from deepsimbad.errors import InvalidMapConfigError


def slow_value(q_values, relevance, k, action):
    """The mean over the k map images most relevant to the view, of two alike the earlier."""
    order = sorted(range(len(relevance)), key=lambda i: (-relevance[i], i))[:k]
    return sum(float(q_values[i, action]) for i in order) / len(order)


def some_moves(rng, n, a, k, t):
    return Transitions(
        nearest=np.array([rng.choice(n, k, replace=False) for _ in range(t)]),
        action=rng.integers(0, a, t),
        reward=100.0 * rng.integers(0, 2, t),
        next_nearest=np.array([rng.choice(n, k, replace=False) for _ in range(t)]),
        next_allowed=rng.random((t, a)) < 0.7,
    )


def test_the_value_of_a_view_is_the_mean_over_its_nearest_map_images():
    rng = np.random.default_rng(0)
    for n, k in ((30, 4), (3, 4), (30, 1), (100, 70)):
        q_values = rng.random((n, 5), dtype=np.float32)
        relevance = rng.integers(0, 6, n).astype(np.float32)  # ties
        expected = [slow_value(q_values, relevance, k, action) for action in range(5)]
        assert np.allclose(q_of_view(q_values, relevance, k), expected)
    assert q_of_view(q_values, relevance, 4).dtype == np.float32


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
    before = q_values.copy()
    online = learn_online(q_values, moves, config)
    assert np.array_equal(q_values, before), "a live map is never written to"
    learn(q_values, moves, config)
    assert np.allclose(q_values, slow, rtol=1e-4)
    assert np.array_equal(online, q_values)


def test_values_settle_at_the_sum_of_discounted_rewards():
    config = NnqlConfig()
    q_values = initial_q_values(4, 1, config)
    here = np.arange(4)[np.newaxis]
    moves = Transitions(here, np.array([0]), np.array([100.0]), here, np.array([[True]]))
    for _ in range(3000):
        learn(q_values, moves, config)
    assert np.allclose(q_values, 100 / (1 - 0.9), rtol=1e-3)


def test_appended_images_know_nothing_and_the_others_keep_what_they_know():
    config = NnqlConfig()
    q_values = np.random.default_rng(0).random((5, 3), dtype=np.float32)
    longer = append_images(q_values, 2, config)
    assert longer.shape == (7, 3)
    assert np.array_equal(longer[:5], q_values)
    assert np.all(longer[5:] == np.float32(1e-4))


def test_values_of_many_views_at_once():
    q_values = np.random.default_rng(0).random((9, 3), dtype=np.float32)
    nearest = np.array([[0, 4], [8, 8], [2, 1]])
    assert np.allclose(q_of_nearest(q_values, nearest), [q_values[row].mean(axis=0) for row in nearest])


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
        {"n_episodes": -1},
        {"n_neighbours": 0},
        {"batch_episodes": 0},
        {"exploration": 1.5},
        {"learning_rate": float("nan")},
        {"reward": float("inf")},
        {"motion_std_m": -1.0},
        {"seed": -1},
    ],
)
def test_impossible_hyperparameters(bad):
    with pytest.raises(InvalidMapConfigError):
        NnqlConfig(**bad)
