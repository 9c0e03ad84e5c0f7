"""The paper's evaluators on the same sets, under rrf and under the relevance that ships: docs/results/evaluators.md.

    python -m bench.evaluators [WORK [SET...]]

WORK is a folder where drives are rendered and encodings kept, so that a second run goes on (default: a temporary one).
Sets: campus (four seasons of 300 frames, four triplets), netvlad64 (ready encodings, six), corridor and nordland (real
images, one season: landmarks are the map's own).
"""

import itertools
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.measurement import RESULTS, Command, duration, machine, markdown, one_of, print_page, timed, work_folder
from bench.recordings import MAX_PIXELS, NETVLAD, real_recordings
from deepsimbad.core.drive import Drive
from deepsimbad.core.metrics import RetrievalScores, mean_interval
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.core.route import true_images_of
from deepsimbad.evaluators.base import Evaluator, Fitted, Fitting, LandmarkModel, Lesson
from deepsimbad.evaluators.feature_l2 import squared_distances
from deepsimbad.evaluators.registry import EvaluatorKind, evaluator_config, make_evaluator
from deepsimbad.evaluators.trunk import Trunk
from deepsimbad.jobs.build import encode_recording
from deepsimbad.jobs.experiments.cache import open_encoding_cache
from deepsimbad.jobs.experiments.nbv import BLOCK_M
from deepsimbad.jobs.experiments.truth import read_ground_truth
from deepsimbad.jobs.experiments.vpr import DriveViews, VprConfig, build_maps, score_maps, vpr_stages
from deepsimbad.jobs.fitting import Fitter, RecordingPictures
from deepsimbad.jobs.progress import Progress
from deepsimbad_campus.season import PAPER_DATES
from deepsimbad_campus.writer import write_campus
from deepsimbad_client.recordings import Recording
from deepsimbad_client.recordings.sources import open_source

N_LANDMARKS = 200
COMPARED = (Relevance.RRF, DEFAULT_RELEVANCE)
L2_IN_OWN_SPACE = "feature_l2, in its own space"


class OwnSpaceL2(Trunk):
    """Squared L2 of encodings treated as any other dissimilarity, to tell what decision 0029 costs by itself."""

    kind = "l2"

    def __init__(self, extractor: str) -> None:
        super().__init__(extractor)
        self.fitting = Fitting.NOTHING

    def fit(self, lesson: Lesson) -> Fitted:
        """The landmarks' encodings."""
        return Fitted({"l2_landmarks": np.ascontiguousarray(lesson.encodings[lesson.landmarks])})

    def own_dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """Squared L2."""
        return squared_distances(np.ascontiguousarray(encodings), np.asarray(model["l2_landmarks"], np.float32))


@dataclass(frozen=True)
class Kind:
    """A line of a table."""

    make: Callable[[str], Evaluator]  # from an extractor's name
    encodings: tuple[str, ...] = ("feature_l2",)  # kinds whose encodings lie side by side
    alone: int | None = None  # index of the one kind that a view brings; None: all


def fused(half: str, alone: int | None = None) -> Kind:
    """Images fused with another half; `alone` as in `Kind`."""
    of = [{"kind": "feature_l2"}, {"kind": half}]
    return Kind(lambda _: make_evaluator(evaluator_config({"kind": "fused", "of": of})), ("feature_l2", half), alone)


KINDS: Mapping[str, Kind] = {
    "feature_l2": Kind(lambda extractor: evaluator_of("feature_l2", extractor)),
    L2_IN_OWN_SPACE: Kind(OwnSpaceL2),
    "siamese": Kind(lambda extractor: evaluator_of("siamese", extractor)),
    "autoencoder": Kind(lambda extractor: evaluator_of("autoencoder", extractor)),
}
TOLD: Mapping[str, Kind] = {  # of the campus, which tells what it shows
    "objects": Kind(lambda _: make_evaluator(evaluator_config({"kind": "objects"})), ("objects",)),
    "language": Kind(lambda _: make_evaluator(evaluator_config({"kind": "language"})), ("language",)),
    "fused: L2, objects": fused("objects"),
    "fused: L2, language": fused("language"),
    "fused: L2, objects; views of images alone": fused("objects", 0),
    "fused: L2, objects; views of objects alone": fused("objects", 1),
    "fused: L2, language; views of images alone": fused("language", 0),
    "fused: L2, language; views of texts alone": fused("language", 1),
}
# A line, and the lines than the better of which it should be no worse
AGAINST = {
    "siamese": ("feature_l2",),
    "autoencoder": ("feature_l2",),
    "fused: L2, objects": ("feature_l2", "objects"),
    "fused: L2, language": ("feature_l2", "language"),
    "fused: L2, objects; views of images alone": ("feature_l2",),
    "fused: L2, objects; views of objects alone": ("objects",),
    "fused: L2, language; views of images alone": ("feature_l2",),
    "fused: L2, language; views of texts alone": ("language",),
}


def evaluator_of(kind: str, extractor: str) -> Evaluator:
    """The evaluator of a kind with an extractor."""
    return make_evaluator(evaluator_config({"kind": EvaluatorKind(kind).value, "extractor": extractor}))


class KeptPictures(RecordingPictures):
    """A recording's pictures, whose views are kept in a file too."""

    def __init__(self, recording: Recording, file: Path) -> None:
        super().__init__(recording, MAX_PIXELS)
        self._file = file
        if file.exists():
            with np.load(file) as views:
                self._views = {int(name): views[name].astype(np.float32) for name in views.files}

    def keep_views(self, views: dict[int, NDArray[np.float32]]) -> None:
        """Keep views in memory, and write all to the file after every `N_LANDMARKS` of them."""
        super().keep_views(views)
        if len(self._views) % N_LANDMARKS == 0:
            np.savez(self._file, **{str(index): rows.astype(np.float16) for index, rows in self._views.items()})


@dataclass(frozen=True)
class Scored:
    """One evaluator on one triplet."""

    scores: Mapping[str, RetrievalScores]  # by relevance
    block: NDArray[np.int64]  # [n_queries] stretch of 20 m of the test drive
    fitting: Mapping[str, Any] | None


@dataclass(frozen=True)
class Trial:
    """Drives of one experiment, by their sources."""

    drives: "Drives"
    landmarks: str | None
    training: str
    test: str
    ground_truth: Path | None = None

    def scored(self, kind: Kind) -> Scored:
        """The scores of an evaluator, in one session over the test drive."""
        training, test = (self.drives.of(source, kind) for source in (self.training, self.test))
        landmark_drive = None if self.landmarks is None else self.drives.of(self.landmarks, kind)
        if kind.alone is not None:
            first = self.drives.of(self.test, KINDS["feature_l2"]).encoding_dim
            encodings = test.encodings.copy()
            encodings[:, slice(first, None) if kind.alone == 0 else slice(first)] = 0
            test = replace(test, encodings=encodings)
        config = VprConfig(min(N_LANDMARKS, (landmark_drive or training).n_frames), relevances=COMPARED)
        evaluator = kind.make(self.drives.extractor)
        maps = build_maps(config, Fitter(evaluator, self._pictures, config.seed), evaluator, landmark_drive, training)
        truth = (
            true_images_of(test.route(), training.route(), config.tolerance_m)
            if self.ground_truth is None
            else read_ground_truth(self.ground_truth, test.index, training.index)
        )
        progress, views = Progress(vpr_stages(config)), DriveViews(test, evaluator)
        scores = score_maps(config, maps, views, [truth], progress, bound=False)[0]
        block = (test.position_m[[images.size > 0 for images in truth]] // BLOCK_M).astype(np.int64)
        return Scored(scores, block, maps[DEFAULT_RELEVANCE].fitting)

    @cached_property
    def _pictures(self) -> "KeptPictures | None":
        return None if self.drives.extractor == "none" else self.drives.pictures(self.landmarks or self.training)

    def view_s(self, kind: Kind) -> float:
        """Seconds for all dissimilarities of one view, its encoding known."""
        evaluator, drive = kind.make(self.drives.extractor), self.drives.of(self.landmarks or self.training, kind)
        rows = np.linspace(0, drive.n_frames - 1, min(N_LANDMARKS, drive.n_frames)).astype(np.int64)
        model = evaluator.fit(Lesson(drive.encodings, rows)).model
        return timed(lambda: evaluator.dissimilarities(drive.encodings[:1], model), repeats=10).median_s


class Drives:
    """Recordings by source, each encoded once; encodings are kept in a folder."""

    def __init__(self, work: Path, extractor: str = "efficientnet_lite0") -> None:
        self._work, self.extractor = work, extractor
        self._encoded: dict[tuple[str, str], Drive] = {}

    def of(self, source: str, kind: Kind) -> Drive:
        """A drive by the encodings of a kind."""
        first, *other_drives = (self._by(source, name) for name in kind.encodings)
        return replace(first, encodings=np.hstack([first.encodings, *(other.encodings for other in other_drives)]))

    def _by(self, source: str, name: str) -> Drive:
        if (source, name) not in self._encoded:
            is_l2 = name == "feature_l2"
            evaluator = KINDS[name].make(self.extractor) if is_l2 else TOLD[name].make(name)
            made_of = {"extractor": self.extractor} if is_l2 else {"kind": name}
            role = _name(source) + ("" if is_l2 else f"-{name}")
            with open_encoding_cache(self._work, role, source=source, **made_of) as encoding_cache:
                recording = open_source(source)
                encoded = encode_recording(
                    recording, evaluator, MAX_PIXELS, lambda _: None, encoding_cache=encoding_cache
                )
            self._encoded[source, name] = encoded.drive
        return self._encoded[source, name]

    def pictures(self, source: str) -> KeptPictures:
        """The images of a recording."""
        return KeptPictures(open_source(source), self._work / f"{_name(source)}-views.npz")


def _name(source: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in source)[-80:]


def campus(work: Path) -> Iterator[Trial]:
    """Every season is the landmark, training and test season once in four."""
    sources = write_campus(work / "campus", list(PAPER_DATES), 300)
    drives = Drives(work)
    for first in range(4):
        yield Trial(drives, *(sources[(first + k) % 4] for k in range(3)))


def netvlad64(work: Path) -> Iterator[Trial]:
    """All orders of the three domains; no images."""
    folder, drives = real_recordings() / "nordland_netvlad64", Drives(work, "none")
    for order in itertools.permutations(NETVLAD):
        yield Trial(drives, *(str(folder / f"{name}.npy") for name in order))


def corridor(work: Path) -> Iterator[Trial]:
    """One walk on the other."""
    folder, drives = real_recordings() / "corridor", Drives(work)
    yield Trial(drives, None, str(folder / "ref"), str(folder / "query"), folder / "ground_truth_new.npy")


def nordland(work: Path) -> Iterator[Trial]:
    """Winter on summer, frames 0..999."""
    folder, drives = real_recordings() / "nordland", Drives(work)
    yield Trial(drives, None, *(f"{folder / season}#0:1000" for season in ("summer", "winter")))


SETS = {"campus": campus, "netvlad64": netvlad64, "corridor": corridor, "nordland": nordland}


def lines(work: Path, names: list[str]) -> Iterator[str]:
    """The page, with these sets."""
    yield from ("# Evaluators on the same sets", "", f"`python -m bench.evaluators WORK {' '.join(names)}`", "")
    yield from (
        machine(),
        "",
        "ANR / R@1 in percent, mean over the triplets of a set; in brackets ANR by triplet. One session over the",
    )
    yield from (
        "test drive, tolerance 2 m (the corridor by its ground truth). `held-out`: ANR of a fitted model on pairs that",
        "it lacks, beside plain L2's of the same unit vectors. Intervals are 95 %, by 20 m of the test drives.",
    )
    for name in names:
        yield from ("", f"## {name}: {' '.join((SETS[name].__doc__ or '').split())}", "")
        trials, kinds = list(SETS[name](work)), KINDS | (TOLD if name == "campus" else {})
        results: dict[str, list[Scored]] = {}
        yield from markdown(
            ("evaluator", *(relevance.value for relevance in COMPARED), "fitted in", "held-out (L2's)", "a view"),
            (row(trials, kind, results) for kind in kinds.items()),
        )
        yield from ("", "Differences in ANR from the better of those that it stands beside:", "")
        yield from markdown(
            ("evaluator", *(relevance.value for relevance in COMPARED)),
            (
                (kind, *(difference(relevance.value, results, kind, rivals) for relevance in COMPARED))
                for kind, rivals in AGAINST.items()
                if kind in results
            ),
        )


def row(trials: list[Trial], kind: tuple[str, Kind], results: dict[str, list[Scored]]) -> tuple[str, ...]:
    """The cells of one evaluator, whose results are added to `results`."""
    name, row_kind = kind
    scored = results[name] = [trial.scored(row_kind) for trial in trials]
    cells = [figures([result.scores[relevance.value] for result in scored]) for relevance in COMPARED]
    fits = [result.fitting for result in scored if result.fitting is not None]
    fitted = held_out = "-"
    if fits:
        fitted = f"{np.mean([fit['seconds'] for fit in fits]):.1f} s, {fits[0]['n_dissimilarities']:,} dissimilarities"
        anrs = [[fit["held_out"][of]["anr"] or np.nan for fit in fits] for of in (name, "l2")]
        held_out = f"{np.nanmean(anrs[0]):.2f} ({np.nanmean(anrs[1]):.2f})"
    return name, *cells, fitted, held_out, duration(trials[0].view_s(row_kind)) if row_kind.alone is None else "-"


def figures(scores: list[RetrievalScores]) -> str:
    """The means of ANR and R@1, and in brackets ANR by triplet."""
    anr = [score.anr for score in scores]
    mean = f"{np.mean(anr):.2f} / {np.mean([score.recall_at[1] for score in scores]):.0f}"
    return mean if len(anr) == 1 else f"{mean} ({', '.join(f'{value:.2f}' for value in anr)})"


def difference(relevance: str, results: Mapping[str, list[Scored]], kind: str, rivals: tuple[str, ...]) -> str:
    """Mean difference in ANR of the same queries from the best rival's, with its 95 % interval."""
    ranks = {
        name: np.concatenate([100 * result.scores[relevance].normalised_ranks for result in results[name]])
        for name in (kind, *rivals)
    }
    better = min(rivals, key=lambda name: float(ranks[name].mean()))
    block = np.concatenate([10_000 * number + result.block for number, result in enumerate(results[kind])])
    low, high = mean_interval(ranks[kind] - ranks[better], 0, block)
    return f"{ranks[kind].mean() - ranks[better].mean():+.2f} ({low:+.2f} .. {high:+.2f}) from `{better}`"


def measure(arguments: Namespace) -> None:
    """Print the sets asked for; the page where that is all of them."""
    names = arguments.sets or list(SETS)
    if names != ["campus"]:
        real_recordings()  # rather than after an hour of rendering
    with work_folder(arguments.work) as work:
        print_page(lines(work, names), RESULTS / "evaluators.md" if names == list(SETS) else None)


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("work", type=Path, nargs="?", metavar="WORK")
    command.add_argument("sets", nargs="*", type=one_of(SETS), metavar="SET")
    command.run(measure)
