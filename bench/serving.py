"""Answers over loopback: stateless, durable sessions of one robot and of many, and a start after a kill."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from bench.link import Link
from bench.measurement import Timing, markdown, timed, work_folder
from bench.robots import LiveRobot, drive
from bench.worlds import N_LANDMARKS, NCLT_IMAGES
from deepsimbad_client import Client
from deepsimbad_client.http.local_server import LocalServer

ROBOTS, _KILLS, _DIM = 50, 7, 64  # short encodings: what is measured never sees them


@contextmanager
def mapped_service(**arrays: np.ndarray) -> Iterator[LocalServer]:
    """A service with a wandering drive mapped through its HTTP calls; `arrays` are further ones of its frames."""
    wander = np.cumsum(np.random.default_rng(0).normal(size=(NCLT_IMAGES, _DIM)), axis=0)
    encodings = (wander / np.linalg.norm(wander, axis=1, keepdims=True)).astype(np.float32)
    with work_folder() as folder, LocalServer(folder / "data") as server:
        with Link(server.url) as link:
            link.ask("PUT", "/v1/admin/domains/bench", {"evaluator": {"kind": "feature_l2", "extractor": "none"}})
            link.upload("bench", "landmarks", np.arange(len(encodings[::5])) * 0.2, encodings[::5])
            link.upload("bench", "training", np.arange(NCLT_IMAGES) * 0.2, encodings, **arrays)
            config = {"training_traverse": "training", "landmark_traverse": "landmarks", "n_landmarks": N_LANDMARKS}
            link.remap("bench", config)
        yield server


def http_table() -> Iterator[str]:
    """Markdown lines."""
    yield from (f"## HTTP: `POST localizations` on loopback, {NCLT_IMAGES:,} map images, one client", "")
    ranked, rows = np.random.default_rng(0).permutation(N_LANDMARKS).tolist(), []
    path, headers = "/v1/domains/bench/localizations", {"Content-Type": "application/json"}
    with mapped_service() as server, Client(server.url) as client, Link(server.url) as link:
        for count in (N_LANDMARKS, 4):
            ranks = ranked[:count]
            body = json.dumps({"ranked_landmarks": ranks}).encode()
            bare = timed(lambda: link.ask("POST", path, body, headers), 500, 50)  # noqa: B023
            by_client = timed(lambda: client.localize("bench", ranked_landmarks=ranks), 500, 50)  # noqa: B023
            rows.append((f"{count} ranked landmarks", "a bare HTTP/1.1 connection", bare))
            rows.append((f"{count} ranked landmarks", "`deepsimbad_client.Client`", by_client))
        answer = client.localize("bench", ranked_landmarks=ranked)
    yield from markdown(("body", "by", "median"), rows)
    yield ""
    stages = ", ".join(f"{stage} {milliseconds:.3f}" for stage, milliseconds in answer.timings_ms.items())
    yield f"Inside the service, in ms: {stages}"


def session_table() -> Iterator[str]:
    """Markdown lines."""
    yield f"## Sessions: `POST observations` on loopback, {NCLT_IMAGES:,} map images, {N_LANDMARKS} ranks, durable"
    yield ""
    rng, rows = np.random.default_rng(1), []
    bodies = [json.dumps({"ranked_landmarks": rng.permutation(N_LANDMARKS).tolist()}).encode() for _ in range(70)]
    with mapped_service() as server, Link(server.url) as link:
        for n_robots, n_views in ((1, 20), (1, 300), (ROBOTS, 40)):  # the first warms up
            robots = [LiveRobot("", "bench", bodies[k:], session_length=n_views) for k in range(n_robots)]
            start_s = time.perf_counter()
            all_waits = drive(server.url, robots, lambda waits: len(waits.seconds) + 1 >= n_views)  # noqa: B023
            rate = n_robots * n_views / (time.perf_counter() - start_s)
            counted = sum(link.ask("GET", f"/v1/sessions/{waits.session_id}")["n_observations"] for waits in all_waits)
            n_errors = sum(len(waits.failures) for waits in all_waits)
            timing = Timing([seconds for waits in all_waits for seconds in waits.seconds])
            rows.append((n_robots, timing, f"{rate:.0f}", n_errors, f"{counted} of {n_robots * n_views}"))
    head = ("robots", "an observation", "observations a second in all", "errors", "counted by the service")
    yield from markdown(head, rows[1:])
    yield ""
    timings_ms = [stages_ms for waits in all_waits for stages_ms in waits.timings_ms]
    medians = {stage: np.median([stages_ms[stage] for stages_ms in timings_ms]) for stage in timings_ms[0]}
    stages = ", ".join(f"{stage} {median:.2f}" for stage, median in medians.items())
    yield f"Inside the service, in ms, {ROBOTS} robots: {stages}"


def restart_table() -> Iterator[str]:
    """Markdown lines."""
    yield from (f"## Restart: from `kill -9` to a ready service, {NCLT_IMAGES:,} map images", "")
    seconds = []
    with mapped_service() as server:
        for _ in range(_KILLS):
            server.kill()
            start_s = time.perf_counter()
            server.start()
            seconds.append(time.perf_counter() - start_s)
    yield f"From the start of the process to `/readyz` answering 200: {Timing(seconds)}."
