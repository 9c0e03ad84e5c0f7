"""A remap survives the service's death and its orderly stop, but not the death of its own process."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from deepsimbad.store.catalog import Catalog

from ..contract.conftest import Caller, problem, wait_until
from ..contract.server_process import ServerProcess

N_FRAMES, DIM = 400, 64
CAMPUS = "/v1/admin/domains/campus"
CONFIG = {"training_traverse": "drive", "landmark_traverse": "other", "n_landmarks": 30}
LONG, SHORT = 1_000_000, 300  # training episodes; the map's size bounds the former, at some seconds

pytestmark = pytest.mark.slow


@pytest.fixture
def server(tmp_path: Path) -> Iterator[ServerProcess]:
    with ServerProcess(tmp_path / "data") as running:
        running.client.make_domain("campus")
        wander = np.cumsum(np.random.default_rng(0).normal(size=(N_FRAMES, DIM)), axis=0)
        for seed, name in enumerate(("other", "drive")):
            encodings = wander + np.random.default_rng(seed).normal(size=wander.shape)
            running.client.upload("campus", name, encodings.astype(np.float32), np.arange(N_FRAMES) * 1.0)
        yield running


def begin_remap(client: Caller, training_episodes: int) -> str:
    """The path of a remap's job."""
    answer = client.post(f"{CAMPUS}/remaps", json={**CONFIG, "training_episodes": training_episodes})
    assert answer.status_code == 202, answer.text
    return answer.headers["location"]


def training(server: ServerProcess) -> tuple[str, int]:
    """The path of a job that is training its experience database, and the id of its process."""
    path = begin_remap(server.client, LONG)
    wait_until(lambda: server.client.get(path).json()["stage"] == "train")
    log = map(json.loads, server.log_path.read_text(encoding="utf-8").splitlines())
    started = (line for line in log if line["message"] == "a job's process started")
    (pid,) = (line["pid"] for line in started if path.endswith(line["job_id"]))
    return path, pid


def is_gone(pid: int) -> bool:
    try:
        return Path("/proc", str(pid), "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.parametrize("end", ["kill", "stop"])
def test_the_next_service_begins_it_again_and_makes_one_map(server: ServerProcess, end: str) -> None:
    path, pid = training(server)
    waiting_path = begin_remap(server.client, SHORT)
    problem(server.client.delete(CAMPUS), 409, "traverse_in_use")
    getattr(server, end)()
    wait_until(lambda: is_gone(pid))
    with Catalog.open(server.log_path.parent / "data") as catalog:
        record = catalog.job(path.rpartition("/")[2])
    assert (record.state, record.n_starts) == (("running", 1) if end == "kill" else ("queued", 0))
    server.start()
    problem(server.client.delete(f"{CAMPUS}/traverses/drive"), 409, "traverse_in_use")
    jobs = [server.client.wait_for(job_path.rpartition("/")[2]) for job_path in (path, waiting_path)]
    assert [job["state"] for job in jobs] == ["succeeded"] * 2, jobs
    assert [row["version"] for row in server.client.get(f"{CAMPUS}/maps").json()["maps"]] == [2, 1]
    assert jobs[0]["result"]["map_version"] == 1


def test_a_job_whose_own_process_dies_fails_by_name_and_one_that_is_cancelled_ends(server: ServerProcess) -> None:
    client = server.client
    path, pid = training(server)
    os.kill(pid, signal.SIGKILL)
    job = client.wait_for(path.rpartition("/")[2])
    assert (job["state"], job["error"]["code"]) == ("failed", "job_interrupted")
    assert "SIGKILL" in str(job["error"])
    assert client.get(f"{CAMPUS}/maps").json()["maps"] == []
    client.make_map("campus", **CONFIG, training_episodes=SHORT)

    path, pid = training(server)  # and one is cancelled in its process
    client.delete(path)
    assert client.wait_for(path.rpartition("/")[2])["state"] == "cancelled"
    wait_until(lambda: is_gone(pid))
    assert client.delete(CAMPUS).status_code == 204
