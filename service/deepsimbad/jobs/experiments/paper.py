"""Section III of the paper: eight landmark-training-test triplets of four drives, Fig. 6, Fig. 7, sizes and times.

Every figure comes from the functions that `experiment vpr` and `experiment nbv` are made of. Triplets with the same
landmark and training drive share their maps. What was measured is kept, so that a run that was stopped goes on.
"""

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.building import Built
from deepsimbad.core.drive import Drive
from deepsimbad.core.landmark_model import fitting_number
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.planners import DEFAULT_PLANNER, NNQL
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.core.route import true_images_of
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.jobs.build import measure_drive, views_of
from deepsimbad.jobs.experiments.cache import ResultCache, code_digest, drive_digest
from deepsimbad.jobs.experiments.nbv import (
    BLOCK_M,
    CLAIRVOYANT,
    Episode,
    NbvConfig,
    NbvReport,
    Setup,
    TestDrive,
    drive_planner,
    planner_names,
    starts_of,
    train_setup,
)
from deepsimbad.jobs.experiments.truth import nearest_images
from deepsimbad.jobs.experiments.vpr import (
    RANKS,
    DriveViews,
    VprConfig,
    bits_per_map_image,
    build_maps,
    relisted_map,
    score_maps,
    vpr_stages,
)
from deepsimbad.jobs.fitting import Fitter, Pictures
from deepsimbad.jobs.progress import Progress, Shares, in_threads

SEASONS = {"WI": "2012-01-22", "SP": "2012-03-31", "SU": "2012-08-04", "AU": "2012-11-17"}
TRIPLETS = tuple(
    (triplet[:2], triplet[3:5], triplet[6:])
    for triplet in "WI-SP-SU WI-SP-AU SP-SU-AU SP-SU-WI SU-AU-WI SU-AU-SP AU-WI-SP AU-WI-SU".split()  # noqa: SIM905
)  # landmark, training, test
LIST_LENGTHS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 500)
SETUPS = {"paper": Relevance.RRF, "ours": DEFAULT_RELEVANCE}
_TIMED_VIEWS = 200
Document: TypeAlias = dict[str, Any]  # JSON-ready
Triplet: TypeAlias = tuple[str, str, str]  # landmark, training, test


@dataclass(frozen=True)
class PaperConfig:
    """What is measured."""

    n_landmarks: int = 500  # r
    list_length: int = 4  # h, of everything but the curves over h
    list_lengths: tuple[int, ...] = LIST_LENGTHS
    tolerances_m: tuple[float, ...] = (2.0, 5.0, 10.0, 25.0)  # that matches are true within; the first is that of ANR
    training_episodes: int = 10_000
    episodes: int = 150  # test episodes of every planner
    seed: int = 0

    def vpr(self, relevances: tuple[Relevance, ...] = tuple(Relevance)) -> VprConfig:
        """The configuration of `experiment vpr`."""
        return VprConfig(self.n_landmarks, self.list_length, self.tolerances_m[0], relevances, self.seed)

    def nbv(self) -> NbvConfig:
        """The configuration of `experiment nbv`."""
        return NbvConfig(
            n_landmarks=self.n_landmarks,
            list_length=self.list_length,
            training_episodes=self.training_episodes,
            episodes=self.episodes,
            seed=self.seed,
        )

    def limited_to(self, n_candidates: int) -> "PaperConfig":
        """The configuration for a landmark drive of `n_candidates` frames, where those are fewer than its landmarks."""
        r = fitting_number(None, n_candidates, self.n_landmarks)
        lengths = tuple(h for h in self.list_lengths if h <= r)
        return replace(self, n_landmarks=r, list_length=min(self.list_length, r), list_lengths=lengths)


def pieces(config: PaperConfig, triplets: Sequence[Triplet], n_frames: Mapping[str, int]) -> dict[str, float]:
    """What is to be measured of triplets with the same maps -> the seconds that it may take on one core."""
    weights: dict[str, float] = {}
    config, n_map = config.limited_to(n_frames[triplets[0][0]]), n_frames[triplets[0][1]]
    for number, triplet in enumerate(triplets):
        n = n_frames[triplet[2]]
        for h in config.list_lengths:
            listing_s = 3e-8 * n_map * config.n_landmarks * h if number == 0 else 0.0
            weights[_piece(triplet, h)] = listing_s + n * (2e-3 + n_map * h * 6e-9)
        weights[_piece(triplet)] = (0 if number else 20) + 26 * config.episodes * (2e-3 + 4e-6 * n_map)
    return weights


class Pair:
    """A landmark and a training drive, the maps made of them, and what is measured on those.

    Args:
        triplets: The triplets of the pair.
        drives: Drives by season, as `digests` and `pictures`.
    """

    def __init__(
        self,
        config: PaperConfig,
        evaluator: Evaluator,
        triplets: Sequence[Triplet],
        drives: Mapping[str, Drive],
        digests: Mapping[str, str],
        pictures: Mapping[str, Pictures],
    ) -> None:
        self._landmarks, self._training = (drives[season] for season in triplets[0][:2])
        self._config = config.limited_to(self._landmarks.n_frames)
        self._evaluator, self._triplets, self._drives, self._digests = evaluator, triplets, drives, digests
        self._pictures = pictures.get(triplets[0][0])
        self._setups: dict[str, Setup] = {}
        self._relisted_builds: dict[int, dict[Relevance, Built]] = {}  # the maps of the list length under way
        self._views = {triplet[2]: DriveViews(drives[triplet[2]], evaluator) for triplet in triplets}

    def measure(self, cache: ResultCache, shares: Shares) -> dict[str, Document]:
        """Measure everything that the cache does not hold; answers all by triplet."""
        config, results = self._config, {"-".join(triplet): dict[str, Any]() for triplet in self._triplets}

        def keep(piece: str, triplet: Triplet, make: Callable[..., Document], **ingredients: Any) -> Document:
            digests, report = [self._digests[season] for season in triplet], shares.report(piece)
            result = cache.get(piece.replace(" ", "-"), partial(make, triplet, report), drives=digests, **ingredients)
            report(1.0)
            return result

        vpr = {"config": asdict(config.vpr()), "tolerances_m": config.tolerances_m}
        for h in sorted(config.list_lengths, key=lambda h: h != config.list_length):
            for triplet in self._triplets:
                make = partial(self._single_views, h)
                result = keep(_piece(triplet, h), triplet, make, **vpr, list_length=h)
                results["-".join(triplet)][str(h)] = result
            self._relisted_builds.clear()
        for triplet in self._triplets:
            result = keep(_piece(triplet), triplet, self._moves, config=asdict(config.nbv()))
            results["-".join(triplet)]["active"] = result
        return results

    @cached_property
    def _map_builds(self) -> dict[Relevance, Built]:
        """Maps by relevance, of the one list length that everything is measured at."""
        fitter = Fitter(self._evaluator, self._pictures, self._config.seed)
        return build_maps(self._config.vpr(), fitter, self._evaluator, self._landmarks, self._training)

    def _map_builds_at(self, list_length: int) -> dict[Relevance, Built]:
        if list_length == self._config.list_length:
            return self._map_builds
        if list_length not in self._relisted_builds:
            self._relisted_builds[list_length] = {
                name: replace(map_build, map=relisted_map(map_build, list_length))
                for name, map_build in self._map_builds.items()
                if name.traits.is_listed
            }
        return self._relisted_builds[list_length]

    def _single_views(self, list_length: int, triplet: Triplet, report: Callable[[float], None]) -> Document:
        """Fig. 6 of a triplet at one list length."""
        config, test = self._config, self._drives[triplet[2]]
        map_builds, is_main_length = self._map_builds_at(list_length), list_length == self._config.list_length
        vpr = config.vpr(tuple(map_builds))
        progress = Progress(vpr_stages(vpr), lambda state: report(state.progress))
        truths = [true_images_of(test.route(), self._training.route(), metres) for metres in config.tolerances_m]
        scores = score_maps(vpr, map_builds, self._views[triplet[2]], truths, progress, bound=is_main_length)
        tolerances = [f"{metres:g}" for metres in config.tolerances_m]
        is_scored = np.array([truth.size > 0 for truth in truths[0]])
        ranks = {name: 100 * score.normalised_ranks for name, score in scores[0].items()}
        same_route = map_builds[Relevance.COMPOSED].same_route
        anr_at, recall = dict[str, Document](), dict[str, Document]()
        for metres, named_scores in zip(tolerances, scores, strict=True):
            anr_at[metres] = {name: score.anr for name, score in named_scores.items()}
            recall[metres] = {name: {str(k): s.recall_at[k] for k in RANKS} for name, s in named_scores.items()}
        return {
            "anr": anr_at[tolerances[0]],
            "anr_at": anr_at,
            "recall": recall,
            "n_queries": int(is_scored.sum()),
            "n_left_out": int((~is_scored).sum()),
            "blocks": _by_block(ranks, (test.position_m[is_scored] // BLOCK_M).astype(np.int64)),
            "second_season": None if same_route is None else same_route.as_dict(),
            "index_bits": {
                name.value: bits_per_map_image(map_build.map)
                for name, map_build in map_builds.items()
                if is_main_length and name.traits.is_listed
            },
        }

    def _moves(self, triplet: Triplet, report: Callable[[float], None]) -> Document:
        """Fig. 7 of a triplet, under the paper's set-up and ours."""
        config, test = self._config.nbv(), self._drives[triplet[2]]
        starts = starts_of(config, test)
        names = [name for name in planner_names(config) if name != CLAIRVOYANT]
        episodes: dict[str, dict[str, list[Episode]]] = {}
        timings_ms = {}

        def by_planner(setup: str, figure: Callable[[list[Episode]], Any]) -> Document:
            return {name: figure(planner_episodes) for name, planner_episodes in episodes[setup].items()}

        def mean_move_m(planner_episodes: list[Episode]) -> float:
            return float(np.mean([episode.travelled_m[-1] for episode in planner_episodes]) / config.n_steps)

        for place, (name, relevance) in enumerate(SETUPS.items()):
            if name not in self._setups:
                self._setups[name] = train_setup(config, name, self._map_builds[relevance], lambda _: None)
            setup, episodes[name] = self._setups[name], {}
            views = self._views[triplet[2]].by(setup.map.landmark_model)
            drive = TestDrive(views, test.route(), nearest_images(test, self._training))
            for number, planner in enumerate(names):
                part = partial(_part_of, report, place * len(names) + number, len(SETUPS) * len(names))
                episodes[name][planner] = drive_planner(config, setup, planner, drive, starts, part)
            timings_ms[name] = self._median_timings_ms(setup, NNQL if name == "paper" else DEFAULT_PLANNER, test)
        block = (test.position_m[starts] // BLOCK_M).astype(np.int64)
        n_measured = self._training.n_frames + self._landmarks.n_frames  # every frame once, whatever episodes there are
        document = NbvReport(config, episodes["ours"], episodes["paper"], block).as_dict({})
        return {
            **{part: document[part] for part in ("anr", "anr_paper", "best_constant", "n_episodes")},
            **{part: document[f"{part}_confident"] for part in ("views_to", "metres_to", "wrong_when")},
            "blocks": {
                **{setup: _by_block(by_planner(setup, _rank_percent), block) for setup in episodes},
                "views": _by_block(by_planner("ours", lambda runs: [run.views for run in runs]), block),
            },
            "mean_move_m": {setup: by_planner(setup, mean_move_m) for setup in episodes},
            "took_ms": timings_ms,
            "evaluations": n_measured * config.n_landmarks,
            "evaluations_s": n_measured / 1000 * timings_ms["paper"]["describe"],
        }

    def _median_timings_ms(self, setup: Setup, planner: str, test: Drive) -> dict[str, float]:
        """Median milliseconds of a view's stages, driving along."""
        config = LocalizerConfig(update=setup.update, planner=planner)
        localizer = ActiveLocalizer(setup.map, config, time.perf_counter)
        state, at_m, timings = localizer.start(), float(test.position_m[0]), []
        for row in range(min(_TIMED_VIEWS, test.n_frames)):
            started_s = time.perf_counter()
            view = views_of(measure_drive(test.at(np.array([row])), setup.map.landmark_model, self._evaluator)).at(0)
            describe_ms = 1000 * (time.perf_counter() - started_s)
            step = localizer.step(state, view, float(test.position_m[row]) - at_m)
            state, at_m = step.state, float(test.position_m[row])
            timings.append({"describe": describe_ms, **step.timings_ms})
        return {stage: float(np.median([view_timings[stage] for view_timings in timings])) for stage in timings[0]}


def _piece(triplet: Triplet, list_length: int | None = None) -> str:
    return f"{'-'.join(triplet)} {'moves' if list_length is None else f'h {list_length}'}"


def _part_of(report: Callable[[float], None], number: int, n_parts: int, share: float) -> None:
    report((number + share) / n_parts)


def _rank_percent(episodes: Sequence[Episode]) -> NDArray[np.float64]:
    """[episodes] mean of the truth's rank over an episode, percent."""
    return np.array([100 * np.mean(episode.rank_share) for episode in episodes], np.float64)


def _by_block(values: Mapping[str, NDArray[np.float64]], block: NDArray[np.int64]) -> Document:
    """Sums by stretch of the test drive, which is all that a bootstrap by stretches needs."""
    _, block = np.unique(block, return_inverse=True)
    return {
        "n": np.bincount(block).tolist(),
        "sums": {name: np.bincount(block, figures).tolist() for name, figures in values.items()},
    }


def measure_paper(
    config: PaperConfig,
    evaluator: Evaluator,
    drives: Mapping[str, Drive],
    folder: Path,
    ingredients: Mapping[str, Any],
    tell: Callable[[str, float], None],
    pictures: Mapping[str, Pictures],
) -> dict[str, Document]:
    """Measure every triplet whose drives are there; answers results by the triplet's name.

    Args:
        folder: Keeps results.
        ingredients: All that figures depend on beside drives and configuration.
        tell: Called by several threads with what is under way and the share done; may raise CancelledError.
        pictures: Images of the drives, for evaluators that are fitted to them.
    """
    digests = {season: drive_digest(drive) for season, drive in drives.items()}
    cache = ResultCache(folder, {**ingredients, "code": code_digest()})
    pairs = [Pair(config, evaluator, triplets, drives, digests, pictures) for triplets in _pairs(drives)]
    n_frames = {season: drive.n_frames for season, drive in drives.items()}
    shares = Shares(tell, seconds_to_measure(config, n_frames))
    results: dict[str, Document] = {}

    def measure(pair: Pair) -> None:
        results.update(pair.measure(cache, shares))

    in_threads([partial(measure, pair) for pair in pairs])
    return {"-".join(triplet): results["-".join(triplet)] for triplet in runnable(drives)}


def runnable(seasons: Collection[str]) -> list[Triplet]:
    """The triplets whose drives are there."""
    return [triplet for triplet in TRIPLETS if set(triplet) <= set(seasons)]


def _pairs(seasons: Collection[str]) -> list[list[Triplet]]:
    """The runnable triplets, those with the same landmark and training drive together."""
    pairs: dict[tuple[str, str], list[Triplet]] = {}
    for triplet in runnable(seasons):
        pairs.setdefault(triplet[:2], []).append(triplet)
    return list(pairs.values())


def seconds_to_measure(config: PaperConfig, n_frames: Mapping[str, int]) -> dict[str, float]:
    """The seconds that every piece of the measuring may take on one core, by its name; `n_frames` is by season."""
    return {name: s for triplets in _pairs(n_frames) for name, s in pieces(config, triplets, n_frames).items()}
