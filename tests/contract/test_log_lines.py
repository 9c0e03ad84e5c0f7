"""The log line of a request names its key, its subject and its error; refusals are counted."""

import logging
import re

import pytest

from .conftest import JSON, RANKS, of_one_process, path_of, service

pytestmark = of_one_process  # whose log is read

ALL = ("request_id", "peer", "method", "path", "status", "key_id", "domain", "session_id", "job_id", "code")


@pytest.fixture
def lines(caplog):
    with caplog.at_level(logging.INFO, logger="deepsimbad"):
        yield caplog


def last(lines, *names):
    """The fields of these names in the last request's line, without those that it lacks."""
    line = [vars(record) for record in lines.records if record.name == "deepsimbad.api.door"][-1]
    return {name: line[name] for name in names if name in line}


def test_a_line_tells_what_the_request_was_about(client, lines):
    answer = client.get("/v1/domains/ready", headers={"X-Request-ID": "mine-1"})
    assert answer.headers["x-request-id"] == "mine-1"
    expected = {
        "request_id": "mine-1",
        "peer": "testclient",
        "method": "GET",
        "path": "/v1/domains/ready",
        "status": 200,
    }
    assert last(lines, *ALL) == {**expected, "domain": "ready"}
    assert last(lines, "ms")["ms"] > 0
    session = client.begin()
    path, session_id = path_of(session), session["session_id"]
    client.post(f"{path}/observations", json=RANKS)
    assert last(lines, "session_id", "domain", "code") == {"session_id": session_id, "domain": "ready"}
    client.delete(path)
    client.get(path)
    expected_end = {"session_id": session_id, "status": 410, "code": "ended_session"}
    assert last(lines, "session_id", "status", "code") == expected_end
    client.get("/" + "x" * 5000)
    assert len(last(lines, "path")["path"]) < 300


def test_a_refused_request_is_counted_and_its_line_has_the_code(client, lines):
    client.post("/v1/domains/ready/localizations", content=b"x" * 60_000, headers=JSON)
    assert last(lines, "status", "code") == {"status": 413, "code": "body_too_large"}
    client.get("/v1/domains/nowhere")
    assert last(lines, "code") == {"code": "unknown_domain"}
    reasons = re.findall(r'deepsimbad_refused_requests_total{reason="(\w+)"} [1-9]', client.get("/metrics").text)
    assert "body_too_large" in reasons
    assert "unknown_domain" not in reasons, "a wrong name is no refusal"


def test_jobs_and_maps_that_serve_are_told(tmp_path, lines):
    with service(tmp_path) as client:
        client.make_ready_domain("ready")
        client.remap("ready")
        client.put("/v1/admin/domains/ready/active-map", json={"version": 1})
    jobs = [vars(record) for record in lines.records if record.message in {"job started", "job ended"}]
    assert [line["message"] for line in jobs] == ["job started", "job ended"] * 2
    expected = {"domain": "ready", "kind": "remap", "state": "succeeded", "map_version": 2, "active": True}
    assert {name: jobs[-1][name] for name in expected} == expected
    switches = [vars(record) for record in lines.records if record.message.startswith("map ")]
    assert [(line["message"], line["domain"], line["map_version"], line["before"]) for line in switches] == [
        ("map activated", "ready", 1, None),
        ("map activated", "ready", 2, 1),
        ("map rolled back", "ready", 1, 2),
    ]
