"""What an attacker sends, to a real process: each refused by name, at no cost to the robot beside it."""

import contextlib
import gzip
import io
import json
import struct
import threading
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from .served import Robot, Served, make_ready_domain, until

pytestmark = pytest.mark.slow

MAX_CONNECTIONS, MAX_REQUESTS = 100, 16
MEBIBYTE = 1024 * 1024
MOST_PEAK_MIB = 120  # that one attack may cost for a moment; what decoders and batches may take is more
READY = "/v1/domains/ready/localizations"
FRAME = "/v1/admin/domains/seen/traverses/t/frames/0?position_m=0"
BATCH = "/v1/admin/domains/ready/traverses/drive/frames"


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile") / "data"


@pytest.fixture(scope="module")
def served(data_dir: Path) -> Iterator[Served]:
    made = Served.start(
        data_dir,
        data_dir.parent / "log",
        max_connections=MAX_CONNECTIONS,
        max_requests=MAX_REQUESTS,
        max_batch_bytes=64 * MEBIBYTE,
    )
    try:
        make_ready_domain(made.url, "ready")
        ask(made, "PUT", "/v1/admin/domains/seen", b'{"evaluator": {"kind": "feature_l2"}}')
        ask(made, "POST", "/v1/admin/domains/seen/traverses", b'{"name": "t"}')
        yield made
        assert b"Traceback" not in made.log.read_bytes()
    finally:
        made.kill()


@pytest.fixture(scope="module")
def robot(served: Served) -> Iterator[Robot]:
    made = Robot(served)
    thread = threading.Thread(target=made.drive)
    thread.start()
    made.answered_more(200)
    yield made
    made.stopped.set()
    thread.join(30)
    assert made.faults == []


@pytest.fixture(autouse=True)
def _others_are_unaffected(served: Served, robot: Robot) -> Iterator[None]:
    served.forget_peak()
    before, n_sockets = served.resident_mib, served.n_sockets
    yield
    robot.answered_more(20)
    assert served.peak_mib - before < MOST_PEAK_MIB
    until(lambda: served.n_sockets <= n_sockets + 2)


@pytest.fixture(scope="module", autouse=True)
def _nothing_is_kept(served: Served, robot: Robot) -> Iterator[None]:
    before = served.resident_mib
    yield
    assert served.resident_mib - before < MOST_PEAK_MIB


def request(method: str, path: str, body: bytes = b"", **headers: str) -> bytes:
    sent = {
        "Host": "127.0.0.1",
        "Connection": "close",
        "Content-Type": "application/json",
        "Content-Length": str(len(body)),
    }
    sent |= {name.replace("_", "-"): value for name, value in headers.items()}
    lines = [f"{method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in sent.items() if value), "", ""]
    return "\r\n".join(lines).encode("utf-8", "surrogateescape") + body


def ask(served: Served, method: str, path: str, body: bytes = b"", **headers: str) -> tuple[int, dict[str, Any]]:
    """The status and the document of an answer."""
    answer = served.tell(request(method, path, body, **headers))
    return parsed(answer)


def parsed(answer: bytes) -> tuple[int, dict[str, Any]]:
    head, _, content = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 "), answer[:300]
    status = int(head[9:12])
    if status >= 400:
        problem: dict[str, Any] = json.loads(content)
        assert b"content-type: application/problem+json" in head
        assert {"type", "title", "status", "detail", "instance", "code", "request_id"} <= set(problem)
        return status, problem
    return status, json.loads(content) if content else {}


# Images


def png_claim(width: int, height: int) -> bytes:
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header)) + bytes(100)


def test_an_image_that_claims_ten_thousand_million_pixels(served: Served) -> None:
    for _ in range(20):
        status, problem = ask(served, "PUT", FRAME, png_claim(100_000, 100_000), Content_Type="image/png")
        assert (status, problem["code"]) == (413, "image_too_large"), problem


def deflate_bomb(n_mebibytes: int) -> bytes:
    """A zlib stream that is small however much it unpacks to."""
    packer = zlib.compressobj(9)
    start = packer.compress(b"") + packer.flush(zlib.Z_FULL_FLUSH)
    one = packer.compress(bytes(MEBIBYTE)) + packer.flush(zlib.Z_FULL_FLUSH)
    return start + one * n_mebibytes


def chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def test_a_png_that_unpacks_to_sixteen_gibibytes(served: Served) -> None:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 16, 16, 8, 2, 0, 0, 0))
    bomb = b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", deflate_bomb(16 * 1024)) + chunk(b"IEND", b"")
    assert len(bomb) < 32 * MEBIBYTE
    status, problem = ask(served, "PUT", FRAME, bomb, Content_Type="image/png")
    assert (status, problem["code"]) == (422, "undecodable_image")


@pytest.mark.parametrize("name", [b"zTXt", b"iCCP", b"iTXt"])
def test_bombs_in_a_pngs_remarks(served: Served, name: bytes) -> None:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 16, 16, 8, 2, 0, 0, 0))
    told = b"a\x00\x01\x00\x00\x00" if name == b"iTXt" else b"a\x00\x00"
    picture = chunk(b"IDAT", zlib.compress(bytes(49 * 16)))
    remark = chunk(name, told + deflate_bomb(2048))
    body = b"\x89PNG\r\n\x1a\n" + header + remark + picture + chunk(b"IEND", b"")
    status, _ = ask(served, "PUT", FRAME, body, Content_Type="image/png")
    assert status in {200, 201, 422}


# Packed bodies


def test_packed_bodies_are_not_unpacked(served: Served) -> None:
    bomb = gzip.compress(bytes(64 * MEBIBYTE))
    for path, coding in (
        (READY, "gzip"),
        (READY, "deflate"),
        (READY, "br"),
        (READY, "gzip, identity"),
        (BATCH, "gzip"),
    ):
        kind = "application/octet-stream" if path == BATCH else "application/json"
        status, problem = ask(served, "POST", path, bomb, Content_Encoding=coding, Content_Type=kind)
        assert (status, problem["code"], problem["allowed"]) == (415, "unsupported_media_type", ["identity"])


def batch_of(n_noughts: int) -> bytes:
    """An npz of so many float32 noughts, of a thousandth of their bytes."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, shape, kind in (
            ("encodings", (n_noughts // 8, 8), "<f4"),
            ("index", (1,), "<i8"),
            ("position_m", (1,), "<f8"),
        ):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, {"descr": kind, "fortran_order": False, "shape": shape})
                left = 4 * n_noughts if name == "encodings" else 8
                while left > 0:
                    left -= member.write(bytes(min(left, MEBIBYTE)))
    return packed.getvalue()


@pytest.mark.parametrize("n_noughts", [8 * MEBIBYTE, 128 * MEBIBYTE])
def test_a_batch_that_unpacks_to_much_more(served: Served, n_noughts: int) -> None:
    bomb = batch_of(n_noughts)
    assert len(bomb) < MEBIBYTE
    status, problem = ask(served, "POST", BATCH, bomb, Content_Type="application/octet-stream")
    assert (status, problem["code"]) in {(422, "invalid_input"), (413, "too_large")}


def test_a_batch_whose_members_lie_about_their_length(served: Served) -> None:
    bomb = bytearray(batch_of(8 * MEBIBYTE))
    true = struct.pack("<I", 4 * 8 * MEBIBYTE + 128)
    assert bomb.count(true) >= 1
    lie = bytes(bomb.replace(true, struct.pack("<I", 4096)))
    status, problem = ask(served, "POST", BATCH, lie, Content_Type="application/octet-stream")
    assert (status, problem["code"]) == (422, "invalid_batch")


# Slow senders


def test_ten_thousand_chunks_of_one_byte(served: Served, robot: Robot) -> None:
    head = request("POST", READY, Content_Length="", Transfer_Encoding="chunked")
    body = b'{"ranked_landmarks": [1, 2]}'.ljust(10_000)
    with served.connect() as drip:
        drip.sendall(head)
        for n_sent, byte in enumerate(body):
            drip.sendall(b"1\r\n" + bytes([byte]) + b"\r\n")
            if n_sent % 1000 == 0:
                robot.answered_more(4)
        drip.sendall(b"0\r\n\r\n")
        answer = b""
        while more := drip.recv(65536):
            answer += more
    assert answer.startswith(b"HTTP/1.1 200 ")


def test_unfinished_bodies_on_many_connections_take_nobodys_turn(served: Served, robot: Robot) -> None:
    """Far more than may be under way at once."""
    with contextlib.ExitStack() as stack:
        connections = [stack.enter_context(served.connect()) for _ in range(4 * MAX_REQUESTS)]
        for connection in connections:
            connection.sendall(request("POST", READY, Content_Length="1000000") + b"{")
        robot.answered_more(100)


def test_with_more_connections_than_may_be_all_are_told_so(served: Served, robot: Robot) -> None:
    """Plain words of the server: an operator's proxy keeps so many from coming."""
    with robot.paused(), contextlib.ExitStack() as stack:
        for _ in range(MAX_CONNECTIONS):
            stack.enter_context(served.connect())
        asked = request("GET", "/healthz")
        until(lambda: served.tell(asked).startswith(b"HTTP/1.1 503 "))
    until(lambda: served.tell(asked).startswith(b"HTTP/1.1 200 "))


# Heads


LINE, HOST = b"GET / HTTP/1.1\r\n", b"Host: localhost\r\n"
POST = b"POST / HTTP/1.1\r\n" + HOST


@pytest.mark.parametrize(
    "head",
    [
        b"GET /" + b"a" * MEBIBYTE + b" HTTP/1.1\r\n\r\n",
        b"GET /v1/domains?" + b"a=b&" * 100_000 + b" HTTP/1.1\r\n\r\n",
        LINE + HOST + b"A: " + b"a" * MEBIBYTE + b"\r\n\r\n",
        LINE + HOST + b"A" * MEBIBYTE + b": b\r\n\r\n",
        LINE + HOST + b"A: b\r\n" * 100_000 + b"\r\n",
        LINE + b"\r\n",  # no Host
        LINE + HOST + HOST + b"\r\n",
        b"GET /v1/\x00 HTTP/1.1\r\n" + HOST + b"\r\n",
        LINE + b"Host: \x00\r\n\r\n",
        POST + b"Content-Length: 5\r\nContent-Length: 6\r\n\r\nhello!",
        POST + b"Content-Length: five\r\n\r\nhello",
        POST + b"Content-Length: -1\r\n\r\nhello",
        POST + b"Transfer-Encoding: xchunked\r\n\r\nhello",
        POST + b"Transfer-Encoding: gzip, chunked\r\n\r\n5\r\nhello\r\n0\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(70_000),
        b"SSH-2.0-OpenSSH_9.6\r\n\r\n",
        bytes(1000) + b"\r\n\r\n",
    ],
    ids=range(17),
)
def test_what_is_no_request_is_answered_400_in_plain_words(served: Served, head: bytes) -> None:
    answer = served.tell(head)
    assert answer.count(b"HTTP/1.1 ") == 1
    assert answer.startswith((b"HTTP/1.1 400 ", b"HTTP/1.1 501 "))


def test_a_content_length_that_no_body_has(served: Served) -> None:
    status, problem = parsed(served.tell(POST + b"Content-Length: 18446744073709551615\r\nConnection: close\r\n\r\n"))
    assert (status, problem["code"]) == (413, "body_too_large")


def test_two_ways_of_ending_a_body_at_once(served: Served) -> None:
    """Whoever stands between might take the other one, and see another request behind it."""
    smuggled = b"0\r\n\r\n" + request("GET", "/v1/domains")
    both = b"Content-Length: %d\r\nTransfer-Encoding: chunked\r\n\r\n" % len(smuggled)
    answer = served.tell(POST + both + smuggled)
    assert answer.count(b"HTTP/1.1 ") == 1
    assert parsed(answer)[1]["code"] == "unreadable_request"


def test_a_content_length_that_is_too_short_makes_garbage_of_the_rest(served: Served) -> None:
    body = b'{"ranked_landmarks": [1, 2]}'
    answers = served.tell(request("POST", READY, body, Connection="") + body + b"\r\n\r\n").split(b"HTTP/1.1 ")[1:]
    assert [answer[:3] for answer in answers] == [b"200", b"400"]


def test_garbage_behind_requests(served: Served) -> None:
    good = request("POST", READY, b'{"ranked_landmarks": [1]}', Connection="")
    answers = served.tell(good * 10 + b"garbage\r\n\r\n" + good).split(b"HTTP/1.1 ")[1:]
    assert [answer[:3] for answer in answers] == [b"200"] * 10 + [b"400"]


def test_headers_that_are_none_of_ours(served: Served) -> None:
    body = b'{"ranked_landmarks": [1]}'
    for name, value in {
        "X-Request-ID": "a" * 10_000,
        "Idempotency-Key": "é" * 5000,
        "Accept": ",".join(["application/octet-stream;q=nan"] * 1000),
        "Authorization": "Bearer " + "a" * 10_000,
        "X-API-Key": "' OR 1=1 --",
        "Range": "bytes=" + ",".join(f"{i}-{i}" for i in range(1000)),
        "X-Forwarded-For": "x" * 1000,
        "Expect": "the-unexpected",
        "Cookie": "a=b; " * 1000,
    }.items():
        status, _ = ask(served, "POST", READY, body, **{name: value})
        assert status == 200, name


# JSON

SIZE = 4 * MEBIBYTE - 100
JSON_BODIES = {
    "deep lists": b'{"ranked_landmarks": ' + b"[" * SIZE,
    "deep objects": b'{"a":' * (SIZE // 5),
    "a long number": b'{"ranked_landmarks": [' + b"9" * SIZE + b"]}",
    "a long fraction": b'{"encoding": [' + b"9" * SIZE + b"]}",
    "a huge exponent": b'{"encoding": [1e' + b"9" * SIZE + b"]}",
    "infinities": b'{"encoding": [' + b"1e999," * (SIZE // 6 - 10) + b"1]}",
    "wrong elements": b'{"ranked_landmarks": [' + b'"",' * (SIZE // 3 - 10) + b"1]}",
    "wrong floats": b'{"dissimilarities": [' + b"{}," * (SIZE // 3 - 10) + b"1]}",
    "unknown members": b"{" + b",".join(b'"%x":0' % number for number in range(SIZE // 10)) + b"}",
    "one member again and again": b"{" + b'"a":0,' * (SIZE // 6 - 10) + b'"a":0}',
    "a long text": b'{"ranked_landmarks": "' + b"a" * SIZE + b'"}',
    "escapes": b'{"ranked_landmarks": "' + b"\\ud800" * (SIZE // 6 - 10) + b'"}',
    "no end": b'{"ranked_landmarks": [' + b"1," * (SIZE // 2 - 20),
    "noughts": bytes(SIZE),
    "blanks": b" " * SIZE,
}


@pytest.mark.parametrize("kind", JSON_BODIES)
def test_megabytes_of_json(served: Served, kind: str) -> None:
    body = JSON_BODIES[kind]
    for method, path in (
        ("POST", READY),
        ("PUT", "/v1/admin/domains/evil"),
        ("POST", "/v1/domains/ready/sessions"),
        ("POST", "/v1/admin/domains/ready/remaps"),
        ("PUT", "/v1/admin/domains/ready/traverses/drive/frames/0?position_m=0"),
    ):
        status, problem = ask(served, method, path, body)
        assert status == 422, problem
        assert problem["code"] in {"invalid_request", "invalid_ranked_landmarks", "invalid_encoding"}
        assert len(json.dumps(problem)) < 20_000
