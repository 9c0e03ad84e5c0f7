"""`POST /v1/localizations`: which of many domains a view is of, and where on it."""

import gc

import numpy as np
import pytest

from deepsimbad.core.atlas import posterior
from deepsimbad.store.records import KeyScope

from .conftest import JPEG, JSON, TAKES_IMAGES, image_body, picture, problem, ready_encodings, service

URL = "/v1/localizations"
FAR = 30.0  # how differently the other route looks


def answer_of(client, body, domains=None, **params):
    of = {} if domains is None else {"domains": domains}
    document = client.answer_to("POST", URL, params=params, json={**body, **of})
    likely_probability = sum(domain["probability"] for domain in document["domains"])
    assert likely_probability + document["others"]["probability"] + document["elsewhere"] == pytest.approx(1)
    assert document["n_left_out"] >= len(document["left_out"])
    return document


def make_domain(client, name, encodings, **config):
    client.make_domain(name)
    client.upload(name, "drive", np.float32(encodings), np.arange(len(encodings)) * 1.0)
    client.make_map(name, landmark_traverse="drive", **config)


@pytest.fixture(scope="module")
def routes(tmp_path_factory):
    """A service with four mapped routes: two look alike, one looks otherwise, one is of longer encodings."""
    with service(tmp_path_factory.mktemp("routes")) as client:
        rng = np.random.default_rng(11)
        client.encodings = {"a": rng.normal(size=(60, 32)), "b": rng.normal(size=(90, 32))}
        client.encodings |= {"far": FAR + rng.normal(size=(50, 32)), "long": rng.normal(size=(50, 40))}
        for name, encodings in client.encodings.items():
            make_domain(client, name, encodings, n_landmarks=30, list_length=4)
        client.make_domain("unmapped")
        yield client


def view_of(client, name, at):
    return {"encoding": client.encodings[name][at].tolist()}


def code_by_domain(answer):
    """Why domains were left out, by their names."""
    return {entry["domain"]: entry["code"] for entry in answer["left_out"]}


def test_a_view_is_of_the_domain_that_it_comes_from_and_where_that_says(routes):
    for name in ("a", "b", "far"):
        for at in (7, 21, 44):
            answer = answer_of(routes, view_of(routes, name, at))
            best = answer["domains"][0]
            assert (best["domain"], best["map_version"]) == (name, 1)
            assert (best["probability"] > 0.5, best["log_evidence"] > 0) == (True, True)
            own_answer = routes.localize(name, view_of(routes, name, at))
            for member in ("belief", "retrieval", "informative", "next_best_view"):
                assert best[member] == own_answer[member], member
            masses = [place["mass"] for place in answer["top"]]
            assert masses == sorted(masses, reverse=True)
            first = best["belief"]["top"][0]
            assert answer["top"][0] == {**first, "domain": name, "mass": first["mass"] * best["probability"]}
            assert code_by_domain(answer) == {"long": "invalid_encoding", "unmapped": "no_active_map"}
            assert answer["n_left_out"] == 2


def test_one_domain_named_answers_as_its_own_call(routes):
    view = view_of(routes, "a", 12)
    answer = answer_of(routes, view, ["a"], shortlist=4)
    own_answer = routes.localize("a", view, shortlist=4)
    (best,) = answer["domains"]
    assert best | own_answer == {**best, "timings_ms": own_answer["timings_ms"], "warnings": []}
    assert answer["others"] == {"n_domains": 0, "probability": pytest.approx(0.0, abs=1e-12)}
    assert answer["n_left_out"] == 0
    (probability,), elsewhere_probability = posterior({"a": best["log_evidence"]})[0].values(), answer["elsewhere"]
    assert (best["probability"], elsewhere_probability) == pytest.approx((probability, 1 - probability))


def test_a_brief_answer_of_many_domains_has_no_lists(routes):
    answer = answer_of(routes, view_of(routes, "a", 12), brief=True)
    assert [domain["retrieval"] + domain["belief"]["top"] + answer["top"] for domain in answer["domains"]] == [[]] * 3
    assert (
        answer["domains"][0]["belief"]["mode_m"] == routes.localize("a", view_of(routes, "a", 12))["belief"]["mode_m"]
    )


def test_probabilities_are_those_of_the_plain_formula_over_each_domain(routes):
    view = view_of(routes, "b", 30)
    log_evidences = {name: answer_of(routes, view, [name])["domains"][0]["log_evidence"] for name in ("a", "b", "far")}
    probabilities, elsewhere_probability = posterior(log_evidences)
    answer = answer_of(routes, view, ["far", "a", "b", "a"])
    assert {domain["domain"]: domain["probability"] for domain in answer["domains"]} == pytest.approx(
        probabilities, abs=1e-6
    )
    assert answer["elsewhere"] == pytest.approx(elsewhere_probability, abs=1e-6)
    short_answer = answer_of(routes, view, ["far", "a", "b"], in_full=1)
    assert [domain["domain"] for domain in short_answer["domains"]] == ["b"]
    assert short_answer["others"]["n_domains"] == 2
    assert short_answer["others"]["probability"] == pytest.approx(probabilities["a"] + probabilities["far"], abs=1e-6)


def test_a_view_of_none_of_the_routes_is_elsewhere(routes):
    answer = answer_of(routes, {"encoding": (np.full(32, -2 * FAR)).tolist()}, ["a", "b"])
    assert answer["elsewhere"] > 0.5
    assert answer["informative"] is False
    assert any("none of these routes" in warning for warning in answer["warnings"])


def test_domains_are_named_in_the_body_or_beside_it(routes):
    view = view_of(routes, "a", 3)

    def answer(body=(), **query):
        return routes.answer_to("POST", URL, params=query, json={**view, **dict(body)}) | {"timings_ms": 0}

    assert answer({"domains": ["a", "b"]}) == answer(domains=["a", "b"])
    assert answer() == answer({"domains": "*"}) == answer(domains="*")
    assert answer()["domains"][0]["domain"] == "a"
    twice = routes.post(URL, params={"domains": "a"}, json={**view, "domains": ["b"]})
    problem(twice, 422, "invalid_request")


@pytest.mark.parametrize(
    ("domains", "status", "code"),
    [
        *((domains, 422, "invalid_request") for domains in ([], [""], ["../a"], "a", 3, ["*"], None, [1])),
        (["a", "nowhere"], 404, "unknown_domain"),
        (["unmapped"], 409, "no_active_map"),
        (["long"], 422, "invalid_encoding"),
        (["long", "unmapped"], 409, "no_domain_answers"),
    ],
)
def test_domains_that_cannot_be_asked_are_named(routes, domains, status, code):
    document = problem(routes.post(URL, json={**view_of(routes, "a", 0), "domains": domains}), status, code)
    assert code != "unknown_domain" or "nowhere" in document["detail"]
    assert code != "no_domain_answers" or [entry["domain"] for entry in document["left_out"]] == domains


def test_bodies_that_cannot_be(routes):
    problem(routes.post(URL, json={"domains": ["a"]}), 422, "invalid_request")
    problem(routes.post(URL, content=b"", headers=JSON), 422, "empty_body")
    view = {**view_of(routes, "a", 0), "domains": ["a"]}
    problem(routes.post(URL, json=view, params={"in_full": 0}), 422, "invalid_request")
    problem(routes.post(URL, content=b"\xff\xd8", headers=JPEG), 409, "no_domain_answers")


def test_ranks_are_of_one_landmark_model(routes):
    ranks = {"ranked_landmarks": list(range(30))}
    problem(routes.post(URL, json={**ranks, "domains": ["a", "b"]}), 409, "landmark_model_differs")
    assert [domain["domain"] for domain in answer_of(routes, ranks, ["b"])["domains"]] == ["b"]
    digest = routes.get("/v1/domains/a").json()["landmark_model_digest"]
    answer = routes.post(URL, json=ranks, headers={"If-Match": f'"{digest}"'}).json()
    assert [domain["domain"] for domain in answer["domains"]] == ["a"]
    assert code_by_domain(answer)["b"] == "landmark_model_differs"


def test_a_remap_a_deletion_and_damage_are_seen_at_the_next_call(routes):
    view = view_of(routes, "a", 5)
    for name in ("gone", "hurt", "new"):
        make_domain(routes, name, routes.encodings["a"], n_landmarks=30)
    answer_of(routes, view, in_full=100)
    assert routes.delete("/v1/admin/domains/gone").status_code == 204
    routes.make_map("new", landmark_traverse="drive", n_landmarks=20)
    routes.services.catalog.map_path("hurt", 1).unlink()
    answer_of(routes, view, ["a"])
    gc.collect()  # nobody holds the others now
    routes.services.maps.forget("hurt")
    answer = answer_of(routes, view, in_full=100)
    versions = {domain["domain"]: domain["map_version"] for domain in answer["domains"]}
    assert versions == {"a": 1, "b": 1, "far": 1, "new": 2}
    assert code_by_domain(answer)["hurt"] == "damaged_map"
    for name in ("hurt", "new"):
        routes.delete(f"/v1/admin/domains/{name}")


def test_a_relevance_that_compares_with_no_other_is_left_out(routes):
    make_domain(routes, "paper", routes.encodings["a"], n_landmarks=30, relevance="rrf")
    answer = answer_of(routes, view_of(routes, "a", 5), ["a", "paper"])
    assert [entry["domain"] for entry in answer["left_out"]] == ["paper"]
    assert "rrf" in answer["left_out"][0]["detail"]
    routes.delete("/v1/admin/domains/paper")


def test_a_view_that_shows_nothing_leaves_all_as_probable_as_before(routes):
    answer = answer_of(routes, {"dissimilarities": [1.0] * 30}, ["a"])
    assert (answer["informative"], answer["elsewhere"]) == (False, pytest.approx(0.02))
    assert "the view told nothing of the place" in answer["warnings"]


def test_an_image_is_encoded_once_for_all_domains_of_an_extractor(client, monkeypatch):
    client.make_domain("seen-too", **TAKES_IMAGES)
    client.upload_pictures("seen-too", "drive")
    client.remap("seen-too", landmark_traverse="drive", n_landmarks=6, list_length=3)
    evaluator = client.services.evaluators.evaluator({"kind": "feature_l2"})
    encode, n_encoded = type(evaluator).encode, []
    monkeypatch.setattr(type(evaluator), "encode", lambda self, images: n_encoded.append(1) or encode(self, images))
    domains = {"domains": ["seen", "seen-too", "ready"]}
    answer = client.answer_to("POST", URL, params=domains, **image_body(picture(7)))
    assert {domain["domain"] for domain in answer["domains"]} == {"seen", "seen-too"}
    assert code_by_domain(answer) == {"ready": "unsupported_media_type"}
    assert len(n_encoded) == 1
    assert answer["top"][0]["map_image"] == 7
    client.delete("/v1/admin/domains/seen-too")


def test_a_picture_is_held_against_those_of_the_likeliest_domain(client):
    client.make_domain("upright", **TAKES_IMAGES)
    client.answer_to("POST", "/v1/admin/domains/upright/traverses", json={"name": "drive"})
    for index in range(6):
        frame = f"/v1/admin/domains/upright/traverses/drive/frames/{index}"
        client.answer_to("PUT", frame, params={"position_m": index}, **image_body(np.rot90(picture(50 + index))))
    client.make_map("upright", n_landmarks=4, list_length=3)
    domains = {"domains": ["seen", "upright"]}
    answer = client.answer_to("POST", URL, params=domains, **image_body(picture(7)))
    assert (answer["domains"][0]["domain"], answer["warnings"]) == ("seen", [])
    client.delete("/v1/admin/domains/upright")


def test_a_key_asks_its_own_domains_alone(tmp_path):
    with service(tmp_path) as client:
        for name in ("mine", "other"):
            make_domain(client, name, ready_encodings(), n_landmarks=10)
        _, key = client.services.catalog.create_key(KeyScope.LOCALIZE, "robot", domains=["mine", "later"])
        client.services.keys.load(client.services.catalog.keys)
        client.headers["X-API-Key"] = key.text
        view = {"encoding": ready_encodings()[3].tolist()}
        assert [domain["domain"] for domain in answer_of(client, view)["domains"]] == ["mine"]
        document = problem(client.post(URL, json={**view, "domains": ["mine", "other"]}), 403, "forbidden")
        assert document["domains"] == ["mine", "later"]


def test_maps_give_way_and_warming_brings_them_back(tmp_path):
    with service(tmp_path, map_cache_bytes=1) as client:
        for name in ("a", "b"):
            make_domain(client, name, ready_encodings(), n_landmarks=10)
        view = {"encoding": ready_encodings()[3].tolist()}
        answer = answer_of(client, view, ["a", "b"])
        assert len(answer["domains"]) == 2, "those that are named are read whatever room there is"
        assert client.services.maps.n_loaded == 1
        ((cold_name, code),) = code_by_domain(answer_of(client, view)).items()
        assert code == "not_loaded"
        assert client.post(f"/v1/admin/domains/{cold_name}/warm").status_code == 202
        assert client.services.maps.peek(cold_name) is not None
        problem(client.post("/v1/admin/domains/nowhere/warm"), 404, "unknown_domain")
        client.make_domain("unmapped")
        problem(client.post("/v1/admin/domains/unmapped/warm"), 409, "no_active_map")
