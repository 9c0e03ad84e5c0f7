"""Robots that ask over one kept connection each, and the pictures that their cameras take."""

import asyncio
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Self
from urllib.parse import urlsplit

import cv2
import numpy as np

from bench.common import duration
from deepsimbad_campus.renderer import Renderer
from deepsimbad_campus.route import Drive, drive_length_m
from deepsimbad_campus.season import PAPER_DATES, drive_date
from deepsimbad_campus.world import World

JSON = "application/json"


class BareConnection:
    """HTTP/1.1 as far as a benchmark needs it: one request at a time, JSON back.

    Args:
        reader: What comes back.
        writer: What is sent.
    """

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    @classmethod
    async def to(cls, url: str) -> Self:
        """Connect."""
        where = urlsplit(url)
        return cls(*await asyncio.open_connection(where.hostname, where.port))

    async def request(
        self, method: str, path: str, body: bytes = b"", key: str = "", media_type: str = JSON
    ) -> tuple[int, bytes]:
        """Send a request.

        Args:
            method: GET, POST, ...
            path: With its query.
            body: What is sent.
            key: The idempotency key; empty: none.
            media_type: Of the body.

        Returns:
            Status and body of the answer.
        """
        named = f"Idempotency-Key: {key}\r\n" if key else ""
        head = (
            f"{method} {path} HTTP/1.1\r\nHost: bench\r\nContent-Type: {media_type}\r\n"
            f"{named}Content-Length: {len(body)}\r\n\r\n"
        )
        self._writer.write(head.encode() + body)
        answer_head = await self._reader.readuntil(b"\r\n\r\n")
        length = int(answer_head.lower().partition(b"content-length:")[2].partition(b"\r\n")[0])
        return int(answer_head[9:12]), await self._reader.readexactly(length)

    def close(self) -> None:
        """Close it."""
        self._writer.close()


@dataclass(frozen=True)
class LiveRobot:
    """One robot.

    Attributes:
        name: What it does, in a table.
        domain: Where it is.
        bodies: What it sends, in turn.
        media_type: Of them.
        session_length: Moves of 1 m in a session, then another one: the route has an end. 0: it asks without a session.
        pause_s: Seconds between an answer and its next request.
    """

    name: str
    domain: str
    bodies: Sequence[bytes]
    media_type: str = JSON
    session_length: int = 0
    pause_s: float = 0.02


@dataclass
class Waits:
    """What one robot met with.

    Attributes:
        seconds: Of every answer.
        failures: Status and code of answers that were no belief.
        map_versions: Of the answers, as they came, changes alone.
    """

    seconds: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    map_versions: list[int] = field(default_factory=list)

    @property
    def n_all(self) -> int:
        """Answers in all."""
        return len(self.seconds)

    @property
    def median_s(self) -> float:
        """Seconds."""
        return float(np.median(self.seconds))

    @property
    def p99_s(self) -> float:
        """Seconds."""
        return float(np.quantile(self.seconds, 0.99))

    @property
    def versions(self) -> str:
        """In the order they came."""
        return " then ".join(map(str, self.map_versions))

    def __str__(self) -> str:
        return f"{duration(self.median_s)}, {duration(self.p99_s)} ({self.n_all})"


async def drive(url: str, robots: Sequence[LiveRobot], until: "asyncio.Task[Any]") -> list[Waits]:
    """Let every robot ask until something is done, and once more."""
    return list(await asyncio.gather(*(_ask(url, robot, until) for robot in robots)))


async def _ask(url: str, robot: LiveRobot, until: "asyncio.Task[Any]") -> Waits:
    waits = Waits()
    connection = await BareConnection.to(url)
    path = f"/v1/domains/{robot.domain}/localizations"
    is_last = False
    while not is_last:
        is_last = until.done()
        if robot.session_length and waits.n_all % robot.session_length == 0:
            path = f"/v1/sessions/{await _session(connection, robot.domain)}/observations?action_m=1"
        body = robot.bodies[waits.n_all % len(robot.bodies)]
        began = time.perf_counter()
        status, answer = await connection.request("POST", path, body, media_type=robot.media_type)
        waits.seconds.append(time.perf_counter() - began)
        said = json.loads(answer)
        if status != 200:
            waits.failures.append(f"{status} {said['code']}")
        elif waits.map_versions[-1:] != [said["map_version"]]:
            waits.map_versions.append(said["map_version"])
        await asyncio.sleep(robot.pause_s)
    connection.close()
    return waits


async def _session(connection: BareConnection, domain: str) -> str:
    status, answer = await connection.request("POST", f"/v1/domains/{domain}/sessions", b"{}")
    if status != 201:
        raise RuntimeError(f"no session: {answer!r}")
    return str(json.loads(answer)["session_id"])


_QUALITY, _SPACING_M = 90, 1.75


def jpegs(n_pictures: int) -> list[bytes]:
    """JPEG files of 1232 x 1616 pixels, upright, one a place along a drive."""
    date = drive_date(next(iter(PAPER_DATES)))
    world = World(0, drive_length_m(n_pictures, _SPACING_M))
    renderer = Renderer(world, Drive(world.route, 0, date, n_pictures, _SPACING_M))
    return [_jpeg(renderer, frame) for frame in range(n_pictures)]


def _jpeg(renderer: Renderer, frame: int) -> bytes:
    upright = cv2.rotate(renderer.stored(frame), cv2.ROTATE_90_CLOCKWISE)
    packed = cv2.imencode(".jpg", upright, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    return np.asarray(packed, np.uint8).tobytes()
