"""The proxy's configuration, run by the real proxy before a real service where its binary is at hand."""

import shutil
import socket
import subprocess
import time
from pathlib import Path

import httpx2
import pytest

from deepsimbad_client.http.local_server import LocalServer

CADDYFILE = Path(__file__).resolve().parents[2] / "deploy" / "Caddyfile"
CADDY = shutil.which("caddy")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CADDY is None, reason="caddy is not installed: its file is not tried"),
]


@pytest.fixture(scope="module")
def port(tmp_path_factory):
    """Of the proxy, whose patience is cut to seconds."""
    folder = tmp_path_factory.mktemp("proxy")
    text = CADDYFILE.read_text()
    for patience, seconds in (("read_header 10s", "read_header 1s"), ("read_body 15m", "read_body 2s")):
        assert text.count(patience) == 1
        text = text.replace(patience, seconds)
    (folder / "Caddyfile").write_text(text)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with LocalServer(folder / "data") as server, (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            [str(CADDY), "run", "--adapter", "caddyfile", "--config", folder / "Caddyfile"],
            env={
                "HOME": str(folder),
                "DEEPSIMBAD_SITE": f"http://127.0.0.1:{port}",
                "DEEPSIMBAD_UPSTREAM": server.url.removeprefix("http://"),
            },
            stderr=log,
        )
        try:
            for _ in range(600):
                assert process.poll() is None, (folder / "log").read_text()
                try:
                    if httpx2.get(f"http://127.0.0.1:{port}/readyz").status_code == 200:
                        break
                except httpx2.TransportError:
                    time.sleep(0.05)
            yield port
        finally:
            process.terminate()
            process.wait(120)


def received(port, *pieces):
    """What comes until the connection is closed."""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
        try:
            for piece in pieces:
                connection.sendall(piece)
        except OSError:  # refused while it was sent
            pass
        answer = b""
        try:
            while part := connection.recv(65536):
                answer += part
        except ConnectionError:
            pass
        return answer


def head(port, line, *headers):
    return "\r\n".join([f"{line} HTTP/1.1", f"Host: 127.0.0.1:{port}", *headers, "", ""]).encode()


def test_the_configuration_is_valid_and_written_as_its_tool_writes_it():
    for arguments in (("validate", "--adapter", "caddyfile", "--config", CADDYFILE), ("fmt", CADDYFILE)):
        process = subprocess.run([str(CADDY), *arguments], capture_output=True, text=True, check=False)
        assert process.returncode == 0, process.stderr
    assert process.stdout == CADDYFILE.read_text()


def test_what_the_service_answers_passes_through(port):
    with httpx2.Client(base_url=f"http://127.0.0.1:{port}") as client:
        answer = client.get("/v1/domains", headers={"X-Request-ID": "mine"})
        assert (answer.status_code, answer.headers["x-request-id"]) == (200, "mine")
        problem = client.get("/v1/domains/unknown")
        assert (problem.status_code, problem.headers["content-type"]) == (404, "application/problem+json")
        assert client.get("/metrics").status_code == 404
        created = client.put("/v1/admin/domains/d", json={"evaluator": {"kind": "feature_l2", "extractor": "none"}})
        assert created.status_code == 201
        large = client.put(
            "/v1/admin/domains/d", content=bytes(5_000_000), headers={"Content-Type": "application/json"}
        )
        assert (large.status_code, large.json()["code"]) == (413, "body_too_large")


@pytest.mark.parametrize(
    "head_start",
    [b"", b"GET / HTTP/1.1\r\n", b"GET / HTTP/1.1\r\nHost: x\r\nA: b\r\n"],
    ids=["silent", "line", "header"],
)
def test_a_head_that_never_ends_is_ended(port, head_start):
    start_s = time.monotonic()
    assert b"200 OK" not in received(port, head_start)
    assert time.monotonic() - start_s < 30


def test_a_body_that_never_ends_is_ended(port):
    path = "POST /v1/domains/d/localizations"
    answer = received(port, head(port, path, "Content-Type: application/json", "Content-Length: 1000") + b"{")
    assert not answer.startswith(b"HTTP/1.1 2")


def test_a_body_that_is_too_long_is_ended_however_it_comes(port):
    request_head = head(port, "PUT /v1/admin/domains/d", "Content-Type: image/png", "Transfer-Encoding: chunked")
    answer = received(port, request_head, *[b"100000\r\n" + bytes(1 << 20) + b"\r\n"] * 40)
    assert not answer.startswith(b"HTTP/1.1 2")


def test_a_head_that_is_too_long_is_refused(port):
    assert received(port, head(port, "GET /v1/domains", "A: " + "a" * 200_000)).startswith(b"HTTP/1.1 431 ")
