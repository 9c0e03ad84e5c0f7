"""`POST /v1/admin/domains/{domain}/experience`: the next map version learns from a session."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.engine.maps import load_snapshot
from deepsimbad.jobs.runner import InThisProcess

from .conftest import N_LANDMARKS, make_ready_domain, ready_encodings, remap, small_settings, wait_for

PATH = "/v1/admin/domains/ready/experience"


@pytest.fixture
def service(tmp_path: Path) -> Iterator[TestClient]:
    app = create_app(small_settings(tmp_path), InThisProcess(tmp_path))
    with TestClient(app, raise_server_exceptions=False) as client:
        make_ready_domain(client, "ready")
        yield client


def walked(client: TestClient, n_views: int = 6) -> tuple[str, list[float]]:
    """A session that drives along the map itself, two images a view."""
    session_id = client.post("/v1/domains/ready/sessions", json={}).json()["session_id"]
    for image in range(0, 2 * n_views, 2):
        body = {"encoding": ready_encodings()[image].tolist()}
        answer = client.post(f"/v1/sessions/{session_id}/observations?action_m=4", json=body)
        assert answer.status_code == 200, answer.text
    return session_id, [2.0 * image for image in range(0, 2 * n_views, 2)]


def refused(client: TestClient, status: int, code: str, **body: Any) -> None:
    answer = client.post(PATH, json=body)
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text


def test_the_next_map_learns_from_a_session(service: TestClient) -> None:
    session_id, positions_m = walked(service)
    known: list[float | None] = [*positions_m]
    known[3] = None
    answer = service.post(PATH, json={"session_id": session_id, "true_positions_m": known})
    assert answer.status_code == 202, answer.text
    assert answer.headers["location"].endswith(answer.json()["job_id"])
    job = wait_for(service, answer.json()["job_id"])
    assert (job["state"], job["kind"]) == ("succeeded", "experience"), job
    assert job["result"]["map_version"] == 2
    assert job["result"]["metrics"]["experience"] == {"from_version": 1, "n_walks": 1, "n_moves": 4}
    catalog = service.app.state.services.catalog  # type: ignore[attr-defined]
    before, after = (load_snapshot(catalog, "ready", version) for version in (1, 2))
    assert before.q_values is not None
    assert after.q_values is not None
    changed = np.flatnonzero((before.q_values != after.q_values).any(axis=0))
    assert changed.tolist() == [3]  # the move of 4 m alone
    assert service.get(f"/v1/sessions/{session_id}").json()["map_version"] == 1
    # A second session on the older version may be fed back too: its landmarks are the same.
    service.delete(f"/v1/sessions/{session_id}")  # and an ended one as well
    again = service.post(PATH, json={"session_id": session_id, "true_positions_m": positions_m})
    assert wait_for(service, again.json()["job_id"])["result"]["map_version"] == 3


def test_a_prior_in_between_begins_another_walk(service: TestClient) -> None:
    session_id, positions_m = walked(service, 3)
    service.put(f"/v1/sessions/{session_id}/prior", json={"position_m": 8, "std_m": 1})
    for _ in range(2):
        service.post(f"/v1/sessions/{session_id}/observations", json={"ranked_landmarks": [1, 2, 3]})
    answer = service.post(PATH, json={"session_id": session_id, "true_positions_m": [*positions_m, 8.0, 8.0]})
    metrics = wait_for(service, answer.json()["job_id"])["result"]["metrics"]
    assert metrics["experience"]["n_walks"] == 2


def test_a_session_whose_map_was_removed(service: TestClient) -> None:
    session_id, positions_m = walked(service, 3)
    service.delete(f"/v1/sessions/{session_id}")
    remap(service, "ready", training_traverse="drive", landmark_traverse="drive", n_landmarks=N_LANDMARKS)
    assert service.delete("/v1/admin/domains/ready/maps/1").status_code == 204
    refused(service, 410, "retired_map", session_id=session_id, true_positions_m=positions_m)


def test_a_session_of_a_domain_that_was_deleted_and_made_anew(service: TestClient) -> None:
    session_id, positions_m = walked(service, 3)
    assert service.delete("/v1/admin/domains/ready").status_code == 204
    make_ready_domain(service, "ready", actions_m=[4.0])
    refused(service, 410, "retired_map", session_id=session_id, true_positions_m=positions_m)


def test_a_map_that_cannot_be_read_is_named_by_its_number(service: TestClient, tmp_path: Path) -> None:
    session_id, positions_m = walked(service, 3)
    remap(service, "ready", training_traverse="drive", landmark_traverse="drive", n_landmarks=N_LANDMARKS)
    (tmp_path / "domains/ready/maps/000001.sqlite").unlink()
    answer = service.post(PATH, json={"session_id": session_id, "true_positions_m": positions_m})
    assert (answer.status_code, answer.json()["code"]) == (503, "damaged_map")
    assert ".sqlite" not in answer.text


def test_what_cannot_be_learnt_from(service: TestClient) -> None:
    session_id, positions_m = walked(service, 3)
    refused(service, 404, "unknown_session", session_id="0" * 32, true_positions_m=positions_m)
    refused(service, 422, "invalid_input", session_id=session_id, true_positions_m=positions_m[:-1])
    refused(service, 422, "invalid_request", session_id=session_id, true_positions_m=[])
    refused(service, 422, "invalid_request", session_id=session_id, true_positions_m=["a"] * 3)
    refused(service, 422, "invalid_request", session_id=session_id)
    nan = b'{"session_id": "%s", "true_positions_m": [1, NaN, 2]}' % session_id.encode()
    answer = service.post(PATH, content=nan, headers={"Content-Type": "application/json"})
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_input")
    other = service.post("/v1/admin/domains/nowhere/experience", json={"session_id": "x", "true_positions_m": [1]})
    assert (other.status_code, other.json()["code"]) == (404, "unknown_domain")
    make_ready_domain(service, "another")
    other = service.post(
        "/v1/admin/domains/another/experience", json={"session_id": session_id, "true_positions_m": positions_m}
    )
    assert (other.status_code, other.json()["code"]) == (404, "unknown_session")
    remap(service, "ready", training_traverse="drive", landmark_traverse="drive", n_landmarks=N_LANDMARKS - 1)
    refused(service, 409, "conflict", session_id=session_id, true_positions_m=positions_m)
