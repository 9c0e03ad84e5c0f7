"""`/v1/.../sessions`: the answers' shapes and truths, and everything bad that may come."""

import asyncio
import io
import math
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from starlette.testclient import TestClient

from deepsimbad.api import requests
from deepsimbad.api.app import create_app
from deepsimbad.jobs.runner import InThisProcess

from .conftest import DIM, N_LANDMARKS, N_READY, encoded, make_ready_domain, picture, remap, small_settings

RANKS = {"ranked_landmarks": list(range(N_LANDMARKS))}
STATE = {"session_id", "domain", "map_version", "n_observations", "expires_at", "belief", "next_best_view"}
JPEG = {"Content-Type": "image/jpeg"}


def begin(client: TestClient, domain: str = "ready", **body: Any) -> dict[str, Any]:
    answer = client.post(f"/v1/domains/{domain}/sessions", json=body)
    assert answer.status_code == 201, answer.text
    found: dict[str, Any] = answer.json()
    assert answer.headers["location"] == f"/v1/sessions/{found['session_id']}"
    return found


def path_of(session: dict[str, Any]) -> str:
    return f"/v1/sessions/{session['session_id']}"


def refused(answer: httpx2.Response, status: int, code: str) -> dict[str, Any]:
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = answer.json()
    return problem


def test_long_answers_of_every_route_are_written_beside_the_loop(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    n_beside = 0
    run_sync = requests.run_sync

    async def counting(run: Callable[..., Any], *given: Any, limiter: Any = None) -> Any:
        nonlocal n_beside
        n_beside += limiter is client.app.state.services.long_work  # type: ignore[attr-defined]
        return await run_sync(run, *given, limiter=limiter)

    monkeypatch.setattr(requests, "run_sync", counting)
    monkeypatch.setattr(requests, "LONG_LIST", 20)
    path = path_of(begin(client))
    asked = [
        ("POST", "/v1/domains/ready/localizations", RANKS),
        ("POST", f"{path}/observations", RANKS),
        ("GET", path, None),
        ("GET", f"{path}/belief", None),
    ]
    for shortlist, n_expected in ((20, 0), (21, len(asked))):
        for method, url, body in asked:
            answer = client.request(method, url, params={"shortlist": shortlist}, json=body)
            assert answer.status_code == 200, answer.text
            belief = answer.json() if url.endswith("/belief") else answer.json()["belief"]
            assert len(belief["top"]) == shortlist
        assert n_beside == n_expected


def test_a_session_from_beginning_to_end(client: TestClient) -> None:
    session = begin(client)
    assert set(session) == STATE
    assert (session["domain"], session["map_version"], session["n_observations"]) == ("ready", 1, 0)
    left = datetime.fromisoformat(session["expires_at"]) - datetime.now(UTC)
    assert 3590 < left.total_seconds() <= 3600
    assert session["belief"]["entropy_bits"] == pytest.approx(math.log2(N_READY), abs=0.01)

    path = path_of(session)
    answer = client.post(f"{path}/observations", json=RANKS, params={"shortlist": 3})
    assert answer.status_code == 200, answer.text
    seen = answer.json()
    assert set(seen) == STATE | {"timings_ms", "retrieval"}
    assert {"predict", "update", "plan", "total"} <= set(seen["timings_ms"])
    assert seen["n_observations"] == 1
    assert len(seen["retrieval"]) == len(seen["belief"]["top"]) == 3
    relevance = [one["relevance"] for one in seen["retrieval"]]
    assert relevance == sorted(relevance, reverse=True)
    assert set(seen["next_best_view"]) == {"planner", "action_m", "actions"}

    moved = client.post(f"{path}/observations", json=RANKS, params={"action_m": 4, "action_std_m": 0.5}).json()
    assert moved["n_observations"] == 2
    state = client.get(path).json()
    assert set(state) == STATE
    assert state["belief"] == moved["belief"]
    assert state["next_best_view"] == moved["next_best_view"]
    assert client.get(f"{path}/belief").json() == moved["belief"]
    assert client.get(f"{path}/next-best-view").json() == moved["next_best_view"]
    packed = client.get(f"{path}/belief", headers={"Accept": "application/octet-stream"})
    assert packed.headers["content-type"] == "application/octet-stream"
    mass = np.load(io.BytesIO(packed.content))
    assert mass.dtype == np.float32
    assert mass.shape == (N_READY,)
    assert mass.sum() == pytest.approx(1)
    assert int(mass.argmax()) == moved["belief"]["top"][0]["map_image"]

    prior = client.put(f"{path}/prior", json={"position_m": 30, "std_m": 2.5})
    assert prior.status_code == 200
    assert set(prior.json()) == STATE
    assert prior.json()["belief"]["mode_m"] == 30
    assert prior.json()["n_observations"] == 2

    assert client.delete(path).status_code == 204
    for gone in (client.get(path), client.delete(path), client.post(f"{path}/observations", json=RANKS)):
        assert refused(gone, 410, "ended_session")["ending"] == "deleted"


def test_a_start_a_planner_and_a_filter_may_be_chosen(client: TestClient) -> None:
    body = {"start_position_m": 20, "start_std_m": 1, "seed": 4, "belief": "particle", "planner": "constant:7"}
    session = begin(client, **body, update="additive_relevance")
    assert session["belief"]["mean_m"] == pytest.approx(20, abs=0.5)
    assert (session["next_best_view"]["planner"], session["next_best_view"]["action_m"]) == ("constant:7", 7)
    again = begin(client, **body, update="additive_relevance")
    assert again["belief"] == session["belief"]
    nulls = begin(client, **dict.fromkeys(["start_position_m", "start_std_m", "seed", "belief", "planner", "update"]))
    assert nulls["belief"] == begin(client)["belief"]


def test_every_form_of_a_view(client: TestClient) -> None:
    ready, seen = begin(client), begin(client, "seen")
    numbers = {"dissimilarities": list(range(N_LANDMARKS))}, {"encoding": [0.5] * DIM}, RANKS
    for place, body in enumerate(numbers):
        answer = client.post(f"{path_of(ready)}/observations", json=body)
        assert answer.json()["n_observations"] == place + 1, answer.text
    answer = client.post(f"{path_of(seen)}/observations", content=encoded(picture(4)), headers=JPEG)
    assert answer.json()["belief"]["mode_m"] == 4


@pytest.mark.parametrize("shade", [0, 90, 255])
@pytest.mark.parametrize("belief", ["grid", "particle"])
def test_a_picture_of_nothing_says_nothing(client: TestClient, shade: int, belief: str) -> None:
    path = path_of(begin(client, "seen", belief=belief))
    before = client.post(f"{path}/observations", content=encoded(picture(4)), headers=JPEG).json()["belief"]
    blank = encoded(np.full((120, 160, 3), shade, np.uint8))
    answer = client.post(f"{path}/observations", content=blank, headers=JPEG)
    assert answer.status_code == 200, answer.text
    after = answer.json()["belief"]
    assert after["entropy_bits"] >= before["entropy_bits"] - 1e-9
    assert after["mode_m"] == before["mode_m"]


def test_an_idempotency_key_counts_once(client: TestClient) -> None:
    path = path_of(begin(client))
    key = {"Idempotency-Key": "view-1"}
    sent = [client.post(f"{path}/observations?action_m=1", json=RANKS, headers=key).json() for _ in range(3)]
    assert [one["n_observations"] for one in sent] == [1, 1, 1]
    assert sent[0]["belief"] == sent[1]["belief"] == sent[2]["belief"]
    other = client.post(f"{path}/observations?action_m=2", json=RANKS, headers=key)
    refused(other, 422, "idempotency_key_reused")
    assert client.post(f"{path}/observations", json=RANKS).json()["n_observations"] == 2
    assert client.post(f"{path}/observations?action_m=1", json=RANKS, headers=key).json()["belief"] == sent[0]["belief"]


@pytest.mark.parametrize("key", ["", "with space", "x" * 256, "\x7f"])
def test_a_key_that_cannot_be_one(client: TestClient, key: str) -> None:
    path = path_of(begin(client))
    refused(client.post(f"{path}/observations", json=RANKS, headers={"Idempotency-Key": key}), 422, "invalid_request")
    assert client.get(path).json()["n_observations"] == 0


@pytest.mark.parametrize(
    ("query", "code"),
    [
        ("action_m=nan", "invalid_move"),
        ("action_m=inf", "invalid_move"),
        ("action_m=-1", "invalid_move"),
        ("action_m=100.5", "invalid_move"),
        ("action_m=1e999", "invalid_move"),
        ("action_m=far", "invalid_request"),
        ("action_m=", "invalid_request"),
        ("action_std_m=nan", "invalid_move"),
        ("action_std_m=-0.1", "invalid_move"),
        ("shortlist=0", "invalid_request"),
        (f"shortlist={N_READY + 1}", "invalid_input"),
    ],
)
def test_bad_queries(client: TestClient, query: str, code: str) -> None:
    path = path_of(begin(client))
    for n_before in (0, 1):
        refused(client.post(f"{path}/observations?{query}", json=RANKS), 422, code)
        assert client.get(path).json()["n_observations"] == n_before
        client.post(f"{path}/observations", json=RANKS)


def test_wholly_past_the_end(client: TestClient) -> None:
    path = path_of(begin(client, start_position_m=78, start_std_m=0.5))
    client.post(f"{path}/observations", json=RANKS)
    problem = refused(client.post(f"{path}/observations?action_m=50", json=RANKS), 422, "past_the_end")
    assert problem["route_end_m"] == 78
    assert client.get(path).json()["n_observations"] == 1


@pytest.mark.parametrize(
    ("content", "content_type", "status", "code"),
    [
        (b"", "application/json", 422, "empty_body"),
        (b"", "image/jpeg", 422, "empty_body"),
        (b"{}", "application/json", 422, "invalid_request"),
        (b"[]", "application/json", 422, "invalid_request"),
        (b'{"ranked_landmarks": []}', "application/json", 422, "invalid_ranked_landmarks"),
        (b'{"ranked_landmarks": [0, 0]}', "application/json", 422, "invalid_ranked_landmarks"),
        (b'{"ranked_landmarks": [10]}', "application/json", 422, "invalid_ranked_landmarks"),
        (b'{"dissimilarities": [1, 2, NaN]}', "application/json", 422, "invalid_dissimilarities"),
        (b'{"encoding": [1]}', "application/json", 422, "invalid_encoding"),
        (b"no image", "image/jpeg", 422, "undecodable_image"),
        (b"x", "text/plain", 415, "unsupported_media_type"),
        (b"x" * 60_000, "application/json", 413, "body_too_large"),
    ],
)
def test_bad_bodies_move_nothing(client: TestClient, content: bytes, content_type: str, status: int, code: str) -> None:
    path = path_of(begin(client))
    answer = client.post(f"{path}/observations", content=content, headers={"Content-Type": content_type})
    refused(answer, status, code)
    assert client.get(path).json()["n_observations"] == 0


def test_a_truncated_image_moves_nothing(client: TestClient) -> None:
    path = path_of(begin(client, "seen"))
    whole = encoded(picture(2))
    refused(client.post(f"{path}/observations", content=whole[:-200], headers=JPEG), 422, "truncated_image")
    assert client.get(path).json()["n_observations"] == 0


@pytest.mark.parametrize(
    ("body", "code"),
    [
        (b"", "empty_body"),
        (b"nothing", "invalid_request"),
        (b'{"start_position_m": "here"}', "invalid_request"),
        (b'{"start_position_m": NaN}', "invalid_prior"),
        (b'{"start_position_m": 1e999}', "invalid_prior"),
        (b'{"start_position_m": 500}', "invalid_prior"),
        (b'{"start_position_m": 10, "start_std_m": 0}', "invalid_prior"),
        (b'{"start_std_m": 0}', "invalid_prior"),
        (b'{"seed": -1}', "invalid_request"),
        (b'{"seed": 1.5}', "invalid_request"),
        (b'{"belief": "guess"}', "invalid_request"),
        (b'{"update": "guess"}', "invalid_request"),
        (b'{"planner": ""}', "invalid_request"),
        (b'{"planner": "clever"}', "invalid_input"),
        (b'{"planner": "constant:3.5"}', "invalid_input"),
        (b'{"colour": 1}', "invalid_request"),
    ],
)
def test_bad_beginnings(client: TestClient, body: bytes, code: str) -> None:
    headers = {"Content-Type": "application/json"}
    refused(client.post("/v1/domains/ready/sessions", content=body, headers=headers), 422, code)


def test_where_no_session_can_begin(client: TestClient) -> None:
    refused(client.post("/v1/domains/nowhere/sessions", json={}), 404, "unknown_domain")
    refused(client.post("/v1/domains/unmapped/sessions", json={}), 409, "no_active_map")


@pytest.mark.parametrize(
    "body", [{"position_m": 1e6, "std_m": 1}, {"position_m": 1, "std_m": 0}, {"position_m": -40, "std_m": 5}]
)
def test_bad_priors(client: TestClient, body: dict[str, float]) -> None:
    path = path_of(begin(client))
    refused(client.put(f"{path}/prior", json=body), 422, "invalid_prior")
    refused(client.put(f"{path}/prior", json={"position_m": 3}), 422, "invalid_request")


def test_sessions_nobody_knows(client: TestClient) -> None:
    for session_id in ("0" * 32, "x"):
        path = f"/v1/sessions/{session_id}"
        for answer in (
            client.get(path),
            client.delete(path),
            client.get(f"{path}/belief"),
            client.get(f"{path}/next-best-view"),
            client.put(f"{path}/prior", json={"position_m": 1, "std_m": 1}),
            client.post(f"{path}/observations", json=RANKS),
        ):
            refused(answer, 404, "unknown_session")
    refused(client.get("/v1/sessions/%20"), 422, "invalid_request")


def test_limits_expiry_and_metrics(tmp_path: Path) -> None:
    settings = small_settings(tmp_path, max_sessions=2, session_ttl_s=0.6, session_sweep_s=0.05)
    with TestClient(create_app(settings, InThisProcess(tmp_path)), raise_server_exceptions=False) as client:
        make_ready_domain(client, "ready")
        first, _ = begin(client), begin(client)
        client.post(f"{path_of(first)}/observations", json=RANKS, headers={"Idempotency-Key": "k"})
        client.post(f"{path_of(first)}/observations", json=RANKS, headers={"Idempotency-Key": "k"})
        client.post(f"{path_of(first)}/observations?action_m=-1", json=RANKS)
        full = client.post("/v1/domains/ready/sessions", json={})
        assert refused(full, 429, "too_many_sessions")["max_sessions"] == 2
        assert int(full.headers["retry-after"]) >= 1
        text = client.get("/metrics").text
        assert "deepsimbad_sessions 2.0" in text
        for outcome in ("accepted", "repeated", "invalid_move"):
            assert f'deepsimbad_observations_total{{outcome="{outcome}"}} 1.0' in text
        assert "deepsimbad_session_commit_writes_count" in text
        for _ in range(100):
            if "deepsimbad_sessions 0.0" in client.get("/metrics").text:
                break
            asyncio.run(asyncio.sleep(0.05))
        assert refused(client.get(path_of(first)), 410, "ended_session")["ending"] == "expired"
        begin(client)


def test_a_restart_and_a_retired_map(tmp_path: Path) -> None:
    key = {"Idempotency-Key": "k"}
    with TestClient(create_app(small_settings(tmp_path), InThisProcess(tmp_path))) as first:
        make_ready_domain(first, "ready")
        path = path_of(begin(first))
        seen = first.post(f"{path}/observations", json=RANKS, headers=key).json()
        remap(first, "ready", training_traverse="drive", landmark_traverse="drive", n_landmarks=9)
        assert first.get("/v1/domains/ready").json()["map_version"] == 2
        assert first.post(f"{path}/observations", json=RANKS).json()["map_version"] == 1
    with TestClient(
        create_app(small_settings(tmp_path), InThisProcess(tmp_path)), raise_server_exceptions=False
    ) as second:
        again = second.post(f"{path}/observations", json=RANKS, headers=key).json()
        assert {**again, "timings_ms": {}, "expires_at": ""} == {**seen, "timings_ms": {}, "expires_at": ""}
        assert second.get(path).json()["n_observations"] == 2
    (tmp_path / "domains" / "ready" / "maps" / "000001.sqlite").unlink()
    with TestClient(
        create_app(small_settings(tmp_path), InThisProcess(tmp_path)), raise_server_exceptions=False
    ) as third:
        problem = refused(third.post(f"{path}/observations", json=RANKS), 410, "retired_map")
        assert "begin a new session" in problem["detail"]
        assert problem["map_version"] == 1
        assert third.delete(path).status_code == 204
        path = path_of(begin(third))
        assert third.delete("/v1/admin/domains/ready").status_code == 204
        refused(third.get(path), 410, "ended_session")


def test_two_at_once_over_http(client: TestClient) -> None:
    """Both answered, one after the other."""
    path = path_of(begin(client))
    transport = httpx2.ASGITransport(client.app)  # type: ignore[arg-type]

    async def both() -> list[httpx2.Response]:
        async with httpx2.AsyncClient(transport=transport, base_url="http://testserver") as sender:
            return await asyncio.gather(*(sender.post(f"{path}/observations", json=RANKS) for _ in range(8)))

    portal: Any = client.portal
    answers = portal.call(both)
    assert sorted(one.json()["n_observations"] for one in answers) == list(range(1, 9))
    assert client.get(path).json()["n_observations"] == 8


def test_a_session_begun_twice_under_one_key_is_one(client: TestClient) -> None:
    make_ready_domain(client, "repeated")
    key = {"Idempotency-Key": "a-robot's-start"}
    body = {"seed": 3, "start_position_m": 20}

    def begun(content: dict[str, Any], headers: dict[str, str] = key, domain: str = "repeated") -> httpx2.Response:
        return client.post(f"/v1/domains/{domain}/sessions", json=content, headers=headers)

    first, again = begun(body), begun(body)
    assert (first.status_code, again.status_code) == (201, 201)
    assert first.json() == again.json()
    assert first.headers["location"] == again.headers["location"] == path_of(first.json())
    assert begun({**body, "planner": None, "start_std_m": 5.0}).json() == first.json()  # the same, written out
    listed = client.get("/v1/admin/sessions", params={"domain": "repeated"}).json()["sessions"]
    assert len(listed) == 1

    refused(begun({"seed": 4}), 422, "idempotency_key_reused")
    refused(begun({**body, "start_position_m": 1e9}), 422, "idempotency_key_reused")
    others = [begun(body, {}), begun(body, {"Idempotency-Key": "another"}), begun(body, key, "ready")]
    assert len({first.json()["session_id"], *(one.json()["session_id"] for one in others)}) == 4

    client.post(f"{path_of(first.json())}/observations", json=RANKS)
    late = begun(body)
    assert (late.status_code, late.json()["n_observations"]) == (201, 1)
    client.delete(path_of(first.json()))
    refused(begun(body), 410, "ended_session")


@pytest.mark.parametrize("key", ["", " ", "a b", "x" * 256, "\x7f"])
def test_a_key_of_a_session_that_cannot_be_one(client: TestClient, key: str) -> None:
    answer = client.post("/v1/domains/ready/sessions", json={}, headers={"Idempotency-Key": key})
    refused(answer, 422, "invalid_request")


def test_a_start_repeated_after_a_restart_or_at_once_is_one_session(tmp_path: Path) -> None:
    begin_under_key = {"json": {}, "headers": {"Idempotency-Key": "once"}}
    with TestClient(create_app(small_settings(tmp_path), InThisProcess(tmp_path))) as before:
        make_ready_domain(before, "d")
        first = before.post("/v1/domains/d/sessions", **begin_under_key).json()  # type: ignore[arg-type]
    with TestClient(create_app(small_settings(tmp_path), InThisProcess(tmp_path))) as after:
        again = after.post("/v1/domains/d/sessions", **begin_under_key)  # type: ignore[arg-type]
        assert (again.status_code, again.json()) == (201, first)

    async def at_once() -> list[httpx2.Response]:
        app = create_app(small_settings(tmp_path, max_sessions=9))
        async with (
            app.router.lifespan_context(app),
            httpx2.AsyncClient(transport=httpx2.ASGITransport(app), base_url="http://service") as robot,
        ):
            asked = [
                robot.post("/v1/domains/d/sessions", json={}, headers={"Idempotency-Key": "together"}) for _ in range(8)
            ]
            answers = await asyncio.gather(*asked)
            session = path_of(answers[0].json())
            seen = await asyncio.gather(*(robot.post(f"{session}/observations", json=RANKS) for _ in range(5)))
            assert sorted(one.json()["n_observations"] for one in seen) == [1, 2, 3, 4, 5]
            listed = (await robot.get("/v1/admin/sessions")).json()["sessions"]
            assert len(listed) == 2
            return answers

    answers = asyncio.run(at_once())
    assert {answer.status_code for answer in answers} == {201}
    assert len({answer.json()["session_id"] for answer in answers}) == 1
