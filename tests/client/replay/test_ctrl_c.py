"""The command line on a real terminal: a pseudo-terminal, a process of its own, and Ctrl-C typed into it."""

import json
import os
import pty
import select
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

pytestmark = pytest.mark.slow

TRAVERSE = {"name": "t", "n_frames": 12}
JOB = {"job_id": "7", "domain": "d", "state": "running", "stage": "train_planner", "progress": 0.25}
CTRL_C = b"\x03"
TAKE_TERMINAL_AND_RUN = """
import fcntl, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
from deepsimbad_client.cli import main
main()
"""
PATIENCE_S = 60


class Endless(BaseHTTPRequestHandler):
    """A service whose one job never ends by itself; it notes what is deleted."""

    protocol_version = "HTTP/1.1"

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["content-length"]))
        self._answer(202, JOB)

    def do_GET(self) -> None:
        if not self.path.endswith("/events"):
            self._answer(200, TRAVERSE if "traverses" in self.path else JOB)
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(f"event: progress\ndata: {json.dumps(JOB)}\n\n".encode())
        self.wfile.flush()
        self.server.released.wait(PATIENCE_S)  # type: ignore[attr-defined]
        self.close_connection = True

    def do_DELETE(self) -> None:
        self.server.deleted.append(self.path)  # type: ignore[attr-defined]
        self.send_response(204)
        self.end_headers()

    def _answer(self, status: int, document: dict[str, Any]) -> None:
        body = json.dumps(document).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *words: Any) -> None:
        del words


@pytest.fixture
def endless() -> Iterator[ThreadingHTTPServer]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), Endless)
    server.deleted = []  # type: ignore[attr-defined]
    server.released = threading.Event()  # type: ignore[attr-defined]
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server
    server.released.set()  # type: ignore[attr-defined]
    server.shutdown()
    thread.join()
    server.server_close()


class Terminal:
    """A command on a pseudo-terminal that controls it, as a shell's window does."""

    def __init__(self, *command: str) -> None:
        self.own, theirs = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, "-c", TAKE_TERMINAL_AND_RUN, *command],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            env={**os.environ, "TERM": "xterm", "COLUMNS": "120"},
        )
        os.close(theirs)
        self.shown = b""

    def wait_for(self, words: bytes) -> None:
        """Read until the words stand on the screen."""
        give_up = time.monotonic() + PATIENCE_S
        while words not in self.shown:
            assert time.monotonic() < give_up, self.shown
            ready, _, _ = select.select([self.own], [], [], 1)
            if ready:
                self.shown += self._read()
            else:
                assert self.process.poll() is None, self.shown

    def type(self, keys: bytes) -> None:
        os.write(self.own, keys)

    def ends(self) -> int:
        """The exit code; what is still shown is read."""
        while more := self._read():
            self.shown += more
        return self.process.wait(PATIENCE_S)

    def _read(self) -> bytes:
        try:
            return os.read(self.own, 65536)
        except OSError:  # the other side is closed
            return b""

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self.own)


@pytest.fixture
def terminal(endless: ThreadingHTTPServer) -> Iterator[Any]:
    opened: list[Terminal] = []

    def command(*words: str) -> Terminal:
        opened.append(Terminal(*words, "--server", f"http://127.0.0.1:{endless.server_port}"))
        return opened[-1]

    yield command
    for each in opened:
        each.close()


@pytest.mark.parametrize(
    ("reply", "is_cancelled", "told"),
    [
        (b"y\n", True, b"job 7 is being cancelled"),
        (b"n\n", False, b"deepsimbad-client jobs 7 --follow"),
        (b"\n", False, b"deepsimbad-client jobs 7 --follow"),
        (CTRL_C, False, b"deepsimbad-client jobs 7 --follow"),
    ],
    ids=["yes", "no", "enter", "once more"],
)
def test_ctrl_c_asks_whether_to_cancel(
    endless: ThreadingHTTPServer, terminal: Any, reply: bytes, is_cancelled: bool, told: bytes
) -> None:
    window = terminal("remap", "--domain", "d", "--training", "t")
    window.wait_for(b"train planner")
    window.type(CTRL_C)
    window.wait_for(b"Cancel job 7 on the server too? [y/N]")
    window.type(reply)
    assert window.ends() == 130
    assert told in window.shown
    assert b"Traceback" not in window.shown
    assert endless.deleted == (["/v1/admin/jobs/7"] if is_cancelled else [])  # type: ignore[attr-defined]


def test_a_job_that_is_followed_later_is_asked_about_too(endless: ThreadingHTTPServer, terminal: Any) -> None:
    window = terminal("jobs", "7", "--follow")
    window.wait_for(b"train planner")
    window.type(CTRL_C)
    window.wait_for(b"[y/N]")
    window.type(b"y\n")
    assert window.ends() == 130
    assert endless.deleted == ["/v1/admin/jobs/7"]  # type: ignore[attr-defined]


@pytest.mark.parametrize(("reply", "code", "n_deleted"), [(b"y\n", 0, 1), (b"n\n", 130, 0), (CTRL_C, 130, 0)])
def test_a_deletion_is_asked_about(
    endless: ThreadingHTTPServer, terminal: Any, reply: bytes, code: int, n_deleted: int
) -> None:
    window = terminal("delete-traverse", "d", "t")
    window.wait_for(b"Delete traverse t of domain d with its 12 frames? [y/N]")
    window.type(reply)
    assert window.ends() == code
    assert endless.deleted == ["/v1/admin/domains/d/traverses/t"] * n_deleted  # type: ignore[attr-defined]
