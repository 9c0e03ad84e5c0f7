"""One connection's limits on time and bytes, over real sockets: a changed uvicorn would show here."""

import asyncio
import contextlib
import json
import re
import socket
import ssl
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from deepsimbad.api import protocol
from deepsimbad.api.envelope import SECURITY_HEADERS
from deepsimbad.api.protocol import LINGER_BYTES, MAX_HEADERS, MAX_PIPELINED, WireLimits, protocol_class
from deepsimbad.api.tls import tls_context

HEADER_S, STALL_S, MAX_HEADER_BYTES, MAX_CONNECTIONS = 0.4, 0.5, 4096, 20
BIG_BYTES = 60_000_000
LOOP_TICK_S = 0.005  # uvloop's clock goes by milliseconds, and which of two in one was first is anyone's guess
TLS = Path(__file__).parent / "tls"
GET = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"


@dataclass
class Application:
    """Answers with what it was sent, and remembers what became of its requests."""

    ended: Counter[str] = field(default_factory=Counter)
    headers: list[dict[bytes, bytes]] = field(default_factory=list)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        scope["state"]["request_id"] = "from-the-application"
        path = scope["path"]
        if path == "/forgetful":  # answers at once, whatever still comes
            await self.answer(send, b"early")
            return
        if path == "/patient":  # reads late
            await asyncio.sleep(3 * STALL_S)
        if path == "/soon":
            await asyncio.sleep(0.1)
        body = b""
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                self.ended[f"{path} left"] += 1
                return
            body += message["body"]
            if not message["more_body"]:
                break
        self.headers.append(dict(scope["headers"]))
        if path == "/stream":
            await self.stream(receive, send)
        elif path == "/big":
            await self.answer(send, bytes(BIG_BYTES))
        else:
            await self.answer(send, f"{scope['method']} {path} {len(body)}".encode())
        self.ended[path] += 1

    async def answer(self, send: Send, body: bytes) -> None:
        headers = [(b"content-length", str(len(body)).encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": body})

    async def stream(self, receive: Receive, send: Send) -> None:
        """As server-sent events do, until the peer leaves."""
        await send({"type": "http.response.start", "status": 200, "headers": []})
        left = asyncio.ensure_future(receive())
        while not left.done():
            await send({"type": "http.response.body", "body": b"x", "more_body": True})
            await asyncio.sleep(0.02)
        self.ended["/stream left"] += 1


@dataclass
class Service:
    port: int
    application: Application
    refused: Counter[str]
    tls: ssl.SSLContext | None

    def connect(self, receive_buffer: int | None = None) -> socket.socket:
        connection = socket.socket()
        if receive_buffer is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        connection.settimeout(20)
        connection.connect(("127.0.0.1", self.port))
        if self.tls is not None:
            return self.tls.wrap_socket(connection, server_hostname="localhost")
        return connection

    def tell(self, *pieces: bytes, every_s: float = 0.0) -> bytes:
        """Send pieces; returns everything that comes until the service closes."""
        with self.connect() as connection:
            for piece in pieces:
                connection.sendall(piece)
                time.sleep(every_s)
            return read_all(connection)


@pytest.fixture(scope="module", params=["http", pytest.param("https", marks=pytest.mark.slow)])
def service(request: pytest.FixtureRequest) -> Iterator[Service]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(protocol, "LINGER_S", 0.3)
        yield from served(request.param == "https")


def served(is_tls: bool) -> Iterator[Service]:
    context, tls = None, None
    if is_tls:
        context = tls_context(TLS / "certificate.pem", TLS / "key.pem")
        tls = ssl.create_default_context(cafile=TLS / "certificate.pem")
    application, refused = Application(), Counter[str]()
    limits = WireLimits(HEADER_S, STALL_S, MAX_HEADER_BYTES, MAX_CONNECTIONS, lambda code: refused.update([code]))
    listening = socket.create_server(("127.0.0.1", 0))
    config = uvicorn.Config(
        application,
        http=protocol_class(limits),
        ws="none",
        log_config=None,
        lifespan="off",
        timeout_keep_alive=30,
        ssl_context_factory=None if context is None else lambda *_: context,
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    yield Service(listening.getsockname()[1], application, refused, tls)
    server.should_exit = True
    thread.join(20)
    assert not thread.is_alive()
    listening.close()


def read_all(connection: socket.socket) -> bytes:
    received = bytearray()
    while piece := connection.recv(65536):
        received += piece
    return bytes(received)


def read_one(connection: socket.socket) -> bytes:
    """One answer of known length, its head and body."""
    received = b""
    while b"\r\n\r\n" not in received:
        received += connection.recv(65536)
    head, _, body = received.partition(b"\r\n\r\n")
    found = re.search(rb"content-length: (\d+)", head.lower())
    assert found is not None, head
    while len(body) < int(found[1]):
        body += connection.recv(65536)
    return head + b"\r\n\r\n" + body


def split(answers: bytes) -> list[bytes]:
    return [b"HTTP/1.1 " + one for one in answers.split(b"HTTP/1.1 ")[1:]]


def check(answer: bytes, status: int, code: str) -> dict[str, Any]:
    """One problem document, as the routes give it; the connection was closed after it."""
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(f"HTTP/1.1 {status} ".encode()), answer[:300]
    headers = dict(line.split(b": ", 1) for line in head.split(b"\r\n")[1:])
    assert headers[b"content-type"] == b"application/problem+json"
    assert headers[b"connection"] == b"close"
    assert int(headers[b"content-length"]) == len(body)
    assert set(SECURITY_HEADERS) <= set(headers.items())
    problem: dict[str, Any] = json.loads(body)
    assert {"type", "title", "status", "detail", "instance", "code", "request_id"} <= set(problem)
    assert (problem["status"], problem["code"]) == (status, code)
    assert problem["request_id"].encode() == headers[b"x-request-id"]
    return problem


def until(met: Any) -> None:
    for _ in range(1000):
        if met():
            return
        time.sleep(0.01)
    raise AssertionError("it did not come about")


# Headers in time


def test_headers_that_never_end(service: Service) -> None:
    before = service.refused["request_timeout"]
    problem = check(service.tell(b"GET / HTTP/1.1\r\nX-Request-ID: mine\r\nA: b\r\n"), 408, "request_timeout")
    assert problem["request_id"] == "mine"
    assert service.refused["request_timeout"] == before + 1


def test_headers_that_drip_have_no_more_time(service: Service) -> None:
    with service.connect() as connection:
        answer = b""
        connection.settimeout(0.05)
        for byte in b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 1000:
            connection.sendall(bytes([byte]))
            try:
                answer = connection.recv(65536)
                break
            except TimeoutError:
                continue
        check(answer, 408, "request_timeout")


def test_a_connection_that_says_nothing_is_closed_without_a_word(service: Service) -> None:
    assert service.tell() == b""
    assert service.refused["silent_connection"] > 0


@pytest.mark.parametrize("begun", [b"\r\n", b"\r\n\r\n", b"G"])
def test_blank_lines_do_not_keep_an_idle_connection(service: Service, begun: bytes) -> None:
    with service.connect() as connection:
        connection.sendall(GET)
        assert read_one(connection).endswith(b"GET / 0")
        connection.sendall(begun)
        check(read_all(connection), 408, "request_timeout")


def test_an_idle_connection_may_wait_longer_than_headers_may(service: Service) -> None:
    with service.connect() as connection:
        for _ in range(2):
            connection.sendall(GET)
            assert read_one(connection).endswith(b"GET / 0")
            time.sleep(2 * HEADER_S)


def test_a_long_answer_is_no_late_header(service: Service) -> None:
    with service.connect() as connection:
        connection.sendall(b"GET /patient HTTP/1.1\r\nHost: x\r\n\r\n")
        assert read_one(connection).endswith(b"GET /patient 0")


# Headers in bytes


def head_of(n_bytes: int) -> bytes:
    start = b"GET / HTTP/1.1\r\nX-Request-ID: mine\r\nA: "
    return start + b"a" * (n_bytes - len(start) - 4) + b"\r\n\r\n"


@pytest.mark.parametrize("piece", [1, 100, MAX_HEADER_BYTES - 1, MAX_HEADER_BYTES, 100_000])
def test_headers_of_the_most_bytes_pass_and_one_more_is_refused(service: Service, piece: int) -> None:
    for n_bytes, status in ((MAX_HEADER_BYTES, 200), (MAX_HEADER_BYTES + 1, 431)):
        head = head_of(n_bytes)
        with service.connect() as connection:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for start in range(0, n_bytes - 1, piece):
                connection.sendall(head[start : min(start + piece, n_bytes - 1)])
            connection.sendall(head[-1:])
            answer = read_one(connection)
            assert answer.startswith(f"HTTP/1.1 {status} ".encode()), answer[:300]


ENDLESS = {
    "line": (b"GET / HTTP/1.1\r\nX-Request-ID: mine\r\nA: ", b"a" * 1000),
    "name": (b"GET / HTTP/1.1\r\nX-Request-ID: mine\r\n", b"a" * 1000),
    "headers": (b"GET / HTTP/1.1\r\nX-Request-ID: mine\r\n", b"A: b\r\n" * 100),
    "address": (b"GET /", b"a" * 1000),
    "blank lines": (b"", b"\r\n" * 1000),
}


@pytest.mark.parametrize("kind", ENDLESS)
def test_endless_heads(service: Service, kind: str) -> None:
    start, piece = ENDLESS[kind]
    with service.connect() as connection:
        connection.sendall(start)
        n_sent = 0
        connection.setblocking(False)
        answer = b""
        while not answer:
            try:
                answer = connection.recv(65536)
            except (BlockingIOError, ssl.SSLWantReadError):
                n_sent += connection.send(piece)
                time.sleep(0.005)
        problem = check(answer, 431, "headers_too_large")
        assert n_sent < MAX_HEADER_BYTES + 100_000
        if b"mine" in start:
            assert problem["request_id"] == "mine"


def test_too_many_headers(service: Service) -> None:
    def head(n_headers: int) -> bytes:
        return b"GET / HTTP/1.1\r\n" + b"".join(b"h%d: \r\n" % i for i in range(n_headers)) + b"\r\n"

    with service.connect() as connection:
        connection.sendall(head(MAX_HEADERS))
        assert read_one(connection).startswith(b"HTTP/1.1 200 ")
    assert check(service.tell(head(MAX_HEADERS + 1)), 431, "headers_too_large")["max_headers"] == MAX_HEADERS
    assert check(service.tell(head(MAX_HEADERS + 2)[:-2]), 431, "headers_too_large")


def test_a_sender_who_reads_only_after_its_last_byte_still_gets_the_answer(service: Service) -> None:
    check(service.tell(b"GET / HTTP/1.1\r\nA: " + b"a" * (LINGER_BYTES - 100_000)), 431, "headers_too_large")


def test_the_headers_of_every_request_are_counted_anew(service: Service) -> None:
    body = b"POST / HTTP/1.1\r\nContent-Length: 50000\r\n\r\n" + bytes(50_000)
    with service.connect() as connection:
        for _ in range(3):
            connection.sendall(body + head_of(MAX_HEADER_BYTES))
            answers = read_one(connection)
            while answers.count(b"HTTP/1.1 200 ") < 2 or not answers.endswith(b"GET / 0"):
                answers += connection.recv(65536)
    assert check(
        service.tell(body, head_of(MAX_HEADER_BYTES * 3))[-2000:].partition(b"50000")[2], 431, "headers_too_large"
    )


# Bodies


def test_a_body_that_stalls(service: Service) -> None:
    answer = service.tell(b"POST /stall HTTP/1.1\r\nContent-Length: 10\r\n\r\n", b"abc")
    problem = check(answer, 408, "request_timeout")
    assert problem["instance"] == "/stall"
    assert problem["request_id"] == "from-the-application"
    until(lambda: service.application.ended["/stall left"] == 1)


def test_a_body_that_never_begins(service: Service) -> None:
    check(service.tell(b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n"), 408, "request_timeout")


@pytest.mark.parametrize("chunked", [False, True])
def test_a_slow_body_that_moves_lives(service: Service, chunked: bool) -> None:
    n_pieces = 16
    pieces = [b"1\r\nx\r\n"] * n_pieces + [b"0\r\n\r\n"] if chunked else [b"x"] * n_pieces
    how = b"Transfer-Encoding: chunked" if chunked else b"Content-Length: %d" % n_pieces
    with service.connect() as connection:
        connection.sendall(b"POST / HTTP/1.1\r\n" + how + b"\r\n\r\n")
        for piece in pieces:
            time.sleep(STALL_S / 4)
            connection.sendall(piece)
        assert read_one(connection).endswith(b"POST / 16")


def test_what_comes_after_an_early_answer_has_no_more_time(service: Service) -> None:
    with service.connect() as connection:
        connection.sendall(b"POST /forgetful HTTP/1.1\r\nContent-Length: 1000\r\n\r\n")
        assert read_one(connection).endswith(b"early")
        with pytest.raises(OSError):  # noqa: PT012, PT011 - closed, sooner or later
            for _ in range(1000):
                connection.sendall(b"x")
                time.sleep(STALL_S / 10)
        # One request has one answer.
        connection.settimeout(1)
        with contextlib.suppress(ConnectionError):
            assert connection.recv(65536) == b""


def test_a_body_that_waits_for_us_does_not_stall(service: Service) -> None:
    with service.connect() as connection:
        connection.sendall(b"POST /patient HTTP/1.1\r\nContent-Length: 10000000\r\n\r\n")
        connection.sendall(bytes(10_000_000))
        assert read_one(connection).endswith(b"POST /patient 10000000")


def test_a_sender_who_waits_to_be_told_to_go_on_does_not_stall(service: Service) -> None:
    with service.connect() as connection:
        connection.sendall(b"POST /patient HTTP/1.1\r\nContent-Length: 3\r\nExpect: 100-continue\r\n\r\n")
        assert connection.recv(25) == b"HTTP/1.1 100 Continue\r\n\r\n"
        connection.sendall(b"abc")
        assert read_one(connection).endswith(b"POST /patient 3")


CHUNKED = b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n1\r\nx\r\n"


def test_trailers_are_no_headers(service: Service) -> None:
    with service.connect() as connection:
        connection.sendall(CHUNKED + b"0\r\nX-Sly: yes\r\n\r\n")
        assert read_one(connection).endswith(b"POST / 1")
        assert b"x-sly" not in service.application.headers[-1]
        connection.sendall(GET)
        assert read_one(connection).endswith(b"GET / 0")
        assert b"x-sly" not in service.application.headers[-1]


@pytest.mark.parametrize(
    ("start", "piece"),
    [(b"0\r\n", b"a: b\r\n" * 20), (b"0\r\na: ", b"a" * 1000), (b"1;", b"a" * 1000), (b"", b"0" * 1000)],
    ids=["trailers", "one trailer", "a chunk extension", "a chunk size"],
)
def test_what_stands_between_chunks_has_a_bound(service: Service, start: bytes, piece: bytes) -> None:
    answer = service.tell(CHUNKED + start, *[piece] * 100)
    assert answer.startswith((b"HTTP/1.1 431 ", b"HTTP/1.1 400 ")), answer[:300]
    check(answer, int(answer[9:12]), "headers_too_large" if answer[9:12] == b"431" else "unreadable_request")


# Answers


def test_an_answer_that_is_not_read_is_cut(service: Service) -> None:
    before = service.refused["answer_not_read"]
    with service.connect(receive_buffer=65536) as connection:
        connection.sendall(b"GET /big HTTP/1.1\r\nHost: x\r\n\r\n")
        until(lambda: service.refused["answer_not_read"] == before + 1)
        received = 0
        with pytest.raises(ConnectionError):  # noqa: PT012
            while piece := connection.recv(1 << 20):
                received += len(piece)
            raise ConnectionError("closed")
        assert received < BIG_BYTES


def test_an_answer_that_is_read_slowly_arrives_whole(service: Service) -> None:
    began = time.monotonic()
    with service.connect(receive_buffer=65536) as connection:
        connection.sendall(b"GET /big HTTP/1.1\r\nConnection: close\r\n\r\n")
        received = rested_at = 0
        while piece := connection.recv(1_000_000):
            received += len(piece)
            if received - rested_at > 200_000 and time.monotonic() - began < 4 * STALL_S:
                rested_at = received
                time.sleep(STALL_S / 5)
    assert received > BIG_BYTES


# Many requests on one connection


def test_requests_one_after_another_are_answered_in_order(service: Service) -> None:
    with service.connect() as connection:
        connection.sendall(b"".join(b"GET /%d HTTP/1.1\r\nHost: x\r\n\r\n" % i for i in range(MAX_PIPELINED)))
        received = b""
        while received.count(b"HTTP/1.1 200 ") < MAX_PIPELINED or not received.endswith(b" 0"):
            received += connection.recv(65536)
    assert [one.partition(b"\r\n\r\n")[2] for one in split(received)] == [
        b"GET /%d 0" % i for i in range(MAX_PIPELINED)
    ]


def test_more_requests_than_may_wait(service: Service) -> None:
    *answered, refused = split(service.tell(GET * (MAX_PIPELINED + 50)))
    assert all(one.startswith(b"HTTP/1.1 200 ") for one in answered)
    assert len(answered) == MAX_PIPELINED + 1  # one runs, the others wait
    assert b"retry-after: 1" in refused
    check(refused, 503, "overloaded")


@pytest.mark.parametrize(
    "garbage", [b"\x16\x03\x01", b"NOTHING AT ALL\r\n\r\n", b"GET / HTTP/1.1\r\nbad header\r\n\r\n"]
)
def test_garbage_after_a_request_leaves_its_answer_alone(service: Service, garbage: bytes) -> None:
    slow = b"GET /soon HTTP/1.1\r\nHost: x\r\n\r\n"
    first, second, third = split(service.tell(slow + GET + garbage))
    assert first.endswith(b"GET /soon 0")
    assert second.endswith(b"GET / 0")
    check(third, 400, "unreadable_request")


def test_a_broken_body_after_a_request_is_refused_in_its_turn(service: Service) -> None:
    broken = b"POST /broken HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n" + b"no size\r\n"
    first, second = split(service.tell(b"GET /soon HTTP/1.1\r\nHost: x\r\n\r\n" + broken))
    assert first.endswith(b"GET /soon 0")
    assert check(second, 400, "unreadable_request")["instance"] == "/broken"
    assert service.application.ended["/broken"] == 0


def test_a_stream_with_a_request_behind_it_ends_when_its_reader_leaves(service: Service) -> None:
    before = service.application.ended["/stream left"]
    with service.connect() as connection:
        connection.sendall(b"GET /stream HTTP/1.1\r\nHost: x\r\n\r\n" + GET)
        assert connection.recv(65536)
    until(lambda: service.application.ended["/stream left"] == before + 1)


# What is HTTP, and what is not


@pytest.mark.parametrize(
    "request_",
    [
        b"GET / HTTP/1.1\nHost: x\n\n",
        b"GET / HTTP/1.1\r\nHost: x\nA: b\r\n\r\n",
        b"GET /\x00 HTTP/1.1\r\n\r\n",
        b"GET /\xff HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nA: b\x00c\r\n\r\n",
        b"GET / HTTP/1.1\r\nA\x00: b\r\n\r\n",
        b"GET / HTTP/1.1\r\nA : b\r\n\r\n",
        b"GET / HTTP/1.1\r\nA: b\r\n c\r\n\r\n",
        b"GET / HTTP/1.1\r\nnothing\r\n\r\n",
        b"GET / HTTP/3.7\r\n\r\n",
        b"GET no/slash HTTP/1.1\r\n\r\n",
        b"GET http://h:99999/ HTTP/1.1\r\n\r\n",
        b"CONNECT h:1 HTTP/1.1\r\n\r\n",
        b"BREW / HTTP/1.1\r\n\r\n",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"POST / HTTP/1.1\r\nContent-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
        b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\nContent-Length: 3\r\n\r\n0\r\n\r\n",
        b"POST / HTTP/1.1\r\nContent-Length: 3\r\nContent-Length: 4\r\n\r\nabc",
        b"POST / HTTP/1.1\r\nContent-Length: -1\r\n\r\n",
        b"POST / HTTP/1.1\r\nContent-Length: 99999999999999999999\r\n\r\n",
        b"POST / HTTP/1.1\r\nTransfer-Encoding: xchunked\r\n\r\nabc",
        b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n-1\r\n",
        b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nffffffffffffffffff\r\n",
        b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n1\nx\n0\n\n",
    ],
)
def test_what_is_no_http_is_answered_as_a_problem(service: Service, request_: bytes) -> None:
    answer = service.tell(request_)
    assert answer.count(b"HTTP/1.1 ") == 1
    check(answer, 400, "unreadable_request")


def test_http_1_0_closes_after_its_answer(service: Service) -> None:
    answer = service.tell(b"POST / HTTP/1.0\r\nContent-Length: 3\r\n\r\nabc")
    assert answer.startswith(b"HTTP/1.1 200 ")
    assert b"connection: close" in answer
    assert answer.endswith(b"POST / 3")


def test_an_upgrade_is_not_taken_up(service: Service) -> None:
    offer = b"POST / HTTP/1.1\r\nConnection: Upgrade\r\nUpgrade: %s\r\nContent-Length: 3\r\n\r\nabc"
    with service.connect() as connection:
        for kind in (b"h2c", b"websocket"):
            connection.sendall(offer % kind)
            assert read_one(connection).endswith(b"POST / 3")
        connection.sendall(GET)
        assert read_one(connection).endswith(b"GET / 0")
    answers = split(service.tell(offer % b"h2c" + b"GET /next HTTP/1.0\r\n\r\n"))
    assert [one.partition(b"\r\n\r\n")[2] for one in answers] == [b"POST / 3", b"GET /next 0"]


# Many connections


@contextlib.contextmanager
def held_open(service: Service) -> Iterator[list[socket.socket]]:
    """Room for connections, which are closed and gone from the service behind the block."""
    held: list[socket.socket] = []
    try:
        yield held
    finally:
        for connection in held:
            connection.close()
    until(lambda: _answers(service))


@pytest.mark.parametrize("silent", [0, MAX_CONNECTIONS - 1], ids=["all-have-asked", "one-never-asked"])
def test_one_connection_more_closes_the_longest_silent(service: Service, silent: int) -> None:
    """Where all have asked, the first; where one never asked, that one, though it came last."""
    with held_open(service) as held:
        for place in range(MAX_CONNECTIONS):
            held.append(service.connect())
            if silent == 0 or place != silent:
                held[-1].sendall(GET)
                assert read_one(held[-1]).endswith(b"GET / 0")
            time.sleep(LOOP_TICK_S)
        n_refused = service.refused["max_connections"]
        with service.connect() as one_more:
            one_more.sendall(GET)
            assert read_one(one_more).endswith(b"GET / 0")
        assert service.refused["max_connections"] == n_refused + 1
        with contextlib.suppress(ConnectionError):
            assert held[silent].recv(65536) == b""
        for connection in held[:silent] + held[silent + 1 :]:
            connection.sendall(GET)
            assert read_one(connection).endswith(b"GET / 0")


def test_announcing_a_body_that_never_comes_holds_no_place(service: Service) -> None:
    """Strangers who are answered 401 at once could else keep all robots out until their bodies stall."""
    with held_open(service) as held:
        for _ in range(MAX_CONNECTIONS):
            held.append(service.connect())
            held[-1].sendall(b"POST /forgetful HTTP/1.1\r\nHost: x\r\nContent-Length: 1000\r\n\r\n")
            assert read_one(held[-1]).endswith(b"early")
        with service.connect() as robot:
            robot.sendall(GET)
            assert read_one(robot).endswith(b"GET / 0")


def _answers(service: Service) -> bool:
    try:
        with service.connect() as connection:
            connection.sendall(GET)
            return read_one(connection).endswith(b"GET / 0")
    except (OSError, AssertionError, IndexError):
        return False


def test_a_request_costs_no_timer() -> None:
    """Beyond uvicorn's own: one for the keep-alive."""
    n_requests, n_timers = 200, 0

    class CountingLoop(asyncio.SelectorEventLoop):
        def call_at(self, *args: Any, **kwargs: Any) -> asyncio.TimerHandle:
            nonlocal n_timers
            n_timers += 1
            return super().call_at(*args, **kwargs)

    async def ask() -> int:
        limits = WireLimits(10.0, 30.0, MAX_HEADER_BYTES, 10, lambda _: None)
        made = protocol_class(limits)
        config = uvicorn.Config(Application(), http=made, ws="none", log_config=None, lifespan="off")
        config.load()
        state = uvicorn.server.ServerState()
        loop = asyncio.get_running_loop()
        server = await loop.create_server(lambda: made(config=config, server_state=state, app_state={}), "127.0.0.1", 0)
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        before = n_timers
        for _ in range(n_requests):
            writer.write(GET)
            head = await reader.readuntil(b"\r\n\r\n")
            assert head.startswith(b"HTTP/1.1 200 ")
            await reader.readexactly(len(b"GET / 0"))
        writer.close()
        await writer.wait_closed()
        server.close()
        await server.wait_closed()
        return n_timers - before

    with asyncio.Runner(loop_factory=CountingLoop) as runner:
        assert runner.run(ask()) <= n_requests + 2
