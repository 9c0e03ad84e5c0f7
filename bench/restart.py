"""How soon a killed service is ready again."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter

import numpy as np

from bench.http import make_map
from bench.timing import Timing
from bench.worlds import NCLT_IMAGES
from deepsimbad_client import Client
from deepsimbad_client.http.local_server import LocalServer

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
