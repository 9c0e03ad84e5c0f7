"""Training: against a slow reference, by seed alone, and on a route where only few places tell anything."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from deepsimbad.core.experience.nnql import NnqlConfig, initial_q_values
from deepsimbad.core.experience.training import TrainingWorld, Walk, choose_actions, train, walk_greedily
from deepsimbad.core.index.retrieval import relevances, shortlist
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.relevance import Query, Relevance, UpdateRule
from deepsimbad.errors import CancelledError
from tests.core.conftest import a_map

ACTIONS_M = (1.0, 2.0, 3.0)
BACK_AND_FORTH_M = (-2.0, 0.0, 3.0)


def random_world(
    config: NnqlConfig, closed: bool = False, known_share: float = 1.0, actions_m: tuple[float, ...] = ACTIONS_M
) -> TrainingWorld:
    rng = np.random.default_rng(5)
    n, r = 80, 15
    map_dissimilarities, live_dissimilarities = rng.normal(size=(2, n, r)).astype(np.float32)
    map_ = a_map(Relevance.RRF, map_dissimilarities, 4, closed=closed, actions_m=actions_m)
    views = Query(live_dissimilarities.argsort(axis=1).argsort(axis=1) + np.float32(1))
    true_image = np.where(rng.random(n) < known_share, np.arange(n), -1)
    return TrainingWorld.on(map_, views, map_.route, true_image, config)


def mass_after_move(mass: np.ndarray, metres: int, std_m: float, closed: bool) -> np.ndarray:
    """The mass after a move, of images a metre apart; what would be past an end of an open route is dropped."""
    n, reach = len(mass), max(1, int(4 * std_m))
    shifted = np.roll(mass, metres)
    if not closed and metres > 0:
        shifted[:metres] = 0
    if not closed and metres < 0:
        shifted[metres:] = 0
    spread = np.zeros(n)
    for image in range(n):
        to = [d for d in range(-reach, reach + 1) if closed or 0 <= image + d < n]
        narrow = {0: 1 - std_m**2, 1: std_m**2 / 2}
        weight = [narrow.get(abs(d), 0.0) if std_m < 0.6 else np.exp(-0.5 * (d / std_m) ** 2) for d in to]
        for d, w in zip(to, weight, strict=True):
            spread[(image + d) % n] += shifted[image] * w / sum(weight)
    return spread / spread.sum()


def slow_training(world: TrainingWorld, config: NnqlConfig, closed: bool) -> np.ndarray:
    """One episode after the other in plain loops: the served filter, the served relevance. Batches of one."""
    n, actions_m = world.n_images, world.map.actions_m
    q_values = np.full((n, actions_m.size), config.initial_q)
    for episode in range(config.n_episodes):
        rng = np.random.default_rng([config.seed, episode])
        frame = int(rng.choice(world.start_frames, 1)[0])
        epsilon = config.exploration_at(np.array([episode]))
        belief = np.full(n, 1 / n)

        def look(belief, frame):
            relevance = relevances(world.map, world.views.at(frame))
            weights = belief * n + np.maximum(relevance, 0)
            return weights / weights.sum(), shortlist(relevance, config.n_neighbours)

        belief, near = look(belief, frame)
        for _ in range(config.n_actions_per_episode):
            allowed = np.array([closed or 0 <= frame + m <= n - 1 for m in actions_m])
            action = int(choose_actions(q_values[near].mean(axis=0)[None], allowed[None], epsilon, rng)[0])
            if action < 0:
                break
            frame = int(frame + actions_m[action]) % n
            belief = mass_after_move(belief, int(actions_m[action]), config.motion_std_m, closed)
            belief, next_near = look(belief, frame)
            if world.true_image[frame] >= 0:
                rank = rank_of_truth(belief, np.array([frame]))
                reward = config.reward if rank < config.top_share * n else 0.0
                next_allowed = [a for a, m in enumerate(actions_m) if closed or 0 <= frame + m <= n - 1]
                best = max((q_values[next_near, a].mean() for a in next_allowed), default=0.0)
                target = reward + config.discount * best
                for image in near:
                    q_values[image, action] += config.learning_rate * (target - q_values[image, action])
            near = next_near
    return q_values


@pytest.mark.parametrize(
    ("closed", "known_share", "actions_m"),
    [(False, 1.0, ACTIONS_M), (True, 0.6, ACTIONS_M), (False, 1.0, BACK_AND_FORTH_M), (True, 1.0, BACK_AND_FORTH_M)],
)
def test_the_same_values_as_plain_loops(closed, known_share, actions_m):
    config = NnqlConfig(n_episodes=60, batch_episodes=1, motion_std_m=0.33, top_share=0.2, exploration=0.5, seed=3)
    world = random_world(config, closed, known_share, actions_m)
    q_values, _ = train(world, config, lambda _: None)
    expected = slow_training(world, config, closed)
    assert (expected > 1).any()
    assert np.allclose(q_values, expected, rtol=1e-4, atol=1e-5)


def test_the_seed_decides_and_threads_do_not():
    config = NnqlConfig(n_episodes=250, seed=7, motion_std_m=0.5)
    world = random_world(config)
    q_values, curve = train(world, config, lambda _: None)
    with ThreadPoolExecutor(2) as pool:
        pool_q_values, pool_curve = train(world, config, lambda _: None, pool)
    assert np.array_equal(q_values, pool_q_values)
    assert (pool_curve, len(curve.reward_share)) == (curve, 3)
    other_q_values, _ = train(world, NnqlConfig(n_episodes=250, seed=8, motion_std_m=0.5), lambda _: None)
    assert not np.array_equal(q_values, other_q_values)


def test_a_cancel_ends_training_between_two_batches():
    config = NnqlConfig(n_episodes=300)
    shares: list[float] = []

    def cancel(share: float) -> None:
        shares.append(share)
        if share > 0.5:
            raise CancelledError("asked to stop")

    with pytest.raises(CancelledError):
        train(random_world(config), config, cancel)
    assert shares == [pytest.approx(1 / 3), pytest.approx(2 / 3)]


def test_no_episodes_teach_nothing():
    config = NnqlConfig(n_episodes=0)
    world = random_world(config)
    q_values, curve = train(world, config, lambda _: None)
    assert np.array_equal(q_values, initial_q_values(80, 3, config))
    assert (curve.reward_share, curve.greedy_reward_share) == ((), curve.random_reward_share)


def test_an_episode_ends_with_the_route():
    walk = Walk(random_world(NnqlConfig(n_episodes=1)), np.array([77, 10]))
    assert walk.allowed.tolist() == [[True, True, False], [True, True, True]]
    walk.step(np.array([1, 2]))
    assert walk.frames.tolist() == [79, 13]
    assert not walk.allowed[0].any()
    walk.step(np.array([-1, 0]))
    assert walk.frames.tolist() == [79, 14]


def test_starts_leave_room_for_a_whole_episode_where_there_is_any():
    for n_actions, closed, last_start in ((10, False, 49), (100, False, 79), (10, True, 79)):
        config = NnqlConfig(n_episodes=1, n_actions_per_episode=n_actions)
        assert random_world(config, closed).start_frames.max() == last_start


def telling_world(config: NnqlConfig) -> TrainingWorld:
    """Every tenth place shows a landmark of its own; the nine between show how far on it is, and nothing else.

    Who steps onto the telling places knows where it is; who wanders sees them once in ten views.
    """
    n, period = 300, 10
    place = np.arange(n)
    first = np.where(place % period == 0, period + place // period, place % period)
    r = period + n // period
    ranks = np.full((n, r), (r + 2) / 2, np.float32)
    ranks[place, first] = 1
    lists = first[np.newaxis].astype(np.uint16)
    map_ = Map(
        config={"relevance": "rrf", "n_landmarks": r},
        lists=lists,
        position_m=place.astype(float),
        actions_m=np.arange(1.0, 10.0),
    )
    return TrainingWorld.on(map_, Query(ranks), map_.route, place, replace(config, update=UpdateRule.LOG_LIKELIHOOD))


def test_where_only_every_tenth_place_tells_the_learnt_moves_find_it():
    config = NnqlConfig(n_episodes=1500, n_actions_per_episode=3, top_share=0.02, motion_std_m=0.0, n_neighbours=4)
    world = telling_world(config)
    q_values, curve = train(world, config, lambda _: None)
    assert curve.greedy_reward_share > curve.random_reward_share + 0.15
    starts = world.start_frames
    greedy = walk_greedily(world, starts, q_values, config)
    random = walk_greedily(world, starts, initial_q_values(300, 9, config), config)
    assert greedy.mean() < 0.7 * random.mean()
