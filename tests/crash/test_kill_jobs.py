"""A remap survives the death of the service and its orderly stop; the death of its own process it does not."""

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepsimbad.store.catalog import Catalog
from deepsimbad_client import Client
from deepsimbad_client.errors import TraverseInUseError
from deepsimbad_client.http.local_server import LocalServer
from deepsimbad_client.http.models import Job

WITHIN_S = 60
N_FRAMES, DIM = 400, 64
CONFIG = {"training_traverse": "drive", "landmark_traverse": "other", "n_landmarks": 30}
LONG, SHORT = 1_000_000, 300  # training episodes; the map's size bounds the former, at some seconds

pytestmark = pytest.mark.slow


@pytest.fixture
def server(tmp_path: Path) -> Iterator[LocalServer]:
    with LocalServer(tmp_path / "data") as running:
        with Client(running.url) as client:
            client.admin.put_domain("campus", {"kind": "feature_l2", "extractor": "none"})
            wander = np.cumsum(np.random.default_rng(0).normal(size=(N_FRAMES, DIM)), axis=0)
            for seed, name in enumerate(("other", "drive")):
                noise = np.random.default_rng(seed).normal(size=wander.shape)
                client.admin.create_traverse("campus", name)
                client.admin.put_frames(
                    "campus",
                    name,
                    encodings=(wander + noise).astype(np.float32),
                    index=np.arange(N_FRAMES),
                    position_m=np.arange(N_FRAMES) * 1.0,
                )
        yield running


def until(look: Callable[[], Any]) -> Any:
    give_up = time.monotonic() + WITHIN_S
    while not (found := look()):
        assert time.monotonic() < give_up
        time.sleep(0.02)
    return found


def log_of(server: LocalServer) -> list[dict[str, Any]]:
    return [json.loads(line) for line in server.log_path.read_text(encoding="utf-8").splitlines()]


def training(server: LocalServer, client: Client) -> tuple[Job, int]:
    """A job that is at training its experience database, and the process it is in."""
    job = client.admin.remap("campus", **CONFIG, training_episodes=LONG)
    until(lambda: client.admin.job(job.job_id).stage == "train")
    started = [line for line in log_of(server) if line["message"] == "a job's process started"]
    (begun,) = [line for line in started if line["job_id"] == job.job_id]
    return job, begun["pid"]


def is_gone(pid: int) -> bool:
    try:
        return Path("/proc", str(pid), "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def ended(client: Client, job_id: str) -> Job:
    until(lambda: client.admin.job(job_id).ended)
    return client.admin.job(job_id)


@pytest.mark.parametrize("how", ["kill", "stop"])
def test_the_next_service_begins_it_again_and_makes_one_map(server: LocalServer, how: str) -> None:
    with Client(server.url) as client:
        job, pid = training(server, client)
        waits = client.admin.remap("campus", **CONFIG, training_episodes=SHORT)
        with pytest.raises(TraverseInUseError):
            client.admin.delete_domain("campus")
        getattr(server, how)()
        until(lambda: is_gone(pid))
        with Catalog.open(server.log_path.parent / "data") as catalog:
            left = catalog.job(job.job_id)
        assert (left.state, left.n_starts) == (("running", 1) if how == "kill" else ("queued", 0))
        server.start()
        with pytest.raises(TraverseInUseError):
            client.admin.delete_traverse("campus", "drive")
        done, after = ended(client, job.job_id), ended(client, waits.job_id)
        assert (done.state, after.state) == ("succeeded", "succeeded"), (done, after)
        assert [each.version for each in client.admin.maps("campus")] == [2, 1]
        assert done.result is not None
        assert done.result["map_version"] == 1


def test_a_job_whose_own_process_dies_fails_by_name_and_one_that_is_cancelled_ends(server: LocalServer) -> None:
    with Client(server.url) as client:
        job, pid = training(server, client)
        os.kill(pid, signal.SIGKILL)
        failed = ended(client, job.job_id)
        assert failed.state == "failed"
        assert failed.error is not None
        assert failed.error["code"] == "job_interrupted"
        assert "SIGKILL" in str(failed.error)
        assert client.admin.maps("campus") == ()
        next_job = client.admin.remap("campus", **CONFIG, training_episodes=SHORT)
        assert ended(client, next_job.job_id).state == "succeeded"

        job, pid = training(server, client)  # and one is cancelled in its process
        client.admin.cancel_job(job.job_id)
        assert ended(client, job.job_id).state == "cancelled"
        until(lambda: is_gone(pid))
        client.admin.delete_domain("campus")
