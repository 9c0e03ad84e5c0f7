"""How far a belief can be trusted, measured on one landmark-training-test triplet with the localizer that ships.

Robots drive along the test traverse, look from the frame nearest to where they are, and report how far they moved.
After every view the belief is held against the truth, which is the map image nearest to the frame.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.belief.particles import BeliefFilter, FilterKind
from deepsimbad.core.belief.summary import CONFIDENT_WITHIN_M, DEFAULT_CONFIDENCE, near_mode
from deepsimbad.core.building import Built, MapPlan
from deepsimbad.core.drive import Drive, SameRoute
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.errors import InvalidMapConfigError, PastTheEndError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.jobs.build import build, measure_drive, views_of
from deepsimbad.jobs.experiments.nbv import TestDrive
from deepsimbad.jobs.experiments.truth import nearest_images
from deepsimbad.jobs.fitting import Fitter, Pictures
from deepsimbad.jobs.progress import Progress

VIEWS = (1, 2, 3, 5, 10)  # after which coverage is reported
_MOVING = {f"moves of {action_m} m": float(action_m) for action_m in (1, 3, 5, 10)}  # metres a move, by stage
_N_MOVES = 10
_MOVE_M = 5.0  # of robots that are tracked, carried, off the route, or misjudge their moves
_TRACKED_MOVES = 10  # before a robot stands, or is carried
_STANDING_VIEWS = 150
_CARRIED_M = 100.0  # how far a robot is carried at least
_SEARCHING_VIEWS = 30  # of a robot that was carried
_ODOMETRY = {f"odometry times {factor}": factor for factor in (0.9, 1.1)}  # metres reported a metre driven
_BESIDE_M = 10.0  # behind the mapped half's end, where another stretch begins
_STRETCHES = ("off the route", "on the route")
_N_BINS = 10
LEAST_M = 250.0  # of test traverse


@dataclass(frozen=True)
class CalibrationConfig:
    """What is measured, and on how many robots; those that only move start at every frame."""

    n_landmarks: int = 300  # r
    list_length: int = 4  # h
    relevance: Relevance = DEFAULT_RELEVANCE
    filter: FilterKind = FilterKind.GRID
    standing: int = 20  # robots that stand, from an unknown start and tracked alike
    carried: int = 60  # robots that are carried; as many are off the route, and on it
    seed: int = 0  # of their starts, and of particles
    # Whether positions of landmark and training traverse are comparable; None: where both know x, y
    same_route: bool | None = True


class Sight(NamedTuple):
    """A belief after a view against the truth; or of many, each field an array [robots, views]."""

    is_covered: Any  # whether the smallest set of map images that holds 95 % holds the true one
    set_m: Any  # metres of route that this set takes
    near_mode: Any  # probability that the robot is within 5 m of the mode
    is_near: Any  # whether the mode is within 5 m of the truth
    off_route: Any  # probability of being lost
    is_refused: Any  # whether the move led past the end, so that the belief stayed as it was


@dataclass(frozen=True)
class CalibrationReport:
    """What every robot believed."""

    config: CalibrationConfig
    sights: dict[str, Sight]  # by stage of `calibration_stages`
    same_route: SameRoute | None = None  # whether the landmark traverse drove the mapped route

    def as_dict(self, sources: dict[str, Any]) -> dict[str, Any]:
        """The flat JSON document; shares in percent."""
        moving_sights = {f"{action_m:g}": self.sights[stage] for stage, action_m in _MOVING.items()}
        odometry_sights = {f"{factor:g}": self.sights[stage] for stage, factor in _ODOMETRY.items()}
        is_standing_covered, tracked_sight = self.sights["standing"].is_covered, self.sights["tracked, then standing"]
        is_tracked_covered = tracked_sight.is_covered[:, -_STANDING_VIEWS:]
        has_stayed = tracked_sight.is_near[tracked_sight.is_near[:, _TRACKED_MOVES] == 1, -1]
        n_views = views_until_found(self.sights["carried"].is_near[:, -_SEARCHING_VIEWS:])
        return {
            "coverage_95": {
                a: {str(v): _percent(s.is_covered[:, v - 1]) for v in VIEWS} for a, s in moving_sights.items()
            },
            "set_m": {a: {str(v): float(s.set_m[:, v - 1].mean()) for v in VIEWS} for a, s in moving_sights.items()},
            "reliability": reliability(list(moving_sights.values())),
            "wrong_when_confident": {move: wrong_when_confident(sight) for move, sight in moving_sights.items()},
            "standing_coverage_95": {"unknown": _percent(is_standing_covered), "tracked": _percent(is_tracked_covered)},
            "lost_their_place": _percent(1 - has_stayed),
            "carried": {"views_median": float(np.median(n_views)), "views_95": float(np.quantile(n_views, 0.95))},
            "off_route": {stage: _percent(self.sights[stage].off_route[:, -1]) for stage in _STRETCHES},
            "odometry_coverage_95": {factor: _percent(sight.is_covered) for factor, sight in odometry_sights.items()},
            "odometry_within_5_m": {factor: _percent(sight.is_near) for factor, sight in odometry_sights.items()},
            "views_refused": {stage: int(sight.is_refused.sum()) for stage, sight in self.sights.items()},
            "second_season": None if self.same_route is None else self.same_route.as_dict(),
            "config": {**asdict(self.config), **sources},
        }


def _percent(shares: NDArray[Any]) -> float | None:
    return float(100 * shares.mean()) if shares.size else None


def reliability(sights: Sequence[Sight]) -> dict[str, list[Any]]:
    """How often the mode was within 5 m of the truth, by ten equal bins of the probability that the belief gave it."""
    probability, is_near = (
        np.concatenate([getattr(sight, part).ravel() for sight in sights]) for part in ("near_mode", "is_near")
    )
    bins = np.minimum((probability * _N_BINS).astype(int), _N_BINS - 1)
    members = [bins == number for number in range(_N_BINS)]
    return {
        "n_views": [int(member.sum()) for member in members],
        "near_mode": [_percent(probability[member]) for member in members],
        "within_5_m": [_percent(is_near[member]) for member in members],
    }


def wrong_when_confident(sight: Sight) -> float:
    """Percent of robots that were more than 5 m off when they first were sure."""
    is_sure = sight.near_mode >= DEFAULT_CONFIDENCE
    first_view = np.arange(len(is_sure)), is_sure.argmax(axis=1)
    return 100 * float((is_sure[first_view] & (sight.is_near[first_view] == 0)).mean())


def views_until_found(is_near: NDArray[np.float64]) -> NDArray[np.int64]:
    """[robots] views until the mode is within 5 m of the truth; where it never is, one more than there are."""
    return np.asarray(np.where(is_near.any(axis=1), is_near.argmax(axis=1) + 1, is_near.shape[1] + 1), np.int64)


def smallest_set(mass: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[n] whether an image is in the smallest set that holds 95 % of the mass; all that tie with its last are."""
    masses = np.sort(mass)[::-1]
    n_before = (np.cumsum(masses, dtype=np.float64) < 0.95 * (1 - 1e-6)).sum()
    return np.asarray(mass >= masses[n_before])


def calibration_stages() -> dict[str, float]:
    """The stages `run_calibration` reports, with their weights."""
    stages = dict.fromkeys(_MOVING, 8.0) | {"standing": 4.0, "tracked, then standing": 4.0, "carried": 3.0}
    return {"map": 8.0, **stages, **dict.fromkeys((*_ODOMETRY, *_STRETCHES), 2.0)}


def run_calibration(
    config: CalibrationConfig,
    evaluator: Evaluator,
    landmarks: Drive,
    training: Drive,
    test: Drive,
    progress: Progress,
    pictures: Pictures | None = None,
) -> CalibrationReport:
    """Map the training traverse, and drive robots along the test traverse.

    Args:
        pictures: Images of the landmark traverse, for evaluators that are fitted to them.

    Raises:
        InvalidMapConfigError: The test traverse is too short.
    """
    if (length_m := float(np.ptp(test.position_m))) < LEAST_M:
        raise InvalidMapConfigError(f"the test traverse is {length_m:g} m long; calibration takes {LEAST_M:g} m")
    fitter = Fitter(evaluator, pictures, config.seed)
    progress.stage("map")
    plan = MapPlan(config.relevance, config.list_length, tuple(_MOVING.values()), same_route=config.same_route)
    map_build = build(
        plan, training, landmarks, landmarks, config.n_landmarks, evaluator, progress.update, fitter=fitter
    )
    true_image = nearest_images(test, training)
    course, sights = _course(config, evaluator, map_build, test, true_image), {}
    for stage, (path_m, moved_m) in _paths(course).items():
        progress.stage(stage)
        sights[stage] = course.drive_robots(path_m, moved_m, progress.update)
    # A map of the first half alone, for robots on it and on the other
    middle_m = float(training.position_m[0] + training.position_m[-1]) / 2
    half_training = training.at(np.flatnonzero(training.position_m <= middle_m))
    half_landmarks = landmarks.at(np.flatnonzero((landmarks.position_m <= middle_m) | (config.same_route is False)))
    n_landmarks = min(config.n_landmarks, half_landmarks.n_frames)
    half_build = build(plan, half_training, half_landmarks, half_landmarks, n_landmarks, evaluator, fitter=fitter)
    at_m, ahead_m = training.position_m[true_image], _MOVE_M * np.arange(VIEWS[-1])
    for stage, is_there in zip(_STRETCHES, (at_m > middle_m + _BESIDE_M, at_m <= middle_m), strict=True):
        progress.stage(stage)
        stretch = test.at(np.flatnonzero(is_there))
        course = _course(config, evaluator, half_build, stretch, nearest_images(stretch, half_training))
        there_m = course.starts_m(ahead_m[-1], config.carried) + ahead_m
        sights[stage] = course.drive_robots(there_m, np.full(ahead_m.size, _MOVE_M), progress.update)
    return CalibrationReport(config, sights, map_build.same_route)


@dataclass(frozen=True)
class _Course:
    """Robots' localizer, and the drive that they follow."""

    localizer: ActiveLocalizer
    drive: TestDrive
    config: CalibrationConfig

    def starts_m(self, travel_m: float, count: int | None = None) -> NDArray[np.float64]:
        """[robots, 1] positions, as `TestDrive.starts`."""
        return self.drive.route.position_m[self.drive.starts(travel_m, count, self.config.seed)][:, np.newaxis]

    def drive_robots(
        self, path_m: NDArray[np.float64], moved_m: NDArray[np.float64], on_progress: Callable[[float], None]
    ) -> Sight:
        """Drive robots along true positions [robots, views], which report moves [views], the first of them unheeded."""
        sights = []
        for number, frames in enumerate(self.drive.route.nearest_image(path_m).tolist()):
            state, robot = self.localizer.start(), []
            for frame, action_m in zip(frames, moved_m.tolist(), strict=True):
                is_refused = False
                try:
                    state = self.localizer.observe(state, self.drive.views.at(frame), action_m).state
                except PastTheEndError:
                    is_refused = True
                robot.append(_sight(state.belief, int(self.drive.true_image[frame]), is_refused))
            sights.append(robot)
            on_progress((number + 1) / len(path_m))
        return Sight(*np.array(sights, np.float64).transpose(2, 0, 1))


def _course(
    config: CalibrationConfig, evaluator: Evaluator, map_build: Built, test: Drive, true_image: NDArray[np.int64]
) -> _Course:
    localizer_config = LocalizerConfig(filter=config.filter, seed=config.seed)
    views = views_of(measure_drive(test, map_build.map.landmark_model, evaluator))
    return _Course(ActiveLocalizer(map_build.map, localizer_config), TestDrive(views, test.route(), true_image), config)


def _sight(belief: BeliefFilter, truth: int, is_refused: bool) -> Sight:
    route, mass = belief.route, belief.mass
    mode, members = int(mass.argmax()), smallest_set(mass)
    off_m = abs(float(route.offset_m(route.position_m[[truth]], float(route.position_m[mode]))[0]))
    near_share = float(near_mode(route, mass, mode)[0]) * (1 - belief.doubt.off_route)
    set_m = float(route.cell_m[members].sum())
    return Sight(members[truth], set_m, near_share, off_m <= CONFIDENT_WITHIN_M, belief.doubt.off_route, is_refused)


def _paths(course: _Course) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """True positions [robots, views] and reported moves [views], by stage."""
    config, paths = course.config, {}
    for stage, action_m in _MOVING.items():
        ahead_m = action_m * np.arange(_N_MOVES + 1)
        paths[stage] = course.starts_m(ahead_m[-1]) + ahead_m, np.full(ahead_m.size, action_m)
    still_m = np.zeros(_STANDING_VIEWS)
    paths["standing"] = course.starts_m(0, config.standing) + still_m, still_m
    tracked_m = _MOVE_M * np.arange(_TRACKED_MOVES + 1)
    stopping_m = np.r_[tracked_m, tracked_m[-1] + still_m]
    from_m = course.starts_m(tracked_m[-1], config.standing)
    paths["tracked, then standing"] = from_m + stopping_m, np.diff(stopping_m, prepend=0.0)

    searching_m = _MOVE_M * np.arange(_SEARCHING_VIEWS)
    rng, n_drawn = np.random.default_rng(config.seed), 10 * config.carried  # of which most are far enough apart
    from_m = rng.choice(course.starts_m(tracked_m[-1]), n_drawn)
    to_m = rng.choice(course.starts_m(searching_m[-1]), n_drawn)
    path_m = np.concatenate([from_m + tracked_m, to_m + searching_m], axis=1)
    path_m = path_m[np.abs(to_m - from_m - tracked_m[-1])[:, 0] >= _CARRIED_M][: config.carried]
    paths["carried"] = path_m, np.full(path_m.shape[1], _MOVE_M)
    at_m = course.drive.route.position_m
    path_m = np.arange(at_m[0], at_m[-1] - _MOVE_M + 1.0, _MOVE_M) + np.arange(_MOVE_M)[:, np.newaxis]
    for stage, factor in _ODOMETRY.items():
        paths[stage] = path_m, np.full(path_m.shape[1], factor * _MOVE_M)
    return paths
