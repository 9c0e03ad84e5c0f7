"""Every bad input gets a problem document that tells what to do, changes nothing, and the service goes on."""

import json
import struct
import zlib

import numpy as np
import pytest

from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY

from .conftest import (
    DIM,
    IS_FLEET,
    JPEG,
    JSON,
    N_LANDMARKS,
    N_READY,
    N_SEEN,
    NAMES,
    NPZ,
    RANKS,
    encoded,
    operations,
    picture,
    problem,
    ready_encodings,
)

READY = "/v1/domains/ready"
SEEN = "/v1/domains/seen"
ADMIN = "/v1/admin/domains/ready"
FRAMES = f"{ADMIN}/traverses/drive/frames"
FRAME = f"{FRAMES}/0?position_m=1"
BAD = "/v1/admin/domains/bad"
SESSIONS, REMAPS, UNMAPPED = f"{READY}/sessions", f"{ADMIN}/remaps", "/v1/domains/unmapped"
OF_A_MAP = ("landmark-model", "landmarks", "coverage")
KIND = {"kind": "feature_l2"}
NESTED_KIND = '{"evaluator": {"x": %s}}' % ("[" * 9000)
REMAP = {"training_traverse": "drive"}
NO_BODY = (None,)


@pytest.fixture(autouse=True)
def _goes_on(client):
    yield
    assert client.post(f"{READY}/localizations", json=RANKS).status_code == 200


def ask(client, method, path, body=None):
    """Send JSON, written out where the body is text or bytes."""
    if isinstance(body, (str, bytes)):
        return client.request(method, path, content=body, headers=JSON)
    return client.request(method, path, json=body)


@pytest.fixture(scope="module")
def views(client):
    """Both calls that take a domain's views, by its name; nothing moves the sessions."""
    sessions = {domain: client.session(domain) for domain in ("ready", "seen")}
    yield {domain: (f"/v1/domains/{domain}/localizations", f"{path}/observations") for domain, path in sessions.items()}
    assert [client.get(path).json()["n_observations"] for path in sessions.values()] == [0, 0]


# Views


def claimed_png(width, height):
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", len(header)) + chunk + struct.pack(">I", zlib.crc32(chunk))


IMAGES = ["image/jpeg", "image/png", "image/tiff", "image/webp"]
PACKED = ("application/vnd.deepsimbad.ranks", "application/vnd.deepsimbad.unit-encoding")
TAKEN = {"allowed": [*IMAGES, "application/json", *PACKED]}
KNOWN = {"allowed": [*TAKEN["allowed"], "text/plain", "multipart/form-data"]}


@pytest.mark.parametrize(
    ("of", "body", "content_type", "status", "code", "hints"),
    [
        ("seen", b"hello, robot", "image/jpeg", 422, "undecodable_image", {}),
        ("seen", encoded(picture(1))[:-200], "image/jpeg", 422, "truncated_image", {}),
        ("seen", encoded(picture(1))[:-200] + b"\xff\xd9", "image/jpeg", 422, "truncated_image", {}),
        ("seen", claimed_png(60_000, 60_000), "image/png", 413, "image_too_large", {"max_pixels": 300_000}),
        ("seen", b"", "image/jpeg", 422, "empty_body", {}),
        ("seen", b"", "application/json", 422, "empty_body", {}),
        ("seen", bytes(200_001), "image/jpeg", 413, "body_too_large", {"max_bytes": 200_000}),
        ("seen", b"x" * 50_001, "application/json", 413, "body_too_large", {"max_bytes": 50_000}),
        ("seen", b"x", "text/plain", 415, "unsupported_media_type", TAKEN),
        ("seen", b"x", "image/bmp", 415, "unsupported_media_type", KNOWN),
        ("seen", b"x", "x", 415, "unsupported_media_type", KNOWN),
        ("seen", b"x", None, 415, "unsupported_media_type", KNOWN),
        ("ready", encoded(picture(1)), "image/jpeg", 415, "unsupported_media_type", {"allowed": ["application/json"]}),
    ],
)
def test_bodies_that_are_no_view(client, views, of, body, content_type, status, code, hints):
    for path in views[of]:
        answer = client.post(path, content=body, headers={"Content-Type": content_type} if content_type else {})
        document = problem(answer, status, code)
        assert document == {**document, **hints}


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ('{"dissimilarities": [1, 2, NaN, 4, 5, 6, 7, 8, 9, 10]}', "invalid_dissimilarities"),
        ('{"dissimilarities": [1, 2, 1e999, 4, 5, 6, 7, 8, 9, 10]}', "invalid_dissimilarities"),
        ('{"dissimilarities": [1, 2, -Infinity, 4, 5, 6, 7, 8, 9, 10]}', "invalid_dissimilarities"),
        ('{"dissimilarities": [1, 2, 3]}', "invalid_dissimilarities"),
        ('{"dissimilarities": []}', "invalid_dissimilarities"),
        ('{"ranked_landmarks": [0, 1, 1]}', "invalid_ranked_landmarks"),
        ('{"ranked_landmarks": [0, 10]}', "invalid_ranked_landmarks"),
        ('{"ranked_landmarks": [-1]}', "invalid_ranked_landmarks"),
        ('{"ranked_landmarks": [%s]}' % (10**30), "invalid_ranked_landmarks"),
        ('{"ranked_landmarks": []}', "invalid_ranked_landmarks"),
        ('{"ranked_landmarks": [0,1,2,3,4,5,6,7,8,9,0]}', "invalid_ranked_landmarks"),
        ('{"encoding": [1, 2]}', "invalid_encoding"),
        ('{"encoding": []}', "invalid_encoding"),
        ('{"encoding": [1, 2, 3, 4, 5, 6, 7, NaN]}', "invalid_encoding"),
        ('{"encoding": [1, 2, 3, 4, 5, 6, 7, 1e39]}', "invalid_encoding"),
        ('{"encoding": [1, 2, 3, 4, 5, 6, 7, 1e30]}', "invalid_encoding"),
        ('{"encoding": [1, 2, 3, 4, 5, 6, 7, %s]}' % ("9" * 400), "invalid_encoding"),
        ('{"ranked_landmarks": [0.5]}', "invalid_request"),
        ('{"ranked_landmarks": [true]}', "invalid_request"),
        ('{"ranked_landmarks": ["0"]}', "invalid_request"),
        ('{"ranked_landmarks": null}', "invalid_request"),
        ('{"ranked_landmarks": [0], "dissimilarities": [1]}', "invalid_request"),
        ('{"\\ud800": [0]}', "invalid_request"),
        ('{"ranked_landmarks": ["\\udfff"]}', "invalid_request"),
        ("{}", "invalid_request"),
        ("null", "invalid_request"),
        ("{", "invalid_request"),
        ("[" * 20_000, "invalid_request"),
        ('{"ranked_landmarks":' * 2_000, "invalid_request"),
        (b"\xff\xfe{}", "invalid_request"),
        (b"\x00", "invalid_request"),
    ],
)
def test_bad_json(client, views, body, code):
    for path in views["ready"]:
        document = problem(ask(client, "POST", path, body), 422, code)
        assert code != "invalid_request" or document["errors"][0]["loc"][0] == "body"
        assert body != "{}" or document["detail"].startswith(
            "body: give exactly one of ranked_landmarks, dissimilarities"
        )


def test_a_body_in_chunks_is_counted_as_it_comes(client):
    chunks = (bytes(1000) for _ in range(10_000))
    problem(client.post(f"{SEEN}/localizations", content=chunks, headers=JPEG), 413, "body_too_large")
    chunks = (bytes(50_000) for _ in range(11))
    problem(client.post(FRAMES, content=chunks, headers=NPZ), 413, "body_too_large")


def test_a_map_that_compares_what_was_not_sent(client, domain):
    assert client.remap(domain, relevance="brute_force")["state"] == "succeeded"
    problem(client.post(f"/v1/domains/{domain}/localizations", json=RANKS), 422, "invalid_input")


# Values in queries and bodies

QUERIES = [
    *((f"shortlist={wrong}", "invalid_request") for wrong in ("0", "-1", "nan", "1.5", "", "x", 10**30)),
    (f"shortlist={N_READY + 1}", "invalid_input"),
    *((f"action_m={wrong}", "invalid_move") for wrong in ("nan", "inf", "-1", "100.5", "1e999")),
    *((f"action_m={wrong}", "invalid_request") for wrong in ("far", "")),
    *((f"action_std_m={wrong}", "invalid_move") for wrong in ("nan", "-0.1")),
]


@pytest.mark.parametrize(("query", "code"), QUERIES)
def test_bad_queries_of_views(client, query, code):
    path = client.session()
    for n_before in (0, 1):
        problem(client.post(f"{path}/observations?{query}", json=RANKS), 422, code)
        assert client.get(path).json()["n_observations"] == n_before
        client.post(f"{path}/observations", json=RANKS)
    if query.startswith("shortlist"):
        problem(client.post(f"{READY}/localizations?{query}", json=RANKS), 422, code)


_NEVER_SENT = pytest.param(" ", marks=pytest.mark.skipif(IS_FLEET, reason="no client sends it over the wire"))


@pytest.mark.parametrize("key", ["", _NEVER_SENT, "a b", "x" * 256, "\x7f"])
def test_idempotency_keys_that_cannot_be(client, key):
    session = client.session()
    for path, body in (
        (f"{session}/observations", RANKS),
        (SESSIONS, {}),
        (REMAPS, {"training_traverse": "drive"}),
        (f"{ADMIN}/experience", {"session_id": "a", "true_positions_m": [1]}),
    ):
        problem(client.post(path, json=body, headers={"Idempotency-Key": key}), 422, "invalid_request")
    assert client.get(session).json()["n_observations"] == 0


STRANGE = {"unknown": "1"}


@pytest.mark.parametrize(
    ("method", "path", "base", "wrong"),
    [
        ("POST", SESSIONS, {}, STRANGE | {"start_position_m": '"here"', "seed": "-1 1.5", "planner": '""'}),
        ("POST", SESSIONS, {}, dict.fromkeys(["belief", "update"], '"guess"')),
        ("POST", SESSIONS, {}, {"price_bits_per_m": '-0.1 100.1 NaN 1e999 "1" true'}),
        ("POST", SESSIONS, {}, {"confidence": '0 1 -0.5 2 NaN "0.9" true'}),
        ("PUT", BAD, {"evaluator": KIND}, STRANGE | {"closed": '"perhaps"', "actions_m": "[] [2,1] [1,1]"}),
        ("PUT", BAD, {"evaluator": KIND}, {"actions_m": '[0] [-0.0] [NaN] [1e999] [-1e4] [1e9] [null] [true] ["1"]'}),
        ("PUT", BAD, {"evaluator": KIND}, {"actions_m": "[0,-5]"}),
        ("POST", f"{ADMIN}/traverses", {}, STRANGE | {"name": '"" "../x" 3 "a\\n"'}),
        ("POST", REMAPS, REMAP, STRANGE | {"list_length": "0", "n_landmarks": "0 65536", "seed": "-1 1.5"}),
        ("POST", REMAPS, REMAP, {"training_episodes": "-1", "activate": '"yes"', "relevance": '"magic"'}),
        ("POST", REMAPS, REMAP, dict.fromkeys(["landmark_traverse", "check_traverse"], '"../drive"')),
        ("POST", REMAPS, REMAP, {"append": "1", "gate_margin": '-1 "1"', "same_route": '"yes" 1'}),
        ("PUT", f"{ADMIN}/active-map", {}, STRANGE | {"version": '0 "1"'}),
    ],
)
def test_members_that_cannot_be(client, method, path, base, wrong):
    """Every value in `wrong`, JSON texts by the name of a member, is refused in that member."""
    for member, values in wrong.items():
        for value in values.split():
            body = json.dumps(base)[:-1] + (", " if base else "") + f'"{member}": {value}}}'
            answer = problem(ask(client, method, path, body), 422, "invalid_request")
            assert value != "NaN" or f"{member}: Input should be a finite number" in answer["detail"]
    assert client.get("/v1/domains/bad").status_code == 404


def test_places_of_frames_that_cannot_be(client):
    for path in (
        *(f"0?position_m={wrong}" for wrong in ("nan", "inf", "-Infinity", "1e999", "x", "1e200")),
        *(f"0?position_m=1&{wrong}" for wrong in ("x_m=-1e200", "y_m=1.1e9", "x_m=nan", "y_m=inf")),
        *(f"0?position_m=1&timestamp_us={wrong}" for wrong in ("-1", "1.5", 10**30)),
        *(f"{index}?position_m=1" for index in ("-1", "1.5", "x", 10**30, "%00")),
        "0?",
    ):
        problem(client.put(f"{FRAMES}/{path}", json={"encoding": [1.0] * DIM}), 422, "invalid_request")


# Names and states


def test_whatever_is_asked_of_a_domain_session_or_job_that_nobody_knows(client):
    """Every operation on such a name is a 404, with a body that would otherwise be accepted."""
    document = client.get("/openapi.json").json()
    n_asked = 0
    for method, path, body, content_type in operations(document):
        for name in ("domain", "session_id", "job_id"):
            if f"{{{name}}}" in path and (method, path) != ("PUT", "/v1/admin/domains/{domain}?"):
                url = path.format(**NAMES | {name: "nobody"})
                answer = client.request(method, url, content=body, headers={"Content-Type": content_type})
                problem(answer, 404, f"unknown_{name.removesuffix('_id')}")
                n_asked += 1
    assert n_asked > 25


@pytest.mark.parametrize(
    ("method", "path", "status", "code", "bodies"),
    [
        ("POST", SESSIONS, 422, "invalid_prior", ('{"start_position_m": NaN}', '{"start_position_m": 1e999}')),
        ("POST", SESSIONS, 422, "invalid_prior", ({"start_position_m": 500}, {"start_std_m": 0})),
        ("POST", SESSIONS, 422, "invalid_input", ({"planner": "clever"}, {"planner": "constant:3.5"})),
        ("POST", SESSIONS, 422, "empty_body", (b"",)),
        ("PUT", BAD, 422, "invalid_request", ({}, '{"evaluator": {"\\ud800": 1}}', NESTED_KIND)),
        ("PUT", BAD, 422, "invalid_request", ({"evaluator": KIND, "actions_m": list(range(1, 100))},)),
        ("PUT", BAD, 422, "invalid_input", ({"evaluator": {}}, {"evaluator": {"kind": "telepathy"}})),
        ("PUT", BAD, 422, "invalid_input", ({"evaluator": {**KIND, "extractor": "magic"}},)),
        ("PUT", BAD, 422, "invalid_input", ({"evaluator": {**KIND, "a": 1}},)),
        ("PUT", FRAME, 422, "invalid_encoding", ({"encoding": [1.0]}, '{"encoding": [NaN]}')),
        ("PUT", FRAME, 422, "invalid_request", ({"ranked_landmarks": [1]},)),
        ("PUT", FRAME, 422, "empty_body", (b"",)),
        ("PUT", FRAME.replace("ready", "seen"), 422, "invalid_encoding", ({"encoding": [1.0, 2.0]},)),
        ("POST", REMAPS, 422, "invalid_map_config", ({**REMAP, "n_landmarks": 10, "list_length": 11},)),
        ("POST", REMAPS, 422, "invalid_map_config", ({**REMAP, "check_traverse": "drive"},)),
        ("POST", REMAPS, 422, "invalid_map_config", ({**REMAP, "append": True, "landmark_traverse": "drive"},)),
        ("POST", REMAPS, 404, "unknown_traverse", ({"training_traverse": "none"}, {**REMAP, "check_traverse": "none"})),
        ("GET", "/v1/admin/jobs?domain=nowhere", 404, "unknown_domain", NO_BODY),
        ("GET", "/v1/admin/sessions?domain=nowhere", 404, "unknown_domain", NO_BODY),
        ("GET", "/v1/sessions/none/events", 404, "unknown_session", NO_BODY),
        ("GET", f"{ADMIN}/traverses/none", 404, "unknown_traverse", NO_BODY),
        ("DELETE", f"{ADMIN}/traverses/none", 404, "unknown_traverse", NO_BODY),
        ("PUT", f"{ADMIN}/traverses/none/frames/0?position_m=1", 404, "unknown_traverse", ({"encoding": [1]},)),
        ("GET", f"{ADMIN}/maps/9/file", 404, "unknown_map_version", NO_BODY),
        ("GET", f"{ADMIN}/maps/0/file", 422, "invalid_request", NO_BODY),
        ("DELETE", f"{ADMIN}/maps/9", 404, "unknown_map_version", NO_BODY),
        ("DELETE", f"{ADMIN}/maps/x", 422, "invalid_request", NO_BODY),
        ("GET", f"{READY}/landmark-model?map_version=99", 404, "unknown_map_version", NO_BODY),
        ("GET", f"{READY}/landmark-model?map_version=0", 422, "invalid_request", NO_BODY),
        ("GET", f"{READY}/coverage?map_version=99", 404, "unknown_map_version", NO_BODY),
        ("GET", f"{SEEN}/landmarks/0/thumbnail", 404, "unknown_thumbnail", NO_BODY),
        ("GET", f"{SEEN}/landmarks/{N_SEEN}/thumbnail", 404, "unknown_thumbnail", NO_BODY),
        ("PUT", f"{ADMIN}/active-map", 404, "unknown_map_version", ({"version": 99, "expected": 1},)),
        ("PUT", f"{ADMIN}/active-map", 409, "lost_activation", [{"version": 1, "expected": n} for n in (99, None)]),
        ("PUT", ADMIN, 409, "domain_differs", ({"evaluator": KIND, "closed": True},)),
        ("POST", f"{UNMAPPED}/localizations", 409, "no_active_map", (RANKS,)),
        ("POST", f"{UNMAPPED}/sessions", 409, "no_active_map", ({},)),
        *(("GET", f"{UNMAPPED}/{name}", 409, "no_active_map", NO_BODY) for name in OF_A_MAP),
        ("GET", "/v2/domains", 404, "not_found", NO_BODY),
        ("GET", "/v1/domains/", 404, "not_found", NO_BODY),
        ("GET", "/v1/domains/..%2f..%2fcatalog.sqlite", 404, "not_found", NO_BODY),
        ("GET", "/v1/domains/%F0%9F%A4%96/%ff?%ff=%00", 404, "not_found", NO_BODY),
        ("BREW", "/healthz", 405, "method_not_allowed", NO_BODY),
    ],
)
def test_what_cannot_be_or_is_not_there(client, method, path, status, code, bodies):
    for body in bodies:
        document = problem(ask(client, method, path, body), status, code)
        assert code != "no_active_map" or "remap" in document["detail"]
    assert client.get("/v1/domains/bad").status_code == 404


def test_a_prior_that_cannot_be(client):
    path = f"{client.session()}/prior"
    for position_m, std_m in ((1e6, 1), (1, 0), (-40, 5)):
        problem(client.put(path, json={"position_m": position_m, "std_m": std_m}), 422, "invalid_prior")
    problem(client.put(path, json={"position_m": 3}), 422, "invalid_request")


@pytest.mark.parametrize(
    ("of", "body", "content_type", "status", "code"),
    [
        ("ready", b"x", "text/plain", 415, "unsupported_media_type"),
        ("ready", encoded(picture(1)), "image/jpeg", 415, "unsupported_media_type"),
        ("seen", b"x", "image/jpeg", 422, "undecodable_image"),
    ],
)
def test_what_is_no_frame(client, of, body, content_type, status, code):
    path = FRAME.replace("ready", of)
    problem(client.put(path, content=body, headers={"Content-Type": content_type}), status, code)


def test_a_method_that_a_path_does_not_know(client):
    answer = client.post("/v1/domains")
    problem(answer, 405, "method_not_allowed")
    assert answer.headers["allow"] == "GET"


def test_names_that_are_none(client):
    for name in ("%2e%2e", ".hidden", "a b", "a'--", "é", "x" * 65, "%00", "%F0%9F%A4%96", "-a", "a%0a"):
        problem(client.get(f"/v1/domains/{name}"), 422, "invalid_request")
        problem(client.put(f"/v1/admin/domains/{name}", json={"evaluator": KIND}), 422, "invalid_request")


# What only a job finds out


def test_an_unknown_word_is_answered_with_the_nearest_and_with_what_there_is(client):
    for method, path, body, status, code, nearest in (
        ("GET", "/v1/domains/raedy", None, 404, "unknown_domain", "ready? There is "),
        ("GET", f"{ADMIN}/traverses/drvie", None, 404, "unknown_traverse", "drive?"),
        ("POST", SESSIONS, {"planner": "infromed"}, 422, "invalid_input", "informed?"),
        ("POST", SESSIONS, {"planer": "nnql"}, 422, "invalid_request", "planner? There is "),
        ("POST", SESSIONS, {"update": "mixtrue"}, 422, "invalid_request", "mixture? There is "),
        ("PUT", BAD, {"evaluator": {"kind": "featurel2"}}, 422, "invalid_input", "feature_l2?"),
    ):
        assert f"did you mean {nearest}" in problem(ask(client, method, path, body), status, code)["detail"]


def test_a_query_parameter_that_a_call_does_not_take_is_refused_by_every_one(client):
    document = client.get("/openapi.json").json()
    for method, path, *_ in operations(document):
        refusal = problem(client.request(method, f"{path.format(**NAMES)}&shortlis=3"), 422, "unknown_parameter")
        assert refusal["unknown"] == ["shortlis"]
        parameters = document["paths"][path.partition("?")[0]][method.lower()].get("parameters", ())
        assert sorted(refusal["allowed"]) == sorted(
            parameter["name"] for parameter in parameters if parameter["in"] == "query"
        )
        assert ("did you mean shortlist?" in refusal["detail"]) == ("shortlist" in refusal["allowed"])
    session = client.session()
    problem(client.post(f"{session}/observations?action_m=3&shortlis=3", json=RANKS), 422, "unknown_parameter")
    assert client.get(session).json()["n_observations"] == 0
    mistyped = client.put(f"{FRAMES}/0?positon_m=1&position_m=1", json={"encoding": [0.5] * DIM})
    assert "did you mean position_m?" in problem(mistyped, 422, "unknown_parameter")["detail"]
    for path in ("/", "/openapi.json", "/docs"):
        problem(client.get(f"{path}?v=2"), 422, "unknown_parameter")


def test_remaps_that_fail_leave_the_map_that_serves(client):
    client.upload("ready", "backwards", ready_encodings()[:2], [5.0, 4.0])
    client.post(f"{ADMIN}/traverses", json={"name": "empty"})
    for config in ({}, {"landmark_traverse": "drive", "relevance": "rrf"}):
        job = client.remap("ready", training_traverse="backwards", **config)
        assert (job["state"], job["error"]["code"]) == ("failed", "invalid_route")
    n_jobs = len(client.get("/v1/admin/jobs?domain=ready").json()["jobs"])
    for options, complaint in (  # what can be known before a job is made
        ({"training_traverse": "empty"}, "no frames yet"),
        ({"landmark_traverse": "empty"}, "no frames yet"),
        ({"check_traverse": "empty"}, "no frames yet"),
        ({"list_length": N_LANDMARKS + 1}, f"list_length {N_LANDMARKS + 1} is not within 1"),
        ({"list_length": 5, "n_landmarks": 4}, "list_length"),
        ({"n_landmarks": N_LANDMARKS - 1}, f"the active map has {N_LANDMARKS} landmarks"),
        ({"landmark_traverse": "backwards"}, "list_length 4 is not within 1 and the number of landmarks, 2"),
        ({"training_traverse": "backwards", "relevance": "rrf"}, "the number of landmarks, 2"),
        ({"training_traverse": "backwards", "append": True, "list_length": 3}, "what is appended to it must be alike"),
    ):
        document = problem(client.post(REMAPS, json={**REMAP, **options}), 422, "invalid_map_config")
        assert complaint in document["detail"]
    assert len(client.get("/v1/admin/jobs?domain=ready").json()["jobs"]) == n_jobs
    too_many = {**REMAP, "landmark_traverse": "drive", "n_landmarks": N_READY + 1}
    assert problem(client.post(REMAPS, json=too_many), 422, "too_few_candidates")["n_candidates"] == N_READY
    assert client.get(READY).json()["map_version"] == 1
    client.post("/v1/admin/domains/unmapped/traverses", json={"name": "drive"})
    answer = client.post("/v1/admin/domains/unmapped/remaps", json={**REMAP, "append": True})
    assert "make one first, without append" in problem(answer, 409, "no_active_map")["detail"]


def test_a_damaged_map(client, domain, data_dir):
    place, active = f"/v1/domains/{domain}", f"/v1/admin/domains/{domain}/active-map"
    client.localize(domain)
    client.remap(domain, activate=False)
    path = data_dir / "domains" / domain / "maps" / "000002.sqlite"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.chmod(0o644)
    path.write_bytes(content)
    # A damaged version never takes over ...
    problem(client.put(active, json={"version": 2, "expected": 1}), 503, "damaged_map")
    assert client.get(place).json()["map_version"] == 1
    # ... and one damaged while it was active is named, not half answered.
    path.write_bytes(content[: len(content) // 3])
    with Catalog.open(data_dir) as catalog:
        catalog.activate(domain, 2, ANY)
    client.services.maps.forget(domain)
    for _ in range(2):
        answer = client.post(f"{place}/localizations", json=RANKS)
        assert problem(answer, 503, "damaged_map")["map_version"] == 2
        assert int(answer.headers["retry-after"]) > 0
        assert str(data_dir) not in answer.text
        problem(client.get(f"{place}/landmark-model"), 503, "damaged_map")
    expected = {"map_version": 2, "map_problem": "damaged_map", "n_map_images": None}
    assert client.get(place).json().items() >= expected.items()
    assert client.put(active, json={"version": 1, "expected": 2}).status_code == 200
    client.localize(domain)


def test_our_own_fault_tells_nothing_but_its_id(client, monkeypatch):
    def broken(*_):
        raise RuntimeError("a secret of the inside")

    monkeypatch.setattr(client.services.catalog, "newest_maps", broken)
    answer = client.get(f"{ADMIN}/maps", headers={"X-Request-ID": "mine-1"})
    assert problem(answer, 500, "internal_error")["request_id"] == "mine-1"
    assert "secret" not in answer.text
    assert answer.headers["x-content-type-options"] == "nosniff"


# Drives that teach nothing, and seasons that are not what they were taken for

PLACES = 120
AT_M = np.arange(float(PLACES))


def season(seed, n_frames=PLACES):
    """Encodings of one route, a metre apart."""
    place = np.random.default_rng(0).normal(size=(n_frames, DIM))
    return (place + 0.2 * np.random.default_rng(seed).normal(size=place.shape)).astype(np.float32)


@pytest.fixture
def map_drives(client, request):
    """A function that maps drives; it returns the job, and a function that tells where a view is."""
    name = f"drives-{zlib.crc32(request.node.name.encode())}"
    client.make_domain(name)

    def map_drives(summer, winter=None, plane=(None, None), **remap):
        for traverse, encodings, at_m in (("summer", summer, plane[0]), ("winter", winter, plane[1])):
            if encodings is not None:
                x_m = {} if at_m is None else {"x_m": at_m, "y_m": np.zeros(len(at_m))}
                client.upload(name, traverse, encodings, np.arange(float(len(encodings))), **x_m)
        options = {"training_episodes": 0, **({} if winter is None else {"landmark_traverse": "winter"}), **remap}
        job = client.remap(name, training_traverse="summer", **options)
        return job, lambda view: client.localize(name, {"encoding": view.astype(float).tolist()})["belief"]["mode_m"]

    yield map_drives
    assert client.delete(f"/v1/admin/domains/{name}").status_code == 204


@pytest.mark.parametrize("still", ["summer", "winter", "both"])
def test_a_number_that_stands_still_in_a_season_says_nothing(map_drives, still):
    summer, winter, live = season(1), season(2), season(3)
    for drive, names in ((summer, ("summer", "both")), (winter, ("winter", "both"))):
        if still in names:
            drive[:, 3] = 700 if drive is winter else -3
    job, place = map_drives(summer, winter, same_route=True)
    assert job["state"] == "succeeded", job["error"]
    assert job["result"]["metrics"]["second_season"]["accepted"] is True
    expected = f"1 of {DIM} numbers of an encoding stand still in traverse {still} alone"
    assert sum(expected in warning for warning in job["result"]["metrics"]["warnings"]) == (still != "both")
    for value in (-3, 0, 700):
        live[:, 3] = value
        assert [place(live[frame]) for frame in (30, 80)] == [30, 80]


def test_fewer_frames_than_a_list_takes_are_refused_at_once(client):
    client.make_domain("few")
    for n_frames in (3, 1):
        client.upload("few", f"drive-{n_frames}", season(1, n_frames), np.arange(float(n_frames)))
        answer = client.post("/v1/admin/domains/few/remaps", json={"training_traverse": f"drive-{n_frames}"})
        assert "list_length 4" in problem(answer, 422, "invalid_map_config")["detail"]


def test_a_short_drive_is_mapped_by_landmarks_of_a_longer_one(map_drives):
    job, place = map_drives(season(1)[:3], season(2), n_landmarks=100)
    assert job["state"] == "succeeded", job["error"]
    assert place(season(3)[1]) == 1


@pytest.mark.parametrize("plane", [False, True])
def test_a_drive_the_other_way_teaches_no_second_season(map_drives, plane):
    planes = (AT_M, AT_M[::-1].copy()) if plane else (None, None)
    job, place = map_drives(season(1), season(2)[::-1], planes, same_route=None if plane else True)
    verdict = job["result"]["metrics"]["second_season"]
    says = "share 0 places" if plane else "agree no better than where one is shifted"
    assert (verdict["accepted"], says in verdict["why"]) == (False, True)
    assert job["result"]["metrics"]["warnings"] == [f"it learnt nothing of a second season: {verdict['why']}"]
    assert place(season(3)[30]) == 30


def test_a_drive_of_another_extractor_is_named_or_teaches_nothing(map_drives, client):
    other = np.random.default_rng(9).normal(size=(PLACES, DIM)).astype(np.float32)
    job, _ = map_drives(season(1), other, same_route=True)
    verdict = job["result"]["metrics"]["second_season"]
    assert (verdict["accepted"], "agree no better" in verdict["why"]) == (False, True)
    client.upload(job["domain"], "short", other[:, :5], AT_M)
    job = client.remap(job["domain"], training_traverse="summer", landmark_traverse="short")
    assert (job["state"], job["error"]["code"]) == ("failed", "invalid_encoding")
    assert "encodings of 5 numbers" in job["error"]["detail"]


@pytest.mark.parametrize("covered", ["summer", "winter"])
@pytest.mark.parametrize("relevance", ["composed", "rrf"])
def test_a_drive_that_shows_one_picture_alone_is_named(map_drives, covered, relevance):
    drives = {"summer": season(1), "winter": season(2)}
    drives[covered][:] = drives[covered][0]
    job, _ = map_drives(**drives, relevance=relevance)
    assert (job["state"], job["error"]["code"]) == ("failed", "invalid_encoding")
    assert f"all {PLACES} frames of traverse {covered} have one and the same encoding" in job["error"]["detail"]


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_encodings_of_any_size_are_compared(map_drives, scale):
    job, place = map_drives(season(1) * np.float32(scale))
    assert job["state"] == "succeeded", job["error"]
    assert place(season(3)[30] * np.float32(scale)) == 30
