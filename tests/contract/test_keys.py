"""A service with keys: every operation asks for one, nobody is asked twice, and changes count without a restart."""

import json
import logging
import re
from functools import partial

import pytest

from deepsimbad.api.app import _ROUTERS
from deepsimbad.cli import run as deepsimbad
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeyScope

from .conftest import RANKS, of_one_process, path_of, problem, service, wait_until

WITHOUT_KEY = {
    "/console",
    "/console/",
    "/console/report.html",
    "/console/{name}",
    "/",
    "/healthz",
    "/readyz",
    "/metrics",
    "/docs",
    "/docs/start.js",
    "/docs/{asset}",
    "/openapi.json",
}


class KeyedService:
    """A service whose data directory has an admin's key and a robot's."""

    def __init__(self, data_dir, client):
        self.data_dir = data_dir
        self.client = client
        self.admin = {"Authorization": f"Bearer {new_key(data_dir, KeyScope.ADMIN)}"}
        self.robot = {"X-API-Key": new_key(data_dir, KeyScope.LOCALIZE)}


def new_key(data_dir, scope, **options):
    with Catalog.open(data_dir) as catalog:
        return catalog.create_key(scope, **options)[1].text


@pytest.fixture(scope="module")
def keyed(tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("keyed")
    with service(data_dir) as client:
        client.make_ready_domain("ready")
        keyed = KeyedService(data_dir, client)
        wait_until(lambda: client.get("/v1/domains").status_code == 401)
        # Made after the other key, which may count before it
        wait_until(lambda: client.get("/v1/domains", headers=keyed.robot).status_code == 200)
        yield keyed


def operations(client):
    for path, methods in client.get("/openapi.json").json()["paths"].items():
        for method, operation in methods.items():
            yield method.upper(), path, operation


def test_every_operation_asks_for_the_scope_that_it_declares(keyed):
    n_asked = 0
    for method, path, operation in operations(keyed.client):
        url = re.sub(r"\{\w+\}", "nothing", path.replace("{index}", "0"))
        ask = partial(keyed.client.request, method, url)
        if not path.startswith("/v1/"):
            assert ask().status_code < 400, path
            assert "security" not in operation
            assert "401" not in operation["responses"]
            continue
        n_asked += 1
        scope = "admin" if path.startswith("/v1/admin/") else "localize"
        assert operation["security"] == [{"bearer": [scope]}, {"api_key": [scope]}]
        assert {"401", "403", "429"} <= set(operation["responses"])
        assert "WWW-Authenticate" in operation["responses"]["401"]["headers"]
        bare = ask()
        assert "X-API-Key" in problem(bare, 401, "unauthorized")["detail"]
        assert bare.headers["www-authenticate"] == "Bearer"
        by_robot = ask(headers=keyed.robot)
        if scope == "admin":
            assert problem(by_robot, 403, "forbidden")["needed"] == "admin"
        else:
            assert by_robot.status_code not in {401, 403}, (method, path)
        assert ask(headers=keyed.admin).status_code not in {401, 403}, (method, path)
    assert n_asked > 25


def test_nothing_outside_v1_is_served_but_what_needs_no_key(keyed):
    paths = {route.path for router in _ROUTERS for route in router.routes}
    assert len(paths) > 20
    paths |= {path for _, path, _ in operations(keyed.client)}
    assert {path for path in paths if not path.startswith("/v1/")} <= WITHOUT_KEY
    for path in WITHOUT_KEY:
        assert (
            keyed.client.get(path.replace("{asset}", "swagger-ui.css").replace("{name}", "main.js")).status_code == 200
        ), path


def test_without_a_key_one_does_not_even_learn_what_is_there(keyed):
    suffixes = ("", "/", "/nothing", "/%61dmin/jobs", "/admin", "/admin/", "/admin/jobs/", "/admin/%2e./x")
    for path in suffixes:
        for method in ("GET", "HEAD", "POST", "OPTIONS", "TRACE", "PATCH", "BREW"):
            assert keyed.client.request(method, f"/v1{path}").status_code == 401, (method, path)
    for path in ("/V1/admin/jobs", "//v1/admin/jobs", "/./v1/admin/jobs", "/v1%2fadmin/jobs?", "/x/../v1/admin/jobs"):
        with_key, bare = keyed.client.get(path, headers=keyed.admin), keyed.client.get(path)
        assert with_key.status_code == 404 or bare.status_code == 401, path


@of_one_process  # whose log it reads
def test_a_robot_localizes_with_its_key_and_the_log_names_it_without_the_secret(keyed, caplog):
    client, robot, secret = keyed.client, keyed.robot, keyed.robot["X-API-Key"]
    with caplog.at_level(logging.INFO, "deepsimbad"):
        session_answer = client.post("/v1/domains/ready/sessions", json={}, headers=robot)
        place = f"{path_of(session_answer.json())}/observations"
        answers = [
            session_answer,
            client.post(place, json=RANKS, headers=robot),
            client.get("/v1/admin/jobs", headers=robot),
            client.get("/v1/admin/jobs", headers={"X-API-Key": f"{secret}x"}),
        ]
    assert [answer.status_code for answer in answers] == [201, 200, 403, 401]
    lines = [vars(record) for record in caplog.records if record.getMessage() == "request"]
    key_id = secret.split("_")[1]
    assert [line["status"] for line in lines] == [201, 200, 403, 401]
    assert [line.get("key_id") for line in lines] == [key_id, key_id, key_id, None]
    assert [line.get("domain") for line in lines] == ["ready", "ready", None, None]
    assert secret not in json.dumps([vars(record) for record in caplog.records], default=str)


def test_a_key_may_be_for_some_domains_alone(keyed):
    ready, other = (
        {"X-API-Key": new_key(keyed.data_dir, KeyScope.LOCALIZE, domains=domains)}
        for domains in (["ready"], ["elsewhere", "other"])
    )
    wait_until(lambda: keyed.client.get("/v1/domains", headers=other).status_code == 200)
    for method, path, body in (
        ("GET", "/v1/domains/ready", None),
        ("POST", "/v1/domains/ready/localizations", RANKS),
        ("POST", "/v1/domains/ready/sessions", {}),
        ("GET", "/v1/domains/ready/landmark-model", None),
    ):
        ask = partial(keyed.client.request, method, json=body)
        assert ask(path, headers=ready).status_code < 300, path
        assert problem(ask(path, headers=other), 403, "forbidden")["domains"] == ["elsewhere", "other"]
        problem(ask(path.replace("ready", "unknown"), headers=ready), 403, "forbidden")
    answers = [keyed.client.get("/v1/domains", headers=key).json()["domains"] for key in (ready, other)]
    assert [[domain["name"] for domain in domains] for domains in answers] == [["ready"], []]


def test_keys_made_and_revoked_beside_a_running_service_count(tmp_path, capsys):
    def command(*arguments):
        assert deepsimbad(["keys", *arguments, "--data-dir", str(tmp_path)]) == 0
        return capsys.readouterr().out

    with service(tmp_path) as client:
        assert client.get("/v1/domains").status_code == 200
        (key,) = re.findall(r"dsk_[\w-]+", command("create", "--scope", "localize"))  # Ray may have written there too
        wait_until(lambda: client.get("/v1/domains").status_code == 401)
        headers = {"Authorization": f"Bearer {key}"}
        assert client.get("/v1/domains", headers=headers).status_code == 200
        command("revoke", key.split("_")[1])
        wait_until(lambda: client.get("/v1/domains", headers=headers).status_code == 401)
        assert client.get("/readyz").status_code == 200
    with service(tmp_path) as client:
        assert client.get("/v1/domains").status_code == 401, "all revoked is closed, after a restart too"


def test_sessions_belong_to_the_key_that_began_them(tmp_path):
    secrets = [new_key(tmp_path, scope) for scope in (KeyScope.ADMIN, KeyScope.LOCALIZE, KeyScope.LOCALIZE)]
    admin, robot, other = ({"X-API-Key": secret} for secret in secrets)
    robot_id = secrets[1].split("_")[1]
    with service(tmp_path, max_sessions_per_key=2, session_sweep_s=0.05) as client:
        client.headers.update(admin)
        client.make_ready_domain("ready")
        start = partial(client.post, "/v1/domains/ready/sessions", json={})
        path, _ = (path_of(start(headers=robot).json()) for _ in range(2))
        document = problem(start(headers=robot), 429, "too_many_sessions")
        assert (document["limit"], document["max_sessions_per_key"]) == ("max_sessions_per_key", 2)
        word = {"Idempotency-Key": "start"}  # others have room, and words, of their own
        assert len({path_of(start(headers=key | word).json()) for key in (admin, other)}) == 2

        for method, url, body in (
            ("POST", f"{path}/observations", RANKS),
            ("GET", path, None),
            ("GET", f"{path}/belief", None),
            ("GET", f"{path}/next-best-view", None),
            ("PUT", f"{path}/prior", {"position_m": 1.0, "std_m": 1.0}),
            ("POST", f"{path}/truths", {"true_positions_m": [1.0]}),
            ("DELETE", path, None),
        ):
            for accept in ("application/json", "application/octet-stream"):
                answer = client.request(method, url, json=body, headers=other | {"Accept": accept})
                problem(answer, 404, "unknown_session")
            if method != "DELETE":
                assert client.request(method, url, json=body, headers=robot).status_code == 200, url
        assert client.get(path).json()["n_observations"] == 1, "an admin knows of all"
        sessions = client.get("/v1/admin/sessions").json()["sessions"]
        assert [session["key_id"] for session in sessions].count(robot_id) == 2

        with Catalog.open(tmp_path) as catalog:
            catalog.revoke_key(robot_id)
        # A revoked key's sessions end
        wait_until(lambda: len(client.get("/v1/admin/sessions").json()["sessions"]) == 2)
        problem(client.get(path), 410, "ended_session")
        assert "event: done" in client.get(f"{path}/events").text
        for url in (path, f"{path}/events"):
            problem(client.get(url, headers=other), 404, "unknown_session")
