"""Liveness, and whether `/readyz` tells the truth, each thing that can break broken in turn; the OpenAPI document."""

import os
import re
import threading

import pytest

from deepsimbad.api import app as application
from deepsimbad.store.layout import catalog_path, sessions_path

from .conftest import problem, service


def test_health_readiness_and_documents(client):
    assert client.get("/healthz").json() == {"status": "alive"}
    assert client.get("/readyz").json() == {"status": "ready", "damaged_maps": []}
    assert client.get("/openapi.json").json()["openapi"].startswith("3.1")


def test_head_is_answered_as_get_is_without_a_body(client):
    job = client.services.catalog.create_job("ready", "remap", {"training_traverse": "drive"})  # one that waits
    for path in (
        *("/healthz", "/readyz", "/metrics", "/docs", "/openapi.json", "/nowhere"),
        *("/v1/domains", "/v1/domains/ready", "/v1/domains/x", "/v1/domains/ready/landmark-model"),
        *("/v1/admin/domains/ready/maps/1/file", "/v1/admin/domains/ready/traverses/drive/frames"),
    ):
        head, got = client.head(path), client.get(path)
        assert (head.status_code, head.content) == (got.status_code, b""), path
        for name in ("content-type", "etag", "accept-ranges"):
            assert head.headers.get(name) == got.headers.get(name), path
    events = client.head(f"/v1/admin/jobs/{job.job_id}/events")
    assert (events.status_code, events.headers["content-type"]) == (200, "text/event-stream; charset=utf-8")
    assert client.head("/v1/domains/ready/localizations").status_code == 405
    assert client.services.event_streams.n_taken == 0
    assert client.delete(f"/v1/admin/jobs/{job.job_id}").status_code == 204


def test_a_service_is_shown_below_a_path(tmp_path):
    with service(tmp_path, root_path="/robots/simbad") as client:
        client.make_ready_domain("below")
        assert client.get("/openapi.json").json()["servers"] == [{"url": "/robots/simbad"}]
        for prefix in ("", "/robots/simbad"):  # by proxies that take it away, and those that do not
            assert client.get(f"{prefix}/v1/domains/below").status_code == 200
            answer = client.post(f"{prefix}/v1/domains/below/sessions", json={})
            assert answer.headers["location"] == f"/robots/simbad/v1/sessions/{answer.json()['session_id']}"
            assert client.get(answer.headers["location"]).status_code == 200
        job = client.post("/v1/admin/domains/below/remaps", json={"training_traverse": "drive"})
        assert job.headers["location"] == f"/robots/simbad/v1/admin/jobs/{job.json()['job_id']}"
        assert client.get("/robots/simbadly/v1/domains").status_code == 404
        client.services.keys.by_id["k"] = None  # one was made: who has none is let nowhere
        for path in ("/v1/domains", "/v1/admin/jobs"):
            problem(client.get(f"/robots/simbad{path}"), 401, "unauthorized")


def test_not_ready_while_stopping(tmp_path):
    threads = set(threading.enumerate())
    with service(tmp_path) as client:
        client.services.stopping.set()
        problem(client.get("/readyz"), 503, "unavailable")
        assert client.get("/healthz").status_code == 200
    left_names = {thread.name for thread in set(threading.enumerate()) - threads}
    assert not {"inference", "jobs"} & left_names


@pytest.fixture
def breakable(one_process, tmp_path, monkeypatch):
    monkeypatch.setattr(application, "TRUSTED_S", -1.0)  # look every time
    with service(tmp_path) as client:
        yield client


def faults(client):
    answer = client.get("/readyz")
    gauge = re.search(r"^deepsimbad_ready (\S+)$", client.get("/metrics").text, re.MULTILINE)
    assert gauge is not None
    assert float(gauge[1]) == (answer.status_code == 200)
    assert client.get("/healthz").status_code == 200, "whatever is wrong, the process lives"
    if answer.status_code == 200:
        return []
    document = problem(answer, 503, "unavailable")
    assert answer.headers["retry-after"]
    assert document["detail"] == "; ".join(document["faults"])
    assert str(client.services.settings.data_dir) not in answer.text
    return list(document["faults"])


def refuse_writes(client, is_on=True):
    client.services.session_store._db.conn.execute(f"PRAGMA query_only = {int(is_on)}")


def close_commits(client):
    client.services.session_store._commits.close()


def remove(client, path_in):
    path_in(client.services.settings.data_dir).unlink()


@pytest.mark.parametrize(
    ("breaks", "expected"),
    [
        (lambda client: client.services.worker.close(), "the inference worker has ended: restart the service"),
        (close_commits, "the thread that writes sessions has ended: restart the service"),
        (lambda client: client.services.runner.close(), "the thread that runs jobs has ended: restart the service"),
        (lambda client: remove(client, catalog_path), "catalog.sqlite was removed under the running service"),
        (lambda client: remove(client, sessions_path), "sessions.sqlite was removed under the running service"),
        (refuse_writes, "sessions.sqlite: it may not be written"),
        (lambda client: client.services.catalog._reader.close(), "catalog.sqlite: it is closed"),
    ],
)
def test_what_is_broken_is_told(breakable, breaks, expected):
    assert faults(breakable) == []
    breaks(breakable)
    assert expected in faults(breakable)


def test_a_disk_almost_full_or_read_only(breakable, monkeypatch):
    statvfs = os.statvfs

    def read_only(path):
        real = statvfs(path)
        return os.statvfs_result((*real[:8], real.f_flag | os.ST_RDONLY, real.f_namemax))

    with monkeypatch.context() as patch:
        patch.setattr(application, "LEAST_FREE_BYTES", 1 << 60)
        (fault,) = faults(breakable)
        assert re.fullmatch(r"\d+ MiB are free in the data directory, fewer than 1099511627776", fault)
    with monkeypatch.context() as patch:
        patch.setattr(os, "statvfs", read_only)
        assert faults(breakable) == ["the data directory lies on a read-only file system"]
    assert faults(breakable) == [], "it is ready again when the fault is gone"


def test_whoever_asks_often_is_answered_from_memory(breakable, monkeypatch):
    """Else a stranger could keep the disk busy."""
    refuse_writes(breakable)
    assert len(faults(breakable)) == 1
    refuse_writes(breakable, False)
    assert faults(breakable) == []
    monkeypatch.setattr(application, "TRUSTED_S", 1000.0)
    refuse_writes(breakable)
    assert breakable.get("/readyz").status_code == 200
