"""A remap survives the service's death and its orderly stop, but not the death of its own process."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from deepsimbad.store.catalog import Catalog
from deepsimbad_client import Client
from deepsimbad_client.errors import TraverseInUseError
from deepsimbad_client.http.local_server import LocalServer
from deepsimbad_client.http.models import Job

from ..contract.conftest import wait_until

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


def training(server: LocalServer, client: Client) -> tuple[Job, int]:
    """A job that is training its experience database, and the id of its process."""
    job = client.admin.remap("campus", **CONFIG, training_episodes=LONG)
    wait_until(lambda: client.admin.job(job.job_id).stage == "train")
    log = map(json.loads, server.log_path.read_text(encoding="utf-8").splitlines())
    (pid,) = (line["pid"] for line in log if "a job's process started" in line.values() and job.job_id in line.values())
    return job, pid


def is_gone(pid: int) -> bool:
    try:
        return Path("/proc", str(pid), "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def ended_job(client: Client, job_id: str) -> Job:
    wait_until(lambda: client.admin.job(job_id).ended)
    return client.admin.job(job_id)


@pytest.mark.parametrize("end", ["kill", "stop"])
def test_the_next_service_begins_it_again_and_makes_one_map(server: LocalServer, end: str) -> None:
    with Client(server.url) as client:
        job, pid = training(server, client)
        waits = client.admin.remap("campus", **CONFIG, training_episodes=SHORT)
        with pytest.raises(TraverseInUseError):
            client.admin.delete_domain("campus")
        getattr(server, end)()
        wait_until(lambda: is_gone(pid))
        with Catalog.open(server.log_path.parent / "data") as catalog:
            record = catalog.job(job.job_id)
        assert (record.state, record.n_starts) == (("running", 1) if end == "kill" else ("queued", 0))
        server.start()
        with pytest.raises(TraverseInUseError):
            client.admin.delete_traverse("campus", "drive")
        first_job, second_job = ended_job(client, job.job_id), ended_job(client, waits.job_id)
        assert (first_job.state, second_job.state) == ("succeeded", "succeeded"), (first_job, second_job)
        assert [version.version for version in client.admin.maps("campus")] == [2, 1]
        assert first_job.result is not None
        assert first_job.result["map_version"] == 1


def test_a_job_whose_own_process_dies_fails_by_name_and_one_that_is_cancelled_ends(server: LocalServer) -> None:
    with Client(server.url) as client:
        job, pid = training(server, client)
        os.kill(pid, signal.SIGKILL)
        failed_job = ended_job(client, job.job_id)
        assert failed_job.state == "failed"
        assert failed_job.error is not None
        assert failed_job.error["code"] == "job_interrupted"
        assert "SIGKILL" in str(failed_job.error)
        assert client.admin.maps("campus") == ()
        next_job = client.admin.remap("campus", **CONFIG, training_episodes=SHORT)
        assert ended_job(client, next_job.job_id).state == "succeeded"

        job, pid = training(server, client)  # and one is cancelled in its process
        client.admin.cancel_job(job.job_id)
        assert ended_job(client, job.job_id).state == "cancelled"
        wait_until(lambda: is_gone(pid))
        client.admin.delete_domain("campus")
