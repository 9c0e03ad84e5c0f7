"""`POST /v1/domains/{domain}/localizations`: the answer's shape and truth."""

import io

import numpy as np
import pytest
from starlette.testclient import TestClient

from .conftest import DIM, N_LANDMARKS, N_READY, N_SEEN, encoded, picture, ready_encodings

READY = "/v1/domains/ready/localizations"
SEEN = "/v1/domains/seen/localizations"
RANKS = {"ranked_landmarks": list(range(N_LANDMARKS))}


def test_the_answer_has_every_member_of_the_contract(client: TestClient) -> None:
    answer = client.post(READY, json=RANKS)
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/json"
    found = answer.json()
    assert set(found) == {"map_version", "timings_ms", "belief", "retrieval", "next_best_view"}
    assert found["map_version"] == 1
    assert set(found["next_best_view"]) == {"planner", "action_m", "actions"}
    assert [action["action_m"] for action in found["next_best_view"]["actions"]] == list(range(1, 11))
    belief = found["belief"]
    assert set(belief) == {
        "mean_m",
        "mode_m",
        "std_m",
        "credible_95_m",
        "entropy_bits",
        "off_route",
        "histogram",
        "top",
    }
    assert belief["off_route"] is None
    assert len(belief["histogram"]["edges_m"]) == len(belief["histogram"]["mass"]) + 1 <= 201
    assert sum(belief["histogram"]["mass"]) == pytest.approx(1)
    assert len(belief["top"]) == len(found["retrieval"]) == 10
    assert set(belief["top"][0]) == {"map_image", "route_position_m", "x_m", "y_m", "mass"}
    assert set(found["retrieval"][0]) == {"map_image", "route_position_m", "relevance"}
    relevance = [one["relevance"] for one in found["retrieval"]]
    assert relevance == sorted(relevance, reverse=True)


def test_a_map_frames_own_encoding_is_found_again(client: TestClient) -> None:
    hits = 0
    for index, encoding in enumerate(ready_encodings()):
        best = client.post(f"{READY}?shortlist=1", json={"encoding": encoding.tolist()}).json()["retrieval"]
        hits += best[0]["map_image"] == index
        assert best[0]["route_position_m"] == 2.0 * best[0]["map_image"]
    assert hits >= 0.8 * N_READY  # a list of 4 among 10 landmarks does not tell all 40 apart


def test_unknown_coordinates_are_null(client: TestClient) -> None:
    top = client.post(f"{READY}?shortlist={N_READY}", json=RANKS).json()["belief"]["top"]
    places = {one["map_image"]: one for one in top}
    assert len(places) == N_READY
    assert places[3]["x_m"] is None
    assert places[4]["x_m"] == 8.0
    assert places[4]["y_m"] == -4.0


def test_images_of_all_types_are_found_again(client: TestClient) -> None:
    for media_type, extension in {"jpeg": ".jpg", "png": ".png", "tiff": ".tiff", "webp": ".webp"}.items():
        answer = client.post(
            SEEN, content=encoded(picture(7), extension), headers={"Content-Type": f"image/{media_type}"}
        )
        assert answer.status_code == 200, answer.text
        assert answer.json()["retrieval"][0]["map_image"] == 7


def test_encoding_dissimilarities_and_ranks_of_one_view_get_one_answer(client: TestClient) -> None:
    landmarks = _landmarks()
    encoding = ready_encodings()[11]
    dissimilarities = np.square(landmarks - encoding).sum(axis=1)
    ranked = np.argsort(dissimilarities, kind="stable")
    answers = [
        client.post(READY, json=body).json()["retrieval"]
        for body in (
            {"encoding": encoding.tolist()},
            {"dissimilarities": dissimilarities.tolist()},
            {"ranked_landmarks": ranked.tolist()},
        )
    ]
    assert answers[0] == answers[1] == answers[2]


def _landmarks() -> np.ndarray:
    """The paper's rule, slowly: the frames farthest from their nearest other."""
    encodings = ready_encodings().astype(np.float64)
    apart = np.square(encodings[:, None] - encodings[None]).sum(axis=2)
    np.fill_diagonal(apart, np.inf)
    return encodings[np.argsort(-apart.min(axis=1), kind="stable")[:N_LANDMARKS]]


def test_all_relevances_as_npy(client: TestClient) -> None:
    answer = client.post(READY, json=RANKS, headers={"Accept": "application/octet-stream"})
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/octet-stream"
    relevance = np.load(io.BytesIO(answer.content), allow_pickle=False)
    assert relevance.dtype == np.float32
    assert relevance.shape == (N_READY,)
    best = client.post(READY, json=RANKS).json()["retrieval"]
    order = np.argsort(-relevance, kind="stable")[:10]
    assert [one["map_image"] for one in best] == order.tolist()
    assert [one["relevance"] for one in best] == pytest.approx(relevance[order].tolist())


@pytest.mark.parametrize(
    ("accept", "content_type"),
    [
        ("*/*", "application/json"),
        ("application/json, application/octet-stream;q=0.5", "application/json"),
        ("application/json;q=0.5, application/octet-stream", "application/octet-stream"),
        ("application/octet-stream;q=nonsense", "application/json"),
    ],
)
def test_accept_chooses_the_form(client: TestClient, accept: str, content_type: str) -> None:
    answer = client.post(READY, json=RANKS, headers={"Accept": accept})
    assert answer.headers["content-type"] == content_type


def test_ranks_may_be_cut_short(client: TestClient) -> None:
    assert client.post(READY, json={"ranked_landmarks": [4]}).status_code == 200


@pytest.mark.parametrize("shortlist", [1, N_READY])
def test_shortlist_sizes_retrieval_and_top(client: TestClient, shortlist: int) -> None:
    found = client.post(f"{READY}?shortlist={shortlist}", json=RANKS).json()
    assert len(found["retrieval"]) == len(found["belief"]["top"]) == shortlist


def test_a_map_smaller_than_the_default_shortlist_gives_all_it_has(client: TestClient) -> None:
    client.put("/v1/admin/domains/lonely", json={"evaluator": {"kind": "feature_l2", "extractor": "none"}})
    client.post("/v1/admin/domains/lonely/traverses", json={"name": "one"})
    for index in range(2):
        client.put(
            f"/v1/admin/domains/lonely/traverses/one/frames/{index}?position_m=5",
            json={"encoding": [float(index)] * DIM},
        )
    client.post("/v1/admin/domains/lonely/traverses", json={"name": "single"})
    client.put("/v1/admin/domains/lonely/traverses/single/frames/0?position_m=5", json={"encoding": [1.0] * DIM})
    job = client.post(
        "/v1/admin/domains/lonely/remaps",
        json={"training_traverse": "single", "landmark_traverse": "one", "n_landmarks": 2, "list_length": 2},
    ).json()
    list(client.get(f"/v1/admin/jobs/{job['job_id']}/events").iter_lines())
    answer = client.post("/v1/domains/lonely/localizations", json={"ranked_landmarks": [0]})
    assert answer.status_code == 200, answer.text
    found = answer.json()
    assert [one["map_image"] for one in found["retrieval"]] == [0]
    assert found["belief"]["histogram"] == {"edges_m": [5.0, 5.0], "mass": [1.0]}
    assert found["belief"]["entropy_bits"] == 0
    assert found["belief"]["credible_95_m"] == [5.0, 5.0]


def test_the_domain_tells_of_its_map(client: TestClient) -> None:
    found = client.get("/v1/domains/ready").json()
    assert found["name"] == "ready"
    assert found["map_version"] == 1
    assert found["map_problem"] is None
    assert found["route_length_m"] == 2.0 * (N_READY - 1)
    assert found["n_map_images"] == N_READY
    assert found["n_landmarks"] == N_LANDMARKS
    assert found["list_length"] == 4
    assert found["evaluator"] == {"kind": "feature_l2", "extractor": "none"}
    assert found["input_size"] is None
    assert found["index_bits_per_map_image"] > 0
    assert found["actions_m"] == [float(action) for action in range(1, 11)]
    seen = client.get("/v1/domains/seen").json()
    assert seen["n_map_images"] == N_SEEN
    assert len(seen["input_size"]) == 2
    unmapped = client.get("/v1/domains/unmapped").json()
    assert unmapped["map_version"] is None
    assert unmapped["n_map_images"] is None
    listed = {one["name"]: one for one in client.get("/v1/domains").json()["domains"]}
    assert listed["ready"] == found
    assert listed["unmapped"] == unmapped
