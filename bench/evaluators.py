"""The paper's evaluators on the same sets, under rrf and under the relevance that ships: docs/results/evaluators.md.

    python -m bench.evaluators [WORK [SET...]]

WORK is a folder where drives are rendered and encodings kept, so that a second run goes on (default: a temporary one).
Sets: campus (four seasons of 300 frames, four triplets), netvlad64 (ready encodings, six), corridor and nordland (real
images, one season: landmarks are the map's own).
"""

import itertools
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.common import duration, machine, markdown, real_recordings, write_page
from deepsimbad.core.metrics import RetrievalScores
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.core.route import true_images_of
from deepsimbad.evaluators.base import Evaluator, Fitted, Fitting, LandmarkModel, Lesson
from deepsimbad.evaluators.feature_l2 import squared_distances
from deepsimbad.evaluators.registry import EvaluatorKind, evaluator_config, make_evaluator
from deepsimbad.evaluators.trunk import Trunk
from deepsimbad.jobs.build import EncodedRecording, encode_recording
from deepsimbad.jobs.fitting import RecordingPictures
from deepsimbad.jobs.kept import kept_encodings
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.truth import read_ground_truth
from deepsimbad.jobs.vpr import VprConfig, VprReport, run_vpr, vpr_stages
from deepsimbad_campus.season import PAPER_DATES
from deepsimbad_campus.writer import write_campus
from deepsimbad_client.recordings import Recording
from deepsimbad_client.recordings.sources import open_source

N_LANDMARKS, MAX_PIXELS = 200, 50_000_000
COMPARED = (Relevance.RRF, Relevance.STANDARDISED, DEFAULT_RELEVANCE)
L2_IN_OWN_SPACE = "feature_l2, in its own space"


class OwnSpaceL2(Trunk):
    """Squared L2 of encodings taken as if it were any dissimilarity: what decision 0029 costs by itself."""

    kind = "l2"
    fitting = Fitting.NOTHING  # type: ignore[assignment]

    def fit(self, lesson: Lesson) -> Fitted:
        """The landmarks' encodings."""
        return Fitted({"l2_landmarks": np.ascontiguousarray(lesson.encodings[lesson.landmarks])})

    def own_dissimilarities(self, encodings: NDArray[np.float32], model: LandmarkModel) -> NDArray[np.float32]:
        """Squared L2."""
        return squared_distances(np.ascontiguousarray(encodings), np.asarray(model["l2_landmarks"], np.float32))


KINDS: Mapping[str, Callable[[str], Evaluator]] = {
    "feature_l2": lambda extractor: made("feature_l2", extractor),
    L2_IN_OWN_SPACE: OwnSpaceL2,
    "siamese": lambda extractor: made("siamese", extractor),
    "autoencoder": lambda extractor: made("autoencoder", extractor),
}


def made(kind: str, extractor: str) -> Evaluator:
    """An evaluator by its names."""
    return make_evaluator(evaluator_config({"kind": EvaluatorKind(kind).value, "extractor": extractor}))


class KeptPictures(RecordingPictures):
    """A recording's, whose views are kept in a file too."""

    def __init__(self, recording: Recording, file: Path) -> None:
        super().__init__(recording, MAX_PIXELS)
        self._file = file
        if file.exists():
            with np.load(file) as views:
                self._views = {int(name): views[name].astype(np.float32) for name in views.files}

    def keep_views(self, views: dict[int, NDArray[np.float32]]) -> None:
        """Write all anew, now and then."""
        super().keep_views(views)
        if len(self._views) % N_LANDMARKS == 0:
            np.savez(self._file, **{str(index): each.astype(np.float16) for index, each in self._views.items()})


@dataclass(frozen=True)
class Trial:
    """Drives of one experiment, encoded."""

    landmarks: EncodedRecording | None
    training: EncodedRecording
    test: EncodedRecording
    pictures: KeptPictures | None  # of the drive that landmarks are chosen from
    extractor: str
    ground_truth: Path | None = None

    def report(self, kind: str) -> VprReport:
        """What an evaluator scores."""
        candidates = (self.landmarks or self.training).drive
        config = VprConfig(min(N_LANDMARKS, candidates.n_frames), relevances=COMPARED)
        training, test = self.training.drive, self.test.drive
        truth = (
            true_images_of(test.route(), training.route(), config.tolerance_m)
            if self.ground_truth is None
            else read_ground_truth(self.ground_truth, test.index, training.index)
        )
        known = None if self.landmarks is None else self.landmarks.drive
        progress = Progress(vpr_stages(config))
        return run_vpr(config, KINDS[kind](self.extractor), known, training, self.test, truth, progress, self.pictures)

    def view_s(self, kind: str) -> float:
        """Seconds for all dissimilarities of one view, its encoding known."""
        evaluator, drive = KINDS[kind](self.extractor), (self.landmarks or self.training).drive
        rows = np.linspace(0, drive.n_frames - 1, min(N_LANDMARKS, drive.n_frames)).astype(np.int64)
        model = evaluator.fit(Lesson(drive.encodings, rows)).model
        seconds = []
        for row in range(12):
            began = time.perf_counter()
            evaluator.dissimilarities(drive.encodings[row : row + 1], model)
            seconds.append(time.perf_counter() - began)
        return float(np.median(seconds[2:]))


class Drives:
    """Recordings by source, each encoded once, what was encoded kept in a folder."""

    def __init__(self, work: Path, extractor: str = "efficientnet_lite0") -> None:
        self._work, self.extractor = work, extractor
        self._evaluator = made("feature_l2", extractor)
        self._encoded: dict[str, EncodedRecording] = {}

    def of(self, source: str) -> EncodedRecording:
        """A drive."""
        if source not in self._encoded:
            with kept_encodings(self._work, _name(source), source=source, extractor=self.extractor) as kept:
                self._encoded[source] = encode_recording(
                    open_source(source), self._evaluator, MAX_PIXELS, lambda _: None, kept=kept
                )
        return self._encoded[source]

    def pictures(self, source: str) -> KeptPictures:
        """Its images."""
        return KeptPictures(open_source(source), self._work / f"{_name(source)}-views.npz")

    def trial(self, landmarks: str | None, training: str, test: str, ground_truth: Path | None = None) -> Trial:
        """Of three sources."""
        of_landmarks = None if landmarks is None else self.of(landmarks)
        pictures = None if self.extractor == "none" else self.pictures(landmarks or training)
        return Trial(of_landmarks, self.of(training), self.of(test), pictures, self.extractor, ground_truth)


def _name(source: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in source)[-80:]


def campus(work: Path) -> Iterator[Trial]:
    """Every season is the landmark, training and test season once in four."""
    sources = write_campus(work / "campus", list(PAPER_DATES), 300)
    drives = Drives(work)
    for first in range(4):
        yield drives.trial(*(sources[(first + k) % 4] for k in range(3)))


def netvlad64(work: Path) -> Iterator[Trial]:
    """All orders of the three domains; no images."""
    folder, drives = real_recordings() / "nordland_netvlad64", Drives(work, "none")
    for order in itertools.permutations(("nr", "nq", "nq2")):
        yield drives.trial(*(str(folder / f"{name}.npy") for name in order))


def corridor(work: Path) -> Iterator[Trial]:
    """One walk on the other."""
    folder, drives = real_recordings() / "corridor", Drives(work)
    yield drives.trial(None, str(folder / "ref"), str(folder / "query"), folder / "ground_truth_new.npy")


def nordland(work: Path) -> Iterator[Trial]:
    """Winter on summer, frames 0..999."""
    folder, drives = real_recordings() / "nordland", Drives(work)
    yield drives.trial(None, *(f"{folder / season}#0:1000" for season in ("summer", "winter")))


SETS = {"campus": campus, "netvlad64": netvlad64, "corridor": corridor, "nordland": nordland}


def lines(work: Path, names: list[str]) -> Iterator[str]:
    """The page, with these sets."""
    yield from ("# Evaluators on the same sets", "", f"`python -m bench.evaluators WORK {' '.join(names)}`", "")
    yield from (machine(), "", "ANR / R@1 in percent, mean over the triplets of a set; in brackets the worst ANR.")
    yield "What a fitted model scores on held-out pairs stands beside plain L2 of the same unit vectors."
    for name in names:
        yield from ("", f"## {name}: {' '.join((SETS[name].__doc__ or '').split())}", "")
        trials = list(SETS[name](work))
        yield from markdown(
            ("evaluator", *(relevance.value for relevance in COMPARED), "fitted in", "held-out ANR (L2's)", "a view"),
            (row(trials, kind) for kind in KINDS),
        )


def row(trials: list[Trial], kind: str) -> tuple[str, ...]:
    """One evaluator's figures."""
    reports = [trial.report(kind) for trial in trials]
    cells = [figures([report.scores[relevance.value] for report in reports]) for relevance in COMPARED]
    fits: list[Mapping[str, Any]] = [report.fitting for report in reports if report.fitting is not None]
    fitted = held_out = "-"
    if fits:
        fitted = f"{np.mean([fit['seconds'] for fit in fits]):.1f} s, {fits[0]['n_dissimilarities']:,} dissimilarities"
        both = [[fit["held_out"][name]["anr"] or np.nan for fit in fits] for name in (kind, "l2")]
        held_out = f"{np.nanmean(both[0]):.2f} ({np.nanmean(both[1]):.2f})"
    return kind, *cells, fitted, held_out, duration(trials[0].view_s(kind))


def figures(scores: list[RetrievalScores]) -> str:
    """Means, and the worst."""
    anr = [score.anr for score in scores]
    return f"{np.mean(anr):.2f} / {np.mean([score.recall_at[1] for score in scores]):.0f} ({max(anr):.2f})"


def main() -> None:
    """Write the page."""
    names = sys.argv[2:] or list(SETS)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        if names == list(SETS):
            write_page("evaluators.md", lines(work, names))
        else:
            for line in lines(work, names):
                print(line, flush=True)


if __name__ == "__main__":
    main()
