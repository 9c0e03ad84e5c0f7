"""Robots that ask over one kept connection each, and the pictures that their cameras take."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np

from bench.link import JSON, Link, RefusedError
from bench.measurement import duration
from deepsimbad_campus.renderer import Renderer
from deepsimbad_campus.route import Drive, drive_length_m
from deepsimbad_campus.season import PAPER_DATES, drive_date
from deepsimbad_campus.world import World


@dataclass(frozen=True)
class LiveRobot:
    """One robot.

    Attributes:
        name: What it does, in a table.
        domain: Name of the domain where it is.
        bodies: The bodies that it sends, in turn.
        media_type: Of the bodies.
        session_length: Moves of 1 m in a session, then another one: the route has an end. 0: it asks without a session.
        pause_s: Seconds between an answer and its next request.
    """

    name: str
    domain: str
    bodies: Sequence[bytes]
    media_type: str = JSON
    session_length: int = 0
    pause_s: float = 0.0


@dataclass
class Waits:
    """What one robot met with.

    Attributes:
        seconds: From every request to its answer.
        failures: Status and code of answers that were no belief.
        map_versions: Of the answers, as they came, without repetitions.
        timings_ms: Of every tenth answer, as the service gives them.
        session_id: Its last session; empty: none.
    """

    seconds: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    map_versions: list[int] = field(default_factory=list)
    timings_ms: list[dict[str, float]] = field(default_factory=list)
    session_id: str = ""

    def quantile_s(self, share: float) -> float:
        """Seconds within which this share of the answers came."""
        return float(np.quantile(self.seconds, share))

    def __str__(self) -> str:
        return f"{duration(self.quantile_s(0.5))}, {duration(self.quantile_s(0.99))} ({len(self.seconds)})"


def drive(url: str, robots: Sequence[LiveRobot], is_over: Callable[[Waits], bool]) -> list[Waits]:
    """Let every robot ask, in a thread of its own, until it is over, and once more."""
    with ThreadPoolExecutor(len(robots)) as pool:
        return list(pool.map(partial(_ask, url, is_over), robots))


def _ask(url: str, is_over: Callable[[Waits], bool], robot: LiveRobot) -> Waits:
    waits, is_last = Waits(), False
    path, headers = f"/v1/domains/{robot.domain}/localizations", {"Content-Type": robot.media_type}
    with Link(url) as link:
        while not is_last:
            number, is_last = len(waits.seconds), is_over(waits)
            if robot.session_length and number % robot.session_length == 0:
                waits.session_id = link.ask("POST", f"/v1/domains/{robot.domain}/sessions", {})["session_id"]
                path = f"/v1/sessions/{waits.session_id}/observations?action_m=1"
            key = {"Idempotency-Key": f"view-{number}"} if robot.session_length else {}
            start_s = time.perf_counter()
            try:
                answer = link.ask("POST", path, robot.bodies[number % len(robot.bodies)], headers | key)
            except RefusedError as error:
                answer = None
                waits.failures.append(f"{error.status} {error.code}")
            waits.seconds.append(time.perf_counter() - start_s)
            if answer is not None and waits.map_versions[-1:] != [answer["map_version"]]:
                waits.map_versions.append(answer["map_version"])
            if answer is not None and number % 10 == 0:
                waits.timings_ms.append(answer["timings_ms"])
            time.sleep(robot.pause_s)
    return waits


def jpegs(n_pictures: int) -> list[bytes]:
    """JPEG files of 1232 x 1616 pixels, upright, one a place along a drive."""
    spacing_m, date = 1.75, drive_date(next(iter(PAPER_DATES)))
    world = World(0, drive_length_m(n_pictures, spacing_m))
    renderer = Renderer(world, Drive(world.route, 0, date, n_pictures, spacing_m))
    upright = (cv2.rotate(renderer.stored_picture(frame), cv2.ROTATE_90_CLOCKWISE) for frame in range(n_pictures))
    return [cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes() for picture in upright]


def grainy_jpegs(n_pictures: int) -> list[bytes]:
    """JPEG files of 640 x 480 pixels, about 90 kB each: smooth shapes with the grain of a camera."""
    rng = np.random.default_rng(0)
    bodies = []
    for _ in range(n_pictures):
        coarse = cv2.resize(rng.integers(0, 256, (24, 32, 3), np.uint8), (640, 480), interpolation=cv2.INTER_CUBIC)
        grainy = np.clip(coarse + rng.normal(0, 6, coarse.shape), 0, 255).astype(np.uint8)
        bodies.append(cv2.imencode(".jpg", grainy, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes())
    return bodies
