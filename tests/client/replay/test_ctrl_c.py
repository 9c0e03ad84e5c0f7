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
N_PRESSES = 20


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
        assert self._shows(words, PATIENCE_S), self.shown

    def press_ctrl_c(self, then: bytes | None) -> None:
        """Interrupt until the words stand on the screen, or, with None, until the command ends.

        Pressed in the instant before Python waits for input or for bytes, Ctrl-C is only seen when that wait ends: a
        person presses it again, and so does this.
        """
        for _ in range(N_PRESSES):
            os.write(self.own, CTRL_C)
            if self._shows(then, PATIENCE_S / N_PRESSES):
                return
        raise AssertionError(self.shown)

    def answer(self, keys: bytes) -> int:
        """Type what the command waits for; returns its exit code."""
        if keys == CTRL_C:
            self.press_ctrl_c(then=None)
        else:
            os.write(self.own, keys)
            assert self._shows(None, PATIENCE_S), self.shown
        return self.process.wait(PATIENCE_S)

    def _shows(self, words: bytes | None, within_s: float) -> bool:
        """Whether the words come to stand on the screen, or the command ends where there are none to wait for."""
        give_up = time.monotonic() + within_s
        while words is None or words not in self.shown:
            ready, _, _ = select.select([self.own], [], [], max(0.0, give_up - time.monotonic()))
            if not ready:
                return False
            more = self._read()
            if not more:
                return words is None
            self.shown += more
        return True

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
    window.press_ctrl_c(then=b"Cancel job 7 on the server too? [y/N]")
    assert window.answer(reply) == 130
    assert told in window.shown
    assert b"Traceback" not in window.shown
    assert endless.deleted == (["/v1/admin/jobs/7"] if is_cancelled else [])  # type: ignore[attr-defined]


def test_a_job_that_is_followed_later_is_asked_about_too(endless: ThreadingHTTPServer, terminal: Any) -> None:
    window = terminal("jobs", "7", "--follow")
    window.wait_for(b"train planner")
    window.press_ctrl_c(then=b"[y/N]")
    assert window.answer(b"y\n") == 130
    assert endless.deleted == ["/v1/admin/jobs/7"]  # type: ignore[attr-defined]


@pytest.mark.parametrize(("reply", "code", "n_deleted"), [(b"y\n", 0, 1), (b"n\n", 130, 0), (CTRL_C, 130, 0)])
def test_a_deletion_is_asked_about(
    endless: ThreadingHTTPServer, terminal: Any, reply: bytes, code: int, n_deleted: int
) -> None:
    window = terminal("delete-traverse", "d", "t")
    window.wait_for(b"Delete traverse t of domain d with its 12 frames? [y/N]")
    assert window.answer(reply) == code
    assert endless.deleted == ["/v1/admin/domains/d/traverses/t"] * n_deleted  # type: ignore[attr-defined]
