"""`deepsimbad serve` as a process of its own, requests to it, a robot that uses it all along, and what it costs."""

import contextlib
import http.client
import json
import socket
import sys
import threading
import time
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from deepsimbad_client.http.local_server import LocalServer

from .conftest import IS_FLEET, Caller, wait_until


class ServerProcess(LocalServer):
    """The process, and `client`, who asks it while it is up.

    A `program`, run in place of the command, gets the data directory first and the port last.
    """

    def __init__(self, data_dir, program=None, **settings):
        variables = {f"DEEPSIMBAD_{name.upper()}": str(value) for name, value in settings.items()}
        super().__init__(data_dir, data_dir.parent / "log", variables)
        if program is not None:
            self.command = [sys.executable, "-c", program, str(data_dir)]
        elif IS_FLEET:
            options = ["--replicas", "2", "--data-dir", str(data_dir), "--map-store", f"file://{data_dir}-store"]
            self.command = [sys.executable, "-m", "deepsimbad", "ray", "serve", *options]
        self.client = self._caller()

    def _caller(self):
        return Caller(base_url=self.url, timeout=120, trust_env=False)

    def start(self):
        self.client.close()  # and with it connections to the process that was
        self.client = self._caller()
        super().start()

    def kill(self):
        super().kill()
        self.client.close()

    def connect(self):
        return socket.create_connection(("127.0.0.1", self.port), timeout=120)

    def tell(self, message):
        """Send bytes on a new connection; returns all that comes until it is closed."""
        received = bytearray()
        with self.connect() as connection:
            with contextlib.suppress(OSError):  # refused while it was sent
                connection.sendall(message)
            with contextlib.suppress(ConnectionError):
                while piece := connection.recv(65536):
                    received += piece
        return bytes(received)

    @cached_property
    def answering(self):
        """The processes that answer: this one, or those of the fleet that it began."""
        if not IS_FLEET:
            return [self.pid]
        parents, replica_pids = {}, []
        for process in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                parents[int(process.name)] = process_number(process, "PPid")
                if (process / "cmdline").read_bytes().startswith(b"ray::ServeReplica:"):
                    replica_pids.append(int(process.name))

        def is_ours(pid):
            while pid not in {0, self.pid}:
                pid = parents.get(pid, 0)
            return pid == self.pid

        return [pid for pid in replica_pids if is_ours(pid)]

    def forget_peak(self):
        """Set the peak of memory to what is held now."""
        for pid in self.answering:
            Path(f"/proc/{pid}/clear_refs").write_text("5")

    def mib(self, name="VmRSS"):
        """Memory held now by each process that answers; `VmHWM`: its peak."""
        return np.array([process_number(Path(f"/proc/{pid}"), name) for pid in self.answering]) / 1024

    @contextlib.contextmanager
    def limited(self, most_mib):
        """Check that inside the block no process ever holds `most_mib` more memory than before it."""
        self.forget_peak()
        before_mib = self.mib()
        yield
        assert max(self.mib("VmHWM") - before_mib) < most_mib

    @property
    def n_sockets(self):
        """Open sockets: connections, and the few of its own."""
        n_open = 0
        for pid in self.answering:
            for descriptor in Path(f"/proc/{pid}/fd").iterdir():
                with contextlib.suppress(FileNotFoundError):
                    n_open += str(descriptor.readlink()).startswith("socket:")
        return n_open


def process_number(process, name):
    """A number by its name in a process's status file."""
    for line in (process / "status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1])
    raise AssertionError(f"no {name}")


@dataclass
class Robot:
    """Localizes and observes all along on a connection of its own, and notes what went wrong."""

    server: ServerProcess
    n_answered: int = 0
    faults: list[str] = field(default_factory=list)
    stopped: threading.Event = field(default_factory=threading.Event)
    turn: threading.Lock = field(default_factory=threading.Lock)  # held by whoever wants it to ask nothing

    def drive(self):
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=120)

        def ask(path, body):
            connection.request("POST", path, json.dumps(body), {"Content-Type": "application/json"})
            answer = connection.getresponse()
            content = answer.read()
            if answer.status >= 300:
                self.faults.append(f"{answer.status} {content!r}")
            return json.loads(content)

        try:
            session_id = ask("/v1/domains/ready/sessions", {})["session_id"]
            while not self.stopped.is_set():
                with self.turn:
                    ask("/v1/domains/ready/localizations", {"ranked_landmarks": [3, 1, 2]})
                    ask(f"/v1/sessions/{session_id}/observations", {"ranked_landmarks": [1, 2]})
                self.n_answered += 2
                time.sleep(0.02)  # others need the processor too
        except Exception as error:
            self.faults.append(repr(error))
        finally:
            connection.close()

    def answered_more(self, n_more):
        """Wait until `n_more` requests more were answered."""
        n_wanted = self.n_answered + n_more
        wait_until(lambda: self.faults or self.n_answered >= n_wanted)
        assert self.faults == [], self.faults
