"""A service with keys: every operation asks for one, nobody is asked twice, and changes count without a restart."""

import json
import logging
import re
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import _ROUTERS, create_app
from deepsimbad.cli import run as deepsimbad
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeyScope

from .conftest import make_ready_domain, small_settings
from .test_bad_input import check

WITHOUT_KEY = {"/healthz", "/readyz", "/metrics", "/docs", "/docs/start.js", "/docs/{asset}", "/openapi.json"}


class Keyed:
    """A service whose data directory has an admin's key and a robot's."""

    def __init__(self, data_dir: Path, client: TestClient, admin: str, robot: str) -> None:
        self.data_dir = data_dir
        self.client = client
        self.admin = {"Authorization": f"Bearer {admin}"}
        self.robot = {"X-API-Key": robot}


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Keyed]:
    data_dir = tmp_path_factory.mktemp("keyed")
    with Catalog.open(data_dir) as catalog:
        _, admin = catalog.create_key(KeyScope.ADMIN, "admin")
        _, robot = catalog.create_key(KeyScope.LOCALIZE, "robot")
    with TestClient(
        create_app(small_settings(data_dir), InThisProcess(data_dir)), raise_server_exceptions=False
    ) as client:
        client.headers["Authorization"] = f"Bearer {admin.text}"
        make_ready_domain(client, "ready")
        del client.headers["Authorization"]
        yield Keyed(data_dir, client, admin.text, robot.text)


def operations(client: TestClient) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, methods in client.get("/openapi.json").json()["paths"].items():
        for method, operation in methods.items():
            yield method.upper(), path, operation


def test_every_operation_asks_for_the_scope_that_it_declares(keyed: Keyed) -> None:
    n_asked = 0
    for method, path, operation in operations(keyed.client):
        url = path.replace("{index}", "0")
        url = re.sub(r"\{\w+\}", "nothing", url)
        bare = keyed.client.request(method, url)
        if not path.startswith("/v1/"):
            assert bare.status_code < 400, path
            assert "security" not in operation
            continue
        n_asked += 1
        (needed,) = operation["security"][0]["bearer"]
        assert operation["security"] == [{"bearer": [needed]}, {"api_key": [needed]}]
        assert needed == ("admin" if path.startswith("/v1/admin/") else "localize")
        problem = check(bare, 401, "unauthorized")
        assert bare.headers["www-authenticate"] == "Bearer"
        assert "X-API-Key" in problem["detail"]
        by_robot = keyed.client.request(method, url, headers=keyed.robot)
        if needed == "admin":
            assert check(by_robot, 403, "forbidden")["needed"] == "admin"
        else:
            assert by_robot.status_code not in {401, 403}, (method, path)
        assert keyed.client.request(method, url, headers=keyed.admin).status_code not in {401, 403}, (method, path)
    assert n_asked > 25


def test_the_document_tells_how_to_send_a_key_and_what_refusals_look_like(keyed: Keyed) -> None:
    document = keyed.client.get("/openapi.json").json()
    schemes = document["components"]["securitySchemes"]
    assert (schemes["bearer"]["type"], schemes["bearer"]["scheme"]) == ("http", "bearer")
    assert (schemes["api_key"]["in"], schemes["api_key"]["name"]) == ("header", "X-API-Key")
    for _, path, operation in operations(keyed.client):
        declared = set(operation["responses"])
        assert ({"401", "403", "429"} <= declared) == path.startswith("/v1/"), path
        assert "WWW-Authenticate" in operation["responses"].get("401", {"headers": "WWW-Authenticate"})["headers"]


def test_nothing_outside_v1_is_served_but_what_needs_no_key(keyed: Keyed) -> None:
    served = {route.path for router in _ROUTERS for route in router.routes}
    assert len(served) > 20
    assert {path for path in served if not path.startswith("/v1/")} <= WITHOUT_KEY
    assert {path for _, path, _ in operations(keyed.client) if not path.startswith("/v1/")} <= WITHOUT_KEY
    for path in WITHOUT_KEY:
        assert keyed.client.get(path.replace("{asset}", "swagger-ui.css")).status_code == 200, path


@pytest.mark.parametrize(
    "path",
    [
        "/v1",
        "/v1/",
        "/v1/nothing",
        "/v1/%61dmin/jobs",
        "/v1/admin",
        "/v1/admin/",
        "/v1/admin/jobs/",
        "/v1/admin/%2e./x",
    ],
)
def test_without_a_key_one_does_not_even_learn_what_is_there(keyed: Keyed, path: str) -> None:
    for method in ("GET", "HEAD", "POST", "OPTIONS", "TRACE", "PATCH", "BREW"):
        answer = keyed.client.request(method, path)
        assert answer.status_code == 401, method


@pytest.mark.parametrize(
    "path", ["/V1/admin/jobs", "//v1/admin/jobs", "/./v1/admin/jobs", "/v1%2fadmin/jobs?", "/x/../v1/admin/jobs"]
)
def test_no_other_spelling_of_a_path_is_served(keyed: Keyed, path: str) -> None:
    assert keyed.client.request("GET", path, headers=keyed.admin).status_code == 404 or (
        keyed.client.request("GET", path).status_code == 401
    )


def test_a_robot_localizes_with_its_key(keyed: Keyed) -> None:
    query = {"ranked_landmarks": [1, 2, 3]}
    begun = keyed.client.post("/v1/domains/ready/sessions", json={}, headers=keyed.robot)
    assert begun.status_code == 201
    place = f"/v1/sessions/{begun.json()['session_id']}/observations"
    check(keyed.client.post(place, json=query), 401, "unauthorized")
    assert keyed.client.post(place, json=query, headers=keyed.robot).status_code == 200
    check(keyed.client.put("/v1/admin/domains/other", json={}, headers=keyed.robot), 403, "forbidden")


def test_a_large_body_without_a_key_is_answered_and_not_read(keyed: Keyed) -> None:
    def pieces() -> Iterator[bytes]:
        for _ in range(100):
            yield bytes(10_000)

    answer = keyed.client.put("/v1/admin/domains/ready/traverses/drive/frames/0?position_m=0", content=pieces())
    check(answer, 401, "unauthorized")


def test_log_lines_name_key_and_domain_and_never_the_secret(keyed: Keyed, caplog: pytest.LogCaptureFixture) -> None:
    secret = keyed.robot["X-API-Key"]
    with caplog.at_level(logging.INFO, "deepsimbad"):
        begun = keyed.client.post("/v1/domains/ready/sessions", json={}, headers=keyed.robot).json()
        place = f"/v1/sessions/{begun['session_id']}/observations"
        keyed.client.post(place, json={"ranked_landmarks": [1]}, headers=keyed.robot)
        keyed.client.get("/v1/admin/jobs", headers=keyed.robot)
        keyed.client.get("/v1/admin/jobs", headers={"X-API-Key": f"{secret}x"})
    lines = [record for record in caplog.records if record.getMessage() == "request"]
    key_id = secret.split("_")[1]
    assert [getattr(line, "status", None) for line in lines] == [201, 200, 403, 401]
    assert [getattr(line, "key_id", None) for line in lines] == [key_id, key_id, key_id, None]
    assert [getattr(line, "domain", None) for line in lines] == ["ready", "ready", None, None]
    assert secret not in json.dumps([vars(record) for record in caplog.records], default=str)


def test_a_key_may_be_for_some_domains_alone(keyed: Keyed) -> None:
    with Catalog.open(keyed.data_dir) as catalog:
        _, ready = catalog.create_key(KeyScope.LOCALIZE, domains=["ready"])
        _, other = catalog.create_key(KeyScope.LOCALIZE, domains=["elsewhere", "other"])
    headers = {"X-API-Key": ready.text}
    wait_until(lambda: keyed.client.get("/v1/domains", headers=headers), 200)
    calls = (
        ("GET", "/v1/domains/ready", None),
        ("POST", "/v1/domains/ready/localizations", {"ranked_landmarks": [1]}),
        ("POST", "/v1/domains/ready/sessions", {}),
        ("GET", "/v1/domains/ready/landmark-model", None),
    )
    for method, path, body in calls:
        assert keyed.client.request(method, path, json=body, headers=headers).status_code < 300, path
        refused = keyed.client.request(method, path, json=body, headers={"X-API-Key": other.text})
        check(refused, 403, "forbidden")
        assert refused.json()["domains"] == ["elsewhere", "other"]
        check(
            keyed.client.request(method, path.replace("ready", "unknown"), json=body, headers=headers), 403, "forbidden"
        )
    listed = [keyed.client.get("/v1/domains", headers={"X-API-Key": key.text}).json() for key in (ready, other)]
    assert [[domain["name"] for domain in answer["domains"]] for answer in listed] == [["ready"], []]


def wait_until(answers: Any, status: int) -> None:
    give_up = time.monotonic() + 30
    while answers().status_code != status:
        assert time.monotonic() < give_up
        time.sleep(0.05)


def test_keys_made_and_revoked_beside_a_running_service_count(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def command(*arguments: str) -> str:
        assert deepsimbad(["keys", *arguments, "--data-dir", str(tmp_path)]) == 0
        return capsys.readouterr().out.strip()

    with TestClient(create_app(small_settings(tmp_path)), raise_server_exceptions=False) as client:
        assert client.get("/v1/domains").status_code == 200
        key = command("create", "--scope", "localize")
        wait_until(lambda: client.get("/v1/domains"), 401)
        headers = {"Authorization": f"Bearer {key}"}
        assert client.get("/v1/domains", headers=headers).status_code == 200
        command("revoke", key.split("_")[1])
        wait_until(lambda: client.get("/v1/domains", headers=headers), 401)
        assert client.get("/readyz").status_code == 200
    with TestClient(create_app(small_settings(tmp_path))) as client:
        assert client.get("/v1/domains").status_code == 401, "all revoked is closed, after a restart too"


@pytest.mark.parametrize("has_key", [True, False])
def test_the_start_up_log_says_whether_it_runs_open(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, has_key: bool
) -> None:
    if has_key:
        with Catalog.open(tmp_path) as catalog:
            catalog.create_key(KeyScope.ADMIN)
            gone, _ = catalog.create_key(KeyScope.ADMIN)
            catalog.revoke_key(gone.key_id)
    with caplog.at_level(logging.INFO, "deepsimbad"), TestClient(create_app(small_settings(tmp_path))):
        pass
    said = [record for record in caplog.records if hasattr(record, "n_keys")]
    assert len(said) == 1
    assert ("open" in said[0].getMessage()) == (not has_key)
    assert said[0].levelno == (logging.INFO if has_key else logging.WARNING)
    assert vars(said[0])["n_keys"] == int(has_key)


def test_a_rate_a_key(tmp_path: Path) -> None:
    with Catalog.open(tmp_path) as catalog:
        _, key = catalog.create_key(KeyScope.LOCALIZE)
        _, other = catalog.create_key(KeyScope.LOCALIZE)
    settings = small_settings(tmp_path, rate_limit_per_s=0.01, rate_limit_burst=3)
    with TestClient(create_app(settings)) as client:
        statuses = [client.get("/v1/domains", headers={"X-API-Key": key.text}).status_code for _ in range(4)]
        assert statuses == [200, 200, 200, 429]
        refused = client.get("/v1/domains", headers={"X-API-Key": key.text})
        check(refused, 429, "rate_limited")
        assert 0 < int(refused.headers["retry-after"]) <= 100
        assert client.get("/v1/domains", headers={"X-API-Key": other.text}).status_code == 200
        assert client.get("/v1/domains").status_code == 401


def test_a_limit_on_domains(tmp_path: Path) -> None:
    body = {"evaluator": {"kind": "feature_l2", "extractor": "none"}}
    with TestClient(create_app(small_settings(tmp_path, max_domains=2))) as client:
        assert client.put("/v1/admin/domains/a", json=body).status_code == 201
        assert client.put("/v1/admin/domains/b", json=body).status_code == 201
        assert check(client.put("/v1/admin/domains/c", json=body), 409, "too_many_domains")["max_domains"] == 2
        assert client.put("/v1/admin/domains/b", json=body).status_code == 200
        assert client.delete("/v1/admin/domains/a").status_code == 204
        assert client.put("/v1/admin/domains/c", json=body).status_code == 201


def test_sessions_belong_to_the_key_that_began_them(tmp_path: Path) -> None:
    with Catalog.open(tmp_path) as catalog:
        secrets = [catalog.create_key(scope, "")[1].text for scope in (KeyScope.ADMIN, *2 * [KeyScope.LOCALIZE])]
        robot_id = catalog.keys()[1].key_id
    admin, robot, other = ({"X-API-Key": secret} for secret in secrets)
    settings = small_settings(tmp_path, max_sessions_per_key=2, session_sweep_s=0.05)
    with TestClient(create_app(settings, InThisProcess(tmp_path)), raise_server_exceptions=False) as client:
        client.headers.update(admin)
        make_ready_domain(client, "ready")
        begin = partial(client.post, "/v1/domains/ready/sessions", json={})
        mine, _ = (begin(headers=robot).json()["session_id"] for _ in range(2))
        problem = check(begin(headers=robot), 429, "too_many_sessions")
        assert (problem["limit"], problem["max_sessions_per_key"]) == ("max_sessions_per_key", 2)
        assert begin(headers=other).status_code == 201, "another key has room of its own"

        path, view = f"/v1/sessions/{mine}", {"ranked_landmarks": [1, 2]}
        for method, url, body in (
            ("POST", f"{path}/observations", view),
            ("GET", path, None),
            ("GET", f"{path}/belief", None),
            ("GET", f"{path}/next-best-view", None),
            ("PUT", f"{path}/prior", {"position_m": 1.0, "std_m": 1.0}),
            ("POST", f"{path}/truths", {"true_positions_m": [1.0]}),
            ("DELETE", path, None),
        ):
            check(client.request(method, url, json=body, headers=other), 404, "unknown_session")
            if method != "DELETE":
                assert client.request(method, url, json=body, headers=robot).status_code == 200, url
        assert client.get(path).json()["n_observations"] == 1, "an admin knows of all"
        listed = client.get("/v1/admin/sessions").json()["sessions"]
        assert [session["key_id"] for session in listed].count(robot_id) == 2

        with Catalog.open(tmp_path) as catalog:
            catalog.revoke_key(robot_id)
        give_up = time.monotonic() + 30
        while client.get(path).status_code != 410:
            assert time.monotonic() < give_up, "a revoked key's sessions end"
            time.sleep(0.05)
        assert len(client.get("/v1/admin/sessions").json()["sessions"]) == 1
        check(client.get(path, headers=other), 404, "unknown_session")
