"""The command line on a real terminal: a pseudo-terminal, a process of its own, and Ctrl-C typed into it."""

import json
import os
import pty
import select
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, closing
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
PATIENCE_S, N_PRESSES = 60, 20


class Endless(BaseHTTPRequestHandler):
    """A service whose one job never ends by itself; it notes what is deleted."""

    protocol_version = "HTTP/1.1"
    deleted: list[str]
    released: threading.Event

    def do_POST(self):
        self.rfile.read(int(self.headers["content-length"]))
        self._answer(202, JOB)

    def do_GET(self):
        if not self.path.endswith("/events"):
            self._answer(200, TRAVERSE if "traverses" in self.path else JOB)
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(f"event: progress\ndata: {json.dumps(JOB)}\n\n".encode())
        self.wfile.flush()
        self.released.wait(PATIENCE_S)
        self.close_connection = True

    def do_DELETE(self):
        self.deleted.append(self.path)
        self.send_response(204)
        self.end_headers()

    def _answer(self, status, document):
        body = json.dumps(document).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *words):
        del words


@pytest.fixture
def endless():
    handler: Any = type("Handler", (Endless,), {"deleted": [], "released": threading.Event()})
    server: Any = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.deleted = handler.deleted
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server
    handler.released.set()
    server.shutdown()
    thread.join()
    server.server_close()


class Terminal:
    """A command on a pseudo-terminal that controls it, as a shell's window does."""

    def __init__(self, *command):
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

    def shows(self, words, within_s=PATIENCE_S):
        """Whether the words come to stand on the screen, or the command ends where there are none to wait for."""
        give_up = time.monotonic() + within_s
        while words is None or words not in self.shown:
            if not select.select([self.own], [], [], max(0.0, give_up - time.monotonic()))[0]:
                return False
            try:
                self.shown += (more := os.read(self.own, 65536))
            except OSError:  # the other side is closed
                more = b""
            if not more:
                return words is None
        return True

    def press_ctrl_c(self, then):
        """Interrupt until the words stand on the screen, or, with None, until the command ends.

        Pressed in the instant before Python waits for input or for bytes, Ctrl-C is only seen when that wait ends: a
        person presses it again, and so does this.
        """
        for _ in range(N_PRESSES):
            os.write(self.own, CTRL_C)
            if self.shows(then, PATIENCE_S / N_PRESSES):
                return
        raise AssertionError(self.shown)

    def answer(self, keys):
        """Type what the command waits for; returns its exit code."""
        if keys == CTRL_C:
            self.press_ctrl_c(then=None)
        else:
            os.write(self.own, keys)
            assert self.shows(None), self.shown
        return self.process.wait(PATIENCE_S)

    def close(self):
        self.process.kill()
        self.process.wait()
        os.close(self.own)


@pytest.fixture
def terminal(endless):
    with ExitStack() as opened:
        address = f"http://127.0.0.1:{endless.server_port}"
        yield lambda *words: opened.enter_context(closing(Terminal(*words, "--server", address)))


REMAPPED = ("remap", "--domain", "d", "--training", "t")


@pytest.mark.parametrize(
    ("command", "reply", "is_cancelled"),
    [(REMAPPED, b"n\n", False), (("jobs", "7", "--follow"), b"y\n", True), (REMAPPED, CTRL_C, False)],
    ids=["no", "yes", "once more"],
)
def test_ctrl_c_asks_whether_to_cancel(endless, terminal, command, reply, is_cancelled):
    window = terminal(*command)
    assert window.shows(b"train planner"), window.shown
    window.press_ctrl_c(then=b"Cancel job 7 on the server too? [y/N]")
    assert window.answer(reply) == 130
    assert (b"job 7 is being cancelled" if is_cancelled else b"deepsimbad-client jobs 7 --follow") in window.shown
    assert b"Traceback" not in window.shown
    assert endless.deleted == ["/v1/admin/jobs/7"] * is_cancelled


@pytest.mark.parametrize(("reply", "code", "n_deleted"), [(b"y\n", 0, 1), (b"\n", 130, 0), (CTRL_C, 130, 0)])
def test_a_deletion_is_asked_about(endless, terminal, reply, code, n_deleted):
    window = terminal("delete-traverse", "d", "t")
    assert window.shows(b"Delete traverse t of domain d with its 12 frames? [y/N]"), window.shown
    assert window.answer(reply) == code
    assert endless.deleted == ["/v1/admin/domains/d/traverses/t"] * n_deleted
