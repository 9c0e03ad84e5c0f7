"""A service that is asked to stop finishes what it has begun, keeps what it acknowledged, and ends."""

import json
import os
import shutil
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

from ..contract.conftest import N_LANDMARKS, Caller, service, wait_until
from ..contract.server_process import ServerProcess

pytestmark = pytest.mark.slow

ENDS = {signal.SIGTERM: 0, signal.SIGINT: 130}  # exit code by the signal that asked


@pytest.fixture(scope="module")
def mapped_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data directory with a map; never touched."""
    data_dir = tmp_path_factory.mktemp("mapped") / "data"
    with service(data_dir) as client:
        client.make_ready_domain("loop", closed=True)
    return data_dir


@pytest.fixture
def server(mapped_dir: Path, tmp_path: Path) -> Iterator[ServerProcess]:
    """A service, not started yet, on a copy of the mapped data directory."""
    server = ServerProcess(shutil.copytree(mapped_dir, tmp_path / "data"))
    try:
        yield server
        assert "Traceback" not in server.log_path.read_text()
    finally:
        server.stop()


def end(server: ServerProcess, number: int = signal.SIGTERM) -> None:
    os.kill(server.pid, number)


@dataclass
class Robot:
    """Observes as fast as it is answered, on one connection, and remembers what it was told."""

    server: ServerProcess
    number: int
    n_told: int = 0
    belief: Any = None
    refusals: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.path = self.server.client.session("loop", seed=self.number)

    def until_refused(self) -> None:
        rng = np.random.default_rng(self.number)
        with Caller(base_url=self.server.url, timeout=60) as client, suppress(httpx2.TransportError):
            while True:
                ranks = {"ranked_landmarks": rng.permutation(N_LANDMARKS).tolist()}
                answer = client.post(f"{self.path}/observations?action_m=1", json=ranks)
                if answer.status_code != 200:
                    self.refusals.append(answer.status_code)
                    return
                document = answer.json()
                self.n_told, self.belief = document["n_observations"], document["belief"]

    def check_nothing_is_lost(self) -> None:
        state = self.server.client.get(self.path).json()
        # A robot is answered before its connection closes: nothing is there that it was not told of.
        assert (state["n_observations"], state["belief"]) == (self.n_told, self.belief)


def test_what_was_acknowledged_is_there_afterwards(server: ServerProcess) -> None:
    server.start()
    robots = [Robot(server, number) for number in range(8)]
    for signal_number, code in ENDS.items():
        threads = [threading.Thread(target=robot.until_refused) for robot in robots]
        n_before = sum(robot.n_told for robot in robots)
        for thread in threads:
            thread.start()
        wait_until(lambda n_least=n_before + 100: sum(robot.n_told for robot in robots) >= n_least)
        end(server, signal_number)
        assert server.wait(60) == code
        for thread in threads:
            thread.join(60)
        server.start()
        for robot in robots:
            assert robot.refusals == []
            robot.check_nothing_is_lost()


def send_frame(server: ServerProcess, n_sent: int) -> socket.socket:
    """A request that is under way, whose body has come in part."""
    body = json.dumps({"encoding": [1.0] * 8}).encode()
    connection = server.connect()
    head = "PUT /v1/admin/domains/loop/traverses/drive/frames/7?position_m=7 HTTP/1.1\r\nHost: localhost\r\n"
    head += f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    connection.sendall(head.encode() + body[:n_sent])
    wait_until(lambda: "deepsimbad_requests_in_flight 2.0" in server.client.get("/metrics").text)  # with this one
    return connection


def read_all(connection: socket.socket) -> bytes:
    received = b""
    while piece := connection.recv(65536):
        received += piece
    return received


def is_stopping(server: ServerProcess) -> bool:
    try:
        with server.connect():
            return False
    except OSError:
        return True


def test_what_is_under_way_is_finished_and_what_is_idle_is_closed(server: ServerProcess) -> None:
    server.environment = {"DEEPSIMBAD_SHUTDOWN_GRACE_S": "600"}
    server.start()
    with (
        server.connect() as idle_connection,
        server.connect() as new_connection,
        send_frame(server, 5) as busy_connection,
    ):
        idle_connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        answer = b""
        while not answer.endswith(b'{"status":"alive"}'):
            answer += idle_connection.recv(65536)
        end(server)
        assert idle_connection.recv(65536) == b""
        assert new_connection.recv(65536) == b""
        wait_until(lambda: is_stopping(server))
        busy_connection.sendall(json.dumps({"encoding": [1.0] * 8}).encode()[5:])
        answer = read_all(busy_connection)
        assert answer.startswith(b"HTTP/1.1 200 ")
    assert server.wait(60) == 0


def test_who_takes_too_long_is_told_so(server: ServerProcess) -> None:
    server.environment = {"DEEPSIMBAD_SHUTDOWN_GRACE_S": "1"}
    server.start()
    with send_frame(server, 5) as busy_connection:
        end(server)
        head, _, content = read_all(busy_connection).partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 503 ")
        assert json.loads(content)["code"] == "unavailable"
    assert server.wait(60) == 0


def test_event_streams_end(server: ServerProcess) -> None:
    server.start()
    config = {"training_traverse": "drive", "landmark_traverse": "drive", "training_episodes": 1_000_000}
    answer = server.client.post("/v1/admin/domains/loop/remaps", json=config | {"n_landmarks": N_LANDMARKS})
    job = answer.headers["location"]
    with server.connect() as stream:
        stream.sendall(f"GET {job}/events HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        received = b""
        while b"event: progress" not in received:
            received += stream.recv(65536)
        end(server)
        assert read_all(stream).endswith(b"0\r\n\r\n")
    assert server.wait(60) == 0
    server.start()
    assert server.client.get(job).json()["state"] in {"queued", "running", "succeeded"}
    server.client.delete(job)


def test_a_second_signal_does_not_wait(server: ServerProcess) -> None:
    server.environment = {"DEEPSIMBAD_SHUTDOWN_GRACE_S": "600"}
    server.start()
    robot = Robot(server, 1)
    for signal_number, code in ENDS.items():
        with send_frame(server, 5):
            end(server, signal_number)
            wait_until(lambda: is_stopping(server))
            end(server, signal_number)
            assert server.wait(60) == code
        server.start()
        assert server.client.get(robot.path).json()["n_observations"] == 0
