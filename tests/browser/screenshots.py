"""Pictures of the console before a rendered campus: `make screenshots` writes README's into docs/images.

With a folder, `python -m tests.browser.screenshots FOLDER` shows every page there, in both themes, on a desk and on a
phone, for somebody who looks at them.
"""

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Page, sync_playwright

from deepsimbad_campus.writer import write_campus
from deepsimbad_client import Client
from deepsimbad_client.http.admin import remap
from deepsimbad_client.http.local_server import LocalServer
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings import Recording
from deepsimbad_client.recordings.sources import open_source

from .conftest import CHROMIUM, QUIET

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
SEASONS, N_FRAMES, N_VIEWS, STEP = ("winter", "spring", "summer"), 300, 14, 3
DESK, PHONE = {"width": 1360, "height": 900}, {"width": 390, "height": 844}
HEIGHT_SHOWN = 1480  # README's: down to the places that are most like a view
_QUALITY = 82


@contextmanager
def campus(folder: Path) -> Iterator[tuple[str, dict[str, Recording]]]:
    """The address of a service that has mapped a campus, with another domain that has no map yet, and the drives."""
    sources = write_campus(folder / "campus", SEASONS, N_FRAMES)
    drives = {season: open_source(source) for season, source in zip(SEASONS, sources, strict=True)}
    with LocalServer(folder / "data") as server, Client(server.url) as client:
        client.admin.put_domain("campus", {"kind": "feature_l2"}, thumbnails=True)
        client.admin.put_domain("harbour", {"kind": "feature_l2"}, thumbnails=True)
        for season in SEASONS[:2]:
            upload(client, drives[season], "campus", season)
        for relevance in ("rrf", "composed"):
            remap(client, "campus", "spring", landmark_traverse="winter", relevance=relevance)
        yield server.url, drives


def drive(client: Client, drive: Recording, first: int, n_views: int) -> str:
    """Drive a session over so many views; returns its id."""
    session = client.session("campus", keep=True)
    for row in range(first, first + n_views * STEP, STEP):
        moved_m = drive.frames[row].position_m - drive.frames[row - STEP].position_m
        session.observe(**drive.view(row, None), action_m=moved_m)
    return session.session_id


def open_page(page: Page, url: str, fragment: str) -> None:
    """Open a page and wait until it rests."""
    page.goto(f"{url}/console#{fragment}")
    page.reload()
    page.wait_for_timeout(1500)


def small(png: bytes, path: Path) -> None:
    """Write a screenshot as WebP."""
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    cv2.imwrite(str(path), image, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])


def main() -> None:
    """Take the pictures."""
    everything = Path(sys.argv[1]) if sys.argv[1:] else None
    with (
        tempfile.TemporaryDirectory() as folder,
        campus(Path(folder)) as (url, drives),
        Client(url) as client,
        sync_playwright() as playwright,
    ):
        session = drive(client, drives["summer"], 60, N_VIEWS)
        job = client.admin.jobs()[0].job_id
        view = drives["summer"].image(drives["summer"].frames[120], None)
        picture = {"name": "view.jpg", "mimeType": view.content_type, "buffer": view.body}
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=QUIET, chromium_sandbox=False)
        if everything is None:
            for name, fragment, scheme in (
                ("console-domain", "domains/campus", "light"),
                ("console-session", f"sessions/{session}", "dark"),
            ):
                tall = {**DESK, "height": HEIGHT_SHOWN}
                page = browser.new_context(viewport=tall, color_scheme=scheme).new_page()
                open_page(page, url, fragment)
                small(page.screenshot(), IMAGES / f"{name}.webp")
            page = browser.new_context(viewport=PHONE, color_scheme="light", device_scale_factor=1.5).new_page()
            open_page(page, url, f"sessions/{session}")
            small(page.screenshot(), IMAGES / "console-phone.webp")
            return
        everything.mkdir(parents=True, exist_ok=True)
        pages = {
            "domains": "",
            "domain": "domains/campus",
            "unmapped": "domains/harbour",
            "jobs": "jobs",
            "upload": "domains/campus/upload",
            "sessions": "sessions",
            "session": f"sessions/{session}",
            "try": "try/campus",
            "tried": "try/campus",
            "job": f"jobs/{job}",
            "report": "report",
            "missing": "none",
        }
        for scheme in ("light", "dark"):
            for width, viewport in (("desk", DESK), ("phone", PHONE)):
                page = browser.new_context(viewport=viewport, color_scheme=scheme).new_page()
                for name, fragment in pages.items():
                    open_page(page, url, fragment)
                    if name == "tried":
                        page.set_input_files("input[type=file]", picture)
                        page.get_by_text("After this one view").wait_for()
                        page.wait_for_timeout(700)
                    page.screenshot(path=everything / f"{name}-{width}-{scheme}.png", full_page=True)


if __name__ == "__main__":
    if CHROMIUM is None:
        sys.exit("no Chromium is installed: apt-get install chromium")
    main()
