"""A remap of a long domain: its seconds, and what live queries notice of it."""

import asyncio
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.bare_connection import BareConnection
from bench.landmarks import N_CANDIDATES
from bench.timing import duration
from bench.worlds import ENCODING_DIM, N_LANDMARKS, NCLT_IMAGES
from deepsimbad.store.frames import UNKNOWN_TIMESTAMP, TraverseFrames
from deepsimbad.store.traverses import Traverse
from deepsimbad_client import Client
from deepsimbad_client.local_server import LocalServer

EPISODES = 10_000
MOST_SECONDS, MOST_SECONDS_UNDER_LOAD, MOST_MEDIAN_RATIO, MOST_P99_RATIO = 60.0, 120.0, 1.5, 3.0
_IDLE_S = 30.0
_PAUSE_S = 0.02  # between an answer and the next request of the same robot
_SESSION_LENGTH = 500  # moves of 1 m, then another: the route has an end
_SPACING_M = 0.2
_BLOCK = 1024
_DOMAIN = "bench"
_STAGES = ("read_frames", "select_landmarks", "describe", "train", "check")
_CONFIG = {
    "training_traverse": "training",
    "landmark_traverse": "landmarks",
    "n_landmarks": N_LANDMARKS,
    "training_episodes": EPISODES,
}


def remap_table() -> Iterator[str]:
    """Markdown lines."""
    yield (
        f"## Remap: {NCLT_IMAGES:,} frames of {ENCODING_DIM:,} numbers, {N_LANDMARKS} of {N_CANDIDATES:,} landmarks, "
        f"{EPISODES:,} episodes"
    )
    yield ""
    with tempfile.TemporaryDirectory() as folder, LocalServer(Path(folder) / "data") as server:
        with Client(server.url) as client:
            client.admin.put_domain(_DOMAIN, {"kind": "feature_l2", "extractor": "none"})
        write_seasons(Path(folder) / "data")
        alone = asyncio.run(_remapped(server.url))
        yield "| stage | seconds |"
        yield "|---|---|"
        for stage in _STAGES:
            yield f"| {stage.replace('_', ' ')} | {alone.stages[stage]:.1f} |"
        rest = alone.seconds - sum(alone.stages[stage] for stage in _STAGES)
        yield f"| its process, digest of the frames, seal, activate | {rest:.1f} |"
        yield f"| from the request to the end of the job (at most {MOST_SECONDS:.0f}) | {alone.seconds:.1f} |"
        yield ""
        idle, during, remap = asyncio.run(_driven(server.url))
    yield (
        "Two robots meanwhile, one observing in a session and one localizing, each with "
        f"{1000 * _PAUSE_S:.0f} ms between an answer and the next request, on the map of before:"
    )
    yield ""
    yield (
        "| call | idle: median, p99 | during the next remap: median, p99 "
        f"| median ratio (at most {MOST_MEDIAN_RATIO:g}) | p99 ratio (at most {MOST_P99_RATIO:g}) "
        "| failures | map versions |"
    )
    yield "|---|---|---|---|---|---|---|"
    for before, after in zip(idle, during, strict=True):
        yield (
            f"| `POST {before.what}` | {before} | {after} | {after.median_s / before.median_s:.2f} "
            f"| {after.p99_s / before.p99_s:.2f} | {_counted(before.failures + after.failures)} "
            f"of {after.n_all + before.n_all} | {after.versions} |"
        )
    yield ""
    yield f"That remap took {remap.seconds:.1f} s (at most {MOST_SECONDS_UNDER_LOAD:.0f})."


def _counted(failures: list[str]) -> str:
    """How many, and which."""
    return f"{len(failures)} ({', '.join(sorted(set(failures)))})" if failures else "0"


@dataclass(frozen=True)
class Remapped:
    """One remap through HTTP.

    Attributes:
        seconds: From the request to the job's end, seen by polling.
        stages: Seconds of every stage, as the job tells them.
    """

    seconds: float
    stages: dict[str, float]


@dataclass
class Waits:
    """What one robot met with.

    Attributes:
        what: The call.
        seconds: Of every answer.
        failures: Status and code of answers that were no belief.
        map_versions: Of the answers, as they came, changes alone.
    """

    what: str
    seconds: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    map_versions: list[int] = field(default_factory=list)

    @property
    def n_all(self) -> int:
        """Answers in all."""
        return len(self.seconds)

    @property
    def median_s(self) -> float:
        """Seconds."""
        return float(np.median(self.seconds))

    @property
    def p99_s(self) -> float:
        """Seconds."""
        return float(np.quantile(self.seconds, 0.99))

    @property
    def versions(self) -> str:
        """In the order they came."""
        return " then ".join(map(str, self.map_versions))

    def __str__(self) -> str:
        return f"{duration(self.median_s)}, {duration(self.p99_s)} ({self.n_all})"


async def _remapped(url: str) -> Remapped:
    connection = await BareConnection.to(url)
    began = time.perf_counter()
    status, answer = await connection.request(
        "POST", f"/v1/admin/domains/{_DOMAIN}/remaps", json.dumps(_CONFIG).encode()
    )
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


async def _driven(url: str) -> tuple[list[Waits], list[Waits], Remapped]:
    """Two robots, first alone, then beside a remap."""
    paths = ["localizations", "observations"]
    await _drive(url, [Waits(path) for path in paths], asyncio.create_task(asyncio.sleep(1.0)))
    idle, during = ([Waits(path) for path in paths] for _ in range(2))
    await _drive(url, idle, asyncio.create_task(asyncio.sleep(_IDLE_S)))
    remap = asyncio.create_task(_remapped(url))
    await _drive(url, during, remap)
    return idle, during, await remap


async def _drive(url: str, robots: list[Waits], until: "asyncio.Task[Any]") -> None:
    """Let every robot ask until something is done, and once more."""
    await asyncio.gather(*(_ask(url, waits, until) for waits in robots))


async def _ask(url: str, waits: Waits, until: "asyncio.Task[Any]") -> None:
    rng = np.random.default_rng(2)
    bodies = [json.dumps({"ranked_landmarks": rng.permutation(N_LANDMARKS).tolist()}).encode() for _ in range(50)]
    connection = await BareConnection.to(url)
    path = f"/v1/domains/{_DOMAIN}/localizations"
    n_asked, is_last = 0, False
    while not is_last:
        is_last = until.done()
        if waits.what == "observations" and n_asked % _SESSION_LENGTH == 0:
            path = f"/v1/sessions/{await _session(connection)}/observations?action_m=1"
        began = time.perf_counter()
        status, answer = await connection.request("POST", path, bodies[n_asked % len(bodies)])
        waits.seconds.append(time.perf_counter() - began)
        said = json.loads(answer)
        if status != 200:
            waits.failures.append(f"{status} {said['code']}")
        elif waits.map_versions[-1:] != [said["map_version"]]:
            waits.map_versions.append(said["map_version"])
        n_asked += 1
        await asyncio.sleep(_PAUSE_S)
    connection.close()


async def _session(connection: BareConnection) -> str:
    status, answer = await connection.request("POST", f"/v1/domains/{_DOMAIN}/sessions", b"{}")
    if status != 201:
        raise RuntimeError(f"no session: {answer!r}")
    return str(json.loads(answer)["session_id"])


def write_seasons(data_dir: Path) -> None:
    """Two drives of one wandering route, straight into their files: an upload is not what is measured here."""
    frames_of = np.linspace(0, NCLT_IMAGES - 1, N_CANDIDATES).round().astype(np.int64)
    with (
        Traverse.create(data_dir, _DOMAIN, "training") as training,
        Traverse.create(data_dir, _DOMAIN, "landmarks") as landmarks,
    ):
        rng = np.random.default_rng(0)
        level = rng.standard_normal(ENCODING_DIM, dtype=np.float32)
        for start in range(0, NCLT_IMAGES, _BLOCK):
            places = np.empty((min(_BLOCK, NCLT_IMAGES - start), ENCODING_DIM), np.float32)
            for place in places:
                level = np.float32(0.98) * level + np.float32(0.2) * rng.standard_normal(ENCODING_DIM, np.float32)
                place[:] = level
            index = np.arange(start, start + len(places))
            training.put_frames(_season(places, index, index, rng))
            chosen = np.flatnonzero((frames_of >= start) & (frames_of < start + len(places)))
            landmarks.put_frames(_season(places[frames_of[chosen] - start], chosen, frames_of[chosen], rng))


def _season(
    places: NDArray[np.float32], index: NDArray[np.int64], frame: NDArray[np.int64], rng: np.random.Generator
) -> TraverseFrames:
    """The places as one season shows them: unit vectors, as NetVLAD's are."""
    seen = places + np.float32(0.7) * rng.standard_normal(places.shape, np.float32)
    seen = (seen / np.linalg.norm(seen, axis=1, keepdims=True)).astype(np.float32)
    unknown = np.full(index.size, np.nan)
    times = np.full(index.size, UNKNOWN_TIMESTAMP)
    return TraverseFrames(index, (frame * _SPACING_M).astype(np.float64), times, unknown, unknown, seen)


if __name__ == "__main__":
    for line in remap_table():
        print(line, flush=True)
