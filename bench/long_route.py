"""How many landmarks a long route wants, and chosen how: a rendered campus in three seasons, up to 26,208 places.

    python -m bench.long_route FOLDER [--frames N]

Pictures are rendered and encoded block by block into FOLDER, which takes hours for the whole route: cut short, it goes
on where it stopped, and with `--frames` fewer than lie there it measures at once.
"""

import os
from argparse import Namespace
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from bench.landmarks import RULES, Case
from bench.measurement import RESULTS, Command, figures, machine, markdown, print_page
from bench.quantised import LIST_LENGTH, TOLERANCE, session_scores
from deepsimbad.core.composed import learnt_landmarks
from deepsimbad.core.drive import Drive
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.remap_config import DEFAULT_N_LANDMARKS
from deepsimbad_campus.renderer import Renderer
from deepsimbad_campus.route import BLOCK, drive_length_m
from deepsimbad_campus.route import Drive as CampusDrive
from deepsimbad_campus.season import drive_date
from deepsimbad_campus.world import World

SEASONS = ("summer", "autumn", "winter")  # map, landmark drive where there is one, robot
SEED, SPACING_M = 0, 1.0
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


def report(folder: Path, n_frames: int) -> Iterator[str]:
    """The lines of the page."""
    yield from ("# How many landmarks a long route wants", "")
    yield (
        f"A rendered campus (seed {SEED}, {SPACING_M:g} m between frames), images by the default extractor: the map of "
        f"{SEASONS[0]}, the robot's drive of {SEASONS[2]}, landmarks of two seasons from {SEASONS[1]}. Its first "
        f"places, h = {LIST_LENGTH}, one session over the test drive, tolerance {TOLERANCE:g} m, landmarks moved to "
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
        training, second, test = (drives[season].at(np.arange(n_places)) for season in SEASONS)
        case = Case(training, test, second if is_of_two_seasons else None)
        built_map = case.build(min(DEFAULT_N_LANDMARKS, n_places))
        bound = " / ".join(figures([session_scores(built_map, built_map.places, test)])[:2])
        for name, rule in RULES.items():
            cells = []
            for r in (r for r in NUMBERS if r <= n_places):
                landmarks = learnt_landmarks(built_map.places, case.landmarks(built_map, rule, r), LIST_LENGTH)
                cells.append(" / ".join(figures([case.scores(built_map, landmarks)])[:2]))
            yield [f"{n_places:,}", name, *cells, *[""] * (len(NUMBERS) - len(cells)), bound]


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


def measure(arguments: Namespace) -> None:
    """Render and encode what is missing, measure, print, write `docs/results/long-route.md`."""
    arguments.folder.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(len(SEASONS)) as pool:
        list(pool.map(partial(encode, arguments.folder, arguments.frames), SEASONS))
    print_page(report(arguments.folder, arguments.frames), RESULTS / "long-route.md")


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("folder", type=Path, metavar="FOLDER")
    command.add_argument("--frames", type=int, default=MOST_FRAMES, metavar="N")
    command.run(measure)
