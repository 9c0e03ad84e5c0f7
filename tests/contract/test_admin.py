"""The admin calls that make, fill, map and switch a domain."""

import errno
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from deepsimbad.store import catalog

from .conftest import DIM, N_READY, NPZ, encoded, make_ready_domain, npz, picture, ready_encodings, remap

EVALUATOR = {"kind": "feature_l2", "extractor": "none"}


def test_a_domain_is_made_once(client: TestClient) -> None:
    first = client.put("/v1/admin/domains/once", json={"evaluator": EVALUATOR})
    again = client.put("/v1/admin/domains/once", json={"evaluator": EVALUATOR, "closed": False})
    assert (first.status_code, again.status_code) == (201, 200)
    assert first.json() == again.json() == client.get("/v1/domains/once").json()
    assert first.json()["actions_m"] == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]


def test_an_options_default_is_the_same_as_the_option_written_out(client: TestClient) -> None:
    made = client.put("/v1/admin/domains/defaults", json={"evaluator": {"kind": "feature_l2"}})
    again = client.put("/v1/admin/domains/defaults", json={"evaluator": made.json()["evaluator"]})
    assert again.status_code == 200


def test_a_deleted_domain_is_gone_and_its_name_free(client: TestClient) -> None:
    make_ready_domain(client, "brief")
    assert client.post("/v1/domains/brief/localizations", json={"ranked_landmarks": [0]}).status_code == 200
    gone = client.delete("/v1/admin/domains/brief")
    assert (gone.status_code, gone.content) == (204, b"")
    assert client.post("/v1/domains/brief/localizations", json={"ranked_landmarks": [0]}).status_code == 404
    make_ready_domain(client, "brief", closed=True)
    assert client.get("/v1/domains/brief").json()["closed"] is True


def test_a_domain_whose_folder_cannot_be_removed_is_gone_with_its_sessions(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(folder: Path) -> None:
        raise OSError(errno.EIO, "Input/output error", str(folder))

    make_ready_domain(client, "stuck")
    session = client.post("/v1/domains/stuck/sessions", json={}).json()["session_id"]
    with monkeypatch.context() as patched:
        patched.setattr(catalog, "bury", fail)
        assert client.delete("/v1/admin/domains/stuck").status_code == 503
    assert client.get("/v1/domains/stuck").status_code == 404
    view = client.post(f"/v1/sessions/{session}/observations", json={"ranked_landmarks": [0]})
    assert (view.status_code, view.json()["code"]) == (410, "ended_session")
    assert client.post("/v1/domains/stuck/localizations", json={"ranked_landmarks": [0]}).status_code == 404
    assert 'domain="stuck"' not in client.get("/metrics").text


def test_traverses_are_listed_and_deleted(client: TestClient) -> None:
    client.put("/v1/admin/domains/shelf", json={"evaluator": EVALUATOR})
    base = "/v1/admin/domains/shelf/traverses"
    made = client.post(base, json={"name": "b"})
    assert (made.status_code, made.json()) == (201, {"name": "b", "n_frames": 0, "missing": []})
    assert client.post(base, json={"name": "b"}).status_code == 200
    client.post(base, json={"name": "a"})
    assert [one["name"] for one in client.get(base).json()["traverses"]] == ["a", "b"]
    assert client.delete(f"{base}/a").status_code == 204
    assert [one["name"] for one in client.get(base).json()["traverses"]] == ["b"]
    assert client.get(f"{base}/a").status_code == 404


def test_frames_twice_and_out_of_order(client: TestClient) -> None:
    client.put("/v1/admin/domains/order", json={"evaluator": EVALUATOR})
    base = "/v1/admin/domains/order/traverses"
    client.post(base, json={"name": "t"})
    seen = []
    for index in (5, 0, 2, 5):
        answer = client.put(
            f"{base}/t/frames/{index}",
            params={"position_m": index, "timestamp_us": index, "x_m": 1, "y_m": 2},
            json={"encoding": [float(index)] * DIM},
        )
        seen.append((answer.status_code, answer.json()))
    assert seen == [
        (201, {"index": 5, "n_frames": 1}),
        (201, {"index": 0, "n_frames": 2}),
        (201, {"index": 2, "n_frames": 3}),
        (200, {"index": 5, "n_frames": 3}),
    ]
    assert client.get(f"{base}/t").json() == {"name": "t", "n_frames": 3, "missing": [[1, 1], [3, 4]]}
    batch = npz(encodings=np.ones((3, DIM)), index=np.array([4, 2, 3]), position_m=np.array([4, 2, 3]))
    answer = client.post(f"{base}/t/frames", content=batch, headers=NPZ)
    assert (answer.status_code, answer.json()) == (200, {"n_new": 2, "n_replaced": 1, "n_frames": 5})


def test_a_deleted_traverse_takes_no_more_frames(client: TestClient) -> None:
    client.put("/v1/admin/domains/again", json={"evaluator": EVALUATOR})
    base = "/v1/admin/domains/again/traverses"
    client.post(base, json={"name": "t"})
    frame = {"encoding": [1.0] * DIM}
    assert client.put(f"{base}/t/frames/0?position_m=1", json=frame).status_code == 201
    assert client.delete(f"{base}/t").status_code == 204
    assert client.put(f"{base}/t/frames/0?position_m=1", json=frame).status_code == 404
    assert client.post(base, json={"name": "t"}).status_code == 201
    assert client.put(f"{base}/t/frames/0?position_m=1", json={"encoding": [1.0] * 3}).status_code == 201


def test_what_a_job_needs_is_not_deleted(client: TestClient) -> None:
    make_ready_domain(client, "needed")
    app: Any = client.app
    catalog = app.state.services.catalog
    job = catalog.create_job("needed", "remap", {"training_traverse": "drive"})  # one that waits
    for place in ("/v1/admin/domains/needed/traverses/drive", "/v1/admin/domains/needed"):
        answer = client.delete(place)
        assert (answer.status_code, answer.json()["code"]) == (409, "traverse_in_use")
    assert client.delete(f"/v1/admin/jobs/{job.job_id}").status_code == 204
    assert client.delete("/v1/admin/domains/needed/traverses/drive").status_code == 204
    assert client.post("/v1/domains/needed/localizations", json={"ranked_landmarks": [0]}).status_code == 200
    assert client.delete("/v1/admin/domains/needed").status_code == 204


def test_one_encoding_length_a_traverse(client: TestClient) -> None:
    client.put("/v1/admin/domains/lengths", json={"evaluator": EVALUATOR})
    base = "/v1/admin/domains/lengths/traverses"
    client.post(base, json={"name": "t"})
    assert client.put(f"{base}/t/frames/0?position_m=1", json={"encoding": [1.0, 2.0]}).status_code == 201
    answer = client.put(f"{base}/t/frames/1?position_m=1", json={"encoding": [1.0]})
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_encoding")


@pytest.mark.parametrize("dim", [64, 4096])
def test_a_domain_of_images_takes_ready_encodings_of_any_one_length(client: TestClient, dim: int) -> None:
    """By batch and one by one; the first frame of a traverse decides how long they are."""
    name = f"any-{dim}"
    assert client.put(f"/v1/admin/domains/{name}", json={"evaluator": {"kind": "feature_l2"}}).status_code == 201
    base = f"/v1/admin/domains/{name}/traverses"
    encodings = np.random.default_rng(dim).integers(-9, 10, (20, dim)).astype(np.float16)
    assert client.post(base, json={"name": "drive"}).status_code == 201
    for index in range(2):
        body = {"encoding": encodings[index].tolist()}
        assert client.put(f"{base}/drive/frames/{index}?position_m={index}", json=body).status_code == 201
    n = np.arange(2, 20)
    stored = client.post(
        f"{base}/drive/frames", content=npz(encodings=encodings[2:], index=n, position_m=n), headers=NPZ
    )
    assert stored.json() == {"n_new": 18, "n_replaced": 0, "n_frames": 20}

    image = client.put(
        f"{base}/drive/frames/20?position_m=20", content=encoded(picture(1)), headers={"Content-Type": "image/jpeg"}
    )
    assert (image.status_code, image.json()["code"]) == (422, "invalid_encoding")
    assert str(dim) in image.json()["detail"]

    job = remap(client, name, training_traverse="drive", landmark_traverse="drive", n_landmarks=20)
    assert job["state"] == "succeeded", job
    localizations = f"/v1/domains/{name}/localizations"
    assert client.post(localizations, json={"ranked_landmarks": [7, 3, 11]}).json()["retrieval"]
    found = client.post(localizations, json={"encoding": encodings[13].tolist()}).json()
    assert found["retrieval"][0]["map_image"] == 13
    image = client.post(localizations, content=encoded(picture(1)), headers={"Content-Type": "image/jpeg"})
    assert (image.status_code, image.json()["code"]) == (422, "invalid_encoding")
    assert f"landmarks of {dim}" in image.json()["detail"]


def test_an_image_and_its_encoding_are_the_same_frame(client: TestClient) -> None:
    dim = client.get("/v1/domains/seen").json()["encoding_dim"]
    answer = client.put(
        "/v1/admin/domains/seen/traverses/drive/frames/3?position_m=3",
        content=encoded(picture(3)),
        headers={"Content-Type": "image/jpeg; charset=binary"},
    )
    assert answer.status_code == 200
    short = client.put("/v1/admin/domains/seen/traverses/drive/frames/3?position_m=3", json={"encoding": [0.5]})
    assert short.json()["encoding_dim"] == dim


def test_a_remap_is_followed_by_its_events(client: TestClient) -> None:
    make_ready_domain(client, "followed")
    job = client.post(
        "/v1/admin/domains/followed/remaps", json={"training_traverse": "drive", "relevance": "rrf", "seed": 3}
    )
    assert job.status_code == 202
    assert job.headers["location"] == f"/v1/admin/jobs/{job.json()['job_id']}"
    with client.stream("GET", f"{job.headers['location']}/events") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        lines = list(stream.iter_lines())
    events = [line.removeprefix("event: ") for line in lines if line.startswith("event: ")]
    told = [json.loads(line.removeprefix("data: ")) for line in lines if line.startswith("data: ")]
    assert events[-1] == "done"
    assert set(events[:-1]) <= {"progress"}
    assert told[-1] == client.get(job.headers["location"]).json()
    assert set(told[-1]) >= {"job_id", "domain", "state", "stage", "progress", "eta_s", "result", "error"}
    assert told[-1]["state"] == "succeeded"
    assert told[-1]["progress"] == 1
    assert told[-1]["error"] is None
    assert set(told[-1]["result"]) == {"map_version", "active", "metrics"}
    assert told[-1]["config"]["seed"] == 3
    assert client.get("/v1/domains/followed").json()["relevance"] == "rrf"
    listed = client.get("/v1/admin/jobs?domain=followed").json()["jobs"]
    assert [one["result"]["map_version"] for one in listed] == [2, 1]
    assert listed[0] in client.get("/v1/admin/jobs").json()["jobs"]


def test_versions_are_switched_and_rolled_back(client: TestClient) -> None:
    make_ready_domain(client, "rolled")
    place, query = "/v1/admin/domains/rolled", {"ranked_landmarks": [1, 2, 3]}
    job = remap(client, "rolled", training_traverse="drive", relevance="rrf", activate=False)
    assert job["result"] == {"map_version": 2, "active": False, "metrics": job["result"]["metrics"]}

    def states() -> list[tuple[int, str]]:
        return [(one["version"], one["state"]) for one in client.get(f"{place}/maps").json()["maps"]]

    def answer() -> Any:
        found = client.post("/v1/domains/rolled/localizations", json=query).json()
        return found["map_version"], found["retrieval"]

    old = answer()
    assert states() == [(2, "sealed"), (1, "active")]
    switched = client.put(f"{place}/active-map", json={"version": 2, "expected": 1})
    assert (switched.status_code, switched.json()["state"]) == (200, "active")
    assert states() == [(2, "active"), (1, "retired")]
    assert answer()[0] == 2
    lost = client.put(f"{place}/active-map", json={"version": 1, "expected": 1})
    assert (lost.status_code, lost.json()["code"]) == (409, "lost_activation")
    assert client.put(f"{place}/active-map", json={"version": 1, "expected": 2}).status_code == 200
    assert answer() == old
    assert client.put(f"{place}/active-map", json={"version": 2}).status_code == 200


def test_the_map_lists_what_it_was_built_with(client: TestClient) -> None:
    newest = client.get("/v1/admin/domains/ready/maps").json()["maps"][-1]
    assert newest["config"]["n_landmarks"] == 10
    assert newest["config"]["training_traverse"] == "drive"
    assert len(newest["sha256"]) == 64
    assert newest["file_bytes"] > 0
    assert newest["metrics"]["n_map_images"] == N_READY


def test_a_closed_route_is_a_loop(client: TestClient) -> None:
    make_ready_domain(client, "loop", closed=True, actions_m=[2.5])
    found = client.get("/v1/domains/loop").json()
    assert found["closed"] is True
    assert found["actions_m"] == [2.5]
    assert found["route_length_m"] > 2.0 * (N_READY - 1)
    body = {"encoding": ready_encodings()[0].tolist()}
    assert client.post("/v1/domains/loop/localizations", json=body).status_code == 200
