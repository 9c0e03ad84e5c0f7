"""Liveness, readiness, metrics, documents."""

import threading
from pathlib import Path
from typing import Any

import pytest
from starlette.responses import JSONResponse
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app

from .conftest import make_ready_domain, small_settings


def test_health_readiness_and_documents(client: TestClient) -> None:
    assert client.get("/healthz").json() == {"status": "alive"}
    assert client.get("/readyz").json() == {"status": "ready", "damaged_maps": []}
    assert client.get("/docs").status_code == 200
    assert client.get("/openapi.json").json()["openapi"].startswith("3.1")


def test_the_openapi_document_is_written_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    n_written = 0
    render = JSONResponse.render

    def counting(self: JSONResponse, content: Any) -> bytes:
        nonlocal n_written
        n_written += 1
        return render(self, content)

    monkeypatch.setattr(JSONResponse, "render", counting)
    with TestClient(create_app(small_settings(tmp_path))) as client:
        first = client.get("/openapi.json")
        assert (first.status_code, first.headers["content-type"]) == (200, "application/json")
        assert client.get("/openapi.json").content == first.content
    assert n_written == 1


def test_metrics_count_by_route_and_not_by_path(client: TestClient) -> None:
    client.post("/v1/domains/ready/localizations", json={"ranked_landmarks": [0]})
    client.get("/v1/domains/some-unknown-name")
    client.get("/some/unknown/path")
    answer = client.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain")
    counted = 'deepsimbad_requests_total{method="POST",route="/v1/domains/{domain}/localizations",status="200"}'
    assert counted in answer.text
    assert "some-unknown-name" not in answer.text
    assert "/some/unknown" not in answer.text
    assert 'deepsimbad_localization_stage_seconds_count{stage="retrieve"}' in answer.text
    assert 'deepsimbad_belief_entropy_bits_count{domain="ready"}' in answer.text


def test_two_applications_do_not_share_metrics(client: TestClient, tmp_path: Path) -> None:
    with TestClient(create_app(small_settings(tmp_path))) as other:
        assert "deepsimbad_requests_total{" not in other.get("/metrics").text


def test_what_was_acknowledged_is_there_after_a_restart(tmp_path: Path) -> None:
    query = {"ranked_landmarks": [3, 1, 2]}
    with TestClient(create_app(small_settings(tmp_path))) as first:
        make_ready_domain(first, "kept")
        before = first.post("/v1/domains/kept/localizations", json=query).json()
        make_ready_domain(first, "lost")
    (tmp_path / "domains" / "lost" / "maps" / "000001.sqlite").unlink()
    with TestClient(create_app(small_settings(tmp_path)), raise_server_exceptions=False) as second:
        assert second.get("/readyz").json()["damaged_maps"] == ["lost"]
        after = second.post("/v1/domains/kept/localizations", json=query).json()
        assert {**after, "timings_ms": {}} == {**before, "timings_ms": {}}
        assert second.post("/v1/domains/lost/localizations", json=query).status_code == 503


def test_not_ready_while_stopping(tmp_path: Path) -> None:
    before = set(threading.enumerate())
    app: Any = create_app(small_settings(tmp_path))
    with TestClient(app) as client:
        app.state.services.stopping.set()
        answer = client.get("/readyz")
        assert (answer.status_code, answer.json()["code"]) == (503, "unavailable")
        assert answer.headers["retry-after"]
        assert client.get("/healthz").status_code == 200
    left = {thread.name for thread in set(threading.enumerate()) - before}
    assert not {"inference", "jobs"} & left
