"""Images just under the pixel limit, many at once, and damaged ones: what they cost a real process."""

import http.client
import io
import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx2
import pytest
from PIL import Image as Pillow

from .conftest import encoded, picture
from .served import Served, make_ready_domain

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 10_000, 5_000  # 50,000,000 pixels, the default limit
# One such image while it is decoded (a lossless WebP in two forms at once: 350 MB), and as much again for the rest.
MOST_MIB = 700
N_SENDERS = 24
LOCALIZE = "/v1/domains/ready/localizations"  # an image that shows something is refused, when it has been looked at
FRAMES = "/v1/admin/domains/seen/traverses/t/frames"


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    made = Served.start(tmp_path / "data", tmp_path / "log")
    try:
        make_ready_domain(made.url, "ready")
        with httpx2.Client(base_url=made.url) as client:
            client.put("/v1/admin/domains/seen", json={"evaluator": {"kind": "feature_l2"}}).raise_for_status()
            client.post("/v1/admin/domains/seen/traverses", json={"name": "t"}).raise_for_status()
        yield made
    finally:
        made.kill()


def large(form: str) -> bytes:
    stream = io.BytesIO()
    Pillow.new("RGB", (WIDTH, HEIGHT), (30, 60, 90)).save(stream, form, lossless=True)
    return stream.getvalue()


def sent(served: Served, method: str, path: str, body: bytes, kind: str) -> tuple[int, str]:
    """The status of an answer, and its code where it is a problem."""
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=120)
    try:
        connection.request(method, path, body, {"Content-Type": f"image/{kind}"})
        answer = connection.getresponse()
        document = json.loads(answer.read())
        return answer.status, document.get("code", "")
    finally:
        connection.close()


def test_many_just_under_the_limit_at_once(served: Served) -> None:
    """They wait for each other, and some are refused; a robot's own views go on, and memory is that of one of them."""
    bombs = {form.lower(): large(form) for form in ("WEBP", "PNG")}
    assert all(len(body) < 200_000 for body in bombs.values())
    small = encoded(picture(1))
    path = f"{FRAMES}/0?position_m=0"
    assert sent(served, "PUT", path, small, "jpeg") == (201, "")
    served.forget_peak()
    before = served.resident_mib
    stopped, n_seen, faults = threading.Event(), 0, []

    def robot() -> None:
        nonlocal n_seen
        while not stopped.is_set():
            for asked in (("PUT", path, small, "jpeg"), ("POST", LOCALIZE, small, "jpeg")):
                answer = sent(served, *asked)
                if answer not in {(200, ""), (415, "unsupported_media_type")}:
                    faults.append(answer)
            n_seen += 1

    def hostile(number: int) -> tuple[int, str]:
        kind, body = list(bombs.items())[number % 2]
        if number % 3 == 0:
            return sent(served, "PUT", f"{FRAMES}/{number + 1}?position_m=0", body, kind)
        return sent(served, "POST", LOCALIZE, body, kind)

    thread = threading.Thread(target=robot)
    thread.start()
    with ThreadPoolExecutor(N_SENDERS) as senders:
        answers = list(senders.map(hostile, range(N_SENDERS)))
    n_seen_meanwhile = n_seen
    stopped.set()
    thread.join()
    assert faults == []
    assert n_seen_meanwhile >= 3
    assert served.peak_mib - before < MOST_MIB
    assert set(answers) <= {(201, ""), (415, "unsupported_media_type"), (503, "overloaded")}
    assert (201, "") in answers or (415, "unsupported_media_type") in answers
    # And none of it is kept: each is answered when it comes alone.
    for number, (kind, body) in enumerate(bombs.items()):
        assert sent(served, "PUT", f"{FRAMES}/{100 + number}?position_m=0", body, kind) == (201, "")
