"""How many landmarks a long route wants, and chosen how: a rendered campus in three seasons, up to 26,208 places.

    python -m bench.long_route FOLDER [--frames N]

Pictures are rendered and encoded block by block into FOLDER, which takes hours for the whole route: cut short, it goes
on where it stopped, and with `--frames` fewer than lie there it measures at once.
"""

import argparse
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.landmarks import RULES
from bench.measurement import machine, markdown, write_page
from bench.quantised import LIST_LENGTH, composed_places
from deepsimbad.core.building import MapPlan, compose_map
from deepsimbad.core.composed import Moments, compose, described, learnt_landmarks, unit_encodings
from deepsimbad.core.drive import Drive
from deepsimbad.core.metrics import RetrievalScorer, RetrievalScores
from deepsimbad.core.relevance import Relevance
from deepsimbad.core.route import true_images_of
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.build import measure_drive, views_of
from deepsimbad.jobs.experiments.vpr import moves_between
from deepsimbad.jobs.remap_config import DEFAULT_N_LANDMARKS
from deepsimbad_campus.renderer import Renderer
from deepsimbad_campus.route import BLOCK, drive_length_m
from deepsimbad_campus.route import Drive as CampusDrive
from deepsimbad_campus.season import drive_date
from deepsimbad_campus.world import World

SEASONS = ("summer", "autumn", "winter")  # map, landmark drive where there is one, robot
SEED, SPACING_M, TOLERANCE_M = 0, 1.0, 2.0
MOST_FRAMES = 26_208
LENGTHS = (500, 1_000, 2_000, 4_000, 8_000, 16_000)  # places, beside all that are encoded
NUMBERS = (75, 150, 300, 500, 1_000, 2_000)  # r


def encode(folder: Path, n_frames: int, season: str) -> None:
    """Write the encodings of a season's blocks that are not there yet."""
    os.nice(10)
    cv2.setNumThreads(1)
    world = World(SEED, drive_length_m(MOST_FRAMES, SPACING_M))
    drive = CampusDrive(world.route, SEED, drive_date(season), MOST_FRAMES, SPACING_M)
    renderer = Renderer(world, drive)
    evaluator = make_evaluator(evaluator_config({"kind": "feature_l2"}), Compute(n_threads=1))
    evaluator.load()
    np.save(folder / f"{season}-position_m.npy", drive.position_m)
    for block in range(-(-n_frames // BLOCK)):
        if (path := _block(folder, season, block)).exists():
            continue
        frames = range(block * BLOCK, min((block + 1) * BLOCK, MOST_FRAMES))
        upright = (cv2.rotate(renderer.stored_picture(frame), cv2.ROTATE_90_CLOCKWISE) for frame in frames)
        encodings = evaluator.encode([evaluator.prepare(picture) for picture in upright])
        np.save(part := path.with_suffix(".part.npy"), encodings)
        part.rename(path)


def _block(folder: Path, season: str, block: int) -> Path:
    return folder / f"{season}-{block:03d}.npy"


@dataclass(frozen=True)
class Stretch:
    """The first places of the route: a map made of them, and a session's views of them in another season."""

    places: NDArray[np.float32]  # [n, k] that lists stand for
    candidates: NDArray[np.float32]  # [c, k] frames that may be landmarks
    views: NDArray[np.float32]  # [v, k] of the test drive, by the session's own statistics
    truth: list[NDArray[np.int64]]  # true images of every view

    def scores(self, landmarks: NDArray[np.float32]) -> RetrievalScores:
        """Of lists of these landmarks [r, k], moved to where their sums come nearest."""
        landmarks = learnt_landmarks(self.places, landmarks, LIST_LENGTH)
        restored, scorer = composed_places(compose(self.places, landmarks, LIST_LENGTH), landmarks), RetrievalScorer()
        return self._scored(restored, scorer)

    def bound(self) -> RetrievalScores:
        """With nothing left out."""
        return self._scored(self.places, RetrievalScorer())

    def _scored(self, places: NDArray[np.float32], scorer: RetrievalScorer) -> RetrievalScores:
        for view, truth in zip(self.views, self.truth, strict=True):
            scorer.add(places @ view, truth)
        return scorer.result()


def stretch(drives: dict[str, Drive], n_places: int, *, is_of_two_seasons: bool) -> Stretch:
    """The first `n_places` frames of all drives, mapped."""
    training, second, test = (drives[season].at(np.arange(n_places)) for season in SEASONS)
    landmark_drives = (second, second) if is_of_two_seasons else (None, None)
    plan = MapPlan(Relevance.COMPOSED, LIST_LENGTH, (1.0,), same_route=is_of_two_seasons)
    built_map = compose_map(plan, training, *landmark_drives, min(DEFAULT_N_LANDMARKS, n_places))
    map_, live, views = built_map.map, built_map.map.live_statistics, []
    projection = map_.landmark_model.get("projection")
    measured = views_of(measure_drive(test, map_.landmark_model, FeatureL2("none")))
    for number, moved_m in enumerate(moves_between(test)):
        live, _ = map_.after_view(live, measured.at(number), moved_m)
        views.append(unit_encodings(test.encodings[number], live.encodings, projection))
    candidates = (second if is_of_two_seasons else training).encodings
    u = described(candidates, Moments.of(candidates), projection)
    return Stretch(built_map.places, u, np.stack(views), true_images_of(test.route(), map_.route, TOLERANCE_M))


def report(folder: Path, n_frames: int) -> Iterator[str]:
    """The lines of the page."""
    yield from ("# How many landmarks a long route wants", "")
    yield (
        f"A rendered campus (seed {SEED}, {SPACING_M:g} m between frames), images by the default extractor: the map of "
        f"{SEASONS[0]}, the robot's drive of {SEASONS[2]}, landmarks of two seasons from {SEASONS[1]}. Its first "
        f"places, h = {LIST_LENGTH}, one session over the test drive, tolerance {TOLERANCE_M:g} m, landmarks moved to "
        "where their sums come nearest to the places. ANR / R@1, percent."
    )
    yield from ("", f"Made by `python -m bench.long_route FOLDER --frames {n_frames}`.", "", machine())
    drives = read(folder, n_frames)
    for is_of_two_seasons, title in ((False, "One season, landmarks of the map's own drive"), (True, "Two seasons")):
        yield from ("", f"## {title}", "")
        yield from markdown(
            ("places", "landmarks by", *(f"r = {r}" for r in NUMBERS), "with nothing left out"),
            rows(drives, n_frames, is_of_two_seasons=is_of_two_seasons),
        )


def rows(drives: dict[str, Drive], n_frames: int, *, is_of_two_seasons: bool) -> Iterator[list[str]]:
    """A row for every length and rule; r up to the number of places."""
    for n_places in (*(n for n in LENGTHS if n < n_frames), n_frames):
        places = stretch(drives, n_places, is_of_two_seasons=is_of_two_seasons)
        bound = places.bound()
        for name, rule in RULES.items():
            scores = [places.scores(places.candidates[rule(places.candidates, r)]) for r in NUMBERS if r <= n_places]
            cells = [*map(figures, scores), *[""] * (len(NUMBERS) - len(scores))]
            yield [f"{n_places:,}", name, *cells, figures(bound)]


def figures(scores: RetrievalScores) -> str:
    """ANR / R@1."""
    return f"{scores.anr:.2f} / {scores.recall_at[1]:.1f}"


def read(folder: Path, n_frames: int) -> dict[str, Drive]:
    """The encoded drives."""
    blocks = range(-(-n_frames // BLOCK))
    return {
        season: Drive(
            position_m=np.load(folder / f"{season}-position_m.npy")[:n_frames],
            encodings=np.concatenate([np.load(_block(folder, season, block)) for block in blocks])[:n_frames],
        )
        for season in SEASONS
    }


def main() -> None:
    """Render and encode what is missing, measure, print, write `docs/results/long-route.md`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--frames", type=int, default=MOST_FRAMES, metavar="N")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(len(SEASONS)) as pool:
        list(pool.map(partial(encode, arguments.folder, arguments.frames), SEASONS))
    write_page("long-route.md", report(arguments.folder, arguments.frames))


if __name__ == "__main__":
    main()
