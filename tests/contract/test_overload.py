"""A service that has too much to do says so at once, and still says how it is."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from anyio.to_thread import current_default_thread_limiter, run_sync
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.jobs.runner import InThisProcess

from .conftest import NPZ, make_ready_domain, small_settings

READY = "/v1/domains/ready/localizations"
VIEW = {"ranked_landmarks": [0, 1]}


@pytest.fixture
def busy(tmp_path: Path) -> Iterator[TestClient]:
    settings = small_settings(tmp_path, max_queue=1, max_requests=3, max_body_memory_bytes=100_000)
    with TestClient(create_app(settings, InThisProcess(tmp_path)), raise_server_exceptions=False) as client:
        make_ready_domain(client, "ready")
        yield client


def services_of(client: TestClient) -> Any:
    app: Any = client.app
    return app.state.services


def check(answer: Any, limit: str) -> None:
    assert (answer.status_code, answer.json()["code"], answer.json()["limit"]) == (503, "overloaded", limit)
    assert answer.headers["retry-after"] == "1"
    assert answer.headers["content-type"] == "application/problem+json"


def test_a_full_queue(busy: TestClient) -> None:
    session = busy.post("/v1/domains/ready/sessions", json={}).json()
    worker, gate, begun = services_of(busy).worker, threading.Event(), threading.Event()
    worker.submit(lambda: (begun.set(), gate.wait(60)))
    assert begun.wait(60)
    waiting = worker.submit(lambda: None)
    try:
        check(busy.post(READY, json=VIEW), "max_queue")
        check(busy.post("/v1/domains/ready/sessions", json={}), "max_queue")
        check(busy.post(f"/v1/sessions/{session['session_id']}/observations", json=VIEW), "max_queue")
        # What only joins the queue behind the door is turned away there.
        check(busy.get(f"/v1/sessions/{session['session_id']}/next-best-view"), "max_queue")
        assert busy.get("/v1/domains").status_code == 200
        for path in ("/healthz", "/readyz", "/metrics"):
            assert busy.get(path).status_code == 200
        assert 'deepsimbad_refused_requests_total{reason="max_queue"} 4.0' in busy.get("/metrics").text
    finally:
        gate.set()
    waiting.result(60)
    assert busy.post(READY, json=VIEW).status_code == 200
    found = busy.get(f"/v1/sessions/{session['session_id']}").json()
    assert found["n_observations"] == 0


def test_threads_that_are_all_taken_do_not_keep_health_waiting(busy: TestClient) -> None:
    gate, portal = threading.Event(), busy.portal
    assert portal is not None
    n_threads = int(portal.call(_n_threads))
    begun = threading.Semaphore(0)

    def hold() -> None:
        begun.release()
        gate.wait(60)

    held = [portal.start_task_soon(run_sync, hold) for _ in range(n_threads)]
    try:
        for _ in held:
            assert begun.acquire(timeout=60)
        for path in ("/healthz", "/readyz", "/metrics"):
            assert busy.get(path).status_code == 200
        assert busy.post(READY, json=VIEW).status_code == 200
    finally:
        gate.set()
        for task in held:
            task.result(60)


async def _n_threads() -> float:
    return current_default_thread_limiter().total_tokens


def test_a_body_that_does_not_fit_memory(busy: TestClient) -> None:
    body = bytes(180_000)
    seen = "/v1/admin/domains/ready/traverses/drive/frames/0?position_m=1"
    check(busy.put(seen, content=body, headers={"Content-Type": "image/jpeg"}), "max_body_memory_bytes")
    pieces = (bytes(1000) for _ in range(180))
    json_type = {"Content-Type": "image/png"}
    check(busy.put(seen, content=pieces, headers=json_type), "max_body_memory_bytes")
    batch = busy.post("/v1/admin/domains/ready/traverses/drive/frames", content=body, headers=NPZ)
    assert batch.json()["code"] == "invalid_batch"  # it went to the disk
