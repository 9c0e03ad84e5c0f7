"""A service that has too much to do says so at once, and still says how it is."""

import threading
from contextlib import contextmanager

import pytest
from anyio.to_thread import current_default_thread_limiter, run_sync

from .conftest import DIM, NPZ, RANKS, npz, problem, service

READY = "/v1/domains/ready/localizations"


@pytest.fixture
def busy(one_process, tmp_path):
    with service(tmp_path, max_queue=1, max_event_streams=1, max_uploads=1) as client:
        client.make_ready_domain("ready")
        yield client


def overloaded(answer, limit):
    assert problem(answer, 503, "overloaded")["limit"] == limit
    assert answer.headers["retry-after"] == "1"


def is_healthy(client):
    return {client.get(path).status_code for path in ("/healthz", "/readyz", "/metrics")} == {200}


@contextmanager
def full_queue(busy):
    """Keep the worker busy and its queue, of one task, full inside the block."""
    worker, gate, has_begun = busy.services.worker, threading.Event(), threading.Event()
    worker.submit(lambda: (has_begun.set(), gate.wait(60)))
    assert has_begun.wait(60)
    answer = worker.submit(lambda: None)
    try:
        yield
    finally:
        gate.set()
    answer.result(60)


def test_a_full_queue(busy):
    path = busy.session()
    with full_queue(busy):
        overloaded(busy.post("/v1/localizations?domains=ready", json=RANKS), "max_queue")
        overloaded(busy.post("/v1/domains/ready/sessions", json={}), "max_queue")
        assert busy.post(READY, json=RANKS).status_code == 200  # what is short waits for nobody
        assert busy.get(f"{path}/next-best-view").status_code == 200
        assert busy.post(f"{path}/observations", json=RANKS).status_code == 200
        assert is_healthy(busy)
        assert 'deepsimbad_refused_requests_total{reason="max_queue"} 2.0' in busy.get("/metrics").text
    assert busy.get(path).json()["n_observations"] == 1


def test_long_views_wait_in_the_queue(busy, monkeypatch):
    """A map too large to be answered between two requests is answered by the worker, in turn."""
    monkeypatch.setattr("deepsimbad.engine.localizer._MOST_IMAGES", 0)
    path = busy.session()
    with full_queue(busy):
        overloaded(busy.post(READY, json=RANKS), "max_queue")
        overloaded(busy.post(f"{path}/observations", json=RANKS), "max_queue")
    assert busy.post(f"{path}/observations", json=RANKS).json()["n_observations"] == 1


async def n_default_threads():
    return int(current_default_thread_limiter().total_tokens)


def test_threads_that_are_all_taken_do_not_keep_health_waiting(busy):
    gate, n_begun, portal = threading.Event(), threading.Semaphore(0), busy.portal
    assert portal is not None
    holders = [
        portal.start_task_soon(run_sync, lambda: (n_begun.release(), gate.wait(60)))
        for _ in range(portal.call(n_default_threads))
    ]
    try:
        for _ in holders:
            assert n_begun.acquire(timeout=60)
        assert is_healthy(busy)
        assert busy.post(READY, json=RANKS).status_code == 200
    finally:
        gate.set()
        for holder in holders:
            holder.result(60)


def test_only_so_many_streams_and_uploads_at_once(busy):
    job, services = busy.get("/v1/admin/jobs").json()["jobs"][0]["job_id"], busy.services
    frames = "/v1/admin/domains/ready/traverses/drive/frames"
    batch = {"content": npz(encodings=[[0.0] * DIM], index=[0], position_m=[0.0]), "headers": NPZ}
    with services.event_streams.slot(), services.uploads.slot():
        overloaded(busy.get(f"/v1/admin/jobs/{job}/events"), "max_event_streams")
        overloaded(busy.post(frames, **batch), "max_uploads")
    for _ in range(2):  # what has ended makes room
        assert busy.get(f"/v1/admin/jobs/{job}/events").status_code == 200
        assert busy.post(frames, **batch).status_code == 200
