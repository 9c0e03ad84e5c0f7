"""The service as a process on loopback: what an in-process transport cannot show."""

import http.client
import json
import os
import signal

import pytest

from .conftest import JPEG, TAKES_IMAGES, of_one_process, problem, wait_until
from .server_process import ServerProcess

MEBIBYTE = 1024 * 1024
FRAME = "/v1/admin/domains/d/traverses/t/frames/0?position_m=0"
HEAD = f"PUT {FRAME} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: image/jpeg\r\n".encode()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with ServerProcess(tmp_path_factory.mktemp("wire") / "data") as process:
        process.client.make_domain("d", **TAKES_IMAGES)
        process.client.post("/v1/admin/domains/d/traverses", json={"name": "t"})
        yield process


def test_a_declared_length_is_refused_before_a_byte_of_it(server):
    with server.connect() as connection:
        connection.sendall(HEAD + b"Content-Length: %d\r\n\r\n" % (100 * MEBIBYTE))
        assert connection.recv(65536).startswith(b"HTTP/1.1 413 ")


def test_a_sender_who_reads_only_after_its_last_byte_still_gets_the_answer(server):
    with server.limited(100):
        for content in (bytes(100 * MEBIBYTE), (bytes(65536) for _ in range(1600))):
            problem(server.client.put(FRAME, content=content, headers=JPEG), 413, "body_too_large")


def test_a_small_unread_body_leaves_the_connection_open(server):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    for _ in range(3):
        connection.request("POST", "/v1/domains/none/localizations", b"x" * 5000, {"Content-Type": "text/plain"})
        answer = connection.getresponse()
        assert answer.status == 404
        answer.read()
        assert answer.headers.get("connection") is None
    connection.close()


def test_a_head_is_answered_and_leaves_no_error_in_the_log(server):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    for path in ("/v1/domains", "/", "/docs/start.js", "/v1/admin/domains/d/traverses/t/frames", "/readyz"):
        connection.request("HEAD", path)
        answer = connection.getresponse()
        assert (answer.status, answer.read()) == (200, b"")
    connection.close()
    assert '"ERROR"' not in server.log_path.read_text()


@of_one_process  # whose log it reads
def test_a_sender_who_leaves_early_is_no_fault_of_ours_and_it_ends_well_when_asked(server):
    with server.connect() as connection:
        connection.sendall(HEAD + b"X-Request-ID: left\r\nContent-Length: 1000\r\n\r\nabc")
    wait_until(lambda: '"left"' in server.log_path.read_text())
    lines = [json.loads(line) for line in server.log_path.read_text().splitlines()]
    assert not [line for line in lines if "exception" in line]
    assert [line["status"] for line in lines if line.get("request_id") == "left"] == [499]
    assert any(line["message"].startswith("runs open") and line["level"] == "WARNING" for line in lines)
    os.kill(server.pid, signal.SIGTERM)
    assert server.wait(60) == 0
