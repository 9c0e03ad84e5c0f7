"""Two services that share maps by a store: what one activates the other serves, also while the store is away."""

import shutil

import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.errors import SettingsError, UnavailableError
from deepsimbad.store.map_store import MapStore

from .conftest import IS_FLEET, N_LANDMARKS, RANKS, problem, service, small_settings, wait_until

LOCALIZATIONS = "/v1/domains/ready/localizations"


@pytest.fixture
def store(tmp_path):
    return tmp_path / "store"


@pytest.fixture
def client_a(tmp_path, store):
    with service(tmp_path / "a", map_store=f"file://{store}") as client:
        client.make_ready_domain("ready")
        yield client


@pytest.fixture
def client_b(tmp_path, store, client_a):
    with service(tmp_path / "b", map_store=f"file://{store}") as client:
        yield client


def answer_of(client):
    return client.localize() | {"timings_ms": None}


def is_active(client, domain):
    maps = client.get(f"/v1/admin/domains/{domain}/maps").json().get("maps")
    return maps and maps[0]["state"] == "active"


def wait_for_version(client, version):
    wait_until(lambda: client.post(LOCALIZATIONS, json=RANKS).json().get("map_version") == version)


def answer_once_known(client, domain):
    """The answer to a localization once the domain is known: in a fleet each process hears of a domain by itself."""
    answers = []

    def is_known():
        answers.append(client.post(f"/v1/domains/{domain}/localizations", json=RANKS))
        return answers[-1].status_code != 404

    wait_until(is_known)
    return answers[-1]


def activate(client, version, expected):
    return client.put("/v1/admin/domains/ready/active-map", json={"version": version, "expected": expected})


def test_what_one_activates_the_other_serves(client_a, client_b):
    assert answer_of(client_b) == answer_of(client_a)
    assert client_b.get("/v1/domains/ready").json() == client_a.get("/v1/domains/ready").json()
    session = client_b.session()
    assert client_a.remap("ready", landmark_traverse="drive", n_landmarks=N_LANDMARKS)["result"]["map_version"] == 2
    wait_for_version(client_b, 2)
    assert answer_of(client_b) == answer_of(client_a)
    assert client_b.observe(session)["map_version"] == 1, "a session keeps the map it began on"
    assert activate(client_a, 1, 2).status_code == 200
    problem(activate(client_b, 2, 2), 409, "lost_activation")
    wait_for_version(client_b, 1)
    assert activate(client_b, 2, 1).status_code == 200, "from anywhere"
    wait_for_version(client_a, 2)
    client_a.make_domain("unmapped")
    wait_until(lambda: client_b.get("/v1/domains/unmapped").status_code == 200)
    problem(answer_once_known(client_b, "unmapped"), 409, "no_active_map")
    assert client_a.delete("/v1/admin/domains/ready").status_code == 204
    wait_until(lambda: client_b.post(LOCALIZATIONS, json=RANKS).status_code == 404)


@pytest.mark.skipif(IS_FLEET, reason="keeps its sessions in the store that is lost")
def test_a_service_without_its_store_serves_what_it_has_and_says_what_it_has_not(client_a, client_b, store):
    client_a.make_ready_domain("cold")
    wait_until(lambda: is_active(client_b, "cold"))
    answer = answer_of(client_b)
    shutil.move(store, store.with_name("lost"))
    assert answer_of(client_b) == answer
    assert client_b.observe(client_b.session())["map_version"] == 1
    answer_while_away = client_b.post("/v1/domains/cold/localizations", json=RANKS)
    problem(answer_while_away, 503, "unavailable")
    assert answer_while_away.headers["retry-after"]
    problem(activate(client_a, 1, 1), 503, "unavailable")
    problem(client_a.delete("/v1/admin/domains/ready"), 503, "unavailable")
    job = client_a.remap("ready")
    assert (job["state"], job["error"]["code"]) == ("failed", "unavailable")
    assert answer_of(client_a) == answer
    store.rmdir()  # the job's process looked for it
    shutil.move(store.with_name("lost"), store)
    wait_until(lambda: client_b.post("/v1/domains/cold/localizations", json=RANKS).status_code == 200)
    assert activate(client_a, 2, 1).status_code == 200, "what the job had sealed"
    wait_for_version(client_b, 2)


def test_while_a_new_map_cannot_be_had_the_one_before_serves(client_a, client_b, monkeypatch):
    assert answer_of(client_b)["map_version"] == 1

    def away(*_):
        raise UnavailableError("the store is away", reason="unreachable")

    with monkeypatch.context() as patched:
        patched.setattr(MapStore, "map_pieces", away)
        client_a.remap("ready")
        wait_until(lambda: client_b.get("/v1/admin/domains/ready/maps").json()["maps"][0]["version"] == 2)
        assert is_active(client_b, "ready")
        wait_until(lambda: client_b.services.maps.refresh("ready").record.active_version == 2)
        assert answer_of(client_b)["map_version"] == 1
    wait_for_version(client_b, 2)


def test_a_damaged_object_is_named_and_the_other_domains_go_on(client_a, client_b, store):
    client_a.make_ready_domain("cold")
    wait_until(lambda: is_active(client_b, "cold"))
    cold = "/v1/domains/cold/localizations"
    digest = client_a.get("/v1/admin/domains/cold/maps").json()["maps"][0]["sha256"]
    path = store / f"maps/{digest}.sqlite"
    content = path.read_bytes()
    path.chmod(0o644)
    path.write_bytes(content[:-1])
    response = answer_once_known(client_b, "cold")
    assert problem(response, 503, "damaged_map")["map_version"] == 1
    assert response.headers["retry-after"]
    assert answer_of(client_b)["map_version"] == 1
    path.write_bytes(content)
    wait_until(lambda: client_b.post(cold, json=RANKS).status_code == 200)


def test_a_service_that_cannot_have_its_store_does_not_start(tmp_path):
    app = create_app(small_settings(tmp_path / "data", map_store="nowhere"))
    with pytest.raises(SettingsError), TestClient(app):
        pass
