"""The paper's active experiment on one landmark-training-test triplet (III, Fig. 7).

An episode is views and commanded moves on the recorded test traverse: the robot stands on a frame, looks, is told how
far to move, and moves exactly so far. After each move the belief of the map image nearest to the truth is ranked by
ANR's rule. Every planner starts from the same frames, under our set-up and under the paper's.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief.summary import CONFIDENT_WITHIN_M, DEFAULT_CONFIDENCE, near_mode
from deepsimbad.core.building import Built, MapPlan
from deepsimbad.core.drive import Drive, SameRoute
from deepsimbad.core.experience.nnql import NnqlConfig
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig, LocalizerState, Step
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import mean_interval, rank_of_truth
from deepsimbad.core.planners import CONSTANT, DEFAULT_PLANNER, NNQL, RANDOM
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Query, Relevance, UpdateRule
from deepsimbad.core.route import Route
from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.compute import available_cores
from deepsimbad.jobs.build import build, measure_drive, train_nnql, views_of
from deepsimbad.jobs.experiments.truth import nearest_images
from deepsimbad.jobs.fitting import Fitter, Pictures
from deepsimbad.jobs.progress import Progress

CLAIRVOYANT = "clairvoyant"
BLOCK_M = 20.0  # starts nearer together have much the same episode
DISTANCES_M = (10.0, 20.0, 50.0)
_SETUPS = ("ours", "paper")
MOST_MOVES = 20
PENALTY_VIEWS = 20


@dataclass(frozen=True)
class TestDrive:
    """What the robot may see, and where it truly is."""

    views: Query  # the described test frames, in the order they were driven; a batch
    route: Route  # their positions
    true_image: NDArray[np.int64]  # [m] int64, the map image nearest to every test frame

    def starts(self, travel_m: float, count: int | None, seed: int) -> NDArray[np.int64]:
        """Frames from which `travel_m` fit: all of them, or `count` drawn with replacement."""
        frames = np.flatnonzero(self.route.position_m + travel_m <= self.route.position_m[-1])
        return frames if count is None or not frames.size else np.random.default_rng(seed).choice(frames, count)


@dataclass(frozen=True)
class Episode:
    """One episode: the truth's rank after each of some moves, and when the robot was sure of its place."""

    rank_share: NDArray[np.float64]  # [steps] share of map images placed before the truth after each move
    travelled_m: NDArray[np.float64]  # [steps] metres moved until then
    views: float  # until the robot was sure of its place; 20 more where it was wrong, or never sure
    metres: float  # moved by then
    is_wrong: bool  # whether it was sure, and more than 5 m off


Chooser: TypeAlias = Callable[[int, Step, float], float]
"""Commands the next move in metres, of episode number, last step and true position (for those who may know it)."""


@dataclass(frozen=True)
class EpisodeRunner:
    """Runs episodes with the localizer that ships."""

    localizer: ActiveLocalizer  # the algorithm on a map
    drive: TestDrive  # the test traverse
    n_steps: int  # moves an episode
    action_std_m: float | None = None  # the error that the filter expects of a move; None: its own default
    until_sure: bool = True  # whether episodes go on, to 20 moves, while the robot is not sure

    def run(self, episode: int, start: int, choose: Chooser) -> Episode:
        """Run one episode from a test frame; it goes on to 20 moves where it is not sure, while the drive lasts."""
        shares, travelled_m = np.empty(self.n_steps), np.empty(self.n_steps)
        route, position_m = self.drive.route, float(self.drive.route.position_m[start])
        step = self.localizer.step(self.localizer.start(), self.drive.views.at(start))
        moved_m, certainty = 0.0, self._certainty(step, position_m, 1, 0.0)
        for number in range(max(self.n_steps, MOST_MOVES) if self.until_sure else self.n_steps):
            if number >= self.n_steps and certainty is not None:
                break
            action_m = choose(episode, step, position_m)
            if number >= self.n_steps and not route.start_m <= position_m + action_m <= route.position_m[-1]:
                break
            moved_m, position_m = moved_m + abs(action_m), position_m + action_m
            step, share = self.observe(step.state, position_m, action_m)
            if number < self.n_steps:
                shares[number], travelled_m[number] = share, moved_m
            certainty = certainty or self._certainty(step, position_m, number + 2, moved_m)
        views, metres, is_wrong = certainty or (MOST_MOVES + 1, moved_m, False)
        penalty_views = PENALTY_VIEWS if is_wrong or certainty is None else 0
        return Episode(shares, travelled_m, float(views + penalty_views), metres, is_wrong)

    def _certainty(self, step: Step, position_m: float, views: int, metres: float) -> tuple[int, float, bool] | None:
        """`views`, `metres` and whether a robot that is sure of its place is wrong; None where it is not sure."""
        belief = step.state.belief
        mass, route = belief.mass, belief.route
        mode = int(mass.argmax())
        if near_mode(route, mass, mode)[0] * (1 - belief.doubt.off_route) < DEFAULT_CONFIDENCE:
            return None
        frame = int(self.drive.route.nearest_image(np.array([position_m]))[0])
        truth_m = route.position_m[self.drive.true_image[frame]]
        off_m = abs(float(route.offset_m(np.array([truth_m]), float(route.position_m[mode]))[0]))
        return views, metres, off_m > CONFIDENT_WITHIN_M

    def observe(self, state: LocalizerState, position_m: float, action_m: float) -> tuple[Step, float]:
        """Look from the frame nearest to a position; returns the step and the truth's rank share."""
        frame = int(self.drive.route.nearest_image(np.array([position_m]))[0])
        step = self.localizer.step(state, self.drive.views.at(frame), action_m, self.action_std_m)
        mass = step.state.belief.mass
        return step, rank_of_truth(mass, self.drive.true_image[[frame]]) / mass.size


def follow_plan(episode: int, step: Step, position_m: float) -> float:  # noqa: ARG001
    """Do what the localizer's own planner recommends."""
    if step.plan is None:
        raise ValueError("the planner recommends nothing on this map")
    return step.plan.action_m


def random_chooser(actions_m: NDArray[np.float64], seed: int) -> Chooser:
    """Draws moves uniformly, by the seed, the episode's number and the step's."""

    def choose(episode: int, step: Step, position_m: float) -> float:  # noqa: ARG001
        return float(np.random.default_rng([seed, episode, step.state.n_observations]).choice(actions_m))

    return choose


def clairvoyant_chooser(runner: EpisodeRunner, actions_m: NDArray[np.float64]) -> Chooser:
    """Tries every move on the test traverse itself and takes the best: a bound no planner can know."""

    def choose(episode: int, step: Step, position_m: float) -> float:  # noqa: ARG001
        shares = [runner.observe(step.state, position_m + action_m, action_m)[1] for action_m in actions_m]
        return float(actions_m[int(np.argmin(shares))])

    return choose


@dataclass(frozen=True)
class NbvConfig:
    """What is compared."""

    n_landmarks: int = 300  # r
    list_length: int = 4  # h
    relevance: Relevance = DEFAULT_RELEVANCE  # of our set-up, as `update`; the paper's is measured beside it
    update: UpdateRule = DEFAULT_RELEVANCE.traits.update
    actions_m: tuple[float, ...] = tuple(float(metres) for metres in range(1, 11))  # the moves
    n_steps: int = 10  # moves an episode
    training_episodes: int = 10_000  # of NNQL
    episodes: int | None = None  # test episodes of every planner; None: one from every start
    seed: int = 0  # of starts, random moves and training
    # Whether positions of landmark and training traverse are comparable; None: where both know x, y
    same_route: bool | None = True

    @property
    def episode_m(self) -> float:
        """Metres that the longest episode takes."""
        return self.n_steps * max(self.actions_m)


@dataclass(frozen=True)
class NbvReport:
    """What every planner scored."""

    config: NbvConfig
    our_episodes: dict[str, list[Episode]]  # by planner, under our set-up
    paper_episodes: dict[str, list[Episode]]  # by planner, under the paper's
    block: NDArray[np.int64]  # [episodes] the stretch of 20 m that each began in
    same_route: SameRoute | None = None  # whether the landmark traverse drove the mapped route; None: nobody looked

    @property
    def best_constant(self) -> str:
        """The constant move that took the fewest views, known only afterwards."""
        constants = [name for name in self.our_episodes if name.startswith(CONSTANT)]
        return min(constants, key=lambda name: float(self._values(name, "views").mean()))

    def as_dict(self, sources: dict[str, Any]) -> dict[str, Any]:
        """The stable flat JSON document of design section 7; percent."""
        shares = {name: 100 * self._values(name, "rank_share") for name in self.our_episodes}
        by_episode = {name: rows.mean(axis=1) for name, rows in shares.items()}
        views, metres = ({name: self._values(name, part) for name in self.our_episodes} for part in ("views", "metres"))
        wrong_shares = {name: 100 * self._values(name, "is_wrong") for name in self.our_episodes}
        rivals = (RANDOM, self.best_constant)
        return {
            "anr": _means(by_episode),
            "default": DEFAULT_PLANNER,
            "anr_paper": {
                name: float(100 * _stack(episodes, "rank_share").mean())
                for name, episodes in self.paper_episodes.items()
            },
            "interval_95": self._intervals(by_episode),
            "difference_95": self._differences(by_episode, rivals),
            "views_to_confident": {**_means(views), "interval_95": self._intervals(views)},
            "metres_to_confident": {**_means(metres), "interval_95": self._intervals(metres)},
            "wrong_when_confident": {**_means(wrong_shares), "interval_95": self._intervals(wrong_shares)},
            "views_difference_95": self._differences(views, rivals),
            "best_constant": self.best_constant,
            "anr_by_step": {name: rows.mean(axis=0).tolist() for name, rows in shares.items()},
            "anr_at_distance_m": {
                name: _at_distances(rows, self._values(name, "travelled_m")) for name, rows in shares.items()
            },
            "n_episodes": len(self.block),
            "second_season": None if self.same_route is None else self.same_route.as_dict(),
            "config": {**asdict(self.config), **sources},
        }

    def _values(self, planner: str, part: str) -> NDArray[np.float64]:
        return _stack(self.our_episodes[planner], part)

    def _intervals(self, values: Mapping[str, NDArray[np.float64]]) -> dict[str, list[float]]:
        return {name: list(mean_interval(rows, self.config.seed, self.block)) for name, rows in values.items()}

    def _differences(self, values: Mapping[str, NDArray[np.float64]], rivals: Sequence[str]) -> dict[str, list[float]]:
        """Intervals of the default planner's values less its rivals', episode by episode."""
        differences = {f"{DEFAULT_PLANNER} - {rival}": values[DEFAULT_PLANNER] - values[rival] for rival in rivals}
        return self._intervals(differences)


def _stack(episodes: Sequence[Episode], part: str) -> NDArray[np.float64]:
    return np.array([getattr(episode, part) for episode in episodes], np.float64)


def _means(values: Mapping[str, NDArray[np.float64]]) -> dict[str, float]:
    return {name: float(rows.mean()) for name, rows in values.items()}


def nbv_stages(config: NbvConfig) -> dict[str, float]:
    """The stages `run_nbv` reports, with their weights."""
    stages: dict[str, float] = {}
    for setup in _SETUPS:
        stages |= {f"map ({setup})": 1.0, f"train ({setup})": 4.0}
        stages |= {f"{name} ({setup})": 4.0 if name in {RANDOM, CLAIRVOYANT} else 1.0 for name in planner_names(config)}
    return stages


@dataclass(frozen=True)
class Setup:
    """A map with its experience database, and how beliefs on it change."""

    name: str  # ours, or the paper's
    map: Map
    update: UpdateRule
    action_std_m: float | None  # as of `EpisodeRunner`


def run_nbv(
    config: NbvConfig,
    evaluator: Evaluator,
    landmarks: Drive,
    training: Drive,
    test: Drive,
    progress: Progress,
    pictures: Pictures | None = None,
) -> NbvReport:
    """Map, train, and drive every planner's episodes.

    Args:
        pictures: Images of the landmark traverse, for evaluators that are fitted to them.

    Raises:
        InvalidMapConfigError: The test traverse is shorter than an episode.
    """
    starts, fitter = starts_of(config, test), Fitter(evaluator, pictures, config.seed)
    results: dict[str, dict[str, list[Episode]]] = {}
    for name in _SETUPS:
        progress.stage(f"map ({name})")
        relevance, *_ = _setup(config, name)
        plan = MapPlan(relevance, config.list_length, config.actions_m, same_route=config.same_route)
        map_build = build(
            plan, training, landmarks, landmarks, config.n_landmarks, evaluator, progress.update, fitter=fitter
        )
        progress.stage(f"train ({name})")
        setup = train_setup(config, name, map_build, progress.update)
        views = views_of(measure_drive(test, setup.map.landmark_model, evaluator))
        drive = TestDrive(views, test.route(), nearest_images(test, training))
        results[name] = {}
        for planner in planner_names(config):
            progress.stage(f"{planner} ({name})")
            results[name][planner] = drive_planner(config, setup, planner, drive, starts, progress.update)
    block = (test.position_m[starts] // BLOCK_M).astype(np.int64)
    return NbvReport(config, results["ours"], results["paper"], block, map_build.same_route)


def starts_of(config: NbvConfig, test: Drive) -> NDArray[np.int64]:
    """The frames from which every planner starts.

    Raises InvalidMapConfigError: the test traverse is shorter than an episode.
    """
    drive = TestDrive(Query.uninformative(1), test.route(), np.empty(0, np.int64))
    starts = drive.starts(config.episode_m, config.episodes, config.seed)
    if starts.size == 0:
        raise InvalidMapConfigError(f"the test traverse is shorter than an episode of {config.episode_m:g} m")
    return starts


def _setup(config: NbvConfig, name: str) -> tuple[Relevance, UpdateRule, float | None]:
    """Relevance, update and `action_std_m` of our set-up or the paper's."""
    if name == "ours":
        return config.relevance, config.update, None
    return Relevance.RRF, UpdateRule.ADDITIVE_RELEVANCE, 0.7  # metres: the blur of the paper's reference figures


def train_setup(config: NbvConfig, name: str, map_build: Built, on_progress: Callable[[float], None]) -> Setup:
    """Let a map learn its Q-values under a set-up, by its name."""
    _, update, action_std_m = _setup(config, name)
    nnql = NnqlConfig(
        config.training_episodes, config.n_steps, update=update, motion_std_m=action_std_m, seed=config.seed
    )
    q_values, _ = train_nnql(
        map_build.rehearsal, map_build.map_drive, map_build.second, nnql, on_progress, available_cores()
    )
    return Setup(name, replace(map_build.map, q_values=q_values), update, action_std_m)


def drive_planner(
    config: NbvConfig,
    setup: Setup,
    planner: str,
    drive: TestDrive,
    starts: NDArray[np.int64],
    on_progress: Callable[[float], None],
) -> list[Episode]:
    """A planner's episodes, one from every start."""
    # Where a chooser that only an experiment has plans, the localizer's own planner is one that costs nothing.
    localizer_planner = planner if planner in {NNQL, DEFAULT_PLANNER} else f"{CONSTANT}:{config.actions_m[0]:g}"
    localizer = ActiveLocalizer(setup.map, LocalizerConfig(update=setup.update, planner=localizer_planner))
    # Of the paper's set-up only ranks are reported: additive updates hardly ever make a robot sure.
    runner = EpisodeRunner(localizer, drive, config.n_steps, setup.action_std_m, until_sure=setup.name == "ours")
    return _episodes(runner, starts, _chooser(planner, runner, config), planner == RANDOM, on_progress)


def planner_names(config: NbvConfig) -> list[str]:
    """The planners in the order in which they are driven."""
    constants = (f"{CONSTANT}_{action_m:g}" for action_m in config.actions_m)
    return [RANDOM, *constants, CLAIRVOYANT, NNQL, DEFAULT_PLANNER]


def _chooser(name: str, runner: EpisodeRunner, config: NbvConfig) -> Chooser:
    actions_m = np.array(config.actions_m)
    if name == RANDOM:
        return random_chooser(actions_m, config.seed)
    if name == CLAIRVOYANT:
        return clairvoyant_chooser(runner, actions_m)
    if name in {NNQL, DEFAULT_PLANNER}:
        return follow_plan
    action_m = float(name.removeprefix(f"{CONSTANT}_"))
    return lambda *_: action_m


def _episodes(
    runner: EpisodeRunner, starts: NDArray[np.int64], choose: Chooser, draws: bool, on_progress: Callable[[float], None]
) -> list[Episode]:
    """Every start's episode; where nothing is drawn, equal starts have equal episodes and are run once."""
    episode_by_start: dict[int, Episode] = {}
    episodes = []
    for number, start in enumerate(starts.tolist()):
        if draws or start not in episode_by_start:
            episode_by_start[start] = runner.run(number, start, choose)
        episodes.append(episode_by_start[start])
        on_progress((number + 1) / starts.size)
    return episodes


def _at_distances(shares: NDArray[np.float64], travelled_m: NDArray[np.float64]) -> dict[str, float | None]:
    """ANR of the last view within each distance, over the episodes that went so far."""
    anr: dict[str, float | None] = {}
    for distance_m in DISTANCES_M:
        n_within = (travelled_m <= distance_m + 1e-9).sum(axis=1)
        is_reached = (travelled_m[:, -1] >= distance_m - 1e-9) & (n_within > 0)
        last_shares = shares[np.arange(len(shares)), np.maximum(n_within - 1, 0)]
        anr[f"{distance_m:g}"] = float(last_shares[is_reached].mean()) if is_reached.any() else None
    return anr
