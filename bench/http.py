"""`POST localizations` with ready ranks over loopback, and where the time goes."""

import http.client
import json
import tempfile
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from bench.timing import Timing, timed
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
