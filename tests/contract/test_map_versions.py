"""The life of map versions over HTTP: checked, gated, appended to, downloaded, removed."""

import base64
import hashlib
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.jobs.runner import InThisProcess

from .conftest import DIM, N_READY, NPZ, make_ready_domain, npz, ready_encodings, remap, small_settings

RANKS = {"ranked_landmarks": [3, 1, 2]}
FILE = "application/vnd.sqlite3"
SAME = {"same_route": True}


def upload(client: TestClient, domain: str, name: str, encodings: Any, position_m: Any) -> None:
    base = f"/v1/admin/domains/{domain}/traverses"
    assert client.post(base, json={"name": name}).status_code == 201
    batch = npz(encodings=encodings, index=np.arange(len(encodings)), position_m=position_m)
    assert client.post(f"{base}/{name}/frames", content=batch, headers=NPZ).status_code == 200


def versions(client: TestClient, domain: str) -> dict[int, dict[str, Any]]:
    return {one["version"]: one for one in client.get(f"/v1/admin/domains/{domain}/maps").json()["maps"]}


def refused(answer: Any, status: int, code: str) -> dict[str, Any]:
    assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json"), answer.text
    problem: dict[str, Any] = answer.json()
    assert problem["code"] == code
    return problem


@pytest.fixture
def domain(client: TestClient, request: pytest.FixtureRequest) -> str:
    """A mapped domain of the test's own."""
    name = request.node.name.partition("[")[0].replace("_", "-")[:60]
    make_ready_domain(client, name)
    return name


def test_the_history_tells_when_and_how_good(client: TestClient, domain: str) -> None:
    first = versions(client, domain)[1]
    assert (first["retired_at"], first["removed_at"]) == (None, None)
    assert first["activated_at"].startswith("20")
    assert first["metrics"]["check"]["frames"] == "held_out"
    assert first["metrics"]["check"]["anr_active"] is None
    upload(client, domain, "dense", ready_encodings(), np.arange(N_READY))
    job = remap(client, domain, training_traverse="dense", relevance="rrf")
    check = job["result"]["metrics"]["check"]
    assert set(check) == {
        *("frames", "traverse", "n_queries", "n_left_out", "tolerance_m", "anr", "anr_active"),
        *("active_version", "gate_margin", "passed", "why"),
    }
    assert (check["n_queries"], check["tolerance_m"], check["active_version"]) == (4, 2, 1)
    assert check["anr"] is not None
    assert check["anr_active"] is not None
    history = versions(client, domain)
    assert history[2]["metrics"]["check"] == check
    assert history[1]["retired_at"] is not None
    assert history[1]["state"] == "retired"


def test_a_worse_map_is_sealed_but_not_activated_and_says_why(client: TestClient, domain: str) -> None:
    noise = np.random.default_rng(1).normal(size=(N_READY, DIM))
    upload(client, domain, "noise", noise, 2.0 * np.arange(N_READY))
    upload(client, domain, "day", ready_encodings() + 0.01, 2.0 * np.arange(N_READY))
    asked = {"training_traverse": "noise", "check_traverse": "day", "gate_margin": 1}
    job = remap(client, domain, **asked)
    assert job["state"] == "succeeded"
    assert job["result"]["active"] is False
    check = job["result"]["metrics"]["check"]
    assert check["passed"] is False
    assert "more than 1 above" in check["why"]
    assert versions(client, domain)[2]["state"] == "sealed"
    assert client.get(f"/v1/domains/{domain}").json()["map_version"] == 1
    assert job["config"]["gate_margin"] == 1
    assert remap(client, domain, **asked | {"gate_margin": None})["result"]["active"] is True


def test_frames_are_appended_to_the_map_that_serves(client: TestClient, domain: str) -> None:
    upload(client, domain, "further", np.random.default_rng(2).normal(size=(10, DIM)), 80.0 + np.arange(10))
    assert client.delete(f"/v1/admin/domains/{domain}/traverses/drive").status_code == 204
    job = remap(client, domain, training_traverse="further", append=True)
    assert job["state"] == "succeeded", job
    known = client.get(f"/v1/domains/{domain}").json()
    assert (known["map_version"], known["n_map_images"], known["route_length_m"]) == (2, N_READY + 10, 89.0)
    encoding = np.random.default_rng(2).normal(size=(10, DIM))[4]
    found = client.post(f"/v1/domains/{domain}/localizations", json={"encoding": encoding.tolist()}).json()
    assert found["retrieval"][0]["route_position_m"] == 84.0
    assert versions(client, domain)[2]["config"]["appended"][0]["traverse"] == "further"


def test_what_the_map_holds_is_refused_before_it_is_appended_again(client: TestClient, domain: str) -> None:
    """With its old images left in the copy the frames would find themselves, and any gate would open."""
    asked = {"training_traverse": "drive", "append": True, "gate_margin": 2}
    problem = refused(client.post(f"/v1/admin/domains/{domain}/remaps", json=asked), 422, "invalid_map_config")
    assert "map 1, which serves, holds traverse drive already" in problem["detail"]
    upload(client, domain, "again", ready_encodings(), np.arange(N_READY))
    job = remap(client, domain, **asked | {"training_traverse": "again"})
    assert (job["state"], job["error"]["code"]) == ("failed", "invalid_map_config")
    assert "holds every frame of traverse again already, under another name" in job["error"]["detail"]
    assert list(versions(client, domain)) == [1]


@pytest.mark.parametrize(
    ("wrong", "status", "code"),
    [
        ({"gate_margin": -1}, 422, "invalid_request"),
        ({"gate_margin": "1"}, 422, "invalid_request"),
        ({"append": 1}, 422, "invalid_request"),
        ({"check_traverse": "../drive"}, 422, "invalid_request"),
        ({"check_traverse": "nowhere"}, 404, "unknown_traverse"),
        ({"check_traverse": "drive"}, 422, "invalid_map_config"),
        ({"append": True, "landmark_traverse": "drive"}, 422, "invalid_map_config"),
    ],
)
def test_options_that_cannot_be_are_refused_at_once(
    client: TestClient, wrong: dict[str, Any], status: int, code: str
) -> None:
    answer = client.post("/v1/admin/domains/ready/remaps", json={"training_traverse": "drive", **wrong})
    refused(answer, status, code)


def test_an_unmapped_domain_has_nothing_to_append_to(client: TestClient) -> None:
    client.put("/v1/admin/domains/empty-append", json={"evaluator": {"kind": "feature_l2", "extractor": "none"}})
    upload(client, "empty-append", "drive", ready_encodings(), np.arange(N_READY))
    asked = {"training_traverse": "drive", "append": True}
    answer = client.post("/v1/admin/domains/empty-append/remaps", json=asked)
    refused(answer, 409, "no_active_map")
    assert "make one first, without append" in answer.json()["detail"]


def test_a_check_traverse_is_not_deleted_under_its_job(client: TestClient, domain: str) -> None:
    upload(client, domain, "day", ready_encodings(), np.arange(N_READY))
    app: Any = client.app
    catalog = app.state.services.catalog
    job = catalog.create_job(domain, "remap", {"training_traverse": "drive", "check_traverse": "day"})
    refused(client.delete(f"/v1/admin/domains/{domain}/traverses/day"), 409, "traverse_in_use")
    catalog.update_job(job.job_id, state="cancelled")
    assert client.delete(f"/v1/admin/domains/{domain}/traverses/day").status_code == 204


# The file


def place_of(domain: str, version: int = 1) -> str:
    return f"/v1/admin/domains/{domain}/maps/{version}/file"


def test_a_sealed_map_is_one_file_with_its_digest(client: TestClient, data_dir: Path) -> None:
    answer = client.get(place_of("ready"))
    record = versions(client, "ready")[1]
    body = answer.content
    assert (answer.status_code, answer.headers["content-type"]) == (200, FILE)
    assert body == (data_dir / "domains" / "ready" / "maps" / "000001.sqlite").read_bytes()
    assert len(body) == record["file_bytes"] == int(answer.headers["content-length"])
    assert hashlib.sha256(body).hexdigest() == record["sha256"]
    assert answer.headers["etag"] == f'"sha256:{record["sha256"]}"'
    digest = base64.b64encode(hashlib.sha256(body).digest()).decode()
    assert answer.headers["repr-digest"] == f"sha-256=:{digest}:"
    assert answer.headers["content-disposition"] == 'attachment; filename="ready-000001.sqlite"'
    assert answer.headers["accept-ranges"] == "bytes"


@pytest.mark.parametrize(
    ("asked", "start", "stop"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=100-199", 100, 200),
        ("bytes=4096-", 4096, None),
        ("bytes=-10", -10, None),
        ("bytes=0-99999999999", 0, None),
        ("bytes=-99999999999", 0, None),
    ],
)
def test_part_of_it_can_be_asked_for(client: TestClient, asked: str, start: int, stop: int | None) -> None:
    whole = client.get(place_of("ready"))
    part = client.get(place_of("ready"), headers={"Range": asked})
    assert part.status_code == 206
    assert part.content == whole.content[start:stop]
    assert int(part.headers["content-length"]) == len(part.content)
    n_bytes = len(whole.content)
    first = start % n_bytes
    assert part.headers["content-range"] == f"bytes {first}-{first + len(part.content) - 1}/{n_bytes}"
    for name in ("etag", "repr-digest"):
        assert part.headers[name] == whole.headers[name]


@pytest.mark.parametrize("asked", ["bytes=0-1,5-9", "lines=0-3", "bytes=-", "bytes=9-3", "bytes", "bytes=a-b"])
def test_what_is_no_single_range_is_answered_whole(client: TestClient, asked: str) -> None:
    whole = client.get(place_of("ready"))
    answer = client.get(place_of("ready"), headers={"Range": asked})
    assert (answer.status_code, answer.content) == (200, whole.content)


def test_a_range_behind_the_end(client: TestClient) -> None:
    n_bytes = len(client.get(place_of("ready")).content)
    for asked in (f"bytes={n_bytes}-", "bytes=-0"):
        answer = client.get(place_of("ready"), headers={"Range": asked})
        refused(answer, 416, "range_not_satisfiable")
        assert answer.headers["content-range"] == f"bytes */{n_bytes}"


def test_a_download_goes_on_only_with_the_same_bytes(client: TestClient) -> None:
    whole = client.get(place_of("ready"))
    etag = whole.headers["etag"]
    same = client.get(place_of("ready"), headers={"Range": "bytes=9-", "If-Range": etag})
    assert (same.status_code, same.content) == (206, whole.content[9:])
    other = client.get(place_of("ready"), headers={"Range": "bytes=9-", "If-Range": '"sha256:0"'})
    assert (other.status_code, other.content) == (200, whole.content)
    known = client.get(place_of("ready"), headers={"If-None-Match": f'"else", {etag}'})
    assert (known.status_code, known.content, known.headers["etag"]) == (304, b"", etag)
    assert client.get(place_of("ready"), headers={"If-None-Match": '"else"'}).status_code == 200


def test_a_damaged_file_is_not_sent(client: TestClient, domain: str, data_dir: Path) -> None:
    path = data_dir / "domains" / domain / "maps" / "000001.sqlite"
    path.chmod(0o644)
    body = bytearray(path.read_bytes())
    body[len(body) // 2] ^= 1
    path.write_bytes(body)
    problem = refused(client.get(place_of(domain)), 503, "damaged_map")
    assert problem["map_version"] == 1
    assert str(data_dir) not in str(problem)
    path.unlink()
    refused(client.get(place_of(domain)), 503, "damaged_map")


def test_files_that_are_not_there(client: TestClient) -> None:
    refused(client.get(place_of("ready", 9)), 404, "unknown_map_version")
    refused(client.get(place_of("nowhere")), 404, "unknown_domain")
    refused(client.get(place_of("ready", 0)), 422, "invalid_request")
    refused(client.get("/v1/admin/domains/ready/maps/one/file"), 422, "invalid_request")
    app: Any = client.app
    catalog = app.state.services.catalog
    version = catalog.begin_map("unmapped", {})
    try:
        problem = refused(client.get(place_of("unmapped", version)), 404, "unknown_map_version")
        assert "still being built" in problem["detail"]
        refused(client.delete(f"/v1/admin/domains/unmapped/maps/{version}"), 409, "map_in_use")
    finally:
        catalog.discard_map("unmapped", version)


# Removal


def test_an_old_version_is_removed_by_hand(client: TestClient, domain: str, data_dir: Path) -> None:
    place = f"/v1/admin/domains/{domain}"
    begun = client.post(f"/v1/domains/{domain}/sessions", json={}).json()
    session = f"/v1/sessions/{begun['session_id']}"
    remap(client, domain, training_traverse="drive", relevance="rrf")
    refused(client.delete(f"{place}/maps/2"), 409, "map_in_use")  # it serves
    problem = refused(client.delete(f"{place}/maps/1"), 409, "map_in_use")
    assert "a session lives on map 1" in problem["detail"]
    assert client.post(f"{session}/observations", json=RANKS).json()["map_version"] == 1
    assert client.delete(session).status_code == 204
    gone = client.delete(f"{place}/maps/1")
    assert (gone.status_code, gone.content) == (204, b"")
    assert not (data_dir / "domains" / domain / "maps" / "000001.sqlite").exists()
    row = versions(client, domain)[1]
    assert (row["state"], row["removed_at"] is not None, row["file_bytes"] > 0) == ("retired", True, True)
    assert refused(client.put(f"{place}/active-map", json={"version": 1}), 410, "retired_map")["map_version"] == 1
    refused(client.get(place_of(domain)), 410, "retired_map")
    refused(client.delete(f"{place}/maps/1"), 410, "retired_map")
    refused(client.delete(f"{place}/maps/7"), 404, "unknown_map_version")
    refused(client.delete(f"{place}/maps/x"), 422, "invalid_request")
    refused(client.delete("/v1/admin/domains/nowhere/maps/1"), 404, "unknown_domain")
    assert client.get(f"/v1/domains/{domain}").json()["map_version"] == 2


def test_versions_beyond_those_kept_lose_their_files(tmp_path: Path) -> None:
    settings = small_settings(tmp_path, keep_maps=1, session_sweep_s=0.05)

    def files() -> list[int]:
        return sorted(int(path.stem) for path in (tmp_path / "domains" / "route" / "maps").glob("*.sqlite"))

    with TestClient(create_app(settings, InThisProcess(tmp_path))) as client:
        make_ready_domain(client, "route")
        begun = client.post("/v1/domains/route/sessions", json={}).json()["session_id"]
        for _ in range(2):
            remap(client, "route", training_traverse="drive", relevance="rrf")
        assert files() == [1, 2, 3]  # a robot lives on the first, the second is kept to roll back to
        assert client.put("/v1/admin/domains/route/active-map", json={"version": 2}).status_code == 200
        assert client.put("/v1/admin/domains/route/active-map", json={"version": 3}).status_code == 200
        remap(client, "route", training_traverse="drive", relevance="rrf")
        assert files() == [1, 3, 4]
        removed = versions(client, "route")[2]["removed_at"]
        assert removed is not None
    with TestClient(create_app(settings, InThisProcess(tmp_path))) as client:
        assert files() == [1, 3, 4]
        assert client.post(f"/v1/sessions/{begun}/observations", json=RANKS).json()["map_version"] == 1
        assert client.delete(f"/v1/sessions/{begun}").status_code == 204
        for _ in range(200):
            if files() == [3, 4]:
                break
            time.sleep(0.05)
        assert files() == [3, 4]
        assert versions(client, "route")[2]["removed_at"] == removed
        assert len(versions(client, "route")) == 4


def test_a_second_season_is_learnt_from_where_the_route_is_said_to_be_one(client: TestClient, domain: str) -> None:
    """The drive knows x, y of its own; the other one does not."""
    again = ready_encodings() + 0.1 * np.random.default_rng(1).normal(size=(N_READY, DIM)).astype(np.float32)
    upload(client, domain, "again", again, 2.0 * np.arange(N_READY))
    upload(client, domain, "noise", np.random.default_rng(2).normal(size=(N_READY, DIM)), 2.0 * np.arange(N_READY))
    asked = {"training_traverse": "drive", "landmark_traverse": "again", "training_episodes": 0}
    told = [remap(client, domain, **asked, **said)["result"]["metrics"]["second_season"] for said in ({}, SAME)]
    assert [season["accepted"] for season in told] == [False, True]
    assert "say same_route" in told[0]["why"]
    assert (told[1]["why"], told[1]["n_pairs"]) == (None, N_READY)
    assert 0 <= told[1]["significance"] < 0.001 < told[1]["statistic"]
    noise = remap(client, domain, **asked | SAME | {"landmark_traverse": "noise"})
    season = noise["result"]["metrics"]["second_season"]
    assert (season["accepted"], noise["config"]["same_route"]) == (False, True)
    assert "agree no better" in season["why"]
    newest = max(versions(client, domain).items())[1]
    assert newest["metrics"]["second_season"] == season


@pytest.mark.parametrize("said", ["yes", 1, []])
def test_same_route_is_true_false_or_null(client: TestClient, said: Any) -> None:
    body = {"training_traverse": "drive", "same_route": said}
    refused(client.post("/v1/admin/domains/ready/remaps", json=body), 422, "invalid_request")
