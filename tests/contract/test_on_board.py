"""Encoding on board: the landmark model, binary ranks, and what a robot with other landmarks is told."""

import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.core.descriptor import pack_ranked_landmarks
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad_client import Client, Observation
from deepsimbad_client.errors import LandmarkModelDiffersError
from deepsimbad_client.http.on_board import OnBoardEncoder

from .conftest import N_LANDMARKS, N_READY, N_SEEN, encoded, make_ready_domain, picture, remap, small_settings

RANKS = {"Content-Type": "application/vnd.deepsimbad.ranks"}
MODEL = "/v1/domains/ready/landmark-model"
# Of 10 landmarks an id takes four bits; m = 3, then 7, 2 and 9, and four zero bits.
BY_HAND = b"\x00\x03" + bytes([0b0111_0010, 0b1001_0000])


def refused(answer: Any, status: int, code: str) -> dict[str, Any]:
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text
    problem: dict[str, Any] = answer.json()
    return problem


def begin(client: TestClient, domain: str = "ready") -> str:
    answer = client.post(f"/v1/domains/{domain}/sessions", json={})
    assert answer.status_code == 201, answer.text
    return f"/v1/sessions/{answer.json()['session_id']}"


@pytest.fixture(params=["localizations", "observations"])
def post(request: pytest.FixtureRequest, client: TestClient) -> Any:
    """Posts a view by either call."""
    path = "/v1/domains/ready/localizations"
    if request.param == "observations":
        path = f"{begin(client)}/observations"
    return lambda **sent: client.post(path, **sent)


@pytest.fixture(scope="module")
def rebuilt(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service of its own whose domain `ready` has two maps of different landmarks; version 2 serves."""
    folder = tmp_path_factory.mktemp("rebuilt")
    with TestClient(create_app(small_settings(folder), InThisProcess(folder))) as client:
        make_ready_domain(client, "ready")
        made = remap(client, "ready", training_traverse="drive", landmark_traverse="drive", n_landmarks=7)
        assert made["state"] == "succeeded", made
        yield client


def test_the_landmark_model_is_an_npz_of_named_arrays(client: TestClient) -> None:
    answer = client.get(MODEL)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/octet-stream"
    arrays = np.load(io.BytesIO(answer.content), allow_pickle=False)
    assert set(arrays.files) == {"prototypes", "map_version", "n_landmarks", "evaluator", "weights_sha256"}
    assert arrays["prototypes"].shape == (N_LANDMARKS, 8)
    assert arrays["prototypes"].dtype == np.float32
    assert arrays["map_version"].dtype == np.int64
    assert (int(arrays["map_version"]), int(arrays["n_landmarks"])) == (1, N_LANDMARKS)
    assert json.loads(str(arrays["evaluator"])) == {"kind": "feature_l2", "extractor": "none"}
    assert str(arrays["weights_sha256"]) == ""
    assert {entry.date_time for entry in zipfile.ZipFile(io.BytesIO(answer.content)).infolist()} == {
        (1980, 1, 1, 0, 0, 0)
    }


def test_its_tag_is_the_digest_that_the_domain_tells(client: TestClient) -> None:
    answer = client.get(MODEL)
    digest = client.get("/v1/domains/ready").json()["landmark_model_digest"]
    assert answer.headers["etag"] == f'"{digest}"'
    assert OnBoardEncoder(answer.content).digest == digest
    assert client.get("/v1/domains/unmapped").json()["landmark_model_digest"] is None
    for known in (f'"{digest}"', f'W/"{digest}"', f'"other", "{digest}"', "*"):
        unchanged = client.get(MODEL, headers={"If-None-Match": known})
        assert (unchanged.status_code, unchanged.content) == (304, b"")
        assert unchanged.headers["etag"] == f'"{digest}"'
    assert client.get(MODEL, headers={"If-None-Match": '"other"'}).content == answer.content


def test_the_same_landmarks_are_the_same_bytes(tmp_path: Path) -> None:
    answers = []
    for n_starts in range(2):
        with TestClient(create_app(small_settings(tmp_path), InThisProcess(tmp_path))) as service:
            if n_starts == 0:
                make_ready_domain(service, "ready")
            answers.append(service.get(MODEL))
    assert answers[0].content == answers[1].content
    assert answers[0].headers["etag"] == answers[1].headers["etag"]


def test_another_version_may_be_asked_for(rebuilt: TestClient) -> None:
    now, first = rebuilt.get(MODEL), rebuilt.get(MODEL, params={"map_version": 1})
    assert OnBoardEncoder(now.content).map_version == 2
    assert OnBoardEncoder(now.content).n_landmarks == 7
    assert OnBoardEncoder(first.content).map_version == 1
    assert now.headers["etag"] != first.headers["etag"]
    refused(rebuilt.get(MODEL, params={"map_version": 3}), 404, "unknown_map_version")
    refused(rebuilt.get(MODEL, params={"map_version": 0}), 422, "invalid_request")


def test_where_there_is_no_landmark_model(client: TestClient, tmp_path: Path) -> None:
    refused(client.get("/v1/domains/nowhere/landmark-model"), 404, "unknown_domain")
    refused(client.get("/v1/domains/nowhere/landmark-model?map_version=1"), 404, "unknown_domain")
    refused(client.get("/v1/domains/unmapped/landmark-model"), 409, "no_active_map")
    with TestClient(create_app(small_settings(tmp_path), InThisProcess(tmp_path))) as service:
        make_ready_domain(service, "ready")
        remap(service, "ready", training_traverse="drive", landmark_traverse="drive", n_landmarks=7)
        assert service.delete("/v1/admin/domains/ready/maps/1").status_code == 204
        refused(service.get(MODEL, params={"map_version": 1}), 410, "retired_map")
        (damaged,) = (tmp_path / "domains" / "ready" / "maps").glob("*2.sqlite")
    damaged.chmod(0o644)
    damaged.write_bytes(damaged.read_bytes()[:-100])
    with TestClient(create_app(small_settings(tmp_path), InThisProcess(tmp_path))) as service:
        refused(service.get(MODEL), 503, "damaged_map")
        refused(service.get(MODEL, params={"map_version": 2}), 503, "damaged_map")


def test_ranks_by_hand(post: Any, client: TestClient) -> None:
    assert pack_ranked_landmarks([7, 2, 9], N_LANDMARKS) == BY_HAND
    answer = post(content=BY_HAND, headers=RANKS)
    assert answer.status_code == 200, answer.text
    if "session_id" not in answer.json():
        same = client.post("/v1/domains/ready/localizations", json={"ranked_landmarks": [7, 2, 9]})
        assert answer.json()["retrieval"] == same.json()["retrieval"]
        assert answer.json()["belief"] == same.json()["belief"]


@pytest.mark.parametrize(
    "body",
    [
        b"\0",
        b"\0\0",
        b"\0\x0b" + bytes(6),
        b"\0\2",
        b"\0\2\x12\0",
        b"\0\1\x11",
        b"\0\1\xa0",
        b"\0\2\x11",
    ],
    ids=["a byte", "m 0", "m over r", "too short", "too long", "padding", "id over r", "twice"],
)
def test_bad_ranks(post: Any, body: bytes) -> None:
    refused(post(content=body, headers=RANKS), 422, "invalid_ranked_landmarks")


def test_no_ranks_at_all(post: Any) -> None:
    refused(post(content=b"", headers=RANKS), 422, "empty_body")


def test_415_lists_ranks(post: Any) -> None:
    answer = post(content=b"x", headers={"Content-Type": "text/plain"})
    assert RANKS["Content-Type"] in refused(answer, 415, "unsupported_media_type")["allowed"]


def test_a_robot_with_other_landmarks_is_told(post: Any, client: TestClient) -> None:
    digest = client.get("/v1/domains/ready").json()["landmark_model_digest"]
    for matching in (f'"{digest}"', "*", f'"other" , "{digest}"'):
        assert post(content=BY_HAND, headers={**RANKS, "If-Match": matching}).status_code == 200
        assert post(json={"ranked_landmarks": [7, 2]}, headers={"If-Match": matching}).status_code == 200
    for other in ('"other"', f'W/"{digest}"'):
        problem = refused(post(content=BY_HAND, headers={**RANKS, "If-Match": other}), 409, "landmark_model_differs")
        assert problem["landmark_model_digest"] == digest
        assert problem["given_landmark_models"] == (["other"] if other == '"other"' else [])
        assert problem["map_version"] == 1
    for nonsense in (digest, "", '"', '"a" "b"'):
        refused(post(content=BY_HAND, headers={**RANKS, "If-Match": nonsense}), 422, "invalid_request")


def test_relevances_are_not_answered_to_other_landmarks_either(client: TestClient) -> None:
    told = {**RANKS, "Accept": "application/octet-stream", "If-Match": '"other"'}
    refused(
        client.post("/v1/domains/ready/localizations", content=BY_HAND, headers=told), 409, "landmark_model_differs"
    )


def test_a_refused_view_leaves_the_session_as_it_was(client: TestClient) -> None:
    path = begin(client)
    refused(
        client.post(f"{path}/observations", content=BY_HAND, headers={**RANKS, "If-Match": '"x"'}),
        409,
        "landmark_model_differs",
    )
    assert client.get(path).json()["n_observations"] == 0


def test_a_session_keeps_its_landmarks(rebuilt: TestClient) -> None:
    rebuilt.put("/v1/admin/domains/ready/active-map", json={"version": 1})
    path = begin(rebuilt)
    rebuilt.put("/v1/admin/domains/ready/active-map", json={"version": 2})
    old = OnBoardEncoder(rebuilt.get(MODEL, params={"map_version": 1}).content)
    ranked = old.ranks(encoding=np.arange(8), m=5)
    assert rebuilt.post(f"{path}/observations", content=ranked.body, headers=ranked.headers).status_code == 200
    answer = rebuilt.post("/v1/domains/ready/localizations", content=ranked.body, headers=ranked.headers)
    assert refused(answer, 409, "landmark_model_differs")["map_version"] == 2


def test_on_board_and_by_image_one_answer(client: TestClient, tmp_path: Path) -> None:
    """The same picture: decoded, encoded and ranked here, and there."""
    robot = Client("http://testserver", transport=client._transport)
    encoder = robot.on_board("seen")
    assert encoder.map_version == 1
    assert encoder.n_landmarks == N_SEEN
    path = tmp_path / "view.jpg"
    path.write_bytes(encoded(picture(5)))
    with robot.session("seen") as here, robot.session("seen") as there:
        for number in (5, 3):
            path.write_bytes(encoded(picture(number)))
            ranked = encoder.ranks(path)
            assert len(ranked.body) <= 64
            on_board, by_image = robot.localize("seen", ranked=ranked), robot.localize("seen", path)
            assert on_board.retrieval == by_image.retrieval
            assert on_board.belief == by_image.belief
            assert here.observe(ranked=ranked).belief == there.observe(path).belief
        assert (robot.relevances("seen", ranked=ranked) == robot.relevances("seen", path)).all()
        dark = encoded(np.zeros((90, 120, 3), np.uint8))
        assert here.observe(ranked=encoder.ranks(dark)).belief == there.observe(dark).belief


def test_the_client_names_other_landmarks(client: TestClient) -> None:
    robot = Client("http://testserver", transport=client._transport)
    ranked = robot.on_board("ready").ranks(encoding=np.arange(8))
    assert robot.localize("ready", ranked=ranked).map_version == 1
    with pytest.raises(LandmarkModelDiffersError, match="on_board") as caught:
        robot.localize("ready", ranked=Observation(ranked.body, ranked.content_type, "other"))
    assert caught.value.problem["given_landmark_models"] == ["other"]
    assert len(robot.relevances("ready", ranked=ranked)) == N_READY
