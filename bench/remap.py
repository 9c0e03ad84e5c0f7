"""A remap of a long domain: its seconds, and what live queries notice of it.

`python -m bench.remap` prints this table alone, and ends with 1 where a limit is not kept.
"""

import argparse
import asyncio
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.building import N_CANDIDATES
from bench.common import Limit, breaches, limit_table
from bench.robots import BareConnection, LiveRobot, Waits, drive, jpegs
from bench.worlds import ENCODING_DIM, N_LANDMARKS, NCLT_IMAGES, SPACING_M, write_seasons
from deepsimbad_client import Client
from deepsimbad_client.http.local_server import LocalServer

MOST_SECONDS, MOST_SECONDS_UNDER_LOAD, MOST_MEDIAN_RATIO, MOST_P99_RATIO = 60.0, 120.0, 1.5, 3.0
_SESSION_LENGTH = 500
_N_PICTURES = 20
_CAMERA_PERIOD_S = 0.2  # NCLT's camera takes five pictures a second
_DOMAIN, _CAMERA_DOMAIN = "bench", "camera"
_STAGES = ("read_frames", "select_landmarks", "describe", "train", "check")


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
    """One remap through HTTP.

    Attributes:
        seconds: From the request to the job's end, seen by polling.
        stages: Seconds of every stage, as the job tells them.
    """

    seconds: float
    stages: dict[str, float]


@dataclass(frozen=True)
class RemapFigures:
    """What was measured.

    Attributes:
        size: Of what.
        alone: A remap that nobody asks beside.
        beside: One beside the robots.
        robots: They.
        idle: What each met with before that remap.
        during: And while it went on.
    """

    size: RemapSize
    alone: Remapped
    beside: Remapped
    robots: Sequence[LiveRobot]
    idle: Sequence[Waits]
    during: Sequence[Waits]

    def limits(self) -> list[Limit]:
        """What must be kept."""
        limits = [
            Limit("remap, seconds", self.alone.seconds, MOST_SECONDS),
            Limit("remap beside the robots, seconds", self.beside.seconds, MOST_SECONDS_UNDER_LOAD),
        ]
        for robot, before, after in zip(self.robots, self.idle, self.during, strict=True):
            limits += [
                Limit(f"{robot.name}: median ratio", after.median_s / before.median_s, MOST_MEDIAN_RATIO),
                Limit(f"{robot.name}: p99 ratio", after.p99_s / before.p99_s, MOST_P99_RATIO),
                Limit(f"{robot.name}: failures", len(before.failures) + len(after.failures), 0),
            ]
        return limits


def measured(size: RemapSize) -> RemapFigures:
    """Measure a service of its own."""
    with tempfile.TemporaryDirectory() as folder, LocalServer(Path(folder) / "data") as server:
        with Client(server.url) as client:
            client.admin.put_domain(_DOMAIN, {"kind": "feature_l2", "extractor": "none"})
            client.admin.put_domain(_CAMERA_DOMAIN, {"kind": "feature_l2"})
            encoding_dim = client.domain(_CAMERA_DOMAIN).encoding_dim
        write_seasons(Path(folder) / "data", _DOMAIN, size.n_frames, size.n_candidates, ENCODING_DIM)
        few = RemapSize(size.n_frames, N_LANDMARKS, episodes=0)
        write_seasons(Path(folder) / "data", _CAMERA_DOMAIN, few.n_frames, few.n_candidates, encoding_dim)
        asyncio.run(_remapped(server.url, _CAMERA_DOMAIN, few))
        alone = asyncio.run(_remapped(server.url, _DOMAIN, size))
        robots = _robots(size)
        idle, during, beside = asyncio.run(_driven(server.url, robots, size))
    return RemapFigures(size, alone, beside, robots, idle, during)


def report(figures: RemapFigures) -> Iterator[str]:
    """Markdown lines."""
    size, alone = figures.size, figures.alone
    yield (
        f"## Remap: {size.n_frames:,} frames of {ENCODING_DIM:,} numbers, {N_LANDMARKS} of {size.n_candidates:,} "
        f"landmarks, {size.episodes:,} episodes"
    )
    yield ""
    yield "| stage | seconds |"
    yield "|---|---|"
    for stage in _STAGES:
        yield f"| {stage.replace('_', ' ')} | {alone.stages[stage]:.1f} |"
    rest = alone.seconds - sum(alone.stages[stage] for stage in _STAGES)
    yield f"| its process, digest of the frames, seal, activate | {rest:.1f} |"
    yield f"| from the request to the end of the job | {alone.seconds:.1f} |"
    yield ""
    pauses = ", ".join(f"{1000 * robot.pause_s:.0f}" for robot in figures.robots)
    yield (
        f"{len(figures.robots)} robots meanwhile, with {pauses} ms between an answer and the next request, on the map "
        f"of before; the pictures on a domain of its own with {size.n_frames:,} map images. "
        f"The remap took {figures.beside.seconds:.1f} s beside them."
    )
    yield ""
    yield "| robot | idle: median, p99 | during the next remap: median, p99 | failures | map versions |"
    yield "|---|---|---|---|---|"
    for robot, before, after in zip(figures.robots, figures.idle, figures.during, strict=True):
        yield (
            f"| {robot.name} | {before} | {after} | {_counted(before.failures + after.failures)} "
            f"of {before.n_all + after.n_all} | {after.versions} |"
        )
    yield ""
    yield from limit_table(figures.limits())


def remap_table() -> Iterator[str]:
    """Markdown lines."""
    yield from report(measured(RemapSize()))


def _counted(failures: list[str]) -> str:
    """How many, and which."""
    return f"{len(failures)} ({', '.join(sorted(set(failures)))})" if failures else "0"


def _robots(size: RemapSize) -> list[LiveRobot]:
    rng = np.random.default_rng(2)
    ranks = [json.dumps({"ranked_landmarks": rng.permutation(N_LANDMARKS).tolist()}).encode() for _ in range(50)]
    pictures = jpegs(_N_PICTURES)
    kilobytes = sum(map(len, pictures)) / len(pictures) / 1e3
    session_length = min(_SESSION_LENGTH, int(size.n_frames * SPACING_M))
    return [
        LiveRobot("`POST localizations`, ranks", _DOMAIN, ranks),
        LiveRobot("`POST observations`, ranks", _DOMAIN, ranks, session_length=session_length),
        LiveRobot(
            f"`POST localizations`, JPEG of 1232 x 1616, {kilobytes:.0f} kB",
            _CAMERA_DOMAIN,
            pictures,
            "image/jpeg",
            pause_s=_CAMERA_PERIOD_S,
        ),
    ]


async def _driven(url: str, robots: Sequence[LiveRobot], size: RemapSize) -> tuple[list[Waits], list[Waits], Remapped]:
    """The robots, first alone, then beside a remap."""
    await drive(url, robots, asyncio.create_task(asyncio.sleep(1.0)))
    idle = await drive(url, robots, asyncio.create_task(asyncio.sleep(size.idle_s)))
    remap = asyncio.create_task(_remapped(url, _DOMAIN, size))
    during = await drive(url, robots, remap)
    return idle, during, await remap


async def _remapped(url: str, domain: str, size: RemapSize) -> Remapped:
    config = {
        "training_traverse": "training",
        "landmark_traverse": "landmarks",
        "n_landmarks": N_LANDMARKS,
        "training_episodes": size.episodes,
    }
    connection = await BareConnection.to(url)
    began = time.perf_counter()
    status, answer = await connection.request("POST", f"/v1/admin/domains/{domain}/remaps", json.dumps(config).encode())
    job: dict[str, Any] = json.loads(answer)
    if status != 202:
        raise RuntimeError(f"no remap: {job}")
    while job["state"] in {"queued", "running"}:
        await asyncio.sleep(0.25)
        job = json.loads((await connection.request("GET", f"/v1/admin/jobs/{job['job_id']}"))[1])
    seconds = time.perf_counter() - began
    connection.close()
    if job["state"] != "succeeded":
        raise RuntimeError(f"the remap failed: {job}")
    return Remapped(seconds, job["result"]["metrics"]["seconds"])


def main() -> None:
    """Print the table; ends with 1 where a limit is not kept."""
    usual = RemapSize()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=usual.n_frames)
    parser.add_argument("--candidates", type=int, default=usual.n_candidates)
    parser.add_argument("--episodes", type=int, default=usual.episodes)
    parser.add_argument("--idle", type=float, default=usual.idle_s, metavar="SECONDS")
    given = parser.parse_args()
    figures = measured(RemapSize(given.frames, given.candidates, given.episodes, given.idle))
    print("\n".join(report(figures)), flush=True)
    sys.exit(breaches(figures.limits()))


if __name__ == "__main__":
    main()
