"""Lists page by page: every entry once, whatever is made or removed between two pages."""

from typing import Any

import pytest
from starlette.testclient import TestClient

from .conftest import N_LANDMARKS, make_ready_domain, remap

EVALUATOR = {"kind": "feature_l2", "extractor": "none"}
RANKS = {"ranked_landmarks": list(range(N_LANDMARKS))}


def page(client: TestClient, path: str, **params: Any) -> dict[str, Any]:
    answer = client.get(path, params=params)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    assert len(found) == 2
    assert "next" in found
    return found


def entries(client: TestClient, path: str, key: str, limit: int, **params: Any) -> list[dict[str, Any]]:
    """The whole list, read a page at a time."""
    found: list[dict[str, Any]] = []
    after: dict[str, Any] = {}
    while True:
        answer = page(client, path, limit=limit, **params, **after)
        assert len(answer[key]) <= limit
        found += answer[key]
        if answer["next"] is None:
            return found
        after = {"after": answer["next"]}


@pytest.fixture(scope="module")
def full(client: TestClient) -> str:
    """A domain with five traverses, three jobs, three maps and four sessions."""
    make_ready_domain(client, "full")
    for name in ("b.2", "a", "Z", "b-1"):
        client.post("/v1/admin/domains/full/traverses", json={"name": name})
    for _ in range(2):
        assert remap(client, "full", training_traverse="drive", training_episodes=0)["state"] == "succeeded"
    for _ in range(4):
        client.post("/v1/domains/full/sessions", json={})
    return "full"


LISTS = [
    ("/v1/admin/domains/full/traverses", "traverses", "name", ["Z", "a", "b-1", "b.2", "drive"]),
    ("/v1/admin/domains/full/maps", "maps", "version", [3, 2, 1]),
    ("/v1/admin/jobs?domain=full", "jobs", "job_id", None),
    ("/v1/admin/sessions?domain=full", "sessions", "session_id", None),
]


@pytest.mark.parametrize(("path", "key", "name", "expected"), LISTS, ids=[key for _, key, _, _ in LISTS])
def test_pages_of_any_length_make_up_the_list(
    client: TestClient, full: str, path: str, key: str, name: str, expected: list[Any] | None
) -> None:
    path, _, domain = path.partition("?domain=")
    params = {"domain": domain} if domain else {}
    whole = page(client, path, **params)
    assert whole["next"] is None
    names = [entry[name] for entry in whole[key]]
    assert len(set(names)) == len(names) == {"traverses": 5, "maps": 3, "jobs": 3, "sessions": 4}[key]
    assert expected is None or names == expected
    for limit in (1, 2, 3, 5, 1000):
        assert entries(client, path, key, limit, **params) == whole[key]


def test_the_last_page_says_so_even_where_it_is_full(client: TestClient, full: str) -> None:
    assert page(client, "/v1/admin/domains/full/maps", limit=3)["next"] is None
    assert page(client, "/v1/admin/domains/full/maps", limit=2)["next"] == "maps-2"
    behind = page(client, "/v1/admin/domains/full/maps", after="maps-1")
    assert behind == {"maps": [], "next": None}


def test_what_is_made_meanwhile_moves_nothing(client: TestClient, full: str) -> None:
    first = page(client, "/v1/admin/sessions", domain="full", limit=2)
    made = client.post("/v1/domains/full/sessions", json={}).json()["session_id"]
    rest = page(client, "/v1/admin/sessions", domain="full", after=first["next"])
    shown = [session["session_id"] for session in first["sessions"] + rest["sessions"]]
    assert made not in shown
    assert len(set(shown)) == len(shown) == 4
    assert client.delete(f"/v1/sessions/{made}").status_code == 204


def test_what_stood_at_the_cursor_may_go(client: TestClient) -> None:
    client.put("/v1/admin/domains/shrinking", json={"evaluator": EVALUATOR})
    base = "/v1/admin/domains/shrinking/traverses"
    for name in "abcd":
        client.post(base, json={"name": name})
    first = page(client, base, limit=2)
    client.delete(f"{base}/b")
    assert [each["name"] for each in page(client, base, after=first["next"])["traverses"]] == ["c", "d"]


def test_a_listed_session_is_the_session(client: TestClient) -> None:
    make_ready_domain(client, "robots")
    old = client.post("/v1/domains/robots/sessions", json={}).json()
    new = client.post("/v1/domains/robots/sessions", json={}).json()
    for _ in range(2):
        client.post(f"/v1/sessions/{old['session_id']}/observations", json=RANKS)
    client.put(f"/v1/sessions/{old['session_id']}/prior", json={"position_m": 10, "std_m": 2})
    state = client.get(f"/v1/sessions/{old['session_id']}").json()
    listed = page(client, "/v1/admin/sessions", domain="robots")["sessions"]
    assert [each["session_id"] for each in listed] == [new["session_id"], old["session_id"]]
    assert listed[1]["created_at"] < listed[1]["expires_at"] == state["expires_at"]
    for member in ("domain", "map_version", "n_observations"):
        assert listed[1][member] == state[member]
    assert (listed[0]["n_observations"], listed[1]["n_observations"]) == (0, 2)
    assert listed[1] in entries(client, "/v1/admin/sessions", "sessions", 7)
    client.delete(f"/v1/sessions/{old['session_id']}")
    assert [each["session_id"] for each in page(client, "/v1/admin/sessions", domain="robots")["sessions"]] == [
        new["session_id"]
    ]


@pytest.mark.parametrize("path", [path.partition("?")[0] for path, *_ in LISTS])
@pytest.mark.parametrize(
    "params",
    [
        {"limit": 0},
        {"limit": 1001},
        {"limit": "many"},
        {"after": ""},
        {"after": "1"},
        {"after": "jobs-"},
        {"after": "maps--1"},
        {"after": "maps-1\n"},
        {"after": "sessions-9999999999999999999"},
        {"after": "traverses-../x"},
        {"after": "traverses-"},
        {"after": "of-another-list"},
    ],
)
def test_a_cursor_or_limit_that_cannot_be(client: TestClient, full: str, path: str, params: dict[str, Any]) -> None:
    answer = client.get(path, params=params)
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_request")
    assert next(iter(params)) in answer.json()["detail"]


def test_a_cursor_belongs_to_its_list(client: TestClient, full: str) -> None:
    assert client.get("/v1/admin/jobs", params={"after": "maps-1"}).status_code == 422
    assert client.get("/v1/admin/domains/full/maps", params={"after": "jobs-1"}).status_code == 422


@pytest.mark.parametrize("path", ["/v1/admin/jobs", "/v1/admin/sessions"])
def test_lists_of_an_unknown_domain(client: TestClient, path: str) -> None:
    answer = client.get(path, params={"domain": "nowhere"})
    assert (answer.status_code, answer.json()["code"]) == (404, "unknown_domain")
