"""Images just under the pixel limit, many at once: what they cost a real process."""

import io
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from PIL import Image as Pillow

from .conftest import Caller, encoded, picture
from .served import Served

WIDTH, HEIGHT = 10_000, 5_000  # 50,000,000 pixels, the default limit
# One such image while it is decoded (a lossless WebP in two forms at once: 350 MB), and as much again for the rest.
MOST_MIB = 700
N_SENDERS = 14
LOCALIZE = "/v1/domains/ready/localizations"  # an image that shows something is refused, when it has been looked at
FRAMES = "/v1/admin/domains/seen/traverses/t/frames"
DONE, LOOKED_AT = (201, None), (415, "unsupported_media_type")


def large(form):
    stream = io.BytesIO()
    Pillow.new("RGB", (WIDTH, HEIGHT), (30, 60, 90)).save(stream, form, lossless=True)
    assert stream.tell() < 200_000
    return stream.getvalue()


@pytest.mark.slow
def test_many_just_under_the_limit_at_once(tmp_path):
    """They wait for each other, and some are refused; a robot's own views go on, and memory is that of one of them."""
    bombs = {form: large(form) for form in ("webp", "png")}
    small = encoded(picture(1))
    stopped, n_seen, faults = threading.Event(), 0, []

    def send(path, body, kind):
        method = "PUT" if path.startswith(FRAMES) else "POST"
        answer = client.request(method, path, content=body, headers={"Content-Type": f"image/{kind}"})
        return answer.status_code, answer.json().get("code")

    def robot():
        nonlocal n_seen
        while not stopped.is_set():
            answers = send(f"{FRAMES}/0?position_m=0", small, "jpeg"), send(LOCALIZE, small, "jpeg")
            if answers != ((200, None), LOOKED_AT):
                faults.append(answers)
            n_seen += 1

    def hostile(number):
        kind, body = list(bombs.items())[number % 2]
        return send(f"{FRAMES}/{number + 1}?position_m=0" if number % 3 == 0 else LOCALIZE, body, kind)

    with Served(tmp_path / "data") as served, Caller(base_url=served.url, timeout=120) as client:
        client.make_ready_domain("ready")
        client.put("/v1/admin/domains/seen", json={"evaluator": {"kind": "feature_l2"}})
        client.post("/v1/admin/domains/seen/traverses", json={"name": "t"})
        assert send(f"{FRAMES}/0?position_m=0", small, "jpeg") == DONE
        with served.within(MOST_MIB):
            thread = threading.Thread(target=robot)
            thread.start()
            with ThreadPoolExecutor(N_SENDERS) as senders:
                answers = set(senders.map(hostile, range(N_SENDERS)))
            n_seen_meanwhile = n_seen
            stopped.set()
            thread.join()
        assert faults == []
        assert n_seen_meanwhile >= 3
        assert answers <= {DONE, LOOKED_AT, (503, "overloaded")}
        assert answers & {DONE, LOOKED_AT}
        # And none of it is kept: each is answered when it comes alone.
        for number, (kind, body) in enumerate(bombs.items()):
            assert send(f"{FRAMES}/{100 + number}?position_m=0", body, kind) == DONE
