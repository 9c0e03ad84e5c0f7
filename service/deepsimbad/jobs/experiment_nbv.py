"""The paper's active experiment (III, Fig. 7): every planner from the same starts, ours beside the paper's."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.nnql import NnqlConfig
from deepsimbad.core.planners import CONSTANT, DEFAULT_PLANNER, NNQL, RANDOM
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Query, Relevance
from deepsimbad.core.same_route import SameRoute
from deepsimbad.core.true_images import same_places
from deepsimbad.core.update_rules import DEFAULT_UPDATE, UpdateRule
from deepsimbad.engine.active_localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.evaluators.compute import available_cores
from deepsimbad.jobs.build_map import choose_landmarks, describe, map_contents
from deepsimbad.jobs.encoded_traverse import EncodedTraverse
from deepsimbad.jobs.episodes import (
    Chooser,
    ClairvoyantChooser,
    ConstantChooser,
    Episode,
    EpisodeRunner,
    RandomChooser,
    TestDrive,
    follow_plan,
)
from deepsimbad.jobs.paired import Comparison, compare, mean_interval
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.train_nnql import DescribedDrive, train_nnql
from deepsimbad.store.records import DomainRecord

CLAIRVOYANT = "clairvoyant"
PAPER = (Relevance.RRF, UpdateRule.ADDITIVE_RELEVANCE)
PAPER_ACTION_STD_M = 0.7  # the reference figures' blur for the paper's set-up
DISTANCES_M = (10.0, 20.0, 50.0)


@dataclass(frozen=True)
class NbvConfig:
    """What is compared.

    Attributes:
        n_landmarks, list_length: r and h.
        relevance, update: Of our set-up; the paper's is measured beside it.
        actions_m: The moves.
        n_steps: Moves an episode.
        training_episodes: Of NNQL.
        episodes: Test episodes of every planner.
        seed: Of starts, random moves and training.
        same_route: Whether positions of landmark and training traverse are comparable; None: where both know x, y.
    """

    n_landmarks: int = 300
    list_length: int = 4
    relevance: Relevance = DEFAULT_RELEVANCE
    update: UpdateRule = DEFAULT_UPDATE[DEFAULT_RELEVANCE]
    actions_m: tuple[float, ...] = tuple(float(metres) for metres in range(1, 11))
    n_steps: int = 10
    training_episodes: int = 10_000
    episodes: int = 2000
    seed: int = 0
    same_route: bool | None = True


@dataclass(frozen=True)
class _Setup:
    name: str
    relevance: Relevance
    update: UpdateRule
    action_std_m: float | None


@dataclass(frozen=True)
class NbvReport:
    """What every planner scored.

    Attributes:
        config: What was compared.
        ours, paper: Rank shares [episodes, steps] by planner, under our set-up and the paper's.
        travelled_m: Metres [episodes, steps] by planner, under our set-up.
        same_route: Whether the landmark traverse drove the mapped route; None: nobody looked.
    """

    config: NbvConfig
    ours: dict[str, NDArray[np.float64]]
    paper: dict[str, NDArray[np.float64]]
    travelled_m: dict[str, NDArray[np.float64]]
    same_route: SameRoute | None = None

    @property
    def best_constant(self) -> str:
        """The constant move that did best, known only afterwards."""
        return min((name for name in self.ours if name.startswith(CONSTANT)), key=lambda name: self.ours[name].mean())

    def comparisons(self) -> dict[str, Comparison]:
        """The default planner against random and the best constant move, episode by episode."""
        default = self.ours[DEFAULT_PLANNER].mean(axis=1)
        return {
            rival: compare(default, self.ours[rival].mean(axis=1), self.config.seed)
            for rival in (RANDOM, self.best_constant)
        }

    def as_dict(self, sources: dict[str, Any]) -> dict[str, Any]:
        """The stable flat JSON document of design section 7; percent."""
        seed = self.config.seed
        return {
            "anr": {name: _percent(shares) for name, shares in self.ours.items()},
            "default": DEFAULT_PLANNER,
            "anr_paper": {name: _percent(shares) for name, shares in self.paper.items()},
            "interval_95": {
                name: [100 * end for end in mean_interval(shares.mean(axis=1), seed)]
                for name, shares in self.ours.items()
            },
            "difference_95": {
                f"{DEFAULT_PLANNER} - {rival}": [100 * end for end in found.interval]
                for rival, found in self.comparisons().items()
            },
            "best_constant": self.best_constant,
            "anr_by_step": {name: (100 * shares.mean(axis=0)).tolist() for name, shares in self.ours.items()},
            "anr_at_distance_m": {
                name: _at_distances(shares, self.travelled_m[name]) for name, shares in self.ours.items()
            },
            "n_episodes": self.config.episodes,
            "second_season": None if self.same_route is None else self.same_route.as_dict(),
            "config": {**asdict(self.config), **sources},
        }


def nbv_stages(config: NbvConfig) -> dict[str, float]:
    """The stages `run_nbv` reports, with their weights."""
    stages = {"select landmarks": 2.0}
    for setup in ("ours", "paper"):
        stages |= {f"map ({setup})": 1.0, f"train ({setup})": 4.0}
        stages |= {f"{name} ({setup})": 4.0 if name in {RANDOM, CLAIRVOYANT} else 1.0 for name in _names(config)}
    return stages


def run_nbv(
    config: NbvConfig,
    evaluator: Evaluator,
    landmarks: EncodedTraverse,
    training: EncodedTraverse,
    test: EncodedTraverse,
    progress: Progress,
) -> NbvReport:
    """Map, train, and drive every planner's episodes.

    Raises:
        InvalidMapConfigError: The test traverse is shorter than an episode.
    """
    progress.stage("select landmarks")
    model = choose_landmarks(landmarks.encodings, config.n_landmarks, evaluator, progress.update)
    dissimilarities = evaluator.dissimilarities(test.encodings, model)
    queries = [
        Query(*each) for each in zip(rank_landmarks(dissimilarities), dissimilarities, test.encodings, strict=True)
    ]
    drive = TestDrive(queries, test.route, _nearest_images(test, training))
    travel_m = config.n_steps * max(config.actions_m)
    starts = drive.starts(travel_m, config.episodes, config.seed)
    if starts.size == 0:
        raise InvalidMapConfigError(f"the test traverse is shorter than an episode of {travel_m:g} m")

    results: dict[str, dict[str, list[Episode]]] = {}
    same_route = None
    setups = (
        _Setup("ours", config.relevance, config.update, None),
        _Setup("paper", *PAPER, PAPER_ACTION_STD_M),
    )
    for setup in setups:
        snapshot, same_route = _mapped(config, setup, evaluator, model, landmarks, training, progress)
        results[setup.name] = {}
        for name in _names(config):
            progress.stage(f"{name} ({setup.name})")
            localizer = ActiveLocalizer(snapshot, LocalizerConfig(update=setup.update, planner=_planner(name, config)))
            runner = EpisodeRunner(localizer, drive, config.n_steps, setup.action_std_m)
            chooser = _chooser(name, runner, config)
            results[setup.name][name] = _episodes(runner, starts, chooser, name == RANDOM, progress.update)
    ours = results["ours"]
    return NbvReport(
        config,
        {name: _stack(episodes) for name, episodes in ours.items()},
        {name: _stack(episodes) for name, episodes in results["paper"].items()},
        {name: np.stack([episode.travelled_m for episode in episodes]) for name, episodes in ours.items()},
        same_route,
    )


def _mapped(
    config: NbvConfig,
    setup: _Setup,
    evaluator: Evaluator,
    model: LandmarkModel,
    landmarks: EncodedTraverse,
    training: EncodedTraverse,
    progress: Progress,
) -> tuple[MapSnapshot, SameRoute | None]:
    """The map with its experience database, as a remap makes it, and whether it learnt from the landmark traverse."""
    progress.stage(f"map ({setup.name})")
    route = training.route
    found = describe(
        training.frames,
        route,
        evaluator,
        model,
        setup.relevance,
        config.list_length,
        landmarks.frames,
        config.same_route,
        progress.update,
    )
    domain = DomainRecord("experiment", {}, False, config.actions_m, None, "")
    contents = map_contents(domain, 1, {}, model, found, route)
    progress.stage(f"train ({setup.name})")
    experience = train_nnql(
        found.rehearsal or found.built,
        route,
        config.actions_m,
        partial(DescribedDrive.of, training.frames, False, evaluator, model),
        DescribedDrive.of(landmarks.frames, False, evaluator, model) if found.is_of_two_drives else None,
        NnqlConfig(
            config.training_episodes,
            config.n_steps,
            update=setup.update,
            motion_std_m=setup.action_std_m,
            seed=config.seed,
        ),
        progress.update,
        available_cores(),
    )
    snapshot = MapSnapshot.from_contents(replace(contents, q_values=experience.q_values), index_bytes=0)
    return snapshot, found.same_route


def _names(config: NbvConfig) -> list[str]:
    return [RANDOM, *(_constant(each) for each in config.actions_m), CLAIRVOYANT, NNQL, DEFAULT_PLANNER]


def _constant(action_m: float) -> str:
    return f"{CONSTANT}_{action_m:g}"


def _planner(name: str, config: NbvConfig) -> str:
    """The localizer's own planner; those that only an experiment has are choosers, and it then costs nothing."""
    return name if name in {NNQL, DEFAULT_PLANNER} else f"{CONSTANT}:{config.actions_m[0]:g}"


def _chooser(name: str, runner: EpisodeRunner, config: NbvConfig) -> Chooser:
    actions_m = np.array(config.actions_m)
    if name == RANDOM:
        return RandomChooser(actions_m, config.seed)
    if name == CLAIRVOYANT:
        return ClairvoyantChooser(runner, actions_m)
    if name in {NNQL, DEFAULT_PLANNER}:
        return follow_plan
    return ConstantChooser(float(name.removeprefix(f"{CONSTANT}_")))


def _episodes(
    runner: EpisodeRunner,
    starts: NDArray[np.int64],
    choose: Chooser,
    draws: bool,
    on_progress: Callable[[float], None],
) -> list[Episode]:
    """Every start's episode; where nothing is drawn, equal starts have equal episodes and are run once."""
    known: dict[int, Episode] = {}
    episodes = []
    for number, start in enumerate(starts.tolist()):
        if draws:
            episodes.append(runner.run(number, start, choose))
        else:
            if start not in known:
                known[start] = runner.run(number, start, choose)
            episodes.append(known[start])
        on_progress((number + 1) / starts.size)
    return episodes


def _nearest_images(test: EncodedTraverse, training: EncodedTraverse) -> NDArray[np.int64]:
    """[m] the map image nearest to every test frame: in the plane where both know it, else along the route."""
    nearest = training.route.nearest_image(test.route.position_m).astype(np.int64)
    pairs = same_places(test.route, training.route, tolerance_m=np.inf)
    nearest[pairs[:, 1]] = pairs[:, 0]
    return nearest


def _stack(episodes: Sequence[Episode]) -> NDArray[np.float64]:
    return np.stack([episode.rank_share for episode in episodes])


def _percent(shares: NDArray[np.float64]) -> float:
    return float(100 * shares.mean())


def _at_distances(shares: NDArray[np.float64], travelled_m: NDArray[np.float64]) -> dict[str, float | None]:
    """ANR of the last view within each distance, over the episodes that went so far."""
    found: dict[str, float | None] = {}
    for distance_m in DISTANCES_M:
        n_within = (travelled_m <= distance_m + 1e-9).sum(axis=1)
        reached = (travelled_m[:, -1] >= distance_m - 1e-9) & (n_within > 0)
        last = shares[np.arange(len(shares)), np.maximum(n_within - 1, 0)]
        found[f"{distance_m:g}"] = _percent(last[reached]) if reached.any() else None
    return found
