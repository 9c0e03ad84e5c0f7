"""Two services that share maps by a store: what one activates the other serves, also while the store is away."""

import shutil

import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.errors import SettingsError, UnavailableError
from deepsimbad.store.map_store import MapStore

from .conftest import IS_FLEET, N_LANDMARKS, RANKS, problem, service, small_settings, until

LOCALIZATIONS = "/v1/domains/ready/localizations"


@pytest.fixture
def store(tmp_path):
    return tmp_path / "store"


@pytest.fixture
def here(tmp_path, store):
    with service(tmp_path / "here", map_store=f"file://{store}") as client:
        client.make_ready_domain("ready")
        yield client


@pytest.fixture
def there(tmp_path, store, here):
    with service(tmp_path / "there", map_store=f"file://{store}") as client:
        yield client


def answered(client, path=LOCALIZATIONS):
    answer = client.post(path, json=RANKS)
    assert answer.status_code == 200, answer.text
    document = answer.json()
    document.pop("timings_ms")
    return document


def is_active(client, domain):
    maps = client.get(f"/v1/admin/domains/{domain}/maps").json().get("maps")
    return maps and maps[0]["state"] == "active"


def serves(client, version):
    until(lambda: client.post(LOCALIZATIONS, json=RANKS).json().get("map_version") == version)


def asked_once_known(client, domain):
    """What a domain's localization is answered; of a fleet each process hears of a domain by itself."""
    answers = []

    def is_known():
        answers.append(client.post(f"/v1/domains/{domain}/localizations", json=RANKS))
        return answers[-1].status_code != 404

    until(is_known)
    return answers[-1]


def activated(client, version, expected):
    return client.put("/v1/admin/domains/ready/active-map", json={"version": version, "expected": expected})


def test_what_one_activates_the_other_serves(here, there):
    assert answered(there) == answered(here)
    assert there.get("/v1/domains/ready").json() == here.get("/v1/domains/ready").json()
    session = there.session()
    assert here.remap("ready", landmark_traverse="drive", n_landmarks=N_LANDMARKS)["result"]["map_version"] == 2
    serves(there, 2)
    assert answered(there) == answered(here)
    assert answered(there, f"{session}/observations")["map_version"] == 1, "a session keeps the map it began on"
    assert activated(here, 1, 2).status_code == 200
    problem(activated(there, 2, 2), 409, "lost_activation")
    serves(there, 1)
    assert activated(there, 2, 1).status_code == 200, "from anywhere"
    serves(here, 2)
    assert here.put("/v1/admin/domains/unmapped", json={"evaluator": {"kind": "feature_l2"}}).status_code == 201
    until(lambda: there.get("/v1/domains/unmapped").status_code == 200)
    problem(asked_once_known(there, "unmapped"), 409, "no_active_map")
    assert here.delete("/v1/admin/domains/ready").status_code == 204
    until(lambda: there.post(LOCALIZATIONS, json=RANKS).status_code == 404)


@pytest.mark.skipif(IS_FLEET, reason="keeps its sessions in the store that is lost")
def test_a_service_without_its_store_serves_what_it_has_and_says_what_it_has_not(here, there, store):
    here.make_ready_domain("cold")
    until(lambda: is_active(there, "cold"))
    before = answered(there)
    shutil.move(store, store.with_name("lost"))
    assert answered(there) == before
    session = there.session()
    assert answered(there, f"{session}/observations")["map_version"] == 1
    cold = there.post("/v1/domains/cold/localizations", json=RANKS)
    problem(cold, 503, "unavailable")
    assert cold.headers["retry-after"]
    problem(activated(here, 1, 1), 503, "unavailable")
    problem(here.delete("/v1/admin/domains/ready"), 503, "unavailable")
    job = here.remap("ready")
    assert (job["state"], job["error"]["code"]) == ("failed", "unavailable")
    assert answered(here) == before
    store.rmdir()  # the job's process looked for it
    shutil.move(store.with_name("lost"), store)
    until(lambda: there.post("/v1/domains/cold/localizations", json=RANKS).status_code == 200)
    assert activated(here, 2, 1).status_code == 200, "what the job had sealed"
    serves(there, 2)


def test_while_a_new_map_cannot_be_had_the_one_before_serves(here, there, monkeypatch):
    assert answered(there)["map_version"] == 1

    def away(*_):
        raise UnavailableError("the store is away", reason="unreachable")

    with monkeypatch.context() as patched:
        patched.setattr(MapStore, "map_pieces", away)
        here.remap("ready")
        until(lambda: there.get("/v1/admin/domains/ready/maps").json()["maps"][0]["version"] == 2)
        assert is_active(there, "ready")
        until(lambda: there.services.maps.refresh("ready").record.active_version == 2)
        assert answered(there)["map_version"] == 1
    serves(there, 2)


def test_a_damaged_object_is_named_and_the_other_domains_go_on(here, there, store):
    here.make_ready_domain("cold")
    until(lambda: is_active(there, "cold"))
    cold = "/v1/domains/cold/localizations"
    digest = here.get("/v1/admin/domains/cold/maps").json()["maps"][0]["sha256"]
    path = store / f"maps/{digest}.sqlite"
    whole = path.read_bytes()
    path.chmod(0o644)
    path.write_bytes(whole[:-1])
    damaged = asked_once_known(there, "cold")
    assert problem(damaged, 503, "damaged_map")["map_version"] == 1
    assert damaged.headers["retry-after"]
    assert answered(there)["map_version"] == 1
    path.write_bytes(whole)
    until(lambda: there.post(cold, json=RANKS).status_code == 200)


def test_a_service_that_cannot_have_its_store_does_not_start(tmp_path):
    app = create_app(small_settings(tmp_path / "data", map_store="nowhere"))
    with pytest.raises(SettingsError), TestClient(app):
        pass
