"""`POST /v1/domains/{domain}/localizations`: the answer's shape and truth."""

import io
import itertools
import math

import cv2
import numpy as np
import pytest

from .conftest import (
    DIM,
    JSON,
    N_LANDMARKS,
    N_READY,
    N_SEEN,
    RANKS,
    TAKES_ENCODINGS,
    image_body,
    picture,
    ready_encodings,
)

READY = "/v1/domains/ready/localizations"


def localize(client, view=RANKS, shortlist=10, of="ready"):
    document = client.localize(of, view, shortlist=shortlist)
    assert len(document["retrieval"]) == len(document["belief"]["top"]) == shortlist
    return document


def test_the_answer_has_every_member_of_the_contract(client):
    answer = localize(client)
    members = ("map_version", "timings_ms", "belief", "retrieval", "next_best_view", "informative", "warnings")
    assert set(answer) == set(members)
    assert (answer["map_version"], answer["informative"], answer["warnings"]) == (1, True, [])
    plan = answer["next_best_view"]
    assert set(plan) == {"planner", "action_m", "stop", "actions"}
    assert (plan["planner"], plan["stop"]) == ("informed", answer["belief"]["confident"])
    assert [action["action_m"] for action in plan["actions"]] == list(range(1, 11))
    assert set(plan["actions"][0]) == {"action_m", "q_value", "expected_bits"}
    assert all(0 < action["expected_bits"] < math.log2(N_READY) for action in plan["actions"])
    best = max(plan["actions"], key=lambda action: (action["q_value"], action["action_m"]))
    assert plan["action_m"] == best["action_m"]
    belief = answer["belief"]
    assert set(belief) == {
        *("mean_m", "mode_m", "std_m", "credible_95_m", "credible_95_sets_m", "entropy_bits", "off_route"),
        *("confident", "histogram", "top"),
    }
    assert 0 < belief["off_route"] < 0.1
    pieces = belief["credible_95_sets_m"]
    assert [pieces[0][0], pieces[-1][1]] == belief["credible_95_m"]
    assert all(low <= high for low, high in pieces)
    assert all(piece[1] < following[0] for piece, following in itertools.pairwise(pieces))
    assert any(low <= belief["mode_m"] <= high for low, high in pieces)
    assert len(belief["histogram"]["edges_m"]) == len(belief["histogram"]["mass"]) + 1 <= 201
    assert sum(belief["histogram"]["mass"]) == pytest.approx(1)
    assert set(belief["top"][0]) == {"map_image", "frame", "route_position_m", "x_m", "y_m", "mass"}
    assert set(answer["retrieval"][0]) == {"map_image", "frame", "route_position_m", "relevance"}
    relevance = [place["relevance"] for place in answer["retrieval"]]
    assert relevance == sorted(relevance, reverse=True)


def test_a_map_frames_own_encoding_is_found_again_and_unknown_coordinates_are_null(client):
    hits = 0
    for index, encoding in enumerate(ready_encodings()):
        (best,) = localize(client, {"encoding": encoding.tolist()}, 1)["retrieval"]
        hits += best["map_image"] == index
        assert best["route_position_m"] == 2.0 * best["map_image"]
    assert hits >= 0.8 * N_READY  # a list of 4 among 10 landmarks does not tell all 40 apart
    top = {place["map_image"]: place for place in localize(client, shortlist=N_READY)["belief"]["top"]}
    assert len(top) == N_READY
    assert (top[3]["x_m"], top[4]["x_m"], top[4]["y_m"]) == (None, 8.0, -4.0)
    assert (top[3]["frame"], top[4]["frame"], best["frame"]) == (None, "4.png", f"{best['map_image']}.png")


@pytest.mark.parametrize(
    ("turn", "size", "says"),
    [
        (cv2.ROTATE_90_CLOCKWISE, (120, 160), "they lie on their side: they are 120 x 160, the map's 160 x 120"),
        (None, (240, 120), "they are of another shape"),
        (None, (240, 180), None),
    ],
)
def test_a_picture_that_lies_on_its_side_or_is_of_another_shape_is_answered_with_a_warning(client, turn, size, says):
    image = picture(7) if turn is None else cv2.rotate(picture(7), turn)
    view, path = image_body(cv2.resize(image, size), "tiff"), client.session("seen")
    answers = [client.localize("seen", view)]
    view["headers"]["Idempotency-Key"] = "once"
    answers += [client.observe(path, view) for _ in range(2)]
    for answer in answers:
        assert [says in warning for warning in answer["warnings"] if "pixels" in warning] == [True] * (says is not None)


IMAGE_TYPES = [(kind, kind) for kind in ("jpeg", "png", "tiff", "webp")]
IMAGE_TYPES += [("jpeg", spelling) for spelling in ("jpg", "pjpeg", "tif", "x-png", "X-TIFF")]


@pytest.mark.parametrize(("kind", "spelling"), IMAGE_TYPES)
def test_images_of_all_types_are_found_again_and_the_bytes_say_what_it_is(client, kind, spelling):
    view = {**image_body(picture(7), kind), "headers": {"Content-Type": f"image/{spelling}"}}
    answer = client.localize("seen", view)
    assert answer["retrieval"][0]["map_image"] == 7
    assert answer["belief"]["top"][0]["frame"] == "Straße 7.png"


def test_a_byte_order_mark_before_json_is_passed_over(client):
    body = b'{"ranked_landmarks": [7, 3, 1]}'
    bodies = ({"content": mark + body, "headers": JSON} for mark in (b"", b"\xef\xbb\xbf"))
    plain, marked = (client.localize(view=view) for view in bodies)
    assert marked["belief"] == plain["belief"]


def test_dissimilarities_by_the_served_landmark_model_are_answered_as_the_encoding_is(client):
    """A robot computes them as squared distances between unit vectors of standardised encodings."""
    model = np.load(io.BytesIO(client.get("/v1/domains/ready/landmark-model").content), allow_pickle=False)
    mean, std = model["usual"].astype(np.float64)
    for index in (3, 11, 29):
        standardised = (ready_encodings()[index] - mean) / std
        u = standardised / np.linalg.norm(standardised)
        dissimilarities = np.square(u - model["prototypes"]).sum(axis=1)
        by_encoding = localize(client, {"encoding": ready_encodings()[index].tolist()})
        on_board = localize(client, {"dissimilarities": dissimilarities.tolist()})
        assert by_encoding["retrieval"][0]["map_image"] == index
        for board_entry, encoding_entry in zip(on_board["retrieval"], by_encoding["retrieval"], strict=True):
            assert board_entry == {**encoding_entry, "relevance": pytest.approx(encoding_entry["relevance"], abs=1e-5)}
        assert on_board["belief"]["entropy_bits"] == pytest.approx(by_encoding["belief"]["entropy_bits"], abs=1e-4)
        ranking = np.argsort(dissimilarities, kind="stable").tolist()
        by_ranks = localize(client, {"ranked_landmarks": ranking})["retrieval"]
        assert index in [entry["map_image"] for entry in by_ranks[:3]]


def test_a_view_that_shows_nothing_is_said_so(client):
    answer = localize(client, {"dissimilarities": [1.0] * N_LANDMARKS})
    assert answer["informative"] is False
    assert answer["warnings"] == ["the view told nothing of the place"]
    assert answer["belief"]["entropy_bits"] == pytest.approx(math.log2(N_READY), abs=0.01)


def test_encoding_dissimilarities_and_ranks_of_one_view_get_one_answer_where_ranks_are_compared(client, domain):
    """The landmarks by the paper's rule, slowly: the frames farthest from their nearest other."""
    client.make_map(domain, landmark_traverse="drive", n_landmarks=N_LANDMARKS, relevance="rrf")
    encodings = ready_encodings().astype(np.float64)
    squared_distances = np.square(encodings[:, None] - encodings[None]).sum(axis=2)
    np.fill_diagonal(squared_distances, np.inf)
    landmarks = encodings[np.argsort(-squared_distances.min(axis=1), kind="stable")[:N_LANDMARKS]]
    dissimilarities = np.square(landmarks - encodings[11]).sum(axis=1)
    ranking = np.argsort(dissimilarities, kind="stable")
    answers = [
        localize(client, body, of=domain)["retrieval"]
        for body in (
            {"encoding": encodings[11].tolist()},
            {"dissimilarities": dissimilarities.tolist()},
            {"ranked_landmarks": ranking.tolist()},
        )
    ]
    assert answers[0] == answers[1] == answers[2]
    assert len(localize(client, {"ranked_landmarks": ranking[:1].tolist()}, of=domain)["retrieval"]) == 10


def test_all_relevances_as_npy(client):
    answer = client.post(READY, json=RANKS, headers={"Accept": "application/octet-stream"})
    assert answer.status_code == 200
    relevance = np.load(io.BytesIO(answer.content), allow_pickle=False)
    assert (relevance.dtype, relevance.shape) == (np.float32, (N_READY,))
    best = localize(client)["retrieval"]
    order = np.argsort(-relevance, kind="stable")[:10]
    assert [place["map_image"] for place in best] == order.tolist()
    assert [place["relevance"] for place in best] == pytest.approx(relevance[order].tolist())
    for accept, media_type in (
        ("*/*", "application/json"),
        ("application/json, application/octet-stream;q=0.5", "application/json"),
        ("application/json;q=0.5, application/octet-stream", "application/octet-stream"),
        ("application/octet-stream;q=nonsense", "application/json"),
    ):
        answer = client.post(READY, json=RANKS, headers={"Accept": accept})
        assert answer.headers["content-type"] == media_type, accept


def test_a_map_smaller_than_the_default_shortlist_gives_all_it_has(client):
    client.make_domain("lonely")
    client.upload("lonely", "two", [[0.0] * DIM, [1.0] * DIM], [5.0, 5.0])
    client.upload("lonely", "single", [[1.0] * DIM], [5.0])
    client.remap("lonely", training_traverse="single", landmark_traverse="two", n_landmarks=2, list_length=2)
    answer = client.localize("lonely", {"ranked_landmarks": [0]})
    belief = answer["belief"]
    assert [place["map_image"] for place in answer["retrieval"]] == [0]
    assert belief["histogram"] == {"edges_m": [5.0, 5.0], "mass": [1.0]}
    assert (belief["entropy_bits"], belief["credible_95_m"]) == (0, [5.0, 5.0])


def test_the_domain_tells_of_its_map(client):
    description = client.get("/v1/domains/ready").json()
    expected = {"name": "ready", "map_version": 1, "map_problem": None, "input_size": None, **TAKES_ENCODINGS}
    expected |= {"n_map_images": N_READY, "n_landmarks": N_LANDMARKS, "list_length": 4}
    expected |= {"route_length_m": 2.0 * (N_READY - 1), "actions_m": [float(action) for action in range(1, 11)]}
    assert description == {**description, **expected}
    assert description["index_bits_per_map_image"] > 0
    image_domain = client.get("/v1/domains/seen").json()
    assert (image_domain["n_map_images"], len(image_domain["input_size"])) == (N_SEEN, 2)
    unmapped = client.get("/v1/domains/unmapped").json()
    assert (unmapped["map_version"], unmapped["n_map_images"]) == (None, None)
    domains = {domain["name"]: domain for domain in client.get("/v1/domains").json()["domains"]}
    assert (domains["ready"], domains["unmapped"]) == (description, unmapped)
