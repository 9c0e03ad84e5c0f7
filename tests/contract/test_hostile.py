"""What an attacker sends to a real process is refused by name, at no cost to the robot beside it."""

import contextlib
import gzip
import io
import json
import select
import struct
import threading
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image as Pillow

from .conftest import TAKES_IMAGES, wait_until
from .server_process import Robot, ServerProcess

pytestmark = pytest.mark.slow

MAX_CONNECTIONS, MAX_REQUESTS = 100, 16
MEBIBYTE = 1024 * 1024
MAX_BODY_MEMORY = 48 * MEBIBYTE
MOST_PEAK_MIB = 120  # that one attack may cost for a moment; what decoders and batches may take is more
# An image of 50 megapixels, the default limit, while it is decoded (a lossless WebP in two forms at once: 350 MB), and
# as much again for the rest.
MOST_LARGE_MIB = 700
READY = "/v1/domains/ready/localizations"
FRAME = "/v1/admin/domains/seen/traverses/t/frames/0?position_m=0"
BATCH = "/v1/admin/domains/ready/traverses/drive/frames"
VIEW = b'{"ranked_landmarks": [1, 2]}'


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    limits = {
        "max_connections": MAX_CONNECTIONS,
        "max_requests": MAX_REQUESTS,
        "max_batch_bytes": 64 * MEBIBYTE,
        "max_body_memory_bytes": MAX_BODY_MEMORY,
    }
    with ServerProcess(tmp_path_factory.mktemp("hostile") / "data", **limits) as server:
        server.client.make_ready_domain("ready")
        server.client.make_domain("seen", **TAKES_IMAGES)
        server.client.post("/v1/admin/domains/seen/traverses", json={"name": "t"})
        yield server
        assert b"Traceback" not in server.log_path.read_bytes()


@pytest.fixture(scope="module")
def robot(server):
    robot = Robot(server)
    thread = threading.Thread(target=robot.drive)
    thread.start()
    robot.answered_more(100)
    before_mib = server.mib()
    yield robot
    robot.stopped.set()
    thread.join(60)
    assert robot.faults == []
    assert max(server.mib() - before_mib) < 2 * MOST_PEAK_MIB, "nothing is kept"  # of many times as much


@pytest.fixture(autouse=True)
def _others_are_unaffected(server, robot, request):
    n_sockets = server.n_sockets
    with server.limited(MOST_LARGE_MIB if "just_under_the_limit" in request.node.name else MOST_PEAK_MIB):
        yield
        robot.answered_more(6)
    wait_until(lambda: server.n_sockets <= n_sockets + 2)


def request(method, path, body=b"", **headers):
    fields = {"Host": "127.0.0.1", "Connection": "close", "Content-Type": "application/json"}
    fields |= {"Content-Length": str(len(body))} | {name.replace("_", "-"): value for name, value in headers.items()}
    lines = [f"{method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in fields.items() if value), "", ""]
    return "\r\n".join(lines).encode("utf-8", "surrogateescape") + body


def statuses(answer):
    return [int(part[:3]) for part in answer.split(b"HTTP/1.1 ")[1:]]


def problem(answer):
    """The status and the code of an answer, after checking what all problems have."""
    head, _, content = answer.partition(b"\r\n\r\n")
    document = json.loads(content)
    if statuses(head) == [200]:
        return 200, ""
    assert b"content-type: application/problem+json" in head
    assert {"type", "title", "status", "detail", "instance", "code", "request_id"} <= set(document)
    assert len(content) < 20_000
    return int(head[9:12]), document["code"]


def ask(server, method, path, body=b"", **headers):
    return problem(server.tell(request(method, path, body, **headers)))


# Images


def deflate_bomb(n_mebibytes):
    """A zlib stream that is small however much it unpacks to."""
    packer = zlib.compressobj(9)
    start = packer.compress(b"") + packer.flush(zlib.Z_FULL_FLUSH)
    part = packer.compress(bytes(MEBIBYTE)) + packer.flush(zlib.Z_FULL_FLUSH)
    return start + part * n_mebibytes


def chunk(name, content):
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def png(pixels, size=16, remark=b""):
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", size, size, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + remark + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def test_an_image_that_claims_ten_thousand_million_pixels(server):
    for _ in range(20):
        answer = ask(server, "PUT", FRAME, png(bytes(100), 100_000), Content_Type="image/png")
        assert answer == (413, "image_too_large")


def test_a_png_that_unpacks_to_sixteen_gibibytes(server):
    bomb = png(deflate_bomb(16 * 1024))
    assert len(bomb) < 32 * MEBIBYTE
    assert ask(server, "PUT", FRAME, bomb, Content_Type="image/png") == (422, "undecodable_image")


@pytest.mark.parametrize("name", [b"zTXt", b"iCCP", b"iTXt"])
def test_bombs_in_a_pngs_remarks(server, name):
    head = b"a\x00\x01\x00\x00\x00" if name == b"iTXt" else b"a\x00\x00"
    body = png(zlib.compress(bytes(49 * 16)), remark=chunk(name, head + deflate_bomb(2048)))
    answer = server.tell(request("PUT", FRAME, body, Content_Type="image/png"))
    assert statuses(answer)[0] in {200, 201, 422}


def test_many_images_just_under_the_limit_at_once(server):
    """They wait for each other or are refused, so that memory is held for one of them, and none is kept."""
    bombs = {}
    for form in ("webp", "png"):
        stream = io.BytesIO()
        Pillow.new("RGB", (10_000, 5_000), (30, 60, 90)).save(stream, form, lossless=True)
        assert stream.tell() < 200_000
        bombs[f"image/{form}"] = stream.getvalue()

    def send(number):
        kind, body = list(bombs.items())[number % 2]
        if number % 3 == 0:
            return statuses(server.tell(request("PUT", FRAME, body, Content_Type=kind)))[0]
        return ask(server, "POST", READY, body, Content_Type=kind)  # refused, when it has been looked at

    successes, refusal = {200, 201}, (415, "unsupported_media_type")
    with ThreadPoolExecutor(14) as senders:
        answers = set(senders.map(send, range(14)))
    assert answers <= {*successes, refusal, 503, (503, "overloaded")}
    assert answers & {*successes, refusal}
    assert {send(0), send(3)} <= successes


# Packed bodies


def test_packed_bodies_are_not_unpacked(server):
    bomb = gzip.compress(bytes(64 * MEBIBYTE))
    for path, coding in ((READY, "gzip"), (READY, "br"), (READY, "gzip, identity"), (BATCH, "gzip")):
        assert ask(server, "POST", path, bomb, Content_Encoding=coding) == (415, "unsupported_media_type")


def batch_of(n_noughts):
    """An npz of `n_noughts` float32 noughts, a thousand times smaller than they are unpacked."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, shape, kind, n_bytes in (
            ("encodings", (n_noughts // 8, 8), "<f4", 4 * n_noughts),
            ("index", (1,), "<i8", 8),
            ("position_m", (1,), "<f8", 8),
        ):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, {"descr": kind, "fortran_order": False, "shape": shape})
                for start in range(0, n_bytes, MEBIBYTE):
                    member.write(bytes(min(n_bytes - start, MEBIBYTE)))
    return file.getvalue()


def test_batches_that_unpack_to_much_more_or_lie_about_it(server):
    kind = {"Content_Type": "application/octet-stream"}
    bombs = [batch_of(n_mebi * MEBIBYTE) for n_mebi in (4, 128)]
    for bomb, expected in zip(bombs, ((422, "invalid_input"), (413, "too_large")), strict=True):
        assert len(bomb) < MEBIBYTE
        assert ask(server, "POST", BATCH, bomb, **kind) == expected
    length = struct.pack("<I", 4 * 4 * MEBIBYTE + 128)
    assert length in bombs[0]
    lie = bombs[0].replace(length, struct.pack("<I", 4096))
    assert ask(server, "POST", BATCH, lie, **kind) == (422, "invalid_batch")


# Slow senders


def test_ten_thousand_chunks_of_one_byte(server, robot):
    with server.connect() as drip:
        drip.sendall(request("POST", READY, Content_Length="", Transfer_Encoding="chunked"))
        for n_sent, byte in enumerate(VIEW.ljust(10_000)):
            drip.sendall(b"1\r\n" + bytes([byte]) + b"\r\n")
            if n_sent % 1000 == 0:
                robot.answered_more(4)
        drip.sendall(b"0\r\n\r\n")
        assert drip.recv(65536).startswith(b"HTTP/1.1 200 ")


def test_unfinished_bodies_on_many_connections_take_nobodys_turn(server, robot):
    """There are far more such connections than requests may be under way."""
    with contextlib.ExitStack() as stack:
        for _ in range(4 * MAX_REQUESTS):
            stack.enter_context(server.connect()).sendall(request("POST", READY, Content_Length="1000000") + b"{")
        robot.answered_more(20)


def test_bodies_that_stop_before_their_end_share_the_room_that_there_is(server, robot):
    """A body without room is refused, room is there again when they have gone, and robots' small bodies need none."""
    body = b" " * (4 * MEBIBYTE - 100)
    with contextlib.ExitStack() as stack:
        slow = [stack.enter_context(server.connect()) for _ in range(40)]
        for connection in slow:
            with contextlib.suppress(OSError):  # refused while it was sent
                connection.sendall(request("POST", READY, body)[:-50_000])
        wait_for = select.poll()
        for connection in slow:
            wait_for.register(connection, select.POLLIN)
        n_held = MAX_BODY_MEMORY // len(body)
        wait_until(lambda: len(wait_for.poll(0)) >= len(slow) - n_held)
        robot.answered_more(6)
        assert len(wait_for.poll(0)) == len(slow) - n_held
    wait_until(lambda: ask(server, "POST", READY, body) == (422, "invalid_request"))


def test_batches_that_stop_before_their_end_are_not_held_in_memory(server, robot):
    kind = {"Content_Type": "application/octet-stream"}
    with contextlib.ExitStack() as stack:
        for _ in range(4):
            batch = request("POST", BATCH, bytes(60 * MEBIBYTE), **kind)
            stack.enter_context(server.connect()).sendall(batch[:-9])
        wait_until(lambda: ask(server, "POST", BATCH, b"1", **kind) == (503, "overloaded"))
        robot.answered_more(6)
    wait_until(lambda: ask(server, "POST", BATCH, b"1", **kind) == (422, "invalid_batch"))


def test_with_more_connections_than_may_be_all_are_told_so(server, robot):
    """The answer is the server's plain text, because an operator's proxy keeps so many connections away."""
    message = request("GET", "/healthz")
    with robot.turn:  # until the server has noticed that they are gone
        with contextlib.ExitStack() as stack:
            for _ in range(MAX_CONNECTIONS):
                stack.enter_context(server.connect())
            wait_until(lambda: statuses(server.tell(message)) == [503])
        wait_until(lambda: statuses(server.tell(message)) == [200])


# Heads

LINE, HOST = b"GET / HTTP/1.1\r\n", b"Host: localhost\r\n"
POST = b"POST / HTTP/1.1\r\n" + HOST


@pytest.mark.parametrize(
    "head",
    [
        b"GET /" + b"a" * MEBIBYTE + b" HTTP/1.1\r\n\r\n",
        LINE + HOST + b"A: b\r\n" * 100_000 + b"\r\n",
        LINE + b"\r\n",  # no Host
        LINE + HOST + HOST + b"\r\n",
        b"GET /v1/\x00 HTTP/1.1\r\n" + HOST + b"\r\n",
        POST + b"Content-Length: 5\r\nContent-Length: 6\r\n\r\nhello!",
        POST + b"Content-Length: five\r\n\r\nhello",
        POST + b"Transfer-Encoding: gzip, chunked\r\n\r\n5\r\nhello\r\n0\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(70_000),
        b"SSH-2.0-OpenSSH_9.6\r\n\r\n",
    ],
    ids=range(10),
)
def test_what_is_no_request_is_answered_400_in_plain_words(server, head):
    assert statuses(server.tell(head)) in ([400], [501])


def test_bodies_that_end_in_two_ways_or_later_than_they_say(server):
    """A proxy might heed the other length, and see another request behind the body."""
    endless = server.tell(POST + b"Content-Length: 18446744073709551615\r\nConnection: close\r\n\r\n")
    assert problem(endless) == (413, "body_too_large")
    smuggled = b"0\r\n\r\n" + request("GET", "/v1/domains")
    two_lengths = b"Content-Length: %d\r\nTransfer-Encoding: chunked\r\n\r\n" % len(smuggled)
    assert problem(server.tell(POST + two_lengths + smuggled)) == (400, "unreadable_request")
    good = request("POST", READY, VIEW, Connection="")
    assert statuses(server.tell(good + VIEW + b"\r\n\r\n")) == [200, 400]
    assert statuses(server.tell(good * 10 + b"garbage\r\n\r\n" + good)) == [200] * 10 + [400]


def test_headers_that_are_none_of_ours(server):
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
        assert ask(server, "POST", READY, VIEW, **{name: value})[0] == 200, name


# JSON

SIZE = 4 * MEBIBYTE - 100
JSON_BODIES = {
    "deep lists": b'{"ranked_landmarks": ' + b"[" * SIZE,
    "deep objects": b'{"a":' * (SIZE // 5),
    "a long number": b'{"ranked_landmarks": [' + b"9" * SIZE + b"]}",
    "a huge exponent": b'{"encoding": [1e' + b"9" * SIZE + b"]}",
    "infinities": b'{"encoding": [' + b"1e999," * (SIZE // 6 - 10) + b"1]}",
    "wrong elements": b'{"ranked_landmarks": [' + b'"",' * (SIZE // 3 - 10) + b"1]}",
    "unknown members": b"{" + b",".join(b'"%x":0' % number for number in range(SIZE // 10)) + b"}",
    "a long text": b'{"ranked_landmarks": "' + b"a" * SIZE + b'"}',
    "escapes": b'{"ranked_landmarks": "' + b"\\ud800" * (SIZE // 6 - 10) + b'"}',
    "no end": b'{"ranked_landmarks": [' + b"1," * (SIZE // 2 - 20),
    "blanks": b" " * SIZE,
}


@pytest.mark.parametrize("kind", JSON_BODIES)
def test_megabytes_of_json(server, kind):
    for method, path in (
        ("POST", READY),
        ("PUT", "/v1/admin/domains/evil"),
        ("POST", "/v1/domains/ready/sessions"),
        ("POST", "/v1/admin/domains/ready/remaps"),
        ("PUT", f"{BATCH}/0?position_m=0"),
    ):
        status, code = ask(server, method, path, JSON_BODIES[kind])
        assert status == 422
        assert code in {"invalid_request", "invalid_ranked_landmarks", "invalid_encoding"}
