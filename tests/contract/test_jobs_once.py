"""A request that makes a job makes it once under one `Idempotency-Key`; only so many jobs may wait."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.jobs.runner import InThisProcess

from .conftest import make_ready_domain, ready_encodings, small_settings, wait_for

REMAP = {"training_traverse": "drive", "training_episodes": 0}
KEY = {"Idempotency-Key": "season-4/remap"}
WITHIN_S = 60


class Held:
    """Does jobs in this process; while it is held, none begins."""

    def __init__(self, data_dir: Path) -> None:
        self.entered, self.free = threading.Event(), threading.Event()
        self.free.set()
        self._run_job = InThisProcess(data_dir)

    def __call__(self, job: Any, on_progress: Any, is_cancelled: Callable[[], bool]) -> dict[str, Any]:
        self.entered.set()
        assert self.free.wait(WITHIN_S)
        return self._run_job(job, on_progress, is_cancelled)


@pytest.fixture
def held(tmp_path: Path) -> Held:
    return Held(tmp_path)


@pytest.fixture
def service(tmp_path: Path, held: Held) -> Iterator[TestClient]:
    with TestClient(create_app(small_settings(tmp_path, max_jobs=2), held), raise_server_exceptions=False) as client:
        make_ready_domain(client, "ready")
        yield client
        held.free.set()


def asked(client: TestClient, path: str, body: dict[str, Any], key: dict[str, str] = KEY) -> httpx2.Response:
    return client.post(f"/v1/admin/domains/ready/{path}", json=body, headers=key)


def refused(answer: httpx2.Response, status: int, code: str) -> dict[str, Any]:
    problem: dict[str, Any] = answer.json()
    assert (answer.status_code, problem["code"]) == (status, code), problem
    return problem


def n_jobs(client: TestClient) -> int:
    return len(client.get("/v1/admin/jobs").json()["jobs"])


def test_a_remap_asked_for_twice_under_one_key_is_one(service: TestClient) -> None:
    before = n_jobs(service)
    first = asked(service, "remaps", REMAP)
    job_id = first.json()["job_id"]
    done = wait_for(service, job_id)
    assert (first.status_code, done["state"]) == (202, "succeeded")
    again = asked(service, "remaps", {**REMAP, "seed": 0, "landmark_traverse": None})  # the same, written out
    assert (again.status_code, again.json()) == (202, done)
    assert again.headers["location"] == first.headers["location"] == f"/v1/admin/jobs/{job_id}"
    assert n_jobs(service) == before + 1

    refused(asked(service, "remaps", {**REMAP, "seed": 1}), 422, "idempotency_key_reused")
    found = {job_id}
    for key in ({}, {}, {"Idempotency-Key": "another"}):
        found.add(wait_for(service, asked(service, "remaps", REMAP, key).json()["job_id"])["job_id"])
    assert len(found) == 4

    make_ready_domain(service, "elsewhere")
    elsewhere = service.post("/v1/admin/domains/elsewhere/remaps", json=REMAP, headers=KEY).json()
    assert elsewhere["job_id"] != job_id
    assert wait_for(service, elsewhere["job_id"])["domain"] == "elsewhere"

    service.delete("/v1/admin/domains/ready/traverses/drive")
    assert asked(service, "remaps", REMAP).json() == done, "what was done needs its traverse no more"
    refused(asked(service, "remaps", REMAP, {}), 404, "unknown_traverse")


def test_a_remap_asked_for_again_after_a_restart_is_the_one_before(tmp_path: Path) -> None:
    with TestClient(create_app(small_settings(tmp_path), InThisProcess(tmp_path))) as before:
        make_ready_domain(before, "ready")
        done = wait_for(before, asked(before, "remaps", REMAP).json()["job_id"])
    with TestClient(create_app(small_settings(tmp_path), InThisProcess(tmp_path))) as after:
        again = asked(after, "remaps", REMAP)
        assert (again.status_code, again.json()) == (202, done)
        assert n_jobs(after) == 2
        refused(asked(after, "remaps", {**REMAP, "seed": 1}), 422, "idempotency_key_reused")


def test_experience_fed_back_twice_under_one_key_is_learnt_once(service: TestClient) -> None:
    session_id = service.post("/v1/domains/ready/sessions", json={}).json()["session_id"]
    for image in range(0, 8, 2):
        body = {"encoding": ready_encodings()[image].tolist()}
        assert service.post(f"/v1/sessions/{session_id}/observations?action_m=4", json=body).status_code == 200
    told = {"session_id": session_id, "true_positions_m": [0.0, 4.0, None, 12.0]}
    first = asked(service, "experience", told)
    assert first.status_code == 202, first.text
    done = wait_for(service, first.json()["job_id"])
    assert asked(service, "experience", told).json() == done
    other = {**told, "true_positions_m": [0.0, 4.0, 8.0, 12.0]}
    refused(asked(service, "experience", other), 422, "idempotency_key_reused")
    assert wait_for(service, asked(service, "experience", other, {}).json()["job_id"])["job_id"] != done["job_id"]
    assert wait_for(service, asked(service, "remaps", REMAP).json()["job_id"])["kind"] == "remap"
    ranked = 'deepsimbad_live_anr_percent_count{domain="ready"} 4.0'
    assert ranked in service.get("/metrics").text, "every truth counts once"


@pytest.mark.parametrize("path", ["remaps", "experience"])
@pytest.mark.parametrize("key", ["", " ", "a b", "x" * 256, "\x7f"])
def test_a_key_that_cannot_be_one(service: TestClient, path: str, key: str) -> None:
    refused(asked(service, path, REMAP, {"Idempotency-Key": key}), 422, "invalid_request")


def test_only_so_many_jobs_wait(service: TestClient, held: Held) -> None:
    held.entered.clear()
    held.free.clear()
    asked(service, "remaps", REMAP, {})
    assert held.entered.wait(WITHIN_S)
    waiting = [asked(service, "remaps", REMAP, key).json()["job_id"] for key in ({}, KEY)]
    full = asked(service, "remaps", REMAP, {})
    problem = refused(full, 429, "too_many_jobs")
    assert (problem["limit"], problem["max_jobs"], full.headers["retry-after"]) == ("max_jobs", 2, "30")
    assert asked(service, "remaps", REMAP).json()["job_id"] == waiting[1], "one that is known needs no room"
    service.delete(f"/v1/admin/jobs/{waiting[0]}")
    last = asked(service, "remaps", REMAP, {})
    assert last.status_code == 202, last.text
    held.free.set()
    assert wait_for(service, last.json()["job_id"])["state"] == "succeeded"
