"""The service as a process on loopback: what an in-process transport cannot show."""

import http.client
import json
import signal
import socket
import threading
import time
from collections.abc import Iterator

import httpx2
import pytest

from .served import Served


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("wire")
    served = Served.start(folder / "data", folder / "log")
    try:
        httpx2.put(f"{served.url}/v1/admin/domains/d", json={"evaluator": {"kind": "feature_l2"}})
        httpx2.post(f"{served.url}/v1/admin/domains/d/traverses", json={"name": "t"})
        yield served
    finally:
        served.kill()


FRAME = "/v1/admin/domains/d/traverses/t/frames/0?position_m=0"
CHUNKED_FRAME = (
    f"PUT {FRAME} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: image/jpeg\r\nTransfer-Encoding: chunked\r\n\r\n"
).encode()


def send_until_answered(port: int, head: bytes, piece: bytes, n_pieces: int) -> tuple[bytes, int]:
    """Send a body piece by piece and stop at the first byte of an answer.

    Returns:
        The answer, and how many pieces had been sent when it began.
    """
    with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
        connection.sendall(head)
        began = threading.Event()
        answer = bytearray()

        def listen() -> None:
            try:
                while received := connection.recv(65536):
                    began.set()
                    answer.extend(received)
            except OSError:
                pass

        listener = threading.Thread(target=listen)
        listener.start()
        n_sent = 0
        try:
            while n_sent < n_pieces and not began.is_set():
                connection.sendall(piece)
                n_sent += 1
        except OSError:
            pass
        connection.shutdown(socket.SHUT_WR)
        listener.join(30)
        return bytes(answer), n_sent


def problem_of(answer: bytes) -> dict[str, object]:
    found: dict[str, object] = json.loads(answer.partition(b"\r\n\r\n")[2])
    return found


def test_a_hundred_megabytes_in_chunks_are_refused_while_they_stream(server: Served) -> None:
    server.forget_peak()
    before = server.resident_mib
    piece = b"10000\r\n" + bytes(65536) + b"\r\n"
    answer, n_sent = send_until_answered(server.port, CHUNKED_FRAME, piece, 1600)
    assert answer.startswith(b"HTTP/1.1 413 "), answer[:200]
    assert problem_of(answer)["code"] == "body_too_large"
    assert n_sent < 800  # 32 MiB are taken; what lies in the sockets' buffers comes on top
    assert server.peak_mib - before < 100


def test_a_declared_length_is_refused_before_a_byte_of_it(server: Served) -> None:
    head = (
        f"POST /v1/domains/d/localizations HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: image/jpeg\r\n"
        f"Content-Length: {100 * 1024 * 1024}\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as connection:
        connection.sendall(head.encode())
        assert connection.recv(65536).startswith(b"HTTP/1.1 413 ")


def test_a_sender_who_reads_only_after_its_last_byte_still_gets_the_answer(server: Served) -> None:
    server.forget_peak()
    before = server.resident_mib
    for content in (bytes(100 * 1024 * 1024), (bytes(65536) for _ in range(1600))):
        answer = httpx2.put(f"{server.url}{FRAME}", content=content, headers={"Content-Type": "image/jpeg"})
        assert (answer.status_code, answer.json()["code"]) == (413, "body_too_large")
    assert server.peak_mib - before < 100


def test_a_slow_drip_holds_nobody_up(server: Served) -> None:
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as drip:
        head = (
            f"PUT {FRAME} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: image/jpeg\r\nTransfer-Encoding: chunked\r\n\r\n"
        )
        drip.sendall(head.encode())
        for _ in range(20):
            drip.sendall(b"1\r\nx\r\n")
            began = time.monotonic()
            assert httpx2.get(f"{server.url}/healthz").status_code == 200
            assert time.monotonic() - began < 2
        drip.sendall(b"0\r\n\r\n")
        assert drip.recv(65536).startswith(b"HTTP/1.1 422 ")


def test_a_small_unread_body_leaves_the_connection_open(server: Served) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    for _ in range(3):
        connection.request("POST", "/v1/domains/none/localizations", b"x" * 5000, {"Content-Type": "text/plain"})
        answer = connection.getresponse()
        assert answer.status == 404
        answer.read()
        assert answer.headers.get("connection") is None
    connection.close()


def test_a_sender_who_leaves_early_is_no_fault_of_ours(server: Served) -> None:
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as connection:
        head = f"PUT {FRAME} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: image/jpeg\r\nContent-Length: 1000\r\n\r\nabc"
        connection.sendall(head.encode())
        time.sleep(0.2)
    time.sleep(0.3)
    assert httpx2.get(f"{server.url}/healthz").status_code == 200
    assert "Traceback" not in server.log.read_text()


def test_it_says_that_it_runs_open_and_ends_well_when_asked(server: Served) -> None:
    lines = [json.loads(line) for line in server.log.read_text().splitlines()]
    assert any(line["message"].startswith("runs open") and line["level"] == "WARNING" for line in lines)
    assert any(line["message"] == "request" and line["request_id"] for line in lines)
    server.process.send_signal(signal.SIGTERM)
    assert server.process.wait(15) == 0
