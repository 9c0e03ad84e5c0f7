"""What hostile and broken senders get, after how long, and what it does to a robot beside them.

`python -m bench.hostile` prints `docs/results/hostile.md`; the limits are the default ones.
"""

import contextlib
import io
import json
import socket
import struct
import threading
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from bench.link import BINARY, JSON, Link
from bench.load import Sample
from bench.measurement import Command, machine, markdown, print_page, work_folder
from bench.robots import LiveRobot, drive
from bench.soak.actor import BASE, DOMAIN, N_LANDMARKS, make_domain
from deepsimbad_client.http.local_server import LocalServer

_SILENT = 900
_LARGE, _LARGE_SENDERS = (5_000, 10_000), 24  # pixels just under the limit
_LOCALIZE = f"/v1/domains/{DOMAIN}/localizations"
_FRAMES = f"{BASE}/traverses/spring/frames"
VIEW = json.dumps({"ranked_landmarks": list(range(N_LANDMARKS))}).encode()


def request(method: str, path: str, body: bytes = b"", **headers: str) -> bytes:
    """The bytes of a request."""
    fields = {
        "Host": "localhost",
        "Content-Length": str(len(body)),
        **{k.replace("_", "-"): v for k, v in headers.items()},
    }
    lines = [f"{method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in fields.items() if value)]
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


def attacks() -> dict[str, bytes]:
    """Requests that are sent in one go, by what they are."""

    def view(body: bytes, **headers: str) -> bytes:
        return request("POST", _LOCALIZE, body, **{"Content_Type": JSON, **headers})

    padded, in_chunks = VIEW + b" " * (10_000 - len(VIEW)), {"Content_Length": "", "Transfer_Encoding": "chunked"}
    chunks = b"".join(b"1\r\n%c\r\n" % byte for byte in padded) + b"0\r\n\r\n"
    cyrillic = "/v1/domains/%D0%BA%D0%B0%D0%BC%D0%BF%D1%83%D1%81"
    return {
        "an image that claims 100,000 x 100,000 pixels": view(vast_png(), Content_Type="image/png"),
        "a batch of 5 MB that unpacks to 1.2 GB": request("POST", _FRAMES, deflate_bomb(), Content_Type=BINARY),
        "a body under `Content-Encoding: gzip`": view(zlib.compress(VIEW), Content_Encoding="gzip"),
        "a view in 10,000 chunks of one byte (honest, if odd)": view(b"", **in_chunks) + chunks,
        "a megabyte of headers": request("GET", "/healthz", X_Filler="a" * 1_000_000),
        "a request line of a megabyte": request("GET", "/" + "a" * 1_000_000),
        "JSON 100,000 lists deep": view(b"[" * 100_000),
        "a number of 100,000 digits": view(b'{"ranked_landmarks":[' + b"9" * 100_000 + b"]}"),
        "`..` and an encoded slash for a domain": request("GET", "/v1/domains/..%2f..%2fetc%2fpasswd"),
        "SQL for a domain": request("GET", "/v1/domains/x'%3B%20DROP%20TABLE%20domain%3B--"),
        "a name in other letters": request("GET", cyrillic),
        "`Content-Length` and chunks at once": view(b"0\r\n\r\n", Transfer_Encoding="chunked"),
        "bytes that are no HTTP": bytes(range(256)) * 4,
    }


def answer_to(port: int, content: bytes, give_up_s: float = 60.0) -> tuple[float, str]:
    """Seconds from the last byte to the answer, and its status line and code."""
    with socket.create_connection(("127.0.0.1", port), timeout=give_up_s) as connection:
        start_s = time.perf_counter()
        with contextlib.suppress(ConnectionError):
            connection.sendall(content)
        answer = b""
        try:
            while not _is_whole(answer) and (received := connection.recv(65536)):
                answer += received
        except TimeoutError:
            return time.perf_counter() - start_s, "none: it is held until the sender leaves, or a proxy ends it"
        except ConnectionError:
            pass
        return time.perf_counter() - start_s, _verdict(answer)


def _is_whole(answer: bytes) -> bool:
    """Whether the head is there and, of a problem, its code."""
    return b"\r\n\r\n" in answer and (answer.split(b" ", 2)[1] < b"400" or b'"code"' in answer)


def _verdict(answer: bytes) -> str:
    if not answer:
        return "closed without a word"
    status = answer.split(b" ", 2)[1].decode()
    code = answer.partition(b'"code": "')[2].partition(b'"')[0].decode()
    return f"{status} `{code}`" if code else status


def slow_senders(port: int) -> dict[str, tuple[float, str]]:
    """Answers to senders that stop half-way for half a minute, and to one that is slow and goes on; all at once."""
    whole_request, half_a_head = request("POST", _LOCALIZE, VIEW, Content_Type=JSON), request("GET", "/healthz")[:-2]

    def goes_on() -> tuple[float, str]:
        with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
            start_s = time.perf_counter()
            connection.sendall(whole_request[: -len(VIEW)])
            for piece in np.array_split(np.frombuffer(VIEW, np.uint8), 40):
                time.sleep(1.0)
                connection.sendall(piece.tobytes())
            return time.perf_counter() - start_s, _verdict(connection.recv(65536))

    with ThreadPoolExecutor(3) as senders:
        sending = {
            "a body of which a piece comes every second, 40 s long": senders.submit(goes_on),
            "headers that never end, silent": senders.submit(answer_to, port, half_a_head, 30),
            "a body that stops in the middle": senders.submit(answer_to, port, whole_request[:-10], 30),
        }
        return {name: future.result() for name, future in sending.items()}


def robot_ms(url: str) -> tuple[str, str]:
    """Median and 99th percentile of a robot's localizations, in ms."""
    robot = LiveRobot("", DOMAIN, [VIEW])
    (waits,) = drive(url, [robot], lambda waits: len(waits.seconds) + 1 >= 500)
    if waits.failures:
        raise RuntimeError(f"the robot was refused: {waits.failures}")
    return f"{1000 * waits.quantile_s(0.5):.2f} ms", f"{1000 * waits.quantile_s(0.99):.2f} ms"


def large_crowd(url: str, pid: int) -> tuple[tuple[str, str], Counter[str], float]:
    """A robot's times while many send images just under the limit, the answers to those, and the peak memory in MB."""
    port, picture = int(url.rpartition(":")[2]), np.full((*_LARGE, 3), 90, np.uint8)
    bodies = [  # few bytes, of as many pixels as are taken
        request(
            "POST", _LOCALIZE, cv2.imencode(f".{kind}", picture, options)[1].tobytes(), Content_Type=f"image/{kind}"
        )
        for kind, options in (("webp", [cv2.IMWRITE_WEBP_QUALITY, 101]), ("png", []))
    ]
    verdicts, is_over = Counter[str](), threading.Event()

    def send(number: int) -> None:
        while not is_over.is_set():
            verdict = answer_to(port, bodies[number % 2])[1]
            verdicts[verdict] += 1
            if verdict.startswith("503"):
                is_over.wait(1.0)  # as `Retry-After` says

    Path(f"/proc/{pid}/clear_refs").write_text("5")  # the peak from now on
    with ThreadPoolExecutor(_LARGE_SENDERS) as senders:
        sending = [senders.submit(send, number) for number in range(_LARGE_SENDERS)]
        try:
            robot_times = robot_ms(url)
        finally:
            is_over.set()
        for future in sending:
            future.result()
    status = Path(f"/proc/{pid}/status").read_text()
    return robot_times, verdicts, int(status.partition("VmHWM:")[2].split()[0]) / 1024


def report() -> Iterator[str]:
    """The lines of the page."""
    yield from ("# Hostile and broken senders", "", "Made by `python -m bench.hostile`, with the default limits.")
    yield from ("`tests/contract/test_hostile.py` has more of them, with shorter limits.", "", machine(), "")
    with work_folder() as folder, LocalServer(folder / "data") as server:
        port = int(server.url.rpartition(":")[2])
        with Link(server.url) as link:
            make_domain(link)
        robot_ms(server.url)  # warms up
        earlier, robot = Sample.of(server.pid), {"alone": robot_ms(server.url)}
        rows = []
        for name, content in attacks().items():
            seconds, verdict = answer_to(port, content)
            rows.append((name, verdict, f"{1000 * seconds:.0f} ms"))
        with contextlib.ExitStack() as stack:
            for _ in range(_SILENT):
                connection = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10))
                connection.sendall(b"GET /healthz HTTP/1.1\r\nX-Slow: ")
            robot[f"beside {_SILENT} connections with half a header"] = robot_ms(server.url)
        rows += [(name, verdict, f"{seconds:.1f} s") for name, (seconds, verdict) in slow_senders(port).items()]
        crowd, verdicts, peak_mb = large_crowd(server.url, server.pid)
        robot[f"beside {_LARGE_SENDERS} senders of images just under the limit"] = crowd
        later = Sample.of(server.pid)
    yield from markdown(("sent", "answer", "after"), rows)
    yield ""
    yield from markdown(("a robot's localization", "median", "p99"), [(name, *spent) for name, spent in robot.items()])
    yield ""
    answers = ", ".join(f"{n} times {verdict}" for verdict, n in verdicts.most_common())
    yield f"Images just under the limit were answered {answers}; the service's memory was {peak_mb:.0f} MB at its peak."
    yield ""
    yield (
        f"The service's memory before and after all of it: {earlier.rss_mb:.0f} and {later.rss_mb:.0f} MB; "
        f"its file handles: {earlier.n_handles} and {later.n_handles}."
    )


if __name__ == "__main__":
    Command(__doc__).run(lambda _: print_page(report()))
