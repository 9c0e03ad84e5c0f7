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
    trained,
)
from deepsimbad.jobs.experiments.truth import nearest_images
from deepsimbad.jobs.experiments.vpr import (
    RANKS,
    ViewsOf,
    VprConfig,
    bits_per_map_image,
    build_maps,
    listed_anew,
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
        """As `experiment vpr` would have it."""
        return VprConfig(self.n_landmarks, self.list_length, self.tolerances_m[0], relevances, self.seed)

    def nbv(self) -> NbvConfig:
        """As `experiment nbv` would have it."""
        return NbvConfig(
            n_landmarks=self.n_landmarks,
            list_length=self.list_length,
            training_episodes=self.training_episodes,
            episodes=self.episodes,
            seed=self.seed,
        )

    def fitting(self, n_landmarks: int) -> "PaperConfig":
        """For a landmark drive of fewer frames than landmarks are asked for: all of them, and no longer lists."""
        r = fitting_number(None, n_landmarks, self.n_landmarks)
        lengths = tuple(h for h in self.list_lengths if h <= r)
        return replace(self, n_landmarks=r, list_length=min(self.list_length, r), list_lengths=lengths)


def pieces(config: PaperConfig, triplets: Sequence[Triplet], n_frames: Mapping[str, int]) -> dict[str, float]:
    """What is to be measured of triplets with the same maps, and the seconds that it may take on one core."""
    weights: dict[str, float] = {}
    config, n_map = config.fitting(n_frames[triplets[0][0]]), n_frames[triplets[0][1]]
    for number, triplet in enumerate(triplets):
        n = n_frames[triplet[2]]
        for h in config.list_lengths:
            listing = 3e-8 * n_map * config.n_landmarks * h if number == 0 else 0.0
            weights[_piece(triplet, h)] = listing + n * (2e-3 + n_map * h * 6e-9)
        weights[_piece(triplet)] = (0 if number else 20) + 26 * config.episodes * (2e-3 + 4e-6 * n_map)
    return weights


class Pair:
    """A landmark and a training drive, the maps made of them, and what is measured on those.

    Args:
        triplets: Those of the pair.
        drives: By season; digests and pictures likewise.
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
        self._config = config.fitting(self._landmarks.n_frames)
        self._evaluator, self._triplets, self._drives, self._digests = evaluator, triplets, drives, digests
        self._pictures = pictures.get(triplets[0][0])
        self._setups: dict[str, Setup] = {}
        self._listed: dict[int, dict[Relevance, Built]] = {}  # the maps of the list length under way
        self._views = {triplet[2]: ViewsOf(drives[triplet[2]], evaluator) for triplet in triplets}

    def measure(self, kept: ResultCache, shares: Shares) -> dict[str, Document]:
        """Everything, or what is kept of it, by triplet."""
        config, results = self._config, {"-".join(triplet): dict[str, Any]() for triplet in self._triplets}

        def keep(piece: str, triplet: Triplet, make: Callable[..., Document], **made_of: Any) -> Document:
            digests, report = [self._digests[season] for season in triplet], shares.report(piece)
            result = kept.get(piece.replace(" ", "-"), partial(make, triplet, report), drives=digests, **made_of)
            report(1.0)
            return result

        vpr = {"config": asdict(config.vpr()), "tolerances_m": config.tolerances_m}
        for h in sorted(config.list_lengths, key=lambda h: h != config.list_length):
            for triplet in self._triplets:
                make = partial(self._single_views, h)
                result = keep(_piece(triplet, h), triplet, make, **vpr, list_length=h)
                results["-".join(triplet)][str(h)] = result
            self._listed.clear()
        for triplet in self._triplets:
            result = keep(_piece(triplet), triplet, self._moves, config=asdict(config.nbv()))
            results["-".join(triplet)]["active"] = result
        return results

    @cached_property
    def _built(self) -> dict[Relevance, Built]:
        """At the one list length that everything is measured at."""
        fitter = Fitter(self._evaluator, self._pictures, self._config.seed)
        return build_maps(self._config.vpr(), fitter, self._evaluator, self._landmarks, self._training)

    def _at(self, list_length: int) -> dict[Relevance, Built]:
        if list_length == self._config.list_length:
            return self._built
        if list_length not in self._listed:
            self._listed[list_length] = {
                name: replace(built, map=listed_anew(built, list_length))
                for name, built in self._built.items()
                if name is not Relevance.BRUTE_FORCE  # which has no lists
            }
        return self._listed[list_length]

    def _single_views(self, list_length: int, triplet: Triplet, report: Callable[[float], None]) -> Document:
        """Fig. 6 of a triplet at one list length."""
        config, test = self._config, self._drives[triplet[2]]
        built, whole = self._at(list_length), list_length == self._config.list_length
        vpr = config.vpr(tuple(built))
        progress = Progress(vpr_stages(vpr), lambda state: report(state.progress))
        truths = [true_images_of(test.route(), self._training.route(), metres) for metres in config.tolerances_m]
        scores = score_maps(vpr, built, self._views[triplet[2]], truths, progress, bound=whole)
        at = [f"{metres:g}" for metres in config.tolerances_m]
        is_scored = np.array([truth.size > 0 for truth in truths[0]])
        ranks = {name: 100 * score.normalised_ranks for name, score in scores[0].items()}
        same_route = built[Relevance.COMPOSED].same_route
        return {
            "anr": {name: score.anr for name, score in scores[0].items()},
            "anr_at": {m: {name: s.anr for name, s in each.items()} for m, each in zip(at, scores, strict=True)},
            "recall": {
                m: {name: {str(k): s.recall_at[k] for k in RANKS} for name, s in each.items()}
                for m, each in zip(at, scores, strict=True)
            },
            "n_queries": int(is_scored.sum()),
            "n_left_out": int((~is_scored).sum()),
            "blocks": _by_block(ranks, (test.position_m[is_scored] // BLOCK_M).astype(np.int64)),
            "second_season": None if same_route is None else same_route.as_dict(),
            "index_bits": {
                name.value: bits_per_map_image(each.map)
                for name, each in built.items()
                if whole and name is not Relevance.BRUTE_FORCE
            },
        }

    def _moves(self, triplet: Triplet, report: Callable[[float], None]) -> Document:
        """Fig. 7 of a triplet, under the paper's set-up and ours."""
        config, test = self._config.nbv(), self._drives[triplet[2]]
        starts = starts_of(config, test)
        names = [name for name in planner_names(config) if name != CLAIRVOYANT]
        episodes: dict[str, dict[str, list[Episode]]] = {}
        took_ms = {}
        for place, (name, relevance) in enumerate(SETUPS.items()):
            if name not in self._setups:
                self._setups[name] = trained(config, name, self._built[relevance], lambda _: None)
            setup, episodes[name] = self._setups[name], {}
            views = self._views[triplet[2]].by(setup.map.landmark_model)
            drive = TestDrive(views, test.route(), nearest_images(test, self._training))
            for number, planner in enumerate(names):
                part = partial(_part_of, report, place * len(names) + number, len(SETUPS) * len(names))
                episodes[name][planner] = drive_planner(config, setup, planner, drive, starts, part)
            took_ms[name] = self._took_ms(setup, NNQL if name == "paper" else DEFAULT_PLANNER, test)
        block = (test.position_m[starts] // BLOCK_M).astype(np.int64)
        n_measured = self._training.n_frames + self._landmarks.n_frames  # every frame once, whatever episodes there are
        told = NbvReport(config, episodes["ours"], episodes["paper"], block).as_dict({})
        return {
            **{part: told[part] for part in ("anr", "anr_paper", "best_constant", "n_episodes")},
            **{part: told[f"{part}_confident"] for part in ("views_to", "metres_to", "wrong_when")},
            "blocks": {
                **{
                    setup: _by_block({name: _each(some, "rank_share") for name, some in driven.items()}, block)
                    for setup, driven in episodes.items()
                },
                "views": _by_block(
                    {name: _each(some, "views") / 100 for name, some in episodes["ours"].items()}, block
                ),
            },
            "mean_move_m": {
                setup: {
                    name: float(np.mean([each.travelled_m[-1] for each in some]) / config.n_steps)
                    for name, some in driven.items()
                }
                for setup, driven in episodes.items()
            },
            "took_ms": took_ms,
            "evaluations": n_measured * config.n_landmarks,
            "evaluations_s": n_measured / 1000 * took_ms["paper"]["describe"],
        }

    def _took_ms(self, setup: Setup, planner: str, test: Drive) -> dict[str, float]:
        """Median milliseconds of a view's stages, driving along."""
        config = LocalizerConfig(update=setup.update, planner=planner)
        localizer = ActiveLocalizer(setup.map, config, time.perf_counter)
        state, at_m, took = localizer.start(), float(test.position_m[0]), []
        for row in range(min(_TIMED_VIEWS, test.n_frames)):
            began = time.perf_counter()
            view = views_of(measure_drive(test.at(np.array([row])), setup.map.landmark_model, self._evaluator)).at(0)
            describe_ms = 1000 * (time.perf_counter() - began)
            step = localizer.step(state, view, float(test.position_m[row]) - at_m)
            state, at_m = step.state, float(test.position_m[row])
            took.append({"describe": describe_ms, **step.timings_ms})
        return {stage: float(np.median([each[stage] for each in took])) for stage in took[0]}


def _piece(triplet: Triplet, list_length: int | None = None) -> str:
    return f"{'-'.join(triplet)} {'moves' if list_length is None else f'h {list_length}'}"


def _part_of(report: Callable[[float], None], number: int, n_parts: int, share: float) -> None:
    report((number + share) / n_parts)


def _each(episodes: Sequence[Episode], part: str) -> NDArray[np.float64]:
    """[episodes] mean of a part, percent."""
    return np.array([100 * np.mean(getattr(episode, part)) for episode in episodes], np.float64)


def _by_block(values: Mapping[str, NDArray[np.float64]], block: NDArray[np.int64]) -> Document:
    """Sums by stretch of the test drive: all that a bootstrap by stretches asks for."""
    _, block = np.unique(block, return_inverse=True)
    return {
        "n": np.bincount(block).tolist(),
        "sums": {name: np.bincount(block, each).tolist() for name, each in values.items()},
    }


def measure_paper(
    config: PaperConfig,
    evaluator: Evaluator,
    drives: Mapping[str, Drive],
    folder: Path,
    made_of: Mapping[str, Any],
    tell: Callable[[str, float], None],
    pictures: Mapping[str, Pictures],
) -> dict[str, Document]:
    """Every triplet whose drives are there, by its name; see `Pair`.

    Args:
        folder: Keeps results.
        made_of: All that figures depend on beside drives and configuration.
        tell: Told what is under way and the share that is done, by several threads; may raise CancelledError.
        pictures: Of the drives, for evaluators that are fitted to images.
    """
    digests = {season: drive_digest(drive) for season, drive in drives.items()}
    kept = ResultCache(folder, {**made_of, "code": code_digest()})
    works = [Pair(config, evaluator, triplets, drives, digests, pictures) for triplets in _pairs(drives)]
    n_frames = {season: drive.n_frames for season, drive in drives.items()}
    shares = Shares(tell, seconds_to_measure(config, n_frames))
    results: dict[str, Document] = {}

    def measure(work: Pair) -> None:
        results.update(work.measure(kept, shares))

    in_threads([partial(measure, work) for work in works])
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
    """What every piece of the measuring may take on one core, by its name; drives by season."""
    return {name: s for triplets in _pairs(n_frames) for name, s in pieces(config, triplets, n_frames).items()}
