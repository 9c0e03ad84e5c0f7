"""The paper's experiments on one landmark-training-test triplet: single views (III, Fig. 6) and active ones (Fig. 7).

The first compares every relevance, the second every planner from the same starts, ours beside the paper's.
"""

import pickle
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.building import Built, MapPlan
from deepsimbad.core.composed import unit_encodings
from deepsimbad.core.drive import Drive, SameRoute
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.map import Map
from deepsimbad.core.metrics import RetrievalScorer, RetrievalScores, mean_interval
from deepsimbad.core.nnql import NnqlConfig
from deepsimbad.core.planners import CONSTANT, DEFAULT_PLANNER, NNQL, RANDOM
from deepsimbad.core.relevance import (
    DEFAULT_RELEVANCE,
    DEFAULT_UPDATE,
    LiveStatistics,
    Query,
    Relevance,
    UpdateRule,
    worth_of_move,
)
from deepsimbad.core.retrieval import relevances
from deepsimbad.core.route import same_places
from deepsimbad.errors import InvalidMapConfigError, InvalidSourceError
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.evaluators.compute import available_cores
from deepsimbad.jobs.build import EncodedRecording, build, measured, train_nnql, views_of
from deepsimbad.jobs.episodes import (
    Chooser,
    Episode,
    EpisodeRunner,
    TestDrive,
    clairvoyant_chooser,
    follow_plan,
    random_chooser,
)
from deepsimbad.jobs.progress import Progress
from deepsimbad.store.arrays import is_halvable
from deepsimbad.store.map_file import index_bytes, seal, write_map

_QUERIES_A_BLOCK = 64  # of brute force: large enough for a matrix product, small enough for memory
CLAIRVOYANT = "clairvoyant"
BRUTE_FORCE_U = "brute_force_u"  # all of the unit vectors that composed lists stand for: the most they could tell
BLOCK_M = 20.0  # starts nearer together have much the same episode
DISTANCES_M = (10.0, 20.0, 50.0)


@dataclass(frozen=True)
class VprConfig:
    """What is compared, and how it is scored."""

    n_landmarks: int = 300
    list_length: int = 4
    tolerance_m: float = 2.0  # how far from the query a map image may be and still be true
    relevances: tuple[Relevance, ...] = tuple(Relevance)  # which to compare, in the order of the report
    seed: int = 0  # kept with the result; nothing here is random
    stateless: bool = False  # every view by itself, by the map's statistics, in place of one session in order
    # Whether positions of landmark and training traverse are comparable; None: where both know x, y
    same_route: bool | None = True


@dataclass(frozen=True)
class VprReport:
    """Scores by relevance, and what they cost."""

    config: VprConfig
    scores: dict[str, RetrievalScores]  # by relevance; and of what rivals it
    # Size on disk of the posting tables, of the map for the relevance that ships (or of the first asked for)
    index_bits_per_map_image: float
    seconds: dict[str, float]  # by stage
    same_route: SameRoute | None  # whether the landmark traverse drove the mapped route; None: there is none
    encoding_dim: int  # d
    bytes_per_encoding: int  # of one frame in a traverse's file, places apart
    encode_ms: float | None  # median from reading an image to its encoding; None where encodings came ready

    def as_dict(self, sources: dict[str, Any]) -> dict[str, Any]:
        """The stable flat JSON document of design section 7."""
        first = next(iter(self.scores.values()))
        return {
            "anr": {name: score.anr for name, score in self.scores.items()},
            "recall_at_1": {name: score.recall_at[1] for name, score in self.scores.items()},
            "recall_at_5": {name: score.recall_at[5] for name, score in self.scores.items()},
            "default": DEFAULT_RELEVANCE.value,
            "n_queries": first.n_queries,
            "n_left_out": first.n_left_out,
            "index_bits_per_map_image": self.index_bits_per_map_image,
            "second_season": None if self.same_route is None else self.same_route.as_dict(),
            "encoding_dim": self.encoding_dim,
            "bytes_per_encoding": self.bytes_per_encoding,
            "encode_ms": self.encode_ms,
            "config": {**asdict(self.config), **sources},
            "seconds": self.seconds,
        }


def vpr_stages(config: VprConfig) -> dict[str, float]:
    """The stages `run_vpr` reports, with their weights."""
    return {"describe": 3.0} | {
        f"query by {name.value}": 3.0 if name is Relevance.BRUTE_FORCE else 1.0 for name in config.relevances
    }


def run_vpr(
    config: VprConfig,
    evaluator: Evaluator,
    landmarks: Drive | None,
    training: Drive,
    test: EncodedRecording,
    true_images: Sequence[NDArray[np.int64]],
    progress: Progress,
) -> VprReport:
    """Choose landmarks, map the training traverse, query every test frame in order as one passive session.

    Args:
        landmarks: The landmark traverse; where it drove the mapped route, maps learn from it. None: the training one.
        true_images: For every test frame the map images that count as true.
    """
    progress.stage("describe")
    scores: dict[str, RetrievalScores] = {}
    built: dict[Relevance, Built] = {}
    model: LandmarkModel | None = None
    for number, name in enumerate(config.relevances):
        plan = MapPlan(name, config.list_length, (1.0,), same_route=config.same_route)
        chosen = landmarks if name is Relevance.COMPOSED or model is None else model
        built[name] = build(plan, training, landmarks, chosen, config.n_landmarks, evaluator)
        if name is not Relevance.COMPOSED:
            model = built[name].map.landmark_model
        progress.update((number + 1) / len(config.relevances))
    for name in config.relevances:
        progress.stage(f"query by {name.value}")
        views = views_of(measured(test.drive, built[name].map.landmark_model, evaluator))
        live = None if config.stateless else built[name].map.live_statistics
        worth = _worth_of_views(test.drive)
        scores[name.value] = _score(built[name].map, views, true_images, live, worth, progress.update)
        if name is Relevance.COMPOSED:
            scores[BRUTE_FORCE_U] = _score_by_all(built[name], test.drive, true_images, config.stateless)
    stages = {stage.replace(" ", "_") for stage in vpr_stages(config)}
    seconds = {stage: took for stage, took in progress.seconds().items() if stage in stages}
    sized = built.get(DEFAULT_RELEVANCE, built[config.relevances[0]])
    return VprReport(
        config,
        scores,
        _bits_per_map_image(sized.map),
        seconds,
        sized.same_route,
        encoding_dim=test.drive.encoding_dim,
        bytes_per_encoding=test.drive.encoding_dim * (2 if is_halvable(test.drive.encodings) else 4),
        encode_ms=test.encode_ms,
    )


def _bits_per_map_image(map_: Map) -> float:
    """Write the map to a file, as a remap would, and count the pages of its posting tables."""
    with tempfile.TemporaryDirectory() as folder:
        building, sealed = Path(folder) / "1.building", Path(folder) / "1.sqlite"
        write_map(building, map_)
        seal(building, sealed)
        return 8 * index_bytes(sealed) / map_.n_images


def _worth_of_views(drive: Drive) -> list[float]:
    """What each view of a drive counts for among what is usual: as much as a session's view after that move."""
    return [1.0, *(worth_of_move(move_m) for move_m in np.diff(drive.position_m).tolist())]


def _score(
    map_: Map,
    views: Query,
    true_images: Sequence[NDArray[np.int64]],
    live: LiveStatistics | None,
    worth: Sequence[float],
    on_progress: Callable[[float], None],
) -> RetrievalScores:
    scorer = RetrievalScorer()
    # Without a session's statistics every view is compared by itself; many at once are one matrix product.
    size = _QUERIES_A_BLOCK if map_.relevance is Relevance.BRUTE_FORCE else 1
    for first in range(0, len(true_images), size):
        asked = views.at(slice(first, first + size))
        if size == 1:
            asked = views.at(first)
        live = live.observing(asked, worth[first]) if live else None
        rows = np.atleast_2d(relevances(map_, asked, live))
        for row, truth in zip(rows, true_images[first : first + size], strict=True):
            scorer.add(row, truth)
        on_progress(min(1.0, (first + size) / len(true_images)))
    return scorer.result()


def _score_by_all(
    built: Built, test: Drive, true_images: Sequence[NDArray[np.int64]], stateless: bool
) -> RetrievalScores:
    """What the lists stand for, compared whole: the same unit vectors, and nothing left out."""
    scorer, usual = RetrievalScorer(), built.map.live_statistics
    if built.places is None or usual is None or usual.encodings is None:
        raise InvalidMapConfigError("only a composed map has unit vectors")
    encodings, projection = usual.encodings, built.map.landmark_model.get("projection")
    for encoding, truth, worth in zip(test.encodings, true_images, _worth_of_views(test), strict=True):
        encodings = encodings if stateless else encodings.observing(encoding, worth)
        scorer.add(built.places @ unit_encodings(encoding, encodings, projection), truth)
    return scorer.result()


@dataclass(frozen=True)
class NbvConfig:
    """What is compared."""

    n_landmarks: int = 300  # r
    list_length: int = 4  # h
    relevance: Relevance = DEFAULT_RELEVANCE  # of our set-up, as update; the paper's is measured beside it
    update: UpdateRule = DEFAULT_UPDATE[DEFAULT_RELEVANCE]
    actions_m: tuple[float, ...] = tuple(float(metres) for metres in range(1, 11))  # the moves
    n_steps: int = 10  # moves an episode
    training_episodes: int = 10_000  # of NNQL
    episodes: int | None = None  # test episodes of every planner; None: one from every start
    seed: int = 0  # of starts, random moves and training
    # Whether positions of landmark and training traverse are comparable; None: where both know x, y
    same_route: bool | None = True


@dataclass(frozen=True)
class NbvReport:
    """What every planner scored."""

    config: NbvConfig
    ours: dict[str, list[Episode]]  # by planner, under our set-up
    paper: dict[str, list[Episode]]  # and under the paper's
    block: NDArray[np.int64]  # [episodes] the stretch of 20 m that each began in
    same_route: SameRoute | None = None  # whether the landmark traverse drove the mapped route; None: nobody looked

    @property
    def best_constant(self) -> str:
        """The constant move that took the fewest views, known only afterwards."""
        constants = [name for name in self.ours if name.startswith(CONSTANT)]
        return min(constants, key=lambda name: float(self._each(name, "views").mean()))

    def as_dict(self, sources: dict[str, Any]) -> dict[str, Any]:
        """The stable flat JSON document of design section 7; percent."""
        shares = {name: 100 * self._each(name, "rank_share") for name in self.ours}
        by_episode = {name: rows.mean(axis=1) for name, rows in shares.items()}
        views, metres = ({name: self._each(name, part) for name in self.ours} for part in ("views", "metres"))
        wrong = {name: 100 * self._each(name, "is_wrong") for name in self.ours}
        rivals = (RANDOM, self.best_constant)
        return {
            "anr": _means(by_episode),
            "default": DEFAULT_PLANNER,
            "anr_paper": {
                name: float(100 * _stack(episodes, "rank_share").mean()) for name, episodes in self.paper.items()
            },
            "interval_95": self._intervals(by_episode),
            "difference_95": self._differences(by_episode, rivals),
            "views_to_confident": {**_means(views), "interval_95": self._intervals(views)},
            "metres_to_confident": {**_means(metres), "interval_95": self._intervals(metres)},
            "wrong_when_confident": {**_means(wrong), "interval_95": self._intervals(wrong)},
            "views_difference_95": self._differences(views, rivals),
            "best_constant": self.best_constant,
            "anr_by_step": {name: rows.mean(axis=0).tolist() for name, rows in shares.items()},
            "anr_at_distance_m": {
                name: _at_distances(rows, self._each(name, "travelled_m")) for name, rows in shares.items()
            },
            "n_episodes": len(self.block),
            "second_season": None if self.same_route is None else self.same_route.as_dict(),
            "config": {**asdict(self.config), **sources},
        }

    def _each(self, planner: str, part: str) -> NDArray[np.float64]:
        return _stack(self.ours[planner], part)

    def _intervals(self, values: Mapping[str, NDArray[np.float64]]) -> dict[str, list[float]]:
        return {name: list(mean_interval(rows, self.config.seed, self.block)) for name, rows in values.items()}

    def _differences(self, values: Mapping[str, NDArray[np.float64]], rivals: Sequence[str]) -> dict[str, list[float]]:
        """Of the default planner's values and its rivals', episode by episode."""
        apart = {f"{DEFAULT_PLANNER} - {rival}": values[DEFAULT_PLANNER] - values[rival] for rival in rivals}
        return self._intervals(apart)


def _stack(episodes: Sequence[Episode], part: str) -> NDArray[np.float64]:
    return np.array([getattr(episode, part) for episode in episodes], np.float64)


def _means(values: Mapping[str, NDArray[np.float64]]) -> dict[str, float]:
    return {name: float(rows.mean()) for name, rows in values.items()}


def nbv_stages(config: NbvConfig) -> dict[str, float]:
    """The stages `run_nbv` reports, with their weights."""
    stages: dict[str, float] = {}
    for setup in ("ours", "paper"):
        stages |= {f"map ({setup})": 1.0, f"train ({setup})": 4.0}
        stages |= {f"{name} ({setup})": 4.0 if name in {RANDOM, CLAIRVOYANT} else 1.0 for name in _names(config)}
    return stages


def run_nbv(
    config: NbvConfig, evaluator: Evaluator, landmarks: Drive, training: Drive, test: Drive, progress: Progress
) -> NbvReport:
    """Map, train, and drive every planner's episodes.

    Raises:
        InvalidMapConfigError: The test traverse is shorter than an episode.
    """
    route, true_image = test.route(), nearest_images(test, training)
    travel_m = config.n_steps * max(config.actions_m)
    starts = TestDrive(Query.uninformative(1), route, true_image).starts(travel_m, config.episodes, config.seed)
    if starts.size == 0:
        raise InvalidMapConfigError(f"the test traverse is shorter than an episode of {travel_m:g} m")

    setups = (
        ("ours", config.relevance, config.update, None),
        # With the blur that the reference figures of the paper's set-up have, metres.
        ("paper", Relevance.RRF, UpdateRule.ADDITIVE_RELEVANCE, 0.7),
    )
    results: dict[str, dict[str, list[Episode]]] = {}
    same_route = None
    for setup, relevance, update, action_std_m in setups:
        progress.stage(f"map ({setup})")
        plan = MapPlan(relevance, config.list_length, config.actions_m, same_route=config.same_route)
        built = build(plan, training, landmarks, landmarks, config.n_landmarks, evaluator, progress.update)
        drive = TestDrive(views_of(measured(test, built.map.landmark_model, evaluator)), route, true_image)
        same_route = built.same_route
        progress.stage(f"train ({setup})")
        nnql = NnqlConfig(
            config.training_episodes, config.n_steps, update=update, motion_std_m=action_std_m, seed=config.seed
        )
        q_values, _ = train_nnql(built.rehearsal, built.own, built.second, nnql, progress.update, available_cores())
        map_ = replace(built.map, q_values=q_values)
        results[setup] = {}
        for name in _names(config):
            progress.stage(f"{name} ({setup})")
            # The localizer plans by itself alone; what only an experiment has is a chooser, and planning costs nothing.
            planner = name if name in {NNQL, DEFAULT_PLANNER} else f"{CONSTANT}:{config.actions_m[0]:g}"
            localizer = ActiveLocalizer(map_, LocalizerConfig(update=update, planner=planner))
            runner = EpisodeRunner(localizer, drive, config.n_steps, action_std_m)
            chooser = _chooser(name, runner, config)
            results[setup][name] = _episodes(runner, starts, chooser, name == RANDOM, progress.update)
    block = (route.position_m[starts] // BLOCK_M).astype(np.int64)
    return NbvReport(config, results["ours"], results["paper"], block, same_route)


def _names(config: NbvConfig) -> list[str]:
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
    runner: EpisodeRunner,
    starts: NDArray[np.int64],
    choose: Chooser,
    draws: bool,
    on_progress: Callable[[float], None],
) -> list[Episode]:
    """Every start's episode; where nothing is drawn, equal starts have equal episodes and are run once."""
    driven: dict[int, Episode] = {}
    episodes = []
    for number, start in enumerate(starts.tolist()):
        if draws or start not in driven:
            driven[start] = runner.run(number, start, choose)
        episodes.append(driven[start])
        on_progress((number + 1) / starts.size)
    return episodes


def nearest_images(test: Drive, training: Drive) -> NDArray[np.int64]:
    """[m] the map image nearest to every test frame: in the plane where both know it, else along the route."""
    route = training.route()
    nearest = route.nearest_image(test.position_m).astype(np.int64)
    pairs = same_places(test.route(), route, tolerance_m=np.inf)
    nearest[pairs[:, 1]] = pairs[:, 0]
    return nearest


def _at_distances(shares: NDArray[np.float64], travelled_m: NDArray[np.float64]) -> dict[str, float | None]:
    """ANR of the last view within each distance, over the episodes that went so far."""
    anr: dict[str, float | None] = {}
    for distance_m in DISTANCES_M:
        n_within = (travelled_m <= distance_m + 1e-9).sum(axis=1)
        reached = (travelled_m[:, -1] >= distance_m - 1e-9) & (n_within > 0)
        last = shares[np.arange(len(shares)), np.maximum(n_within - 1, 0)]
        anr[f"{distance_m:g}"] = float(last[reached].mean()) if reached.any() else None
    return anr


class _ArraysOnly(pickle.Unpickler):
    """Unpickles arrays and lists of numbers; a file that names anything else runs nothing."""

    HARMLESS = frozenset({"numpy ndarray", "numpy dtype"}) | {
        f"numpy.{core}.multiarray {name}" for core in ("core", "_core") for name in ("_reconstruct", "scalar")
    }

    def find_class(self, module: str, name: str) -> Any:
        if f"{module} {name}" not in self.HARMLESS:
            raise pickle.UnpicklingError(f"it names {module}.{name}")
        return super().find_class(module, name)


def read_ground_truth(
    path: Path, test_index: NDArray[np.int64], training_index: NDArray[np.int64]
) -> list[NDArray[np.int64]]:
    """Read a `.npy` of accepted matches.

    Args:
        path: An array [q, 2] whose rows are (test frame, list of training frames), as VPR-Bench writes it; or [q]
            of lists, or [q, k] of numbers padded with -1, in test frame order.
        test_index: [m] places of the test frames in their recording.
        training_index: [n] the same of the training frames.

    Returns:
        For every test frame the map images, as places among the training frames; empty where none is accepted.

    Raises:
        InvalidSourceError: Not such a file.
    """
    rows = _load(path)
    try:
        if rows.dtype == object and rows.ndim == 2 and rows.shape[1] == 2:
            accepted = {int(query): [int(t) for t in np.atleast_1d(truth)] for query, truth in rows}
        else:
            accepted = {query: [int(t) for t in np.atleast_1d(truth)] for query, truth in enumerate(rows)}
    except (TypeError, ValueError) as error:
        raise InvalidSourceError(f"{path} holds no lists of frame numbers: {error}") from error
    place_of = {int(index): place for place, index in enumerate(training_index)}
    return [
        np.array(sorted(place_of[t] for t in accepted.get(int(index), ()) if t in place_of), np.int64)
        for index in test_index
    ]


def _load(path: Path) -> NDArray[Any]:
    try:
        with path.open("rb") as file:
            major, _ = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
            _, _, dtype = header(file)
            if dtype.hasobject:
                return np.asarray(_ArraysOnly(file).load())
            file.seek(0)
            return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
    except OSError as error:
        raise InvalidSourceError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, EOFError, pickle.UnpicklingError, AttributeError, IndexError) as error:
        raise InvalidSourceError(f"{path} is no ground truth file: {error}") from error
