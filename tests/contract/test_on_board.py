"""Encoding on board: the landmark model, binary ranks, and what a robot with other landmarks is told."""

import io
import json
import zipfile

import numpy as np
import pytest

from deepsimbad.core.on_board import pack_ranked_landmarks, pack_unit_encoding
from deepsimbad_client import Client, Observation
from deepsimbad_client.errors import LandmarkModelDiffersError
from deepsimbad_client.http.on_board import OnBoardEncoder

from .conftest import (
    DIM,
    N_LANDMARKS,
    N_READY,
    N_SEEN,
    TAKES_ENCODINGS,
    TAKES_IMAGES,
    encoded,
    picture,
    problem,
    ready_encodings,
    service,
)

PACKED = {"Content-Type": "application/vnd.deepsimbad.ranks"}
PACKED_UNIT = {"Content-Type": "application/vnd.deepsimbad.unit-encoding"}
READY = "/v1/domains/ready/localizations"
MODEL = "/v1/domains/ready/landmark-model"
# Of 10 landmarks an id takes four bits; m = 3, then 7, 2 and 9, and four zero bits.
BY_HAND = b"\x00\x03" + bytes([0b0111_0010, 0b1001_0000])


@pytest.fixture(params=["localizations", "observations"])
def post(request, client):
    """Posts a view by either call."""
    path = READY if request.param == "localizations" else f"{client.session()}/observations"
    return lambda **view_request: client.post(path, **view_request)


@pytest.fixture(scope="module")
def rebuilt(tmp_path_factory):
    """A service of its own, started again, whose domain `ready` has two maps of different landmarks; 2 serves."""
    folder = tmp_path_factory.mktemp("rebuilt")
    with service(folder) as client:
        client.make_ready_domain("ready")
        first_model = client.get(MODEL)
        client.remap("ready", landmark_traverse="drive", n_landmarks=7)
    with service(folder) as client:
        model = client.get(MODEL, params={"map_version": 1})
        assert (model.content, model.headers["etag"]) == (first_model.content, first_model.headers["etag"])
        yield client


def test_the_landmark_model_is_an_npz_of_named_arrays(client):
    answer = client.get(MODEL)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/octet-stream"
    arrays = np.load(io.BytesIO(answer.content), allow_pickle=False)
    assert set(arrays.files) == {"prototypes", "usual", "map_version", "n_landmarks", "evaluator", "weights_sha256"}
    assert (arrays["prototypes"].shape, arrays["prototypes"].dtype) == ((N_LANDMARKS, DIM), np.float32)
    assert np.linalg.norm(arrays["prototypes"], axis=1) == pytest.approx(np.ones(N_LANDMARKS))
    statistics = np.stack([ready_encodings().mean(axis=0), ready_encodings().std(axis=0)])
    assert (arrays["usual"].dtype, arrays["usual"]) == (np.float32, pytest.approx(statistics, abs=1e-6))
    assert arrays["map_version"].dtype == np.int64
    assert (int(arrays["map_version"]), int(arrays["n_landmarks"])) == (1, N_LANDMARKS)
    assert json.loads(str(arrays["evaluator"])) == TAKES_ENCODINGS["evaluator"]
    assert str(arrays["weights_sha256"]) == ""
    dates = {entry.date_time for entry in zipfile.ZipFile(io.BytesIO(answer.content)).infolist()}
    assert dates == {(1980, 1, 1, 0, 0, 0)}, "the same landmarks are the same bytes"


def test_its_tag_is_the_digest_that_the_domain_tells(client):
    answer = client.get(MODEL)
    digest = client.get("/v1/domains/ready").json()["landmark_model_digest"]
    assert answer.headers["etag"] == f'"{digest}"'
    assert OnBoardEncoder(answer.content).digest == digest
    assert client.get("/v1/domains/unmapped").json()["landmark_model_digest"] is None
    for etag in (f'"{digest}"', f'W/"{digest}"', f'"other", "{digest}"', "*"):
        unchanged = client.get(MODEL, headers={"If-None-Match": etag})
        assert (unchanged.status_code, unchanged.content) == (304, b"")
        assert unchanged.headers["etag"] == f'"{digest}"'
    assert client.get(MODEL, headers={"If-None-Match": '"other"'}).content == answer.content


def test_another_version_may_be_asked_for_and_a_session_keeps_its_own(rebuilt):
    new_model, old_model = (rebuilt.get(MODEL, params=params) for params in ({}, {"map_version": 1}))
    new_encoder, old_encoder = OnBoardEncoder(new_model.content), OnBoardEncoder(old_model.content)
    assert (new_encoder.map_version, new_encoder.n_landmarks, old_encoder.map_version) == (2, 7, 1)
    assert new_model.headers["etag"] != old_model.headers["etag"]
    rebuilt.put("/v1/admin/domains/ready/active-map", json={"version": 1})
    path = rebuilt.session()
    rebuilt.put("/v1/admin/domains/ready/active-map", json={"version": 2})
    ranks = old_encoder.ranks(encoding=np.arange(8), m=5)
    rebuilt.observe(path, {"content": ranks.body, "headers": ranks.headers})
    answer = rebuilt.post(READY, content=ranks.body, headers=ranks.headers)
    assert problem(answer, 409, "landmark_model_differs")["map_version"] == 2


def test_ranks_by_hand(client):
    assert pack_ranked_landmarks([7, 2, 9], N_LANDMARKS) == BY_HAND
    packed = client.localize(view={"content": BY_HAND, "headers": PACKED})
    assert client.localize(view={"ranked_landmarks": [7, 2, 9]}) | {"timings_ms": packed["timings_ms"]} == packed


def test_a_unit_encoding_by_hand_is_answered_as_its_dissimilarities(client):
    u = np.array([3, 0, -2, 0, 1, 0, 0, 0])
    # Three bits: 6, 3, 1, 3, 4 and three times 3, of three steps on either side of zero.
    by_hand = bytes([3, 0b110_011_00, 0b1_011_100_0, 0b11_011_011])
    assert pack_unit_encoding(u, 3) == by_hand
    packed = client.localize(view={"content": by_hand, "headers": PACKED_UNIT})
    landmarks = np.load(io.BytesIO(client.get(MODEL).content))["prototypes"].astype(np.float64)
    dissimilarities = (2 - 2 * landmarks @ u / np.linalg.norm(u)).tolist()
    by_dissimilarities = client.localize(view={"dissimilarities": dissimilarities})["retrieval"]
    assert packed["retrieval"] == [
        {**place, "relevance": pytest.approx(place["relevance"], abs=1e-5)} for place in by_dissimilarities
    ]
    zeros = bytes([3, 0b011_011_01, 0b1_011_011_0, 0b11_011_011])
    assert client.localize(view={"content": zeros, "headers": PACKED_UNIT})["informative"] is False


BAD_RANKS = {
    "a byte": b"\0",
    "m 0": b"\0\0",
    "m over r": b"\0\x0b" + bytes(6),
    "too short": b"\0\2",
    "too long": b"\0\2\x12\0",
    "padding": b"\0\1\x11",
    "id over r": b"\0\1\xa0",
    "twice": b"\0\2\x11",
}
BAD_UNITS = (b"\1", b"\3\0\0", b"\3\0\0\0\0", b"\3\xff\xff\xff", b"\x09" + bytes(9))


def test_packed_views_that_cannot_be(post):
    for headers, code, bodies in (
        (PACKED, "invalid_ranked_landmarks", BAD_RANKS.values()),
        (PACKED_UNIT, "invalid_encoding", BAD_UNITS),
    ):
        for body in bodies:
            problem(post(content=body, headers=headers), 422, code)
        problem(post(content=b"", headers=headers), 422, "empty_body")


def test_a_robot_with_other_landmarks_is_told(post, client):
    digest = client.get("/v1/domains/ready").json()["landmark_model_digest"]
    for matching in (f'"{digest}"', "*", f'"other" , "{digest}"'):
        assert post(content=BY_HAND, headers={**PACKED, "If-Match": matching}).status_code == 200
        assert post(json={"ranked_landmarks": [7, 2]}, headers={"If-Match": matching}).status_code == 200
    for other in ('"other"', f'W/"{digest}"'):
        answer = post(content=BY_HAND, headers={**PACKED, "If-Match": other})
        document = problem(answer, 409, "landmark_model_differs")
        assert document["landmark_model_digest"] == digest
        assert document["given_landmark_models"] == (["other"] if other == '"other"' else [])
        assert document["map_version"] == 1
    for nonsense in (digest, "", '"', '"a" "b"'):
        problem(post(content=BY_HAND, headers={**PACKED, "If-Match": nonsense}), 422, "invalid_request")


def test_a_view_by_other_landmarks_moves_nothing_and_tells_no_relevances(client):
    path = client.session()
    headers = {**PACKED, "Accept": "application/octet-stream", "If-Match": '"other"'}
    for url in (READY, f"{path}/observations"):
        problem(client.post(url, content=BY_HAND, headers=headers), 409, "landmark_model_differs")
    assert client.get(path).json()["n_observations"] == 0


def test_on_board_and_by_image_one_answer_where_ranks_are_compared(client, tmp_path):
    """The same picture is decoded, encoded and ranked on board, and by the service."""
    client.make_domain("ranked", **TAKES_IMAGES)
    client.upload_pictures("ranked", "drive")
    client.remap("ranked", landmark_traverse="drive", n_landmarks=N_SEEN, list_length=3, relevance="standardised")
    robot = Client(str(client.base_url), transport=client._transport)
    encoder = robot.on_board("ranked")
    assert (encoder.map_version, encoder.n_landmarks) == (1, N_SEEN)
    path = tmp_path / "view.jpg"
    with robot.session("ranked") as board_session, robot.session("ranked") as image_session:
        for number in (5, 3):
            path.write_bytes(encoded(picture(number)))
            ranks = encoder.ranks(path)
            assert len(ranks.body) <= 64
            on_board, by_image = robot.localize("ranked", on_board=ranks), robot.localize("ranked", path)
            assert (on_board.retrieval, on_board.belief) == (by_image.retrieval, by_image.belief)
            assert board_session.observe(on_board=ranks).belief == image_session.observe(path).belief
        assert (robot.relevances("ranked", on_board=ranks) == robot.relevances("ranked", path)).all()
        dark = encoded(np.zeros((90, 120, 3), np.uint8))
        assert board_session.observe(on_board=encoder.ranks(dark)).belief == image_session.observe(dark).belief


def test_a_few_bytes_find_the_place_on_a_map_that_compares_encodings(client):
    robot = Client(str(client.base_url), transport=client._transport)
    encoder = robot.on_board("seen")
    for number in (5, 3):
        for packed_view in (encoder.view(encoded(picture(number))), encoder.ranks(encoded(picture(number)))):
            (answer,) = robot.localize_anywhere(on_board=packed_view, domains=["seen"]).domains
            for retrieval in (robot.localize("seen", on_board=packed_view).retrieval, answer.retrieval):
                assert retrieval[0].map_image == number
    with robot.session("seen") as session:
        session.observe(on_board=encoder.view(encoded(picture(5))))
        assert session.observe(on_board=encoder.view(encoded(picture(5))), action_m=0.0).belief.top[0].map_image == 5


def test_a_map_that_compares_ranks_takes_no_unit_encoding(client):
    client.make_ready_domain("by_ranks")
    client.remap("by_ranks", landmark_traverse="drive", n_landmarks=N_LANDMARKS, relevance="rrf")
    path = "/v1/domains/by_ranks/localizations"
    document = problem(client.post(path, content=b"\3\0\0\0", headers=PACKED_UNIT), 422, "invalid_encoding")
    assert "send ranked landmarks" in document["detail"]


def test_the_client_names_other_landmarks(client):
    robot = Client(str(client.base_url), transport=client._transport)
    ranks = robot.on_board("ready").ranks(encoding=np.arange(8))
    assert robot.localize("ready", on_board=ranks).map_version == 1
    with pytest.raises(LandmarkModelDiffersError, match="on_board") as caught:
        robot.localize("ready", on_board=Observation(ranks.body, ranks.content_type, "other"))
    assert caught.value.problem["given_landmark_models"] == ["other"]
    assert len(robot.relevances("ready", on_board=ranks)) == N_READY
