"""`POST /v1/sessions/{session_id}/truths`: how good the live answers were."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.errors import UnavailableError
from deepsimbad.jobs.runner import InThisProcess

from .conftest import N_READY, make_ready_domain, ready_encodings, remap, small_settings, wait_for

STEP_M = 4.0
NO_RANKS: dict[str, Any] = {"retrieval_ranks": None, "map_version": 1}


@pytest.fixture
def service(tmp_path: Path) -> Iterator[TestClient]:
    with TestClient(
        create_app(small_settings(tmp_path), InThisProcess(tmp_path)), raise_server_exceptions=False
    ) as client:
        make_ready_domain(client, "ready")
        yield client


def walked(client: TestClient, n_views: int = 5) -> tuple[str, list[float], list[float]]:
    """A session that drives along the map itself, where it was, and the rank share of the truth after every view."""
    session_id = client.post("/v1/domains/ready/sessions", json={}).json()["session_id"]
    shares = []
    for view in range(n_views):
        body = {"encoding": (ready_encodings()[2 * view] + 0.8).tolist()}
        moved = client.post(f"/v1/sessions/{session_id}/observations?action_m={STEP_M}", json=body)
        assert moved.status_code == 200, moved.text
        shown = client.get(f"/v1/sessions/{session_id}?shortlist={N_READY}").json()["belief"]["top"]
        mass = {place["map_image"]: place["mass"] for place in shown}
        better = sum(other > mass[2 * view] for other in mass.values())
        tied = sum(other == mass[2 * view] for other in mass.values()) - 1
        shares.append((better + tied / 2) / N_READY)
    return session_id, [STEP_M * view for view in range(n_views)], shares


def told(client: TestClient, session_id: str, positions_m: list[Any]) -> Any:
    answer = client.post(f"/v1/sessions/{session_id}/truths", json={"true_positions_m": positions_m})
    assert answer.status_code == 200, answer.text
    return answer.json()


def counted(client: TestClient) -> tuple[int, float]:
    """How many observations the metric has counted, and their ranks' sum in percent."""
    text = client.get("/metrics").text
    found = dict(re.findall(r'^deepsimbad_live_anr_percent_(count|sum)\{domain="ready"\} (\S+)$', text, re.MULTILINE))
    return int(float(found.get("count", 0))), float(found.get("sum", 0))


def test_the_answer_is_the_anr_of_the_beliefs_that_were_answered(service: TestClient) -> None:
    session_id, positions_m, shares = walked(service)
    assert len(set(shares)) > 1, "else nothing is shown"
    expected = 100 * float(np.mean(shares))
    answer = told(service, session_id, positions_m)
    assert answer == {"n_scored": 5, "n_left_out": 0, "anr": pytest.approx(expected), **NO_RANKS}
    assert counted(service) == (5, pytest.approx(100 * sum(shares)))
    some = told(service, session_id, [None, *positions_m[1:3], None, None])
    assert some == {"n_scored": 2, "n_left_out": 3, "anr": pytest.approx(50 * sum(shares[1:3])), **NO_RANKS}
    none = told(service, session_id, [None] * 5)
    assert none == {"n_scored": 0, "n_left_out": 5, "anr": None, **NO_RANKS}


def test_each_view_is_ranked_by_the_map_images_told(service: TestClient) -> None:
    """Bit by bit as at once, by ANR's rule, also after the session went on or ended."""
    session_id = service.post("/v1/domains/ready/sessions", json={}).json()["session_id"]
    retrievals = []
    for view in range(6):
        body = {"encoding": (ready_encodings()[2 * view] + 0.8).tolist()}
        path = f"/v1/sessions/{session_id}/observations?action_m={STEP_M}&shortlist={N_READY}"
        retrieval = service.post(path, json=body).json()["retrieval"]
        retrievals.append({place["map_image"]: place["relevance"] for place in retrieval})
    images = [[2 * view, 2 * view + 1] if view != 1 else [] for view in range(6)]

    def rank(view: int) -> float | None:
        if not images[view]:
            return None
        relevance = retrievals[view]
        best = max(relevance[image] for image in images[view])
        return sum(one > best for one in relevance.values()) + (list(relevance.values()).count(best) - 1) / 2

    expected = [rank(view) for view in range(6)]
    assert len(set(expected)) > 2, "else nothing is shown"

    def ranks(first: int, last: int) -> list[float | None]:
        part = {"true_positions_m": [None] * (last - first), "true_map_images": images[first:last]}
        answer = service.post(f"/v1/sessions/{session_id}/truths", json={**part, "first_observation": first})
        assert answer.status_code == 200, answer.text
        assert answer.json()["n_left_out"] == last - first
        found: list[float | None] = answer.json()["retrieval_ranks"]
        return found

    assert ranks(0, 6) == expected
    assert ranks(3, 6) == expected[3:]
    service.put(f"/v1/sessions/{session_id}/prior", json={"position_m": 3.0, "std_m": 1.0})
    body = {"encoding": ready_encodings()[12].tolist()}
    retrieval = service.post(f"/v1/sessions/{session_id}/observations", json=body).json()["retrieval"]
    assert retrieval[0]["map_image"] == 12
    images.append([12])
    assert ranks(6, 7) == [0]
    service.delete(f"/v1/sessions/{session_id}")
    assert ranks(2, 7) == [*expected[2:], 0]
    assert counted(service)[0] == 0, "the alarm is of positions alone"


def test_a_truth_far_from_the_map_says_nothing_of_it(service: TestClient) -> None:
    session_id, positions_m, shares = walked(service, 3)
    last_m = 2.0 * (N_READY - 1)
    answer = told(service, session_id, [positions_m[0], 1e9, last_m + 10.5])
    assert answer == {"n_scored": 1, "n_left_out": 2, "anr": pytest.approx(100 * shares[0]), **NO_RANKS}
    assert counted(service)[0] == 1
    assert told(service, session_id, [None, None, last_m + 9.5])["n_scored"] == 1


def test_an_observation_is_counted_once(service: TestClient) -> None:
    session_id, positions_m, shares = walked(service)
    told(service, session_id, [*positions_m[:3], None, None])
    assert counted(service) == (3, pytest.approx(100 * sum(shares[:3])))
    told(service, session_id, [*positions_m[:3], None, None])
    assert counted(service)[0] == 3
    told(service, session_id, positions_m)
    assert counted(service) == (5, pytest.approx(100 * sum(shares)))
    service.post(f"/v1/sessions/{session_id}/observations", json={"ranked_landmarks": [1]})
    told(service, session_id, [*positions_m, 16.0])
    assert counted(service)[0] == 6
    assert service.get(f"/v1/sessions/{session_id}").json()["n_observations"] == 6, "telling moves nothing"


def test_a_truth_that_is_unknown_for_once_stays_told(service: TestClient) -> None:
    session_id, positions_m, _ = walked(service)
    told(service, session_id, positions_m)
    told(service, session_id, [None] * 5)
    told(service, session_id, positions_m)
    assert counted(service)[0] == 5


def test_experience_counts_as_well_and_the_same_positions_only_once(service: TestClient) -> None:
    session_id, positions_m, shares = walked(service)
    service.delete(f"/v1/sessions/{session_id}")
    body = {"session_id": session_id, "true_positions_m": positions_m}
    job = service.post("/v1/admin/domains/ready/experience", json=body).json()
    assert counted(service) == (5, pytest.approx(100 * sum(shares)))
    told(service, session_id, positions_m)
    service.post("/v1/admin/domains/ready/experience", json=body)
    assert counted(service)[0] == 5
    assert wait_for(service, job["job_id"])["state"] == "succeeded"


def test_experience_that_is_refused_counts_once_as_well(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    session_id, positions_m, _ = walked(service)
    body = {"session_id": session_id, "true_positions_m": positions_m}

    def refuse(*_: object) -> None:
        raise UnavailableError("no job is taken now")

    with monkeypatch.context() as patch:
        patch.setattr(service.app.state.services.runner, "submit", refuse)  # type: ignore[attr-defined]
        answer = service.post("/v1/admin/domains/ready/experience", json=body)
    assert (answer.status_code, answer.json()["code"]) == (503, "unavailable")
    job = service.post("/v1/admin/domains/ready/experience", json=body).json()
    assert counted(service)[0] == 5
    assert wait_for(service, job["job_id"])["state"] == "succeeded"


def test_the_season_may_have_turned_meanwhile(service: TestClient) -> None:
    """Another map serves, with other landmarks: the session's own still tells."""
    session_id, positions_m, shares = walked(service)
    remap(service, "ready", training_traverse="drive", landmark_traverse="drive", n_landmarks=7)
    service.delete(f"/v1/sessions/{session_id}")
    answer = told(service, session_id, positions_m)
    assert answer["map_version"] == 1
    assert answer["anr"] == pytest.approx(100 * float(np.mean(shares)))


def test_a_deleted_domain_takes_its_series_along(service: TestClient) -> None:
    session_id, positions_m, _ = walked(service)
    told(service, session_id, positions_m)
    assert service.delete("/v1/admin/domains/ready").status_code == 204
    assert 'domain="ready"' not in service.get("/metrics").text
    answer = service.post(f"/v1/sessions/{session_id}/truths", json={"true_positions_m": positions_m})
    assert (answer.status_code, answer.json()["code"]) == (410, "retired_map")
    assert 'domain="ready"' not in service.get("/metrics").text


@pytest.mark.parametrize(
    ("body", "code"),
    [
        (b'{"true_positions_m": [1, 2, 3]}', "invalid_input"),
        (b'{"true_positions_m": [1]}', "invalid_input"),
        (b'{"true_positions_m": [1, NaN]}', "invalid_input"),
        (b'{"true_positions_m": [1, 1e999]}', "invalid_input"),
        (b'{"true_positions_m": []}', "invalid_request"),
        (b'{"true_positions_m": ["1", 2]}', "invalid_request"),
        (b'{"true_positions_m": [true, 2]}', "invalid_request"),
        (b'{"true_positions_m": null}', "invalid_request"),
        (b'{"true_positions_m": [1, 2], "more": 1}', "invalid_request"),
        (b'{"true_positions_m": [null, null], "true_map_images": [[1]]}', "invalid_input"),
        (b'{"true_positions_m": [null, null], "true_map_images": [[1], [1000]]}', "invalid_input"),
        (b'{"true_positions_m": [null, null], "true_map_images": [[1], [-1]]}', "invalid_request"),
        (b'{"true_positions_m": [null, null], "true_map_images": [[1], [99999999999999999999]]}', "invalid_request"),
        (b'{"true_positions_m": [1, 2], "first_observation": 1000000000000}', "invalid_input"),
        (b'{}', "invalid_request"),
        (b'[1, 2]', "invalid_request"),
        (b'', "empty_body"),
    ],
)  # fmt: skip
def test_truths_that_cannot_be(service: TestClient, body: bytes, code: str) -> None:
    session_id, _, _ = walked(service, 2)
    path = f"/v1/sessions/{session_id}/truths"
    answer = service.post(path, content=body, headers={"Content-Type": "application/json"})
    assert (answer.status_code, answer.json()["code"]) == (422, code), answer.text
    assert counted(service)[0] == 0


def test_nobody_and_other_content(service: TestClient) -> None:
    answer = service.post("/v1/sessions/nobody/truths", json={"true_positions_m": [1]})
    assert (answer.status_code, answer.json()["code"]) == (404, "unknown_session")
    session_id, _, _ = walked(service, 1)
    answer = service.post(f"/v1/sessions/{session_id}/truths", content=b"x", headers={"Content-Type": "text/plain"})
    assert answer.status_code == 415
