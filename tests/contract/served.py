"""`deepsimbad serve` as a process of its own, a robot that uses it all along, and what it costs in memory."""

import contextlib
import http.client
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2

from .conftest import NPZ, npz, ready_encodings


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@dataclass
class Served:
    """The process."""

    process: subprocess.Popen[bytes]
    port: int
    log: Path

    @classmethod
    def start(cls, data_dir: Path, log: Path, **settings: object) -> "Served":
        """Start it and wait until it is ready."""
        port = free_port()
        command = [sys.executable, "-m", "deepsimbad", "serve", "--create", "--port", str(port)]
        command += ["--data-dir", str(data_dir)]
        given = {f"DEEPSIMBAD_{name.upper()}": str(value) for name, value in settings.items()}
        with log.open("ab") as stderr:
            process = subprocess.Popen(command, stderr=stderr, env={**os.environ, **given}, cwd=log.parent)
        served = cls(process, port, log)
        try:
            served.wait_until_ready()
        except BaseException:
            served.kill()
            raise
        return served

    def wait_until_ready(self) -> None:
        for _ in range(1200):
            assert self.process.poll() is None, self.log.read_text()
            try:
                if httpx2.get(f"{self.url}/readyz").status_code == 200:
                    return
            except httpx2.TransportError:
                time.sleep(0.05)
        raise AssertionError("it did not become ready")

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=30)

    def tell(self, *pieces: bytes) -> bytes:
        """Send bytes on a new connection; returns all that comes until it is closed."""
        with self.connect() as connection:
            for piece in pieces:
                try:
                    connection.sendall(piece)
                except OSError:  # refused while it was sent
                    break
            received = bytearray()
            try:
                while more := connection.recv(65536):
                    received += more
            except ConnectionError:
                pass
            return bytes(received)

    def forget_peak(self) -> None:
        """Let the peak of memory be what it is now."""
        Path(f"/proc/{self.process.pid}/clear_refs").write_text("5")

    @property
    def peak_mib(self) -> float:
        return self._status_mib("VmHWM")

    @property
    def resident_mib(self) -> float:
        return self._status_mib("VmRSS")

    def _status_mib(self, name: str) -> float:
        for line in Path(f"/proc/{self.process.pid}/status").read_text().splitlines():
            if line.startswith(f"{name}:"):
                return int(line.split()[1]) / 1024
        raise AssertionError(f"no {name}")

    @property
    def n_sockets(self) -> int:
        """Open sockets: connections, and the few of its own."""
        found = 0
        for descriptor in Path(f"/proc/{self.process.pid}/fd").iterdir():
            with contextlib.suppress(FileNotFoundError):
                found += str(descriptor.readlink()).startswith("socket:")
        return found


def make_ready_domain(url: str, name: str) -> None:
    """A domain that takes ready encodings, mapped."""
    with httpx2.Client(base_url=url, timeout=60) as client:
        config = {"evaluator": {"kind": "feature_l2", "extractor": "none"}}
        client.put(f"/v1/admin/domains/{name}", json=config).raise_for_status()
        client.post(f"/v1/admin/domains/{name}/traverses", json={"name": "drive"}).raise_for_status()
        encodings = ready_encodings()
        index = list(range(len(encodings)))
        batch = npz(encodings=encodings, index=index, position_m=[2.0 * place for place in index])
        stored = client.post(f"/v1/admin/domains/{name}/traverses/drive/frames", content=batch, headers=NPZ)
        stored.raise_for_status()
        job = client.post(
            f"/v1/admin/domains/{name}/remaps",
            json={"training_traverse": "drive", "landmark_traverse": "drive", "n_landmarks": 10},
        ).json()
        while job["state"] in {"queued", "running"}:
            time.sleep(0.05)
            job = client.get(f"/v1/admin/jobs/{job['job_id']}").json()
        assert job["state"] == "succeeded", job


@dataclass
class Robot:
    """Localizes and observes without a pause on connections of its own, and counts what went wrong."""

    served: Served
    n_answered: int = 0
    faults: list[str] = field(default_factory=list)
    stopped: threading.Event = field(default_factory=threading.Event)
    may_go: threading.Event = field(default_factory=threading.Event)
    is_waiting: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self.may_go.set()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """It asks nothing inside the block."""
        self.is_waiting.clear()
        self.may_go.clear()
        assert self.is_waiting.wait(30)
        yield
        self.may_go.set()

    def drive(self) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", self.served.port, timeout=30)

        def ask(path: str, body: dict[str, Any]) -> dict[str, Any]:
            connection.request("POST", path, json.dumps(body), {"Content-Type": "application/json"})
            answer = connection.getresponse()
            content = answer.read()
            if answer.status >= 300:
                self.faults.append(f"{answer.status} {content!r}")
            found: dict[str, Any] = json.loads(content)
            return found

        try:
            session_id = ask("/v1/domains/ready/sessions", {})["session_id"]
            while not self.stopped.is_set():
                if not self.may_go.is_set():
                    self.is_waiting.set()
                    assert self.may_go.wait(120)
                ask("/v1/domains/ready/localizations", {"ranked_landmarks": [3, 1, 2]})
                ask(f"/v1/sessions/{session_id}/observations", {"ranked_landmarks": [1, 2]})
                self.n_answered += 2
                time.sleep(0.002)
        except Exception as error:
            self.faults.append(repr(error))
        finally:
            connection.close()

    def answered_more(self, n_more: int) -> None:
        """Wait until so many more were answered."""
        until(lambda target=self.n_answered + n_more: self.faults or self.n_answered >= target)
        assert self.faults == [], self.faults


def until(met: Callable[[], Any]) -> None:
    for _ in range(3000):
        if met():
            return
        time.sleep(0.01)
    raise AssertionError("it did not come about")
