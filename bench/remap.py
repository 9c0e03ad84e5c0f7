"""A remap of a long domain: its seconds, and what live queries notice of it.

`python -m bench.remap` prints this table alone, and ends with 1 where a limit is not kept.
"""

import json
import sys
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from bench.link import Link
from bench.measurement import Command, Limit, breaches, limit_table, markdown, print_page, work_folder
from bench.robots import LiveRobot, Waits, drive, jpegs
from bench.worlds import ENCODING_DIM, N_CANDIDATES, N_LANDMARKS, NCLT_IMAGES, SPACING_M, write_seasons
from deepsimbad_client import Client
from deepsimbad_client.http.local_server import LocalServer

MOST_SECONDS, MOST_SECONDS_UNDER_LOAD, MOST_MEDIAN_RATIO, MOST_P99_RATIO = 60.0, 120.0, 1.5, 3.0
_DOMAIN, _CAMERA_DOMAIN = "bench", "camera"


@dataclass(frozen=True)
class RemapSize:
    """How much there is to do.

    Attributes:
        n_frames: Of the drive that becomes the map.
        n_candidates: Frames of it that another season shows, among which landmarks are selected.
        episodes: Of training.
        idle_s: How long the robots are measured without a remap.
    """

    n_frames: int = NCLT_IMAGES
    n_candidates: int = N_CANDIDATES
    episodes: int = 10_000
    idle_s: float = 30.0


@dataclass(frozen=True)
class Remapped:
    """Seconds of one remap through HTTP, from the request to the job's end, and of its stages as the job tells them."""

    seconds: float
    stages: dict[str, float]


@dataclass(frozen=True)
class RemapFigures:
    """What was measured.

    Attributes:
        size: How much there was to do.
        alone: A remap while nobody else asks.
        under_load: A remap while the robots ask.
        robots: The robots.
        idle: The waits of each robot before that remap.
        during: The waits of each robot while it went on.
    """

    size: RemapSize
    alone: Remapped
    under_load: Remapped
    robots: Sequence[LiveRobot]
    idle: Sequence[Waits]
    during: Sequence[Waits]

    def limits(self) -> list[Limit]:
        """The limits of the figures."""
        limits = [
            Limit("remap, seconds", self.alone.seconds, MOST_SECONDS),
            Limit("remap beside the robots, seconds", self.under_load.seconds, MOST_SECONDS_UNDER_LOAD),
        ]
        for robot, idle, busy in zip(self.robots, self.idle, self.during, strict=True):
            for share, name, limit in ((0.5, "median", MOST_MEDIAN_RATIO), (0.99, "p99", MOST_P99_RATIO)):
                ratio = busy.quantile_s(share) / idle.quantile_s(share)
                limits.append(Limit(f"{robot.name}: {name} ratio", ratio, limit))
            limits.append(Limit(f"{robot.name}: failures", len(idle.failures) + len(busy.failures), 0))
        return limits


def measured(size: RemapSize) -> RemapFigures:
    """Measure on a service of its own."""
    with work_folder() as folder, LocalServer(folder / "data") as server:
        with Client(server.url) as client:
            client.admin.put_domain(_DOMAIN, {"kind": "feature_l2", "extractor": "none"})
            client.admin.put_domain(_CAMERA_DOMAIN, {"kind": "feature_l2"})
            encoding_dim = client.domain(_CAMERA_DOMAIN).encoding_dim
        write_seasons(folder / "data", _DOMAIN, size.n_frames, size.n_candidates, ENCODING_DIM)
        write_seasons(folder / "data", _CAMERA_DOMAIN, size.n_frames, N_LANDMARKS, encoding_dim)
        _remapped(server.url, _CAMERA_DOMAIN, episodes=0)
        alone = _remapped(server.url, _DOMAIN, size.episodes)
        robots = _robots(size)
        for seconds in (1.0, size.idle_s):
            over_at = time.monotonic() + seconds
            idle = drive(server.url, robots, lambda _: time.monotonic() > over_at)  # noqa: B023
        with ThreadPoolExecutor(1) as pool:
            remap = pool.submit(_remapped, server.url, _DOMAIN, size.episodes)
            during = drive(server.url, robots, lambda _: remap.done())
    return RemapFigures(size, alone, remap.result(), robots, idle, during)


def _robots(size: RemapSize) -> list[LiveRobot]:
    rng = np.random.default_rng(2)
    ranks = [json.dumps({"ranked_landmarks": rng.permutation(N_LANDMARKS).tolist()}).encode() for _ in range(50)]
    pictures = jpegs(20)
    kilobytes = sum(map(len, pictures)) / len(pictures) / 1e3
    camera, session_length = "`POST localizations`, JPEG of 1232 x 1616", min(500, int(size.n_frames * SPACING_M))
    return [
        LiveRobot("`POST localizations`, ranks", _DOMAIN, ranks, pause_s=0.02),
        LiveRobot("`POST observations`, ranks", _DOMAIN, ranks, session_length=session_length, pause_s=0.02),
        # NCLT's camera takes five pictures a second.
        LiveRobot(f"{camera}, {kilobytes:.0f} kB", _CAMERA_DOMAIN, pictures, "image/jpeg", pause_s=0.2),
    ]


def _remapped(url: str, domain: str, episodes: int) -> Remapped:
    config = {"training_traverse": "training", "landmark_traverse": "landmarks", "n_landmarks": N_LANDMARKS}
    start_s = time.perf_counter()
    with Link(url) as link:
        job = link.remap(domain, {**config, "training_episodes": episodes})
    return Remapped(time.perf_counter() - start_s, job["result"]["metrics"]["seconds"])


def report(figures: RemapFigures) -> Iterator[str]:
    """Markdown lines."""
    size, alone = figures.size, figures.alone
    yield (
        f"## Remap: {size.n_frames:,} frames of {ENCODING_DIM:,} numbers, {N_LANDMARKS} of {size.n_candidates:,} "
        f"landmarks, {size.episodes:,} episodes"
    )
    yield ""
    stages = {stage.replace("_", " "): seconds for stage, seconds in alone.stages.items()}
    rest = {"its process, digest of the frames, seal, activate": alone.seconds - sum(stages.values())}
    everything = {**stages, **rest, "from the request to the end of the job": alone.seconds}
    yield from markdown(("stage", "seconds"), [(name, f"{seconds:.1f}") for name, seconds in everything.items()])
    yield ""
    pauses = ", ".join(f"{1000 * robot.pause_s:.0f}" for robot in figures.robots)
    yield (
        f"{len(figures.robots)} robots meanwhile, with {pauses} ms between an answer and the next request, on the map "
        f"of before; the pictures on a domain of its own with {size.n_frames:,} map images. "
        f"The remap took {figures.under_load.seconds:.1f} s beside them."
    )
    yield ""
    rows = []
    for robot, idle, busy in zip(figures.robots, figures.idle, figures.during, strict=True):
        failures = [*idle.failures, *busy.failures]
        kinds = f" ({', '.join(sorted(set(failures)))})" if failures else ""
        share = f"{len(failures)}{kinds} of {len(idle.seconds) + len(busy.seconds)}"
        rows.append((robot.name, idle, busy, share, " then ".join(map(str, busy.map_versions))))
    head = ("robot", "idle: median, p99", "during the next remap: median, p99", "failures", "map versions")
    yield from markdown(head, rows)
    yield ""
    yield from limit_table(figures.limits())


def remap_table() -> Iterator[str]:
    """Markdown lines."""
    yield from report(measured(RemapSize()))


def measure(arguments: Namespace) -> None:
    """Print the table; ends with 1 where a limit is not kept."""
    figures = measured(RemapSize(**vars(arguments)))
    print_page(report(figures))
    sys.exit(breaches(figures.limits()))


if __name__ == "__main__":
    default, command = RemapSize(), Command(__doc__)
    command.add_argument("--frames", type=int, default=default.n_frames, dest="n_frames")
    command.add_argument("--candidates", type=int, default=default.n_candidates, dest="n_candidates")
    command.add_argument("--episodes", type=int, default=default.episodes)
    command.add_argument("--idle", type=float, default=default.idle_s, dest="idle_s", metavar="SECONDS")
    command.run(measure)
