"""A real Chromium before the real service; without one these tests are skipped, and say so."""

import shutil
from pathlib import Path

import cv2
import httpx2
import numpy as np
import pytest

from tests.client.conftest import serving

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
QUIET = [
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]
N_FRAMES = 24


def pictures(folder: Path, seed: int) -> Path:
    """A folder of pictures of a drive past coloured walls, each a little like its neighbours; a season is noise."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    wall = cv2.resize(np.random.default_rng(7).integers(0, 255, (8, 90, 3), np.uint8), (1800, 160))
    for frame in range(N_FRAMES):
        view = wall[:, 50 * frame : 50 * frame + 240].astype(np.int16) + rng.integers(-20, 20, (160, 240, 3))
        cv2.imwrite(str(folder / f"{frame:03d}.jpg"), np.clip(view, 0, 255).astype(np.uint8))
    return folder


@pytest.fixture(scope="session")
def drives(tmp_path_factory) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("drives")
    return {name: pictures(base / name, seed) for seed, name in enumerate(("summer", "winter"))}


def make_domain(url: str, name: str, drive: Path | None, **headers: str) -> None:
    """Make a domain on a loop, and its map if there is a drive."""
    with httpx2.Client(base_url=url, headers=headers, timeout=120) as client:
        body = {"evaluator": {"kind": "feature_l2", "extractor": "gradient_grid"}, "thumbnails": True}
        client.put(f"/v1/admin/domains/{name}", json=body).raise_for_status()
        if drive is None:
            return
        base = f"/v1/admin/domains/{name}/traverses"
        client.post(base, json={"name": "summer"}).raise_for_status()
        for index, path in enumerate(sorted(drive.iterdir())):
            turn = 2 * np.pi * index / N_FRAMES
            query = f"position_m={2 * index}&name={path.name}&x_m={10 * np.cos(turn)}&y_m={10 * np.sin(turn)}"
            client.put(
                f"{base}/summer/frames/{index}?{query}",
                content=path.read_bytes(),
                headers={"Content-Type": "image/jpeg"},
            ).raise_for_status()
        body = {"training_traverse": "summer", "list_length": 3, "training_episodes": 50}
        job = client.post(f"/v1/admin/domains/{name}/remaps", json=body).raise_for_status().json()
        with client.stream("GET", f"/v1/admin/jobs/{job['job_id']}/events") as stream:
            assert '"succeeded"' in stream.read().decode()


@pytest.fixture(scope="session")
def service(tmp_path_factory, drives):
    """An address where the domain `route` is mapped."""
    with serving(tmp_path_factory.mktemp("console")) as url:
        make_domain(url, "route", drives["summer"])
        yield url


@pytest.fixture(scope="module")
def chromium():
    """One browser for each test file: while it is open, no other test could start an event loop."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed: apt-get install chromium")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=CHROMIUM, args=QUIET, chromium_sandbox=False)
        yield browser
        browser.close()


@pytest.fixture
def open_page(chromium, service):
    """Opens a page of the console; any complaint of the page fails the test, unless it was expected."""
    contexts, complaints = [], []

    def open_(fragment: str = "", url: str | None = None, expected: str = "\0", **options):
        context = chromium.new_context(**options)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(60_000)

        def complain(text: str) -> None:
            if expected not in text:
                complaints.append(text)

        page.on("console", lambda message: complain(message.text) if message.type in {"error", "warning"} else None)
        page.on("pageerror", lambda error: complain(str(error)))
        page.goto(f"{url or service}/console#{fragment}")
        return page

    yield open_
    for context in contexts:
        context.close()
    assert complaints == []
