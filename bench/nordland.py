"""Nordland through real HTTP: landmarks and map from summer, live images from winter, every call stateless.

    python -m bench.nordland

Landmarks come from summer frames 1000..1999, the map from summer 0..999, the robot from winter 0..999. A frame is
left out where an image that would be used of it shows nothing (a tunnel): its grey levels' standard deviation is at
most 8 (of the map's frames in either season, of the landmarks' in summer, the only season used of them). One frame
is one metre; a match within two frames is right.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from bench.measurement import RESULTS, Command, machine, markdown, print_page, work_folder
from bench.recordings import real_recordings
from deepsimbad_client import Client
from deepsimbad_client.http.admin import remap
from deepsimbad_client.http.local_server import LocalServer
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay.passive import replay
from deepsimbad_client.replay.report import summarise

DOMAIN = "nordland"
RELEVANCES = ("composed", "standardised", "rrf", "bag_of_landmarks", "simbad", "brute_force")
TOLERANCE_M = 2.0
REMAP: dict[str, Any] = {"landmark_traverse": "landmarks", "n_landmarks": 300, "list_length": 4}
N_FRAMES = 1000
MAP_FRAMES, LANDMARK_FRAMES = range(N_FRAMES), range(N_FRAMES, 2 * N_FRAMES)
_LEAST_GREY_STD = 8.0


@dataclass(frozen=True)
class Measured:
    """The client's summary of every relevance's replay, and how many frames of map and landmarks were left out."""

    summaries: dict[str, dict[str, Any]]
    n_map_frames_left_out: int
    n_landmark_frames_left_out: int
    extractor: str


def kept_frames(seasons: tuple[Path, ...], numbers: range) -> list[int]:
    """The frames that show something in every one of these seasons."""
    return [number for number in numbers if all(_shows_something(season / f"{number:05}.png") for season in seasons)]


def _shows_something(path: Path) -> bool:
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise FileNotFoundError(f"no image at {path}")
    return float(grey.std()) > _LEAST_GREY_STD


def season_folder(folder: Path, season: Path, numbers: list[int], first: int) -> Path:
    """A folder of links to some frames, with their positions: one metre a frame from `first`."""
    folder.mkdir()
    lines = ["name,position_m"]
    for number in numbers:
        name = f"{number:05}.png"
        (folder / name).symlink_to((season / name).resolve())
        lines.append(f"{name},{number - first}")
    (folder / "positions.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def drive_folders(nordland: Path, work: Path, n_frames: int = N_FRAMES) -> tuple[dict[str, Path], int, int]:
    """Folders `landmarks`, `map` and `live`, and how many frames of map and landmarks were left out.

    Args:
        n_frames: How many of the frames of map and landmarks to take, from the first on.
    """
    summer, winter = nordland / "summer", nordland / "winter"
    map_frames = kept_frames((summer, winter), MAP_FRAMES[:n_frames])
    landmark_frames = kept_frames((summer,), LANDMARK_FRAMES[:n_frames])
    drives = {
        "landmarks": season_folder(work / "landmarks", summer, landmark_frames, LANDMARK_FRAMES.start),
        "map": season_folder(work / "map", summer, map_frames, MAP_FRAMES.start),
        "live": season_folder(work / "live", winter, map_frames, MAP_FRAMES.start),
    }
    return drives, n_frames - len(map_frames), n_frames - len(landmark_frames)


def measure(nordland: Path, work: Path, relevances: tuple[str, ...] = RELEVANCES, n_frames: int = N_FRAMES) -> Measured:
    """Upload, remap and replay against a service of our own.

    Args:
        nordland: The folder that holds `summer` and `winter`.
        work: An empty folder.
        relevances: The maps to make, one after the other.
        n_frames: As in `drive_folders`.
    """
    drives, n_map_left_out, n_landmarks_left_out = drive_folders(nordland, work, n_frames)
    live, summaries = open_source(str(drives["live"])), {}
    with LocalServer(work / "data") as server, Client(server.url) as client:
        make_domain(client, drives)
        for relevance in relevances:
            remap(client, DOMAIN, "map", relevance=relevance, **REMAP)
            # One query at a time: the time an answer takes is then the service's, not a queue's.
            drive_replay = replay(client, live, DOMAIN, work / relevance, tolerance_m=TOLERANCE_M, concurrency=1)
            summaries[relevance] = summarise(drive_replay)
        evaluator = client.domain(DOMAIN).evaluator
    extractor = evaluator["extractor"] if isinstance(evaluator, dict) else str(evaluator)
    return Measured(summaries, n_map_left_out, n_landmarks_left_out, extractor)


def make_domain(client: Client, drives: dict[str, Path]) -> None:
    """Make the domain, and upload the traverses `landmarks` and `map`."""
    client.admin.put_domain(DOMAIN, {"kind": "feature_l2"})
    for name in ("landmarks", "map"):
        upload(client, open_source(str(drives[name])), DOMAIN, name)


def report(measured: Measured) -> Iterator[str]:
    """The lines of the page."""
    yield from ("# Nordland over HTTP: map summer, drive winter", "")
    yield (
        "Real images, posted one by one to a running service, each localized on its own (stateless: the map's "
        "statistics alone). Landmarks come from another part of the route: `composed` has no second season to learn "
        "from."
    )
    yield from ("", "Made by `python -m bench.nordland`.", "", machine(), "")
    rows = [
        (
            name,
            f"{of['anr']:.2f}",
            f"{of['recall_at_1']:.1f}",
            f"{of['recall_at_5']:.1f}",
            f"{of['latency_ms']['median']:.1f}",
        )
        for name, of in measured.summaries.items()
    ]
    yield from markdown(("relevance", "ANR %", "R@1 %", "R@5 %", "ms a call, median"), rows)
    yield ""
    first = next(iter(measured.summaries.values()))
    yield (
        f"{first['n_queries']} queries against {first['n_map_images']} map images. Left out because an image "
        f"shows nothing (grey levels' standard deviation at most {_LEAST_GREY_STD:g}): "
        f"{measured.n_map_frames_left_out} of frames 0..999, where either season counts, and "
        f"{measured.n_landmark_frames_left_out} of the landmarks' 1000..1999 in summer. "
        f"r = {REMAP['n_landmarks']}, h = {REMAP['list_length']}, tolerance {TOLERANCE_M:g} frames, "
        f"extractor {measured.extractor}. ANR: 0 is perfect, 50 chance. Times are of a machine shared with other work."
    )


def lines() -> Iterator[str]:
    """Measure; the lines of the page."""
    nordland = real_recordings() / "nordland"
    with work_folder() as work:
        yield from report(measure(nordland, work))


if __name__ == "__main__":
    Command(__doc__).run(lambda _: print_page(lines(), RESULTS / "nordland-http.md"))
