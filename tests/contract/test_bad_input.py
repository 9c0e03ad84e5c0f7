"""Every bad input gets a problem document that tells what to do, and the service goes on."""

import io
import json
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY

from .conftest import DIM, N_LANDMARKS, N_READY, NPZ, encoded, make_ready_domain, npz, picture, remap, wait_for

READY = "/v1/domains/ready/localizations"
SEEN = "/v1/domains/seen/localizations"
FRAMES = "/v1/admin/domains/ready/traverses/drive/frames"
JPEG = {"Content-Type": "image/jpeg"}
JSON = {"Content-Type": "application/json"}


def check(answer: Any, status: int, code: str) -> dict[str, Any]:
    """The problem document of an answer, after checking what all of them have."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = answer.json()
    assert {"type", "title", "status", "detail", "instance", "code", "request_id"} <= set(problem)
    assert problem["status"] == status
    assert problem["code"] == code
    assert problem["type"] == f"urn:deepsimbad:problem:{code}"
    assert problem["request_id"] == answer.headers["x-request-id"]
    assert "Traceback" not in answer.text
    return problem


@pytest.fixture(autouse=True)
def _goes_on(client: TestClient) -> Any:
    yield
    assert client.post(READY, json={"ranked_landmarks": [0, 1]}).status_code == 200


def claimed_png(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", len(header)) + chunk + struct.pack(">I", zlib.crc32(chunk))


# Images


def test_not_an_image(client: TestClient) -> None:
    check(client.post(SEEN, content=b"hello, robot", headers=JPEG), 422, "undecodable_image")


def test_truncated_jpeg(client: TestClient) -> None:
    body = encoded(picture(1))
    check(client.post(SEEN, content=body[: len(body) // 2], headers=JPEG), 422, "truncated_image")


def test_a_png_header_that_claims_too_much(client: TestClient) -> None:
    problem = check(
        client.post(SEEN, content=claimed_png(60_000, 60_000), headers={"Content-Type": "image/png"}),
        413,
        "image_too_large",
    )
    assert problem["max_pixels"] == 300_000


@pytest.mark.parametrize("headers", [JPEG, JSON])
def test_empty_body(client: TestClient, headers: dict[str, str]) -> None:
    check(client.post(SEEN, content=b"", headers=headers), 422, "empty_body")


def test_too_many_bytes(client: TestClient) -> None:
    problem = check(client.post(SEEN, content=bytes(200_001), headers=JPEG), 413, "body_too_large")
    assert problem["max_bytes"] == 200_000


def test_too_many_bytes_in_chunks(client: TestClient) -> None:
    chunks = (bytes(1000) for _ in range(10_000))
    check(client.post(SEEN, content=chunks, headers=JPEG), 413, "body_too_large")


@pytest.mark.parametrize("content_type", ["text/plain", "application/xml", "image/bmp", "x", "multipart/form-data"])
def test_wrong_content_type(client: TestClient, content_type: str) -> None:
    problem = check(
        client.post(SEEN, content=b"x", headers={"Content-Type": content_type}), 415, "unsupported_media_type"
    )
    images = ["image/jpeg", "image/png", "image/tiff", "image/webp"]
    assert problem["allowed"] == [*images, "application/json", "application/vnd.deepsimbad.ranks"]


def test_missing_content_type(client: TestClient) -> None:
    problem = check(client.post(SEEN, content=b"x"), 415, "unsupported_media_type")
    assert "image/jpeg" in problem["allowed"]


def test_an_image_where_only_encodings_are_taken(client: TestClient) -> None:
    problem = check(client.post(READY, content=encoded(picture(1)), headers=JPEG), 415, "unsupported_media_type")
    assert problem["allowed"] == ["application/json"]


# JSON observations


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
        ('{"ranked_landmarks": 3}', "invalid_request"),
        ('{"ranked_landmarks": null}', "invalid_request"),
        ('{"ranked_landmarks": [0], "dissimilarities": [1]}', "invalid_request"),
        ('{"ranked": [0]}', "invalid_request"),
        ('{"\\ud800": [0]}', "invalid_request"),
        ('{"ranked_landmarks": ["\\udfff"]}', "invalid_request"),
        ("{}", "invalid_request"),
        ("[]", "invalid_request"),
        ("null", "invalid_request"),
        ("3", "invalid_request"),
        ("{", "invalid_request"),
        ("not json", "invalid_request"),
        ("[" * 20_000, "invalid_request"),
        ('{"ranked_landmarks":' * 2_000, "invalid_request"),
        (b"\xff\xfe{}", "invalid_request"),
        (b"\x00", "invalid_request"),
    ],
)
def test_bad_json(client: TestClient, body: str | bytes, code: str) -> None:
    problem = check(client.post(READY, content=body, headers=JSON), 422, code)
    if code == "invalid_request":
        assert problem["errors"][0]["loc"][0] == "body"


def test_a_map_that_compares_what_was_not_sent(client: TestClient) -> None:
    make_ready_domain(client, "brute")
    job = remap(client, "brute", training_traverse="drive", relevance="brute_force")
    assert job["state"] == "succeeded"
    check(client.post("/v1/domains/brute/localizations", json={"ranked_landmarks": [0]}), 422, "invalid_input")


@pytest.mark.parametrize("shortlist", ["0", "-1", "nan", "1.5", "", "x", str(10**30), str(N_READY + 1)])
def test_shortlist_out_of_range(client: TestClient, shortlist: str) -> None:
    answer = client.post(READY, params={"shortlist": shortlist}, json={"ranked_landmarks": [0]})
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"


# Names and states


def test_unknown_domain(client: TestClient) -> None:
    check(client.post("/v1/domains/nowhere/localizations", json={"ranked_landmarks": [0]}), 404, "unknown_domain")
    check(client.get("/v1/domains/nowhere"), 404, "unknown_domain")
    check(client.delete("/v1/admin/domains/nowhere"), 404, "unknown_domain")
    check(client.get("/v1/admin/domains/nowhere/traverses"), 404, "unknown_domain")
    check(client.get("/v1/admin/domains/nowhere/traverses/t"), 404, "unknown_domain")
    check(client.delete("/v1/admin/domains/nowhere/traverses/t"), 404, "unknown_domain")
    check(client.get("/v1/admin/domains/nowhere/maps"), 404, "unknown_domain")
    check(client.post("/v1/admin/domains/nowhere/traverses", json={"name": "t"}), 404, "unknown_domain")
    check(client.post("/v1/admin/domains/nowhere/remaps", json={"training_traverse": "t"}), 404, "unknown_domain")
    check(client.put("/v1/admin/domains/nowhere/active-map", json={"version": 1}), 404, "unknown_domain")
    check(client.get("/v1/admin/jobs?domain=nowhere"), 404, "unknown_domain")


@pytest.mark.parametrize(
    "name", ["%2e%2e", ".hidden", "a b", "a'--", "é", "x" * 65, "%00", "%F0%9F%A4%96", "-a", "a%0a"]
)
def test_names_that_are_none(client: TestClient, name: str) -> None:
    check(client.get(f"/v1/domains/{name}"), 422, "invalid_request")
    check(client.put(f"/v1/admin/domains/{name}", json={"evaluator": {"kind": "feature_l2"}}), 422, "invalid_request")


def test_a_path_trick_reaches_nothing(client: TestClient) -> None:
    check(client.get("/v1/domains/..%2f..%2fcatalog.sqlite"), 404, "not_found")


def test_unknown_routes_and_methods(client: TestClient) -> None:
    check(client.get("/v2/domains"), 404, "not_found")
    check(client.get("/v1/domains/"), 404, "not_found")
    check(client.get("/v1/domains/%F0%9F%A4%96/%ff?%ff=%00"), 404, "not_found")
    answer = client.post("/v1/domains")
    check(answer, 405, "method_not_allowed")
    assert answer.headers["allow"] == "GET"
    check(client.request("BREW", "/healthz"), 405, "method_not_allowed")


def test_a_domain_without_a_map(client: TestClient) -> None:
    problem = check(
        client.post("/v1/domains/unmapped/localizations", json={"ranked_landmarks": [0]}), 409, "no_active_map"
    )
    assert "remap" in problem["detail"]


def test_a_damaged_map(client: TestClient, data_dir: Path) -> None:
    make_ready_domain(client, "broken")
    place = "/v1/domains/broken/localizations"
    assert client.post(place, json={"ranked_landmarks": [0]}).status_code == 200
    remap(client, "broken", training_traverse="drive", activate=False)
    sealed = data_dir / "domains" / "broken" / "maps" / "000002.sqlite"
    content = bytearray(sealed.read_bytes())
    content[len(content) // 2] ^= 1
    sealed.chmod(0o644)
    sealed.write_bytes(content)
    # A damaged version never takes over ...
    swap = client.put("/v1/admin/domains/broken/active-map", json={"version": 2, "expected": 1})
    check(swap, 503, "damaged_map")
    assert client.get("/v1/domains/broken").json()["map_version"] == 1
    # ... and one damaged while it was active is named, not half answered.
    sealed.write_bytes(content[: len(content) // 3])
    _activate_behind_the_services_back(data_dir, "broken", 2)
    _forget(client, "broken")
    for _ in range(2):
        answer = client.post(place, json={"ranked_landmarks": [0]})
        problem = check(answer, 503, "damaged_map")
        assert int(answer.headers["retry-after"]) > 0
        assert str(data_dir) not in answer.text
        assert problem["map_version"] == 2
    told = client.get("/v1/domains/broken").json()
    assert (told["map_version"], told["map_problem"], told["n_map_images"]) == (2, "damaged_map", None)
    assert client.put("/v1/admin/domains/broken/active-map", json={"version": 1, "expected": 2}).status_code == 200
    assert client.post(place, json={"ranked_landmarks": [0]}).status_code == 200


def _activate_behind_the_services_back(data_dir: Path, domain: str, version: int) -> None:
    with Catalog.open(data_dir) as catalog:
        catalog.activate(domain, version, ANY)


def _forget(client: TestClient, domain: str) -> None:
    app: Any = client.app
    app.state.services.maps.forget(domain)


# Domains and traverses


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"evaluator": {}},
        {"evaluator": {"kind": "siamese"}},
        {"evaluator": {"kind": "feature_l2", "extractor": "magic"}},
        {"evaluator": {"kind": "feature_l2", "colour": "red"}},
        {"evaluator": {"kind": ["feature_l2"]}},
        {"evaluator": {"kind": "feature_l2"}, "closed": "perhaps"},
        {"evaluator": {"kind": "feature_l2"}, "actions_m": []},
        {"evaluator": {"kind": "feature_l2"}, "actions_m": [0]},
        {"evaluator": {"kind": "feature_l2"}, "actions_m": [2, 1]},
        {"evaluator": {"kind": "feature_l2"}, "actions_m": [1, 1]},
        {"evaluator": {"kind": "feature_l2"}, "actions_m": list(range(1, 100))},
        {"evaluator": {"kind": "feature_l2"}, "color": 1},
    ],
)
def test_bad_domains(client: TestClient, body: dict[str, Any]) -> None:
    answer = client.put("/v1/admin/domains/bad", json=body)
    assert answer.status_code == 422, answer.text
    assert client.get("/v1/domains/bad").status_code == 404


@pytest.mark.parametrize("action", ["NaN", "1e999", "-1", "1e9", "null", "true", '"1"'])
def test_bad_actions(client: TestClient, action: str) -> None:
    body = '{"evaluator": {"kind": "feature_l2"}, "actions_m": [' + action + "]}"
    check(client.put("/v1/admin/domains/bad", content=body, headers=JSON), 422, "invalid_request")


def test_deep_json_where_any_is_taken(client: TestClient) -> None:
    body = '{"evaluator": {"kind": "feature_l2", "x": %s}}' % ("[" * 9000 + "]" * 9000)
    check(client.put("/v1/admin/domains/bad", content=body, headers=JSON), 422, "invalid_request")
    surrogate = '{"evaluator": {"kind": "feature_l2", "\\ud800": 1}}'
    check(client.put("/v1/admin/domains/bad", content=surrogate, headers=JSON), 422, "invalid_request")


def test_a_domain_that_differs(client: TestClient) -> None:
    body = {"evaluator": {"kind": "feature_l2"}, "closed": True}
    check(client.put("/v1/admin/domains/ready", json=body), 409, "domain_differs")


@pytest.mark.parametrize("body", [{}, {"name": ""}, {"name": "../x"}, {"name": 3}, {"name": "a\n"}, {"nom": "t"}])
def test_bad_traverse_names(client: TestClient, body: dict[str, Any]) -> None:
    check(client.post("/v1/admin/domains/ready/traverses", json=body), 422, "invalid_request")


def test_unknown_traverse(client: TestClient) -> None:
    base = "/v1/admin/domains/ready/traverses/none"
    check(client.get(base), 404, "unknown_traverse")
    check(client.delete(base), 404, "unknown_traverse")
    check(client.put(f"{base}/frames/0?position_m=1", json={"encoding": [1]}), 404, "unknown_traverse")
    check(client.post(f"{base}/frames", content=b"x", headers=NPZ), 404, "unknown_traverse")
    body = {"training_traverse": "none"}
    check(client.post("/v1/admin/domains/ready/remaps", json=body), 404, "unknown_traverse")


# Frames


@pytest.mark.parametrize(
    "query",
    [
        "",
        "position_m=nan",
        "position_m=inf",
        "position_m=-Infinity",
        "position_m=1e999",
        "position_m=x",
        "position_m=1e200",
        "position_m=1&x_m=-1e200",
        "position_m=1&y_m=1.1e9",
        "position_m=1&x_m=nan",
        "position_m=1&y_m=inf",
        "position_m=1&timestamp_us=-1",
        "position_m=1&timestamp_us=1.5",
        f"position_m=1&timestamp_us={10**30}",
    ],
)
def test_bad_frame_queries(client: TestClient, query: str) -> None:
    check(client.put(f"{FRAMES}/0?{query}", json={"encoding": [1.0] * DIM}), 422, "invalid_request")


@pytest.mark.parametrize("index", ["-1", "1.5", "x", str(10**30), "%00"])
def test_bad_frame_indices(client: TestClient, index: str) -> None:
    check(client.put(f"{FRAMES}/{index}?position_m=1", json={"encoding": [1.0] * DIM}), 422, "invalid_request")


def test_bad_frame_bodies(client: TestClient) -> None:
    place = f"{FRAMES}/0?position_m=1"
    check(client.put(place, json={"encoding": [1.0]}), 422, "invalid_encoding")
    check(client.put(place, json={"ranked_landmarks": [1]}), 422, "invalid_request")
    check(client.put(place, content=b'{"encoding": [NaN]}', headers=JSON), 422, "invalid_encoding")
    check(client.put(place, content=b"x", headers={"Content-Type": "text/plain"}), 415, "unsupported_media_type")
    check(client.put(place, content=b"", headers=JSON), 422, "empty_body")
    check(client.put(place, content=encoded(picture(1)), headers=JPEG), 415, "unsupported_media_type")
    seen = "/v1/admin/domains/seen/traverses/drive/frames/0?position_m=1"
    check(client.put(seen, content=b"x", headers=JPEG), 422, "undecodable_image")
    check(client.put(seen, json={"encoding": [1.0, 2.0]}), 422, "invalid_encoding")


GOOD = {
    "encodings": np.ones((2, DIM), np.float32),
    "index": np.array([0, 1]),
    "position_m": np.array([0.0, 1.0]),
}


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return packed.getvalue()


def npy(array: np.ndarray, **how: Any) -> bytes:
    packed = io.BytesIO()
    np.lib.format.write_array(packed, array, **how)
    return packed.getvalue()


def npy_header(shape: tuple[int, ...], dtype: str = "<f4") -> bytes:
    packed = io.BytesIO()
    np.lib.format.write_array_header_1_0(packed, {"descr": dtype, "fortran_order": False, "shape": shape})
    return packed.getvalue()


def with_array(name: str, content: bytes) -> bytes:
    members = {f"{key}.npy": npy(array) for key, array in GOOD.items()}
    return zipped({**members, f"{name}.npy": content})


@pytest.mark.parametrize(
    ("body", "code"),
    [
        (b"not a zip", "invalid_batch"),
        (npz(**GOOD)[:-30], "invalid_batch"),
        (npz(**GOOD)[30:], "invalid_batch"),
        (b"PK\x05\x06" + bytes(18), "invalid_batch"),
        (npz(encodings=GOOD["encodings"], index=GOOD["index"]), "invalid_batch"),
        (npz(**GOOD, colour=np.ones(2)), "invalid_batch"),
        (npz(**{**GOOD, "encodings": np.ones(2, np.float32)}), "invalid_batch"),
        (npz(**{**GOOD, "encodings": np.ones((2, DIM), complex)}), "invalid_batch"),
        (npz(**{**GOOD, "index": np.array([0.0, 1.0])}), "invalid_batch"),
        (npz(**{**GOOD, "index": np.array(["0", "1"])}), "invalid_batch"),
        (npz(**{**GOOD, "index": np.array([0, 0])}), "invalid_input"),
        (npz(**{**GOOD, "index": np.array([0, -1])}), "invalid_input"),
        (npz(**{**GOOD, "index": np.array([0, 2**64 - 1], np.uint64)}), "invalid_input"),
        (npz(**{**GOOD, "index": np.array([0])}), "invalid_input"),
        (npz(**{**GOOD, "position_m": np.array([0.0, np.nan])}), "invalid_route"),
        (npz(**{**GOOD, "position_m": np.array([0.0, np.inf])}), "invalid_route"),
        (npz(**{**GOOD, "position_m": np.array([-1.7e308, 1.7e308])}), "invalid_route"),
        (npz(**{**GOOD, "position_m": np.array([0.0, 1.1e9])}), "invalid_route"),
        (npz(**GOOD, x_m=np.array([0.0, np.inf])), "invalid_input"),
        (npz(**GOOD, x_m=np.array([0.0, 1e200])), "invalid_input"),
        (npz(**GOOD, y_m=np.array([np.nan, -1e200])), "invalid_input"),
        (npz(**GOOD, timestamp_us=np.array([0, -2])), "invalid_input"),
        (npz(**{**GOOD, "encodings": np.full((2, DIM), np.nan, np.float32)}), "invalid_encoding"),
        (npz(**{**GOOD, "encodings": np.full((2, DIM), 1e300)}), "invalid_encoding"),
        (npz(**{**GOOD, "encodings": np.ones((2, DIM + 1), np.float32)}), "invalid_encoding"),
        (npz(**{**GOOD, "encodings": np.ones((0, DIM), np.float32)}), "invalid_encoding"),
        (with_array("encodings", npy(np.array([["a", object()]], object), allow_pickle=True)), "invalid_batch"),
        (with_array("encodings", npy_header((10**9, 10**9))), "invalid_batch"),
        (with_array("encodings", npy_header((2, DIM)) + bytes(4 * DIM)), "invalid_batch"),
        (with_array("encodings", npy_header((2, DIM)) + bytes(8 * DIM + 1)), "invalid_batch"),
        (with_array("encodings", b"\x93NUMPY\x09\x00"), "invalid_batch"),
        (with_array("encodings", b""), "invalid_batch"),
        (zipped({f"{i}.npy": b"" for i in range(1000)}), "invalid_batch"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_bad_batches(client: TestClient, body: bytes, code: str) -> None:
    before = client.get("/v1/admin/domains/ready/traverses/drive").json()
    check(client.post(FRAMES, content=body, headers=NPZ), 422, code)
    assert client.get("/v1/admin/domains/ready/traverses/drive").json() == before


def test_a_batch_that_unpacks_to_too_much(client: TestClient) -> None:
    bomb = with_array("encodings", npy_header((62_500, DIM)) + bytes(4 * 62_500 * DIM))
    assert len(bomb) < 100_000
    problem = check(client.post(FRAMES, content=bomb, headers=NPZ), 413, "too_large")
    assert problem["max_bytes"] == 500_000


def test_a_batch_of_too_many_bytes(client: TestClient) -> None:
    check(client.post(FRAMES, content=bytes(500_001), headers=NPZ), 413, "body_too_large")
    check(client.post(FRAMES, content=(bytes(50_000) for _ in range(11)), headers=NPZ), 413, "body_too_large")
    check(client.post(FRAMES, content=b"", headers=NPZ), 422, "empty_body")
    check(client.post(FRAMES, content=npz(**GOOD), headers=JSON), 415, "unsupported_media_type")


# Remaps


@pytest.mark.parametrize(
    "config",
    [
        {"list_length": 0},
        {"n_landmarks": 0},
        {"n_landmarks": 65_536},
        {"n_landmarks": 10, "list_length": 11},
        {"relevance": "magic"},
        {"seed": -1},
        {"seed": 1.5},
        {"training_episodes": -1},
        {"activate": "yes"},
        {"landmark_traverse": "../drive"},
        {"unknown": 1},
    ],
)
def test_bad_remaps(client: TestClient, config: dict[str, Any]) -> None:
    answer = client.post("/v1/admin/domains/ready/remaps", json={"training_traverse": "drive", **config})
    assert answer.status_code == 422, answer.text
    assert answer.headers["content-type"] == "application/problem+json"


def test_fewer_candidates_than_landmarks(client: TestClient) -> None:
    job = remap(client, "ready", training_traverse="drive", landmark_traverse="drive", n_landmarks=N_READY + 1)
    assert job["state"] == "failed"
    assert job["error"]["code"] == "too_few_candidates"
    assert client.get("/v1/domains/ready").json()["map_version"] == 1


def test_more_listed_than_landmarks_kept(client: TestClient) -> None:
    job = remap(client, "ready", training_traverse="drive", list_length=N_LANDMARKS + 1)
    assert (job["state"], job["error"]["code"]) == ("failed", "invalid_map_config")


def test_a_first_remap_without_landmarks(client: TestClient) -> None:
    client.post("/v1/admin/domains/unmapped/traverses", json={"name": "drive"})
    answer = client.post("/v1/admin/domains/unmapped/remaps", json={"training_traverse": "drive"})
    check(answer, 409, "no_active_map")


def test_positions_that_go_backwards_fail_the_remap_alone(client: TestClient) -> None:
    client.post("/v1/admin/domains/ready/traverses", json={"name": "backwards"})
    batch = npz(**{**GOOD, "position_m": np.array([5.0, 4.0])})
    stored = client.post("/v1/admin/domains/ready/traverses/backwards/frames", content=batch, headers=NPZ)
    assert stored.status_code == 200
    job = remap(client, "ready", training_traverse="backwards")
    assert (job["state"], job["error"]["code"]) == ("failed", "invalid_route")
    assert "backwards" in job["error"]["detail"]


def test_an_empty_traverse_fails_the_remap(client: TestClient) -> None:
    client.post("/v1/admin/domains/ready/traverses", json={"name": "empty"})
    assert remap(client, "ready", training_traverse="empty")["state"] == "failed"


def test_our_own_rules_speak_for_themselves(client: TestClient) -> None:
    answer = client.post("/v1/domains/ready/localizations", json={})
    assert answer.json()["detail"] == "body: give exactly one of ranked_landmarks, dissimilarities, encoding"


def test_unknown_jobs_and_maps(client: TestClient) -> None:
    check(client.get("/v1/admin/jobs/none"), 404, "unknown_job")
    check(client.get("/v1/admin/jobs/none/events"), 404, "unknown_job")
    check(client.delete("/v1/admin/jobs/none"), 404, "unknown_job")
    check(client.get("/v1/admin/jobs/a b"), 422, "invalid_request")
    place = "/v1/admin/domains/ready/active-map"
    check(client.put(place, json={"version": 99, "expected": 1}), 404, "unknown_map_version")
    check(client.put(place, json={"version": 1, "expected": 99}), 409, "lost_activation")
    check(client.put(place, json={"version": 1, "expected": None}), 409, "lost_activation")
    check(client.put(place, json={"version": 0}), 422, "invalid_request")
    check(client.put(place, json={"version": "1"}), 422, "invalid_request")


def test_our_own_fault_tells_nothing_but_its_id(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    app: Any = client.app

    def broken(*_: Any) -> None:
        raise RuntimeError("a secret of the inside")

    monkeypatch.setattr(app.state.services.catalog, "newest_maps", broken)
    answer = client.get("/v1/admin/domains/ready/maps", headers={"X-Request-ID": "mine-1"})
    check(answer, 500, "internal_error")
    assert answer.headers["x-request-id"] == "mine-1"
    assert "secret" not in answer.text
    assert json.loads(answer.text)["request_id"] == "mine-1"


def test_a_cancelled_job_stays_cancelled(client: TestClient) -> None:
    job = client.post("/v1/admin/domains/ready/remaps", json={"training_traverse": "drive", "activate": False}).json()
    assert client.delete(f"/v1/admin/jobs/{job['job_id']}").status_code == 204
    ended = wait_for(client, job["job_id"])
    assert ended["state"] in {"cancelled", "succeeded"}
    assert client.delete(f"/v1/admin/jobs/{job['job_id']}").status_code == 204
    assert client.get(f"/v1/admin/jobs/{job['job_id']}").json() == ended
