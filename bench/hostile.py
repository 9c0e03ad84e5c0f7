"""What hostile and broken senders get, after how long, and what it does to a robot beside them.

`python -m bench.hostile` prints `docs/results/hostile.md`; the limits are the default ones.
"""

import contextlib
import io
import json
import socket
import struct
import tempfile
import threading
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from bench.common import describe
from bench.load.trial import Sample
from bench.soak.link import Link
from bench.soak.world import BASE, DOMAIN, N_LANDMARKS, make_domain
from deepsimbad_client.http.local_server import LocalServer

_SILENT = 900
_LARGE, _LARGE_SENDERS = (5_000, 10_000), 24  # pixels just under the limit
_LOCALIZE = f"/v1/domains/{DOMAIN}/localizations"
_FRAMES = f"{BASE}/traverses/spring/frames"


def request(method: str, path: str, body: bytes = b"", **headers: str) -> bytes:
    """The bytes of a request."""
    given = {"Host": "bench", "Content-Length": str(len(body)), **{k.replace("_", "-"): v for k, v in headers.items()}}
    lines = [f"{method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in given.items() if value)]
    return "\r\n".join([*lines, "", ""]).encode("latin-1") + body


def vast_png() -> bytes:
    """A header that claims 100,000 by 100,000 pixels."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))


def deflate_bomb() -> bytes:
    """An npz of one megabyte that unpacks to more than a gigabyte of zeros."""
    packed, rows = io.BytesIO(), 1_200_000
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f4", "fortran_order": False, "shape": (rows, 256)})
    with (
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("encodings.npy", "w", force_zip64=True) as member,
    ):
        member.write(head.getvalue())
        for _ in range(rows * 1024 // (1 << 20)):
            member.write(bytes(1 << 20))
    return packed.getvalue()


def chunked(pieces: list[bytes], **headers: str) -> bytes:
    """A localization whose body comes in these chunks."""
    given = {"Content_Length": "", "Transfer_Encoding": "chunked", **headers}
    head = request("POST", _LOCALIZE, b"", **given)
    return head + b"".join(b"%x\r\n%s\r\n" % (len(piece), piece) for piece in pieces) + b"0\r\n\r\n"


def attacks() -> dict[str, bytes]:
    """What is sent in one go, by what it is."""
    json_type = {"Content_Type": "application/json"}
    view = json.dumps({"ranked_landmarks": list(range(N_LANDMARKS))}).encode()
    padded = view + b" " * (10_000 - len(view))
    return {
        "an image that claims 100,000 x 100,000 pixels": request(
            "POST", _LOCALIZE, vast_png(), Content_Type="image/png"
        ),
        "a batch of 5 MB that unpacks to 1.2 GB": request(
            "POST", _FRAMES, deflate_bomb(), Content_Type="application/octet-stream"
        ),
        "a body under `Content-Encoding: gzip`": request(
            "POST", _LOCALIZE, zlib.compress(view), Content_Encoding="gzip", **json_type
        ),
        "a view in 10,000 chunks of one byte (honest, if odd)": chunked(
            [padded[place : place + 1] for place in range(len(padded))], **json_type
        ),
        "100 kB of headers": request("GET", "/healthz", X_Filler="a" * 100_000),
        "a request line of 100 kB": request("GET", "/" + "a" * 100_000),
        "JSON 100,000 lists deep": request("POST", _LOCALIZE, b"[" * 100_000, **json_type),
        "a number of 100,000 digits": request(
            "POST", _LOCALIZE, b'{"ranked_landmarks":[' + b"9" * 100_000 + b"]}", **json_type
        ),
        "`..` and an encoded slash for a domain": request("GET", "/v1/domains/..%2f..%2fetc%2fpasswd"),
        "SQL for a domain": request("GET", "/v1/domains/x'%3B%20DROP%20TABLE%20domain%3B--"),
        "a name in other letters": request("GET", "/v1/domains/%D0%BA%D0%B0%D0%BC%D0%BF%D1%83%D1%81"),
        "`Content-Length` and chunks at once": request(
            "POST", _LOCALIZE, b"0\r\n\r\n", Transfer_Encoding="chunked", **json_type
        ),
        "bytes that are no HTTP": bytes(range(256)) * 4,
    }


def told(port: int, sent: bytes, give_up_s: float = 60.0) -> tuple[float, str]:
    """Seconds from the last byte to the answer, and its status line and code."""
    with socket.create_connection(("127.0.0.1", port), timeout=give_up_s) as connection:
        began = time.perf_counter()
        with contextlib.suppress(ConnectionError):
            connection.sendall(sent)
        answer = b""
        with contextlib.suppress(ConnectionError):
            while not _is_whole(answer) and (more := connection.recv(65536)):
                answer += more
        return time.perf_counter() - began, _said(answer)


def _is_whole(answer: bytes) -> bool:
    """Whether the head is there and, of a problem, its code."""
    return b"\r\n\r\n" in answer and (answer.split(b" ", 2)[1] < b"400" or b'"code"' in answer)


def _said(answer: bytes) -> str:
    if not answer:
        return "closed without a word"
    status = answer.split(b" ", 2)[1].decode()
    code = answer.partition(b'"code": "')[2].partition(b'"')[0].decode()
    return f"{status} `{code}`" if code else status


def slow_senders(port: int) -> dict[str, tuple[float, str]]:
    """Those who stop in the middle, and one who is slow but goes on; all at once."""
    found: dict[str, tuple[float, str]] = {}
    view = json.dumps({"ranked_landmarks": list(range(N_LANDMARKS))}).encode()
    whole = request("POST", _LOCALIZE, view, Content_Type="application/json")

    def stops(name: str, sent: bytes) -> None:
        found[name] = told(port, sent)

    def goes_on() -> None:
        name = "a body of which a piece comes every second, 40 s long"
        with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
            began = time.perf_counter()
            connection.sendall(whole[: -len(view)])
            for piece in np.array_split(np.frombuffer(view, np.uint8), 40):
                time.sleep(1.0)
                connection.sendall(piece.tobytes())
            found[name] = (time.perf_counter() - began, _said(connection.recv(65536)))

    threads = [
        threading.Thread(
            target=stops, args=("headers that never end, silent", b"GET /healthz HTTP/1.1\r\nHost: b\r\n")
        ),
        threading.Thread(target=stops, args=("a body that stops in the middle", whole[:-10])),
        threading.Thread(target=goes_on),
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


def robot_ms(url: str, n_views: int = 500) -> tuple[float, float]:
    """Median and 99th percentile of a robot's localizations, in ms."""
    spent = []
    with Link(url) as link:
        for _ in range(n_views):
            began = time.perf_counter()
            link.ask("POST", _LOCALIZE, {"ranked_landmarks": list(range(N_LANDMARKS))})
            spent.append(1000 * (time.perf_counter() - began))
    return float(np.median(spent)), float(np.quantile(spent, 0.99))


def silent_crowd(port: int, measure: Callable[[], tuple[float, float]]) -> tuple[float, float]:
    """Measure while many connections have sent half a header and nothing more."""
    with contextlib.ExitStack() as stack:
        for _ in range(_SILENT):
            connection = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10))
            connection.sendall(b"GET /healthz HTTP/1.1\r\nX-Slow: ")
        return measure()


def large_images() -> list[bytes]:
    """A WebP and a PNG of few bytes, of as many pixels as are taken."""
    picture = np.full((*_LARGE, 3), 90, np.uint8)
    kinds = (("webp", [cv2.IMWRITE_WEBP_QUALITY, 101]), ("png", []))
    return [
        request("POST", _LOCALIZE, cv2.imencode(f".{kind}", picture, asked)[1].tobytes(), Content_Type=f"image/{kind}")
        for kind, asked in kinds
    ]


def large_crowd(
    port: int, pid: int, measure: Callable[[], tuple[float, float]]
) -> tuple[tuple[float, float], Counter[str], float]:
    """Measure while many send images just under the limit; also what those were told, and the peak of memory in MB."""
    bodies, told_each = large_images(), Counter[str]()
    ended = threading.Event()

    def send(number: int) -> None:
        while not ended.is_set():
            said = told(port, bodies[number % 2])[1]
            told_each[said] += 1
            if said.startswith("503"):
                ended.wait(1.0)  # as `Retry-After` says

    Path(f"/proc/{pid}/clear_refs").write_text("5")  # the peak from now on
    with ThreadPoolExecutor(_LARGE_SENDERS) as senders:
        sending = [senders.submit(send, number) for number in range(_LARGE_SENDERS)]
        try:
            measured = measure()
        finally:
            ended.set()
        for each in sending:
            each.result()
    status = Path(f"/proc/{pid}/status").read_text()
    return measured, told_each, int(status.partition("VmHWM:")[2].split()[0]) / 1024


def hostile_table() -> Iterator[str]:
    """Markdown lines."""
    with tempfile.TemporaryDirectory() as folder, LocalServer(Path(folder) / "data") as server:
        port = int(server.url.rpartition(":")[2])
        with Link(server.url) as link:
            make_domain(link)
        robot_ms(server.url)  # warms up
        before, idle = Sample.of(server.pid, 0.0), robot_ms(server.url)
        yield "| sent | answer | after |"
        yield "|---|---|---|"
        for name, sent in attacks().items():
            seconds, said = told(port, sent)
            yield f"| {name} | {said} | {1000 * seconds:.0f} ms |"
        crowd = silent_crowd(port, lambda: robot_ms(server.url))
        for name, (seconds, said) in slow_senders(port).items():
            yield f"| {name} | {said} | {seconds:.1f} s |"
        large, large_told, peak_mb = large_crowd(port, server.pid, lambda: robot_ms(server.url))
        after = Sample.of(server.pid, 0.0)
    yield ""
    yield "| a robot's localization | median | p99 |"
    yield "|---|---|---|"
    yield f"| alone | {idle[0]:.2f} ms | {idle[1]:.2f} ms |"
    yield f"| beside {_SILENT} connections with half a header | {crowd[0]:.2f} ms | {crowd[1]:.2f} ms |"
    yield f"| beside {_LARGE_SENDERS} senders of images just under the limit | {large[0]:.2f} ms | {large[1]:.2f} ms |"
    yield ""
    answers = ", ".join(f"{n} times {said}" for said, n in large_told.most_common())
    yield f"Images just under the limit were answered {answers}; the service's memory was {peak_mb:.0f} MB at its peak."
    yield ""
    yield (
        f"The service's memory before and after all of it: {before.rss_mb:.0f} and {after.rss_mb:.0f} MB; "
        f"its file handles: {before.n_handles} and {after.n_handles}."
    )


def main() -> None:
    """Print the page."""
    print("# Hostile and broken senders\n\nMade by `python -m bench.hostile`, with the default limits.")
    print(f"`tests/contract/test_hostile.py` has more of them, with shorter limits.\n\nMachine: {describe()}\n")
    for line in hostile_table():
        print(line, flush=True)


if __name__ == "__main__":
    main()
