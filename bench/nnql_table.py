"""When NNQL beats random and constant moves on real NetVLAD encodings, and when not.

    python -m bench.nnql_table

Every hyperparameter is varied by itself, then a setting is chosen on three triplets and reported on the other three.
"""

import itertools
import sys
from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.common import RESULTS, describe, real_recordings
from deepsimbad.core.drive import Drive
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import mean_interval
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


CHOSEN_ON, REPORTED_ON = (0, 2, 4), (1, 3, 5)
LONGEST = 9  # place of the 10 m move, the best constant of every triplet's mean


@dataclass(frozen=True)
class Setting:
    """One row: what differs from the paper's hyperparameters."""

    label: str
    live: str = LANDMARK_DRIVE
    changes: dict[str, Any] = field(default_factory=dict)

    @property
    def is_possible(self) -> bool:
        """Whether a robot could have it: nobody knows the test traverse beforehand."""
        return self.live not in {TEST_DRIVE, ITSELF}


def _fixed(epsilon: float) -> dict[str, Any]:
    return {"exploration": epsilon, "final_exploration": epsilon}


SETTINGS = (
    Setting("as in the paper; live images: landmark traverse; exploration falls from 1 to 0.1"),
    Setting("live images: held-out frames of the training traverse", HELD_OUT),
    Setting("live images: the map images themselves (what must not be)", ITSELF),
    Setting("live images: the test traverse itself (what nobody has; a bound)", TEST_DRIVE),
    *(Setting(f"exploration {epsilon:g} throughout", changes=_fixed(epsilon)) for epsilon in (0.0, 0.1, 0.3, 1.0)),
    *(Setting(f"k = {k}", changes={"n_neighbours": k}) for k in (1, 10, 30)),
    *(Setting(f"reward for the top {100 * s:g} %", changes={"top_share": s}) for s in (0.05, 0.02, 0.01, 0.005)),
    *(Setting(f"discount {gamma:g}", changes={"discount": gamma}) for gamma in (0.0, 0.5, 0.7)),
    *(Setting(f"learning rate {alpha:g}", changes={"learning_rate": alpha}) for alpha in (0.03, 0.3, 0.6)),
    Setting("2,000 episodes", changes={"n_episodes": 2000}),
    Setting("learning rate 0.3, top 1 %", changes={"learning_rate": 0.3, "top_share": 0.01}),
    Setting(
        "learning rate 0.3, top 0.5 %, discount 0.5",
        changes={"learning_rate": 0.3, "top_share": 0.005, "discount": 0.5},
    ),
    Setting("learning rate 0.3, exploration 1", changes={"learning_rate": 0.3, **_fixed(1.0)}),
    Setting(
        "learning rate 0.3, top 1 %, k = 10, exploration 1",
        changes={"learning_rate": 0.3, "top_share": 0.01, "n_neighbours": 10, **_fixed(1.0)},
    ),
    Setting(
        "learning rate 0.3, top 0.5 %, k = 30, discount 0.7, exploration 1",
        changes={"learning_rate": 0.3, "top_share": 0.005, "n_neighbours": 30, "discount": 0.7, **_fixed(1.0)},
    ),
    Setting("held-out frames, learning rate 0.3, top 1 %", HELD_OUT, {"learning_rate": 0.3, "top_share": 0.01}),
    Setting(
        "held-out frames, learning rate 0.3, top 0.5 %, k = 10, exploration 1",
        HELD_OUT,
        {"learning_rate": 0.3, "top_share": 0.005, "n_neighbours": 10, **_fixed(1.0)},
    ),
)
SEEDS = (1, 2, 3, 4)


def measure(triplets: Sequence[Triplet], setting: Setting, pool: Executor, seed: int = 0) -> NDArray[np.float64]:
    """ANR in percent of every episode, [triplets, starts]."""
    config = NnqlConfig(**setting.changes, seed=seed)
    scores = []
    for triplet in triplets:
        q_values = triplet.learn(setting.live, config, pool)
        scores.append(greedy(triplet.test_world(config), q_values, config, pool))
    return np.stack(scores)


def difference(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> str:
    """Mean paired difference and its interval over the starts, in points of ANR; negative: the first is better."""
    apart = ours.mean(axis=0) - theirs.mean(axis=0)
    low, high = mean_interval(apart, seed=0)
    mark = "**" if high < 0 else ""
    return f"{mark}{apart.mean():+.3f}{mark} ({low:+.3f} .. {high:+.3f})"


def setup_lines(folder: Path, setup: Setup, pool: Executor) -> list[str]:
    """The tables of one set-up."""
    triplets = [Triplet(folder, names, setup) for names in TRIPLETS]
    worlds = [triplet.test_world(NnqlConfig()) for triplet in triplets]
    random = np.stack([random(world, NnqlConfig(), pool) for world in worlds])
    constants = np.stack([[constant(world, action, pool) for world in worlds] for action in range(10)])
    longest = constants[LONGEST]
    names = ["-".join(triplet.names) for triplet in triplets]
    lines = [f"## {setup.name[0].upper()}{setup.name[1:]}", ""]
    lines += [f"| ANR, percent | mean | {' | '.join(names)} |", "|---|---|" + "---|" * len(names)]
    lines += [_row("random moves", random)]
    lines += [_row(f"constant {action + 1} m", constants[action]) for action in (0, 4, LONGEST)]
    best = constants.mean(axis=2).min(axis=0)
    lines.append(_row("each triplet's best constant, known only afterwards", best[:, np.newaxis]))
    lines += ["", "| NNQL | ANR, mean | less random | less constant 10 m |", "|---|---|---|---|"]
    found = {}
    for setting in SETTINGS:
        scores = found[setting.label] = measure(triplets, setting, pool)
        lines.append(
            f"| {setting.label} | {scores.mean():.3f} | {difference(scores, random)} | {difference(scores, longest)} |"
        )
        print(lines[-1], flush=True)
    first = found[SETTINGS[0].label]
    lines += ["", _seeds([first, *(measure(triplets, SETTINGS[0], pool, seed) for seed in SEEDS)], random, longest)]
    return [*lines, "", *_chosen(found, random, constants, names)]


def _seeds(scores: Sequence[NDArray[np.float64]], random: NDArray[np.float64], longest: NDArray[np.float64]) -> str:
    """How far the training's own draws move a row, which no interval over starts shows."""
    means = [each.mean() for each in scores]
    together = np.mean(scores, axis=0)
    return (
        f"The first row with {len(means)} seeds of the training: ANR {np.mean(means):.3f} on average, standard "
        f"deviation {np.std(means, ddof=1):.3f}, from {min(means):.3f} to {max(means):.3f}; their average less random "
        f"{difference(together, random)}, less constant 10 m {difference(together, longest)}."
    )


def _chosen(
    found: dict[str, NDArray[np.float64]], random: NDArray[np.float64], constants: NDArray[np.float64], names: list[str]
) -> list[str]:
    chosen, reported = list(CHOSEN_ON), list(REPORTED_ON)
    possible = [setting.label for setting in SETTINGS if setting.is_possible]
    best = min(possible, key=lambda label: float(found[label][chosen].mean()))
    action = int(constants[:, chosen].mean(axis=(1, 2)).argmin())
    scores = found[best][reported]
    return [
        f"Best possible setting on {', '.join(names[place] for place in chosen)}: **{best}**, ANR "
        f"{found[best][chosen].mean():.3f}, against {random[chosen].mean():.3f} of random moves and "
        f"{constants[action][chosen].mean():.3f} of constant {action + 1} m, the best there. On the other three, "
        f"{', '.join(names[place] for place in reported)}:",
        "",
        "| | ANR, mean | NNQL less it, 95 % interval |",
        "|---|---|---|",
        f"| NNQL with that setting | {scores.mean():.3f} | |",
        f"| random moves | {random[reported].mean():.3f} | {difference(scores, random[reported])} |",
        f"| constant {action + 1} m | {constants[action][reported].mean():.3f} "
        f"| {difference(scores, constants[action][reported])} |",
    ]


def _row(label: str, scores: NDArray[np.float64]) -> str:
    each = " | ".join(f"{score:.2f}" for score in scores.mean(axis=1))
    return f"| {label} | {scores.mean():.3f} | {each} |"


def main() -> None:
    """Measure, print, write `docs/results/nnql.md`."""
    folder = real_recordings() / "nordland_netvlad64"
    lines = [
        "# When NNQL beats random and constant moves",
        "",
        "Nearest-neighbour Q-learning (II-D) on three drives of the Nordland route, 600 places, 64-d NetVLAD, all six "
        "landmark-training-test triplets; r = 300, h = 4, one place taken as one metre, moves of 1 to 10 m, ten a "
        f"test episode, {N_STARTS:,} starts, the same for every row. Trained with 10,000 episodes. ANR of the belief "
        "after each move, in percent: 0 is perfect, 50 chance, smaller is better. Differences are paired by start and "
        "averaged over the triplets, with their 95 % bootstrap interval over the starts; **bold**: better, and zero "
        "is outside.",
        "",
        "Made by `python -m bench.nnql_table`.",
        "",
        f"Machine: {describe()}",
        "",
    ]
    with ThreadPoolExecutor(2) as pool:
        for setup in (PAPER, OURS):
            lines += [*setup_lines(folder, setup, pool), ""]
    lines += ["## What it shows", "", *CONCLUSIONS]
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "nnql.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"\nwritten to {RESULTS / 'nnql.md'}", file=sys.stderr)


CONCLUSIONS = (
    "- **With the paper's numbers NNQL does not beat random moves under the paper's relevance and update** once the "
    "training's own draws are averaged over; single seeds do and do not. Under our relevance and update it does, by a "
    "little. No setting tried beats the constant move of 10 m under either: on this route far moves are simply good, "
    "since neighbouring places look alike and a long move costs the belief nothing.",
    "- **The training's draws matter more than most hyperparameters.** The intervals are over starts, for the one set "
    "of values that was learnt; the line below each table says how far another seed moves a row. Rows closer to each "
    "other than twice that are alike, and a bold figure smaller than that is no proof. So the setting that is best on "
    "three triplets does not carry over to the other three under the paper's set-up; under ours it beats random moves "
    "there too. (The six triplets are six orders of the same three drives, not six routes.)",
    "- **Live images.** Learning from the very traverse that is tested comes near the best constant, and is the one "
    "row that stands clear of the rest under the paper's set-up: what NNQL lacks is knowledge of the season to come, "
    "more than a better learner. Landmark traverse and held-out frames do not differ by more than the seed does; the "
    "map images themselves teach least under our set-up.",
    "- **Exploration.** Under our set-up acting greedily while learning (0 to 0.3) is clearly worse than random moves: "
    "entries start near 0 and values tend to 1,000, so whatever was tried first stays best. Random moves at first, and "
    "fewer of them later, do better than random moves throughout; it is the default.",
    "- **k.** One neighbour is too few under both; ten or thirty are no worse than four.",
    "- **Reward and discount.** The belief ranks the truth in the top 10 % nearly always, so that reward hardly tells "
    "moves apart. Under our set-up a stricter reward (2 %) or no discounted future at all does best, because most of a "
    "value near 1,000 is what any move would earn.",
    "- **Size.** 10,000 episodes of 10 moves reach each of the 6,000 entries of these maps about 66 times. On a map of "
    "26,208 images they reach an entry 1.5 times, and a value moves a tenth of its way at each: there NNQL with the "
    "paper's numbers has hardly begun to learn.",
    "",
    "The planner that ships as default acts on the whole belief instead (`telling`).",
)


if __name__ == "__main__":
    main()
