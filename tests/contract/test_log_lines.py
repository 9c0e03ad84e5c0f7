"""What the log tells of a request: whose, what it was about, what was wrong; and that refusals are counted."""

import logging
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.errors import CancelledError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import JobState

from .conftest import make_ready_domain, remap, small_settings

DOOR = "deepsimbad.api.door"


@pytest.fixture
def lines(caplog: pytest.LogCaptureFixture) -> Iterator[pytest.LogCaptureFixture]:
    with caplog.at_level(logging.INFO, logger="deepsimbad"):
        yield caplog


def last(lines: pytest.LogCaptureFixture) -> dict[str, Any]:
    return [vars(record) for record in lines.records if record.name == DOOR][-1]


def told(line: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: line[name] for name in names if name in line}


ALL = ("request_id", "peer", "method", "path", "status", "key_id", "domain", "session_id", "job_id", "code")


def test_a_line_tells_what_the_request_was_about(client: TestClient, lines: pytest.LogCaptureFixture) -> None:
    answer = client.get("/v1/domains/ready", headers={"X-Request-ID": "mine-1"})
    assert answer.headers["x-request-id"] == "mine-1"
    line = last(lines)
    assert told(line, *ALL) == {
        "request_id": "mine-1",
        "peer": "testclient",
        "method": "GET",
        "path": "/v1/domains/ready",
        "status": 200,
        "domain": "ready",
    }
    assert line["ms"] > 0


def test_a_line_of_a_session_tells_which(client: TestClient, lines: pytest.LogCaptureFixture) -> None:
    session_id = client.post("/v1/domains/ready/sessions", json={}).json()["session_id"]
    client.post(f"/v1/sessions/{session_id}/observations", json={"ranked_landmarks": [1]})
    assert told(last(lines), "session_id", "domain", "code") == {"session_id": session_id, "domain": "ready"}
    client.delete(f"/v1/sessions/{session_id}")
    client.get(f"/v1/sessions/{session_id}")
    assert told(last(lines), "session_id", "status", "code") == {
        "session_id": session_id,
        "status": 410,
        "code": "ended_session",
    }


def test_a_refused_request_is_counted_and_its_line_has_the_code(
    client: TestClient, lines: pytest.LogCaptureFixture
) -> None:
    client.post("/v1/domains/ready/localizations", content=b"x" * 60_000, headers={"Content-Type": "application/json"})
    assert told(last(lines), "status", "code") == {"status": 413, "code": "body_too_large"}
    counted = re.search(
        r'deepsimbad_refused_requests_total{reason="body_too_large"} (\S+)', client.get("/metrics").text
    )
    assert counted is not None
    assert float(counted[1]) >= 1
    client.get("/v1/domains/nowhere")
    assert last(lines)["code"] == "unknown_domain"
    assert 'reason="unknown_domain"' not in client.get("/metrics").text, "a wrong name is no refusal"


def test_a_long_path_makes_no_long_line(client: TestClient, lines: pytest.LogCaptureFixture) -> None:
    client.get("/" + "x" * 5000)
    assert len(last(lines)["path"]) < 300


def test_jobs_and_maps_that_serve_are_told(tmp_path: Path, lines: pytest.LogCaptureFixture) -> None:
    with TestClient(create_app(small_settings(tmp_path))) as client:
        make_ready_domain(client, "ready")
        remap(client, "ready", training_traverse="drive")
        client.put("/v1/admin/domains/ready/active-map", json={"version": 1})
    told_of_jobs = [vars(each) for each in lines.records if each.message in {"job started", "job ended"}]
    assert [line["message"] for line in told_of_jobs] == ["job started", "job ended"] * 2
    assert told(told_of_jobs[-1], "domain", "kind", "state", "map_version", "active") == {
        "domain": "ready",
        "kind": "remap",
        "state": "succeeded",
        "map_version": 2,
        "active": True,
    }
    switched = [vars(each) for each in lines.records if each.message.startswith("map ")]
    assert [(line["message"], line["map_version"], line["before"]) for line in switched] == [
        ("map activated", 1, None),
        ("map activated", 2, 1),
        ("map rolled back", 1, 2),
    ]
    assert all(line["domain"] == "ready" for line in switched)


def test_a_job_that_the_service_stops_with_is_not_told_as_cancelled(
    tmp_path: Path, lines: pytest.LogCaptureFixture
) -> None:
    with TestClient(create_app(small_settings(tmp_path))) as client:
        make_ready_domain(client, "ready")
    began = threading.Event()

    def until_stopped(job: Any, on_progress: Any, is_cancelled: Any) -> dict[str, Any]:
        began.set()
        while not is_cancelled():
            time.sleep(0.01)
        raise CancelledError("stopped")

    lines.clear()
    with TestClient(create_app(small_settings(tmp_path), until_stopped)) as client:
        job_id = client.post("/v1/admin/domains/ready/remaps", json={"training_traverse": "drive"}).json()["job_id"]
        assert began.wait(20)
    told_of_jobs = [record.message for record in lines.records if record.message.startswith("job ")]
    assert told_of_jobs == ["job started", "job stopped"]
    catalog = Catalog.open(tmp_path)
    assert catalog.job(job_id).state is JobState.QUEUED, "the next service goes on with it"
    catalog.close()
