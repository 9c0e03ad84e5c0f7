"""Answers over loopback: stateless, durable sessions of one robot and of many, and a start after a kill."""

import asyncio
import http.client
import json
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Self
from urllib.parse import urlsplit

import numpy as np

from bench.common import Timing, timed
from bench.robots import BareConnection
from bench.worlds import N_LANDMARKS, NCLT_IMAGES
from deepsimbad_client import Client
from deepsimbad_client.http.local_server import LocalServer

_DIM = 64  # short encodings: what is measured never sees them


def http_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## HTTP: `POST localizations` on loopback, {NCLT_IMAGES:,} map images, one client"
    yield ""
    yield "| body | by | median |"
    yield "|---|---|---|"
    rng = np.random.default_rng(0)
    ranked = rng.permutation(N_LANDMARKS).tolist()
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalServer(Path(folder) / "data") as server,
        Client(server.url) as client,
    ):
        make_map(client, rng)
        for count in (N_LANDMARKS, 4):
            sent = ranked[:count]
            yield f"| {count} ranked landmarks | a bare HTTP/1.1 connection | {_bare(server.url, sent)} |"
            by_client = timed(partial(client.localize, "bench", ranked_landmarks=sent), 500, 50)
            yield f"| {count} ranked landmarks | `deepsimbad_client.Client` | {by_client} |"
        answer = client.localize("bench", ranked_landmarks=ranked)
    stages = ", ".join(f"{stage} {milliseconds:.3f}" for stage, milliseconds in answer.timings_ms.items())
    yield ""
    yield f"Inside the service, in ms: {stages}"


def _bare(url: str, ranked: list[int]) -> Timing:
    body = json.dumps({"ranked_landmarks": ranked}).encode()
    with closing(http.client.HTTPConnection(urlsplit(url).netloc)) as connection:
        return timed(lambda: _post(connection, body), 500, 50)


def _post(connection: http.client.HTTPConnection, body: bytes) -> None:
    connection.request("POST", "/v1/domains/bench/localizations", body, {"Content-Type": "application/json"})
    response = connection.getresponse()
    answer = response.read()
    if response.status != http.client.OK:
        raise RuntimeError(answer.decode())


def make_map(client: Client, rng: np.random.Generator) -> None:
    """Upload a wandering traverse and map it, through the same calls a user has."""
    wander = np.cumsum(rng.normal(size=(NCLT_IMAGES, _DIM)), axis=0)
    encodings = (wander / np.linalg.norm(wander, axis=1, keepdims=True)).astype(np.float32)
    client.admin.put_domain("bench", {"kind": "feature_l2", "extractor": "none"})
    for name, rows in (("landmarks", encodings[::5]), ("training", encodings)):
        client.admin.create_traverse("bench", name)
        client.admin.put_frames(
            "bench", name, encodings=rows, index=np.arange(len(rows)), position_m=np.arange(len(rows)) * 0.2
        )
    job = client.admin.remap(
        "bench", training_traverse="training", landmark_traverse="landmarks", n_landmarks=N_LANDMARKS
    )
    while not job.ended:
        job = client.admin.job(job.job_id)
    if job.state != "succeeded":
        raise RuntimeError(f"the benchmark's map failed: {job.error_text}")


ROBOTS = 50
_ONE_ROBOT_VIEWS, _EACH_ROBOT_VIEWS, _WARM_UP = 300, 40, 20
_ACTION_M = 1.0


def session_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## Sessions: `POST observations` on loopback, {NCLT_IMAGES:,} map images, {N_LANDMARKS} ranks, durable"
    yield ""
    yield "| robots | an observation | observations a second in all | errors | counted by the service |"
    yield "|---|---|---|---|---|"
    with tempfile.TemporaryDirectory() as folder, LocalServer(Path(folder) / "data") as server:
        with Client(server.url) as client:
            make_map(client, np.random.default_rng(0))
        asyncio.run(drive_sessions(server.url, 1, _WARM_UP))
        for n_robots, n_views in ((1, _ONE_ROBOT_VIEWS), (ROBOTS, _EACH_ROBOT_VIEWS)):
            driven = asyncio.run(drive_sessions(server.url, n_robots, n_views))
            yield (
                f"| {n_robots} | {driven.timing} | {driven.per_second:.0f} | {driven.n_errors} "
                f"| {driven.n_counted} of {n_robots * n_views} |"
            )
    yield ""
    yield f"Inside the service, in ms, {ROBOTS} robots: {driven.stages}"


@dataclass(frozen=True)
class Driven:
    """What many robots met with.

    Attributes:
        timing: Of every observation, from its first byte sent to the last of its answer.
        seconds: From the first to the last of all.
        n_errors: Answers that were no belief.
        n_counted: Observations that the service says it has.
        stages: Median milliseconds of the stages in the service.
    """

    timing: Timing
    seconds: float
    n_errors: int
    n_counted: int
    stages: str

    @property
    def per_second(self) -> float:
        """Observations answered a second."""
        return len(self.timing.seconds) / self.seconds


async def drive_sessions(url: str, n_robots: int, n_views: int) -> Driven:
    """Let robots observe at once, each as fast as it is answered."""
    rng = np.random.default_rng(1)
    bodies = [
        json.dumps({"ranked_landmarks": rng.permutation(N_LANDMARKS).tolist()}).encode() for _ in range(n_robots + 20)
    ]
    robots = [await _Robot.begin(url) for _ in range(n_robots)]
    began = perf_counter()
    await asyncio.gather(*(robot.observe(bodies[place:], n_views) for place, robot in enumerate(robots)))
    seconds = perf_counter() - began
    n_counted = sum([await robot.n_observations() for robot in robots])
    for robot in robots:
        robot.close()
    every = [spent for robot in robots for spent in robot.seconds]
    stages: dict[str, list[float]] = {}
    for robot in robots:
        for timings_ms in robot.timings_ms:
            for stage, spent in timings_ms.items():
                stages.setdefault(stage, []).append(spent)
    medians = ", ".join(f"{stage} {np.median(spent):.2f}" for stage, spent in stages.items())
    return Driven(Timing(tuple(every)), seconds, sum(robot.n_errors for robot in robots), n_counted, medians)


class _Robot:
    """One session over one bare connection."""

    def __init__(self, connection: BareConnection) -> None:
        self._connection = connection
        self.session_id = ""
        self.seconds: list[float] = []
        self.timings_ms: list[dict[str, float]] = []
        self.n_errors = 0

    @classmethod
    async def begin(cls, url: str) -> Self:
        """Connect and begin a session."""
        robot = cls(await BareConnection.to(url))
        status, answer = await robot._connection.request("POST", "/v1/domains/bench/sessions", b"{}")
        if status != 201:
            raise RuntimeError(f"no session: {answer!r}")
        robot.session_id = json.loads(answer)["session_id"]
        return robot

    async def observe(self, bodies: list[bytes], n_views: int) -> None:
        """Observe again and again."""
        path = f"/v1/sessions/{self.session_id}/observations?action_m={_ACTION_M}"
        for view in range(n_views):
            began = perf_counter()
            status, answer = await self._connection.request("POST", path, bodies[view % len(bodies)], f"view-{view}")
            self.seconds.append(perf_counter() - began)
            if status == 200:
                if view % 10 == 0:
                    self.timings_ms.append(json.loads(answer)["timings_ms"])
            else:
                self.n_errors += 1

    async def n_observations(self) -> int:
        """How many the service has counted."""
        _, answer = await self._connection.request("GET", f"/v1/sessions/{self.session_id}")
        document: dict[str, Any] = json.loads(answer)
        return int(document["n_observations"])

    def close(self) -> None:
        self._connection.close()


_KILLS = 7


def restart_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## Restart: from `kill -9` to a ready service, {NCLT_IMAGES:,} map images"
    yield ""
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        data_dir = Path(folder) / "data"
        with LocalServer(data_dir) as server, Client(server.url) as client:
            make_map(client, np.random.default_rng(0))
        for _ in range(_KILLS):
            server = LocalServer(data_dir)
            began = perf_counter()
            server.start()
            seconds.append(perf_counter() - began)
            server.kill()
    yield f"From the start of the process to `/readyz` answering 200: {Timing(tuple(seconds))}."
