"""The recordings and splits the contest runs on. Development trials chose the winner, report trials only report."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad.evaluators.base import Image
from deepsimbad.evaluators.image import decode_image
from deepsimbad_client.campus.writer import write_campus
from deepsimbad_client.sources import open_source

MAX_PIXELS = 50_000_000
DARK = 8.0  # standard deviation of grey levels up to which a frame shows nothing (tunnels)
TOLERANCE_FRAMES = 2
CAMPUS_TOLERANCE_M = 3.5  # two of its frames


@dataclass(frozen=True)
class Trial:
    """One landmark-map-live triplet, by the names of its recordings.

    Attributes:
        group: Column of the table; trials of one group are averaged.
        landmarks, mapped, live: Names of recordings.
        truth: Map image ids that are right, one array a live frame; frames without any are left out.
    """

    group: str
    landmarks: str
    mapped: str
    live: str
    truth: Sequence[NDArray[np.int64]]


class Recordings(dict[str, list[Image]]):
    """Images by recording."""

    def __init__(self) -> None:
        super().__init__()
        self.trials: list[Trial] = []
        self.notes: list[str] = []


def nordland(recordings: Recordings, data: Path) -> None:
    """The railway in two seasons: one half for development, one for the report."""
    halves = {}
    for half, frames in (("first", range(1000)), ("second", range(1000, 2000))):
        pictures = {s: [_read(data / "nordland" / s / f"{i:05d}.png") for i in frames] for s in ("summer", "winter")}
        kept = [k for k in range(len(frames)) if all(_contrast(pictures[s][k]) > DARK for s in pictures)]
        for season, images in pictures.items():
            recordings[f"{season} {half}"] = [images[k] for k in kept]
        # A landmark is looked at in its own season alone, so only darkness there leaves it out.
        recordings[f"summer {half} alone"] = [image for image in pictures["summer"] if _contrast(image) > DARK]
        place = np.array(kept)
        halves[half] = [np.flatnonzero(np.abs(place - k) <= TOLERANCE_FRAMES) for k in kept]
        recordings.notes.append(
            f"Nordland, {half} thousand: {len(frames) - len(kept)} frames dark in either season left out of map and "
            f"live, {len(frames) - len(recordings[f'summer {half} alone'])} dark in summer out of the landmarks"
        )
    rng = np.random.default_rng(1)
    recordings["winter second, moved"] = [_moved(image, rng) for image in recordings["winter second"]]
    for group, live in (("Nordland", "winter second"), ("Nordland, moved", "winter second, moved")):
        recordings.trials.append(Trial(group, "summer first alone", "summer second", live, halves["second"]))
    recordings.trials.append(
        Trial("Nordland, report split", "summer second alone", "summer first", "winter first", halves["first"])
    )


def corridor(recordings: Recordings, data: Path) -> None:
    """An indoor corridor walked twice; landmarks from elsewhere, and from every other picture of the first walk."""
    for walk in ("ref", "query"):
        recordings[walk] = [_read(path) for path in sorted((data / "corridor" / walk).glob("*.jpg"))]
    accepted = np.load(data / "corridor" / "ground_truth_new.npy", allow_pickle=True)[:, 1]
    truth = [np.array(ids, np.int64) for ids in accepted]
    recordings["ref even"], recordings["ref odd"] = recordings["ref"][0::2], recordings["ref"][1::2]
    odd = [ids[ids % 2 == 1] // 2 for ids in truth]
    recordings.trials.append(Trial("corridor, Nordland landmarks", "summer first alone", "ref", "query", truth))
    recordings.trials.append(Trial("corridor, own landmarks", "ref even", "ref odd", "query", odd))


def campus(recordings: Recordings, seasons: Sequence[str] = ("winter", "summer", "autumn")) -> None:
    """The client's rendered campus: colour seasons, snow, lateral and heading offsets; all six permutations."""
    places: dict[str, NDArray[np.float64]] = {}
    with tempfile.TemporaryDirectory() as root:
        for drive in write_campus(Path(root), seasons, 300, 0):
            recording = open_source(f"nclt:{root}/{drive.date}")
            recordings[drive.date] = [
                decode_image(recording.image(frame, (128, 128)).body, MAX_PIXELS) for frame in recording.frames
            ]
            places[drive.date] = np.array([(frame.x_m, frame.y_m) for frame in recording.frames], np.float64)
    for landmarks, mapped, live in permutations(places):
        apart = np.linalg.norm(places[live][:, None] - places[mapped][None], axis=2)
        truth = [np.flatnonzero(row <= CAMPUS_TOLERANCE_M) for row in apart]
        recordings.trials.append(Trial("rendered campus", landmarks, mapped, live, truth))


def _read(path: Path) -> Image:
    return decode_image(path.read_bytes(), MAX_PIXELS)


def _contrast(image: Image) -> float:
    return float(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).std())


def _moved(image: Image, rng: np.random.Generator) -> Image:
    """Shifted by up to 5 % sideways and 2 % up or down, turned by up to a degree, zoomed by up to 3 %."""
    height, width = image.shape[:2]
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), rng.uniform(-1, 1), 1 + rng.uniform(-0.03, 0.03))
    turn[:, 2] += rng.uniform(-0.05, 0.05) * width, rng.uniform(-0.02, 0.02) * height
    return np.asarray(cv2.warpAffine(image, turn, (width, height), borderMode=cv2.BORDER_REPLICATE), np.uint8)


def all_recordings(data: Path) -> Recordings:
    """Everything, read or rendered."""
    recordings = Recordings()
    nordland(recordings, data)
    corridor(recordings, data)
    campus(recordings)
    return recordings


def groups(trials: Sequence[Trial]) -> Mapping[str, list[Trial]]:
    """Trials by group, in order of first appearance."""
    found: dict[str, list[Trial]] = {}
    for trial in trials:
        found.setdefault(trial.group, []).append(trial)
    return found
