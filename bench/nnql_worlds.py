"""NNQL on real NetVLAD encodings of Nordland: maps, live images to learn from, and test episodes.

One row is one metre; the robot moves exactly the commanded rows; starts are uniform over the frames from which ten of
the longest moves fit; the belief of the map image nearest to the truth is ranked after each of the ten moves.
"""

import itertools
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.drive import Drive
from deepsimbad.core.map import Map
from deepsimbad.core.nnql import NnqlConfig, initial_q_values
from deepsimbad.core.relevance import Relevance, UpdateRule
from deepsimbad.core.training import TrainingWorld, Walk, train, walk_greedily
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.build import Built, build, choose_landmarks, measured
from deepsimbad.jobs.train import train_nnql, world_of

DRIVES = ("nr", "nq", "nq2")
TRIPLETS = tuple(itertools.permutations(DRIVES))
ACTIONS_M = tuple(float(metres) for metres in range(1, 11))
N_LANDMARKS, LIST_LENGTH, N_STARTS = 300, 4, 2000
LANDMARK_DRIVE, HELD_OUT, ITSELF, TEST_DRIVE = "landmark traverse", "held-out frames", "map images", "test traverse"


@dataclass(frozen=True)
class Setup:
    """How views are compared and believed.

    Attributes:
        name: In the report.
        relevance, update: Of map and belief.
        motion_std_m: Blur of the belief; None: as the service does.
    """

    name: str
    relevance: Relevance
    update: UpdateRule
    motion_std_m: float | None


PAPER = Setup("the paper's: rrf, additive relevance", Relevance.RRF, UpdateRule.ADDITIVE_RELEVANCE, 0.7)
OURS = Setup("ours: calibrated, log-likelihood", Relevance.CALIBRATED, UpdateRule.LOG_LIKELIHOOD, None)


@dataclass(frozen=True)
class Triplet:
    """One landmark-training-test triplet under one set-up, mapped."""

    folder: Path
    names: tuple[str, ...]
    setup: Setup

    @cached_property
    def _mapped(self) -> tuple[Built, list[Drive]]:
        evaluator = make_evaluator(evaluator_config({"kind": "feature_l2", "extractor": "none"}))
        encodings = [np.load(self.folder / f"{name}.npy").astype(np.float32) for name in self.names]
        drives = [Drive(position_m=np.arange(float(len(rows))), encodings=rows) for rows in encodings]
        model = choose_landmarks(drives[0].encodings, N_LANDMARKS, evaluator, lambda _: None)
        how = (model, self.setup.relevance, LIST_LENGTH, ACTIONS_M, False, lambda _: None)
        built = build(drives[1], drives[0], True, evaluator, *how)
        return built, [measured(drive, evaluator, model) for drive in drives]

    def learn(self, live: str, config: NnqlConfig, pool: Executor) -> NDArray[np.float32]:
        """Q-values learnt from some live images; `held-out frames` and `landmark traverse` as a remap does."""
        built, (landmarks, own, test) = self._mapped
        config = replace(config, update=self.setup.update, motion_std_m=self.setup.motion_std_m)
        if live in {LANDMARK_DRIVE, HELD_OUT}:
            second = landmarks if live == LANDMARK_DRIVE else None
            return train_nnql(built.rehearsal, lambda: own, second, config, lambda _: None, 2)[0]
        map_ = built.map if live == TEST_DRIVE else built.rehearsal
        world = self._world(map_, own if live == ITSELF else test, config)
        return train(world, config, lambda _: None, pool)[0]

    def test_world(self, config: NnqlConfig) -> TrainingWorld:
        """The test traverse, to be walked on the map that would serve."""
        built, (_, _, test) = self._mapped
        return self._world(built.map, test, replace(config, motion_std_m=self.setup.motion_std_m))

    def _world(self, map_: Map, live: Drive, config: NnqlConfig) -> TrainingWorld:
        return world_of(map_, live, np.arange(live.n_frames), replace(config, update=self.setup.update))


def score(ranks: NDArray[np.float64], n_images: int) -> NDArray[np.float64]:
    """ANR of every episode in percent, from ranks [e, t]."""
    return np.asarray(100 * ranks.mean(axis=1) / n_images, np.float64)


def starts_of(world: TrainingWorld, seed: int = 0) -> NDArray[np.int64]:
    """The same starts for every planner."""
    return np.random.default_rng(seed).choice(world.start_frames, N_STARTS)


def greedy(
    world: TrainingWorld, q_values: NDArray[np.float32], config: NnqlConfig, pool: Executor
) -> NDArray[np.float64]:
    """Episodes that follow Q-values."""
    return score(walk_greedily(world, starts_of(world), q_values, config, pool), world.n_images)


def random(world: TrainingWorld, config: NnqlConfig, pool: Executor) -> NDArray[np.float64]:
    """Episodes of random moves."""
    return greedy(world, initial_q_values(world.n_images, world.n_actions, config), config, pool)


def constant(world: TrainingWorld, action: int, pool: Executor) -> NDArray[np.float64]:
    """Episodes of one move, the action's place."""
    walk = Walk(world, starts_of(world), pool)
    ranks = np.empty((N_STARTS, 10))
    for step in range(10):
        walk.step(np.full(N_STARTS, action))
        ranks[:, step] = walk.ranks
    return score(ranks, world.n_images)
