"""A service that is asked to stop finishes what it has begun, keeps what it acknowledged, and ends."""

import http.client
import json
import os
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepsimbad_client.http.local_server import LocalServer

pytestmark = pytest.mark.slow

N_LANDMARKS = 30
ENDS = {signal.SIGTERM: 0, signal.SIGINT: 130}  # exit code by the signal that asked


class Service(LocalServer):
    """`deepsimbad serve` on a data directory, again and again."""

    def __init__(self, data_dir: Path) -> None:
        super().__init__(data_dir)
        self.data_dir = data_dir

    def signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=60)

    def request(self, method: str, path: str, body: Any = None) -> tuple[int, bytes]:
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)) as connection:
            content = body if isinstance(body, bytes) or body is None else json.dumps(body)
            kind = "application/octet-stream" if isinstance(body, bytes) else "application/json"
            connection.request(method, path, content, {"Content-Type": kind})
            answer = connection.getresponse()
            return answer.status, answer.read()

    def ask(self, method: str, path: str, body: Any = None) -> Any:
        status, content = self.request(method, path, body)
        assert status < 300, content
        return json.loads(content) if content else None


def wait_until(condition: Callable[[], Any]) -> None:
    for _ in range(6000):
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError("it did not come about")


@pytest.fixture(scope="module")
def mapped_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data directory with a map; never touched."""
    service = Service(tmp_path_factory.mktemp("mapped") / "data")
    service.start()
    try:
        make_map(service)
    finally:
        service.signal(signal.SIGTERM)
    assert service.wait(60) == 0
    return service.data_dir


@pytest.fixture
def service(mapped_dir: Path, tmp_path: Path) -> Iterator[Service]:
    """A service, not started yet, on a copy of the mapped data directory."""
    service = Service(shutil.copytree(mapped_dir, tmp_path / "data"))
    try:
        yield service
        assert "Traceback" not in service.log_path.read_text()
    finally:
        service.kill()


def make_map(service: Service) -> None:
    file = service.data_dir.parent / "batch.npz"
    encodings = np.random.default_rng(0).normal(size=(200, 8)).astype(np.float32)
    np.savez(file, encodings=encodings, index=np.arange(200), position_m=np.arange(200.0))
    base = "/v1/admin/domains/loop"
    service.ask("PUT", base, {"evaluator": {"kind": "feature_l2", "extractor": "none"}, "closed": True})
    service.ask("POST", f"{base}/traverses", {"name": "t"})
    service.ask("POST", f"{base}/traverses/t/frames", file.read_bytes())
    config = {"training_traverse": "t", "landmark_traverse": "t", "n_landmarks": N_LANDMARKS, "training_episodes": 0}
    job = service.ask("POST", f"{base}/remaps", config)
    while job["state"] in {"queued", "running"}:
        time.sleep(0.02)
        job = service.ask("GET", f"/v1/admin/jobs/{job['job_id']}")
    assert job["state"] == "succeeded", job


@dataclass
class Robot:
    """Observes as fast as it is answered, on one connection, and remembers what it was told."""

    service: Service
    number: int
    session_id: str = ""
    n_told: int = 0
    belief: Any = None
    refusals: list[int] = field(default_factory=list)

    def begin(self) -> None:
        self.session_id = self.service.ask("POST", "/v1/domains/loop/sessions", {"seed": self.number})["session_id"]

    def until_refused(self) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", self.service.port, timeout=60)
        rng = np.random.default_rng(self.number)
        try:
            while True:
                body = json.dumps({"ranked_landmarks": rng.permutation(N_LANDMARKS).tolist()})
                path = f"/v1/sessions/{self.session_id}/observations?action_m=1"
                connection.request("POST", path, body, {"Content-Type": "application/json"})
                answer = connection.getresponse()
                content = answer.read()
                if answer.status != 200:
                    self.refusals.append(answer.status)
                    return
                document = json.loads(content)
                self.n_told, self.belief = document["n_observations"], document["belief"]
        except (OSError, http.client.HTTPException):
            return
        finally:
            connection.close()

    def check_nothing_is_lost(self) -> None:
        state = self.service.ask("GET", f"/v1/sessions/{self.session_id}")
        # A robot is answered before its connection closes: nothing is there that it was not told of.
        assert (state["n_observations"], state["belief"]) == (self.n_told, self.belief)


def test_what_was_acknowledged_is_there_afterwards(service: Service) -> None:
    service.start()
    robots = [Robot(service, number) for number in range(8)]
    for robot in robots:
        robot.begin()
    for signal_number, code in ENDS.items():
        threads = [threading.Thread(target=robot.until_refused) for robot in robots]
        n_before = sum(robot.n_told for robot in robots)
        for thread in threads:
            thread.start()
        wait_until(lambda n_least=n_before + 100: sum(robot.n_told for robot in robots) >= n_least)
        service.signal(signal_number)
        assert service.wait(60) == code
        for thread in threads:
            thread.join(60)
        service.start()
        for robot in robots:
            assert robot.refusals == []
            robot.check_nothing_is_lost()


def send_frame(service: Service, n_sent: int) -> socket.socket:
    """A request whose body has come in part."""
    body = json.dumps({"encoding": [1.0] * 8}).encode()
    connection = service.connect()
    head = "PUT /v1/admin/domains/loop/traverses/t/frames/7?position_m=7 HTTP/1.1\r\nHost: localhost\r\n"
    head += f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    connection.sendall(head.encode() + body[:n_sent])
    return connection


def read_all(connection: socket.socket) -> bytes:
    received = b""
    while piece := connection.recv(65536):
        received += piece
    return received


def is_stopping(service: Service) -> bool:
    try:
        with service.connect():
            return False
    except OSError:
        return True


def test_what_is_under_way_is_finished_and_what_is_idle_is_closed(service: Service) -> None:
    service.start()
    with (
        service.connect() as idle_connection,
        service.connect() as new_connection,
        send_frame(service, 5) as busy_connection,
    ):
        idle_connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        answer = b""
        while not answer.endswith(b'{"status":"alive"}'):
            answer += idle_connection.recv(65536)
        service.signal(signal.SIGTERM)
        assert idle_connection.recv(65536) == b""
        assert new_connection.recv(65536) == b""
        wait_until(lambda: is_stopping(service))
        busy_connection.sendall(json.dumps({"encoding": [1.0] * 8}).encode()[5:])
        answer = read_all(busy_connection)
        assert answer.startswith(b"HTTP/1.1 200 ")
    assert service.wait(60) == 0


def test_who_takes_too_long_is_told_so(service: Service) -> None:
    service.environment = {"DEEPSIMBAD_SHUTDOWN_GRACE_S": "1"}
    service.start()
    with send_frame(service, 5) as busy_connection:
        time.sleep(0.1)
        service.signal(signal.SIGTERM)
        head, _, content = read_all(busy_connection).partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 503 ")
        assert json.loads(content)["code"] == "unavailable"
    assert service.wait(60) == 0


def test_event_streams_end(service: Service) -> None:
    service.start()
    config = {"training_traverse": "t", "landmark_traverse": "t", "n_landmarks": N_LANDMARKS}
    job = service.ask("POST", "/v1/admin/domains/loop/remaps", config | {"training_episodes": 1_000_000})
    with service.connect() as stream:
        stream.sendall(f"GET /v1/admin/jobs/{job['job_id']}/events HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        received = b""
        while b"event: progress" not in received:
            received += stream.recv(65536)
        service.signal(signal.SIGTERM)
        assert read_all(stream).endswith(b"0\r\n\r\n")
    assert service.wait(60) == 0
    service.start()
    assert service.ask("GET", f"/v1/admin/jobs/{job['job_id']}")["state"] in {"queued", "running", "succeeded"}
    service.ask("DELETE", f"/v1/admin/jobs/{job['job_id']}")


def test_a_second_signal_does_not_wait(service: Service) -> None:
    service.environment = {"DEEPSIMBAD_SHUTDOWN_GRACE_S": "600"}
    service.start()
    robot = Robot(service, 1)
    robot.begin()
    for signal_number, code in ENDS.items():
        with send_frame(service, 5):
            time.sleep(0.1)
            service.signal(signal_number)
            wait_until(lambda: is_stopping(service))
            service.signal(signal_number)
            assert service.wait(60) == code
        service.start()
        assert service.ask("GET", f"/v1/sessions/{robot.session_id}")["n_observations"] == 0
