"""Lists read page by page hold every entry once, whatever is made or removed between two pages."""

import pytest

from .conftest import path_of, problem

LISTS = [
    ("/v1/admin/domains/full/traverses", "traverses", "name", ["Z", "a", "b-1", "b.2", "drive"]),
    ("/v1/admin/domains/full/maps", "maps", "version", [3, 2, 1]),
    ("/v1/admin/jobs?domain=full", "jobs", "job_id", [None] * 3),
    ("/v1/admin/sessions?domain=full", "sessions", "session_id", [None] * 4),
]
OF_FULL = pytest.mark.usefixtures("_full")


def page(client, path, **params):
    path, _, domain = path.partition("?domain=")
    document = client.answer_to("GET", path, params={**params, **({"domain": domain} if domain else {})})
    assert (len(document), "next" in document) == (2, True)
    return document


def entries(client, path, key, limit):
    """The whole list, read a page at a time."""
    rows = []
    cursor = {}
    while True:
        answer = page(client, path, limit=limit, **cursor)
        assert len(answer[key]) <= limit
        rows += answer[key]
        if answer["next"] is None:
            return rows
        cursor = {"after": answer["next"]}


@pytest.fixture(scope="module")
def _full(client):
    """A domain with five traverses, three jobs, three maps and four sessions."""
    client.make_ready_domain("full")
    for name in ("b.2", "a", "Z", "b-1"):
        client.post("/v1/admin/domains/full/traverses", json={"name": name})
    for _ in range(2):
        client.make_map("full", training_episodes=0)
    for _ in range(4):
        client.begin("full")


@OF_FULL
@pytest.mark.parametrize(("path", "key", "name", "expected"), LISTS)
def test_pages_of_any_length_make_up_the_list(client, path, key, name, expected):
    document = page(client, path)
    assert document["next"] is None
    names = [entry[name] for entry in document[key]]
    assert len(set(names)) == len(names) == len(expected)
    assert None in expected or names == expected
    for limit in (1, 2, 3, 5, 1000):
        assert entries(client, path, key, limit) == document[key]


@OF_FULL
def test_the_last_page_says_so_even_where_it_is_full(client):
    path = "/v1/admin/domains/full/maps"
    assert page(client, path, limit=3)["next"] is None
    assert page(client, path, limit=2)["next"] == "maps-2"
    assert page(client, path, after="maps-1") == {"maps": [], "next": None}


@OF_FULL
def test_what_is_made_or_goes_meanwhile_moves_nothing(client):
    path = "/v1/admin/sessions?domain=full"
    first = page(client, path, limit=2)
    new_session = client.begin("full")
    rest = page(client, path, after=first["next"])
    session_ids = [session["session_id"] for session in first["sessions"] + rest["sessions"]]
    assert new_session["session_id"] not in session_ids
    assert len(set(session_ids)) == len(session_ids) == 4
    assert client.delete(path_of(new_session)).status_code == 204

    client.make_domain("shrinking")
    base = "/v1/admin/domains/shrinking/traverses"
    for name in "abcd":
        client.post(base, json={"name": name})
    first = page(client, base, limit=2)
    client.delete(f"{base}/b")  # what stood at the cursor
    assert [traverse["name"] for traverse in page(client, base, after=first["next"])["traverses"]] == ["c", "d"]


def test_a_listed_session_is_the_session(client, domain):
    old_path, new_path = client.session(domain), client.session(domain)
    for _ in range(2):
        client.observe(old_path)
    client.put(f"{old_path}/prior", json={"position_m": 10, "std_m": 2})
    state = client.get(old_path).json()
    sessions = page(client, f"/v1/admin/sessions?domain={domain}")["sessions"]
    assert [path_of(session) for session in sessions] == [new_path, old_path]
    assert sessions[1]["created_at"] < sessions[1]["expires_at"] == state["expires_at"]
    assert [session["n_observations"] for session in sessions] == [0, 2]
    assert (
        state.items() >= {member: sessions[1][member] for member in ("domain", "map_version", "n_observations")}.items()
    )
    assert sessions[1] in entries(client, "/v1/admin/sessions", "sessions", 7)
    client.delete(old_path)
    sessions = page(client, f"/v1/admin/sessions?domain={domain}")["sessions"]
    assert [path_of(session) for session in sessions] == [new_path]


@OF_FULL
@pytest.mark.parametrize("path", [path.partition("?")[0] for path, *_ in LISTS])
def test_a_cursor_or_limit_that_cannot_be(client, path):
    list_name = path.rpartition("/")[2]
    other = "jobs-1" if list_name == "maps" else "maps-1"  # a cursor belongs to its list
    wrong = ["", "1", f"{list_name}-", f"{list_name}-../x", f"{list_name}-1\n", other]
    if list_name != "traverses":  # whose keys are names
        wrong += [f"{list_name}--1", f"{list_name}-9999999999999999999"]
    for name, values in (("limit", [0, 1001, "many"]), ("after", wrong)):
        for value in values:
            answer = client.get(path, params={name: value})
            assert name in problem(answer, 422, "invalid_request")["detail"], value


@OF_FULL
def test_domains_come_in_pages_by_name(client):
    document = page(client, "/v1/domains")
    names = [domain["name"] for domain in document["domains"]]
    assert document["next"] is None
    assert names == sorted(names)
    assert {"full", "ready"} <= set(names)
    for limit in (1, 2, 1000):
        assert entries(client, "/v1/domains", "domains", limit) == document["domains"]
    (behind,) = page(client, "/v1/domains", limit=1, after="domains-full0")["domains"]
    assert behind["name"] == next(name for name in names if name > "full0")
