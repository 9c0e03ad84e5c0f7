"""One `POST observations` in process, commit included, beside the same of another checkout, in turn.

python -m bench.request [CHECKOUT]
"""

import asyncio
import json
import os
import subprocess
import sys
import time
from argparse import SUPPRESS
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import httpx2
import numpy as np

from bench.link import NPZ, packed
from bench.measurement import PROJECT, Command, work_folder

N_IMAGES, N_LANDMARKS, N_WARM, N_MEASURED, N_TURNS = 2000, 300, 100, 600, 4
DOMAIN = "/v1/admin/domains/d"


def compare(checkouts: Sequence[Path]) -> None:
    """Print the median of every turn."""
    for turn in range(N_TURNS):
        for checkout in [*checkouts, PROJECT]:
            folders = [checkout.resolve(strict=True) / name for name in ("service", "client", "migrations")]
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))}
            command = [sys.executable, "-m", "bench.request", "--measure"]
            output = subprocess.check_output(  # noqa: S603 - itself
                command, cwd=PROJECT, env=environment, stderr=subprocess.DEVNULL
            )
            print(f"turn {turn + 1}, {checkout}: {float(output):.2f} ms")


def measure() -> None:
    """Print milliseconds of an observation, of the packages that are on the path."""
    with work_folder() as folder:
        print(1000 * median(asyncio.run(_seconds(folder))[N_WARM:]))


async def _seconds(data_dir: Path) -> list[float]:
    from deepsimbad.api.app import create_app  # noqa: PLC0415 - of the checkout that is on the path
    from deepsimbad.settings import Settings  # noqa: PLC0415

    rng = np.random.default_rng(0)
    encodings = np.cumsum(rng.normal(size=(N_IMAGES, 32)), axis=0).astype(np.float32)
    app = create_app(Settings(data_dir=data_dir))
    transport = httpx2.ASGITransport(app, client=("127.0.0.1", 1))
    async with (
        app.router.lifespan_context(app),
        httpx2.AsyncClient(transport=transport, base_url="http://127.0.0.1", timeout=120) as client,
    ):

        async def call(method: str, path: str, **options: object) -> dict[str, object]:
            answer = await client.request(method, path, **options)
            answer.raise_for_status()
            return answer.json()

        await call("PUT", DOMAIN, json={"evaluator": {"kind": "feature_l2", "extractor": "none"}})
        await call("POST", f"{DOMAIN}/traverses", json={"name": "t"})
        batch = packed(encodings=encodings, index=np.arange(N_IMAGES), position_m=np.arange(float(N_IMAGES)))
        await call("POST", f"{DOMAIN}/traverses/t/frames", content=batch, headers=NPZ)
        drives = {"training_traverse": "t", "landmark_traverse": "t"}
        config = {**drives, "n_landmarks": N_LANDMARKS, "training_episodes": 0}
        job = await call("POST", f"{DOMAIN}/remaps", json=config)
        while job["state"] in {"queued", "running"}:
            await asyncio.sleep(0.2)
            job = await call("GET", f"/v1/admin/jobs/{job['job_id']}")
        session_id = (await call("POST", "/v1/domains/d/sessions", json={}))["session_id"]
        path = f"/v1/sessions/{session_id}/observations?action_m=1"
        seconds = []
        for _ in range(N_WARM + N_MEASURED):
            body = json.dumps({"ranked_landmarks": rng.permutation(N_LANDMARKS).tolist()})
            start_s = time.perf_counter()
            await call("POST", path, content=body, headers={"Content-Type": "application/json"})
            seconds.append(time.perf_counter() - start_s)
    return seconds


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("checkouts", type=Path, nargs="*", metavar="CHECKOUT")
    command.add_argument("--measure", action="store_true", help=SUPPRESS)
    command.run(lambda arguments: measure() if arguments.measure else compare(arguments.checkouts))
