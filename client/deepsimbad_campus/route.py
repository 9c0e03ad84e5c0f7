"""The route, the drives along it and their ground truth: a campus before anything stands on it.

Random numbers are drawn for a numbered block or in order, so that the first part of a long world is the short world.
"""

import datetime
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepsimbad_campus.camera import Array, View

STEP_M = 0.5  # between two samples of the centre line
MAX_HEADING_RAD = np.deg2rad(62)  # away from the general direction, so that the route cannot meet itself again
BLOCK = 100  # frames drawn from one block of randomness; a longer drive begins like a shorter one
INTERVAL_US, TRUTH_STEP_US = 700_000, 10_000
START_M, WIDEST_M = 2.0, 1.2
UNCOVERED = (2.4, 1.4)  # intervals between pictures without ground truth at both ends
NAN_SHARE, NAN_FIRST = 0.004, 3


def stream(seed: int, name: str, block: int = 0) -> np.random.Generator:
    """A generator of its own for every (seed, name, block); platforms and processes agree on it."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), block])


def smooth_line(rng: np.random.Generator, places: Array) -> Array:
    """[n] smooth noise at [n] places (not negative) along a line that has a standard normal knot at whole numbers."""
    left = places.astype(np.int64)
    knots, t = rng.standard_normal(int(left.max()) + 2), places - left
    t = t * t * (3 - 2 * t)
    return np.asarray(knots[left] * (1 - t) + knots[left + 1] * t, np.float64)


class Stretch(NamedTuple):
    """A straight part of the route and the bend that follows it."""

    number: int
    start_m: float
    straight_m: float
    end_m: float


class Route:
    """The centre line every drive follows, in the local north-east plane: `length_m` or more, never crossing itself."""

    def __init__(self, seed: int, length_m: float) -> None:
        rng = stream(seed, "route")
        general, offset, position = rng.uniform(-np.pi, np.pi), 0.0, 0.0
        headings: list[Array] = []
        self.stretches: list[Stretch] = []
        while position < length_m:
            straight = rng.integers(70, 150) * STEP_M
            turn = rng.uniform(0.35, 1.5) * rng.choice([-1.0, 1.0])
            if abs(offset + turn) > MAX_HEADING_RAD:
                turn = -turn
            turn = float(np.clip(offset + turn, -MAX_HEADING_RAD, MAX_HEADING_RAD) - offset)
            bend = max(6.0, np.ceil(abs(turn) * rng.uniform(9, 20) / STEP_M) * STEP_M)
            end = position + straight + bend
            self.stretches.append(Stretch(len(self.stretches), position, straight, end))
            headings.append(np.full(int(straight / STEP_M), general + offset))
            headings.append(general + offset + turn * ((np.arange(int(bend / STEP_M)) + 0.5) * STEP_M / bend))
            offset, position = offset + turn, end
        self._heading = np.concatenate(headings)
        steps = np.stack([np.cos(self._heading), np.sin(self._heading)])
        self._north, self._east = np.pad(np.cumsum(steps, axis=1) * STEP_M, ((0, 0), (1, 0)))
        self._position = np.arange(len(self._north)) * STEP_M

    def heading(self, position_m: Array | float) -> Array:
        """[...] heading of the centre line in radians, clockwise from north, at [...] route positions."""
        return np.asarray(np.interp(position_m, self._position[:-1] + STEP_M / 2, self._heading), np.float64)

    def place(self, position_m: Array | float, right_m: Array | float = 0.0) -> Array:
        """[..., 2] north and east, in metres, of the points `right_m` to the right of [...] route positions."""
        heading = self.heading(position_m)
        north = np.interp(position_m, self._position, self._north) - np.sin(heading) * right_m
        east = np.interp(position_m, self._position, self._east) + np.cos(heading) * right_m
        return np.stack([north, east], axis=-1)


def drive_length_m(n_frames: int, spacing_m: float) -> float:
    """The route position that a drive of `n_frames` never goes beyond."""
    return START_M + -(-n_frames // BLOCK) * BLOCK * spacing_m + 1


class Drive:
    """One drive along the route: where the robot is at every frame and when it stands still.

    `utime` [n] int64 microseconds rises strictly, `position_m` [n] never falls; `sunniness` [n] is how free of clouds
    the sun is, compared within the drive; `exposure` [n] the camera's gain, about 1.
    """

    def __init__(self, route: Route, seed: int, date: datetime.date, n_frames: int, spacing_m: float) -> None:
        self._route, self.seed, self.date, self.spacing_m = route, seed, date, spacing_m
        blocks = range(-(-n_frames // BLOCK))
        moves = [_block_moves(stream(seed, f"moves {date}", k), BLOCK * spacing_m) for k in blocks]
        jitter = [stream(seed, f"clock {date}", k).integers(-20_000, 20_000, BLOCK) for k in blocks]
        rng = stream(seed, f"drive {date}")
        start = np.datetime64(f"{date}T16", "us").astype(np.int64) + rng.integers(0, 3_600_000_000)
        self.utime = start + np.arange(n_frames) * INTERVAL_US + np.concatenate(jitter)[:n_frames]
        self.position_m = position_m = (START_M + np.pad(np.cumsum(np.concatenate(moves)), (1, 0)))[:n_frames]
        frames, bias, lean = np.arange(n_frames), rng.uniform(-0.5, 0.5), rng.normal(0, np.deg2rad(2.6), 2)

        def noise(name: str, places: Array) -> Array:
            return smooth_line(stream(seed, f"{name} {date}"), places)

        right = np.clip(bias + 0.6 * noise("right", position_m / 19), -WIDEST_M, WIDEST_M)
        turn = lean[0] + np.deg2rad(6.0) * noise("turn", position_m / 11)
        pitch = lean[1] * 0.2 + np.deg2rad(0.55) * noise("pitch", position_m / 2.3)
        self._moves = (position_m, right, turn, pitch, np.deg2rad(0.5) * noise("roll", position_m / 3.1))
        self.sunniness, self.exposure = noise("cloud", frames / 17), np.exp(0.11 * noise("exposure", frames / 7))

    def poses(self, utime: NDArray[np.int64]) -> tuple[Array, ...]:
        """[n] route position, north, east, yaw, pitch and roll at [n] moments between the first and last picture."""
        position, right, turn, pitch, roll = (np.interp(utime, self.utime, values) for values in self._moves)
        yaw = (self._route.heading(position) + turn + np.pi) % (2 * np.pi) - np.pi
        return position, *self._route.place(position, right).T, yaw, pitch, roll

    def view(self, frame: int) -> View:
        """The camera's pose at a frame."""
        return View(*(float(value[0]) for value in self.poses(self.utime[frame : frame + 1])[1:]))

    def ground_truth(self) -> Iterator[Array]:
        """[m, 7] utime (us), x (north), y (east), z (down) in metres, roll, pitch, yaw in radians, a block at a time.

        As NCLT publishes them, at about 100 Hz, with the quirks a reader must survive: the first and last few pictures
        lie outside of the time covered (of a drive of fewer than 100 hardly any: it would be refused), and some rows
        hold NaN.
        """
        cuts = UNCOVERED if len(self.utime) >= BLOCK else (0.0, -1.0)
        first, last = int(self.utime[0] + INTERVAL_US * cuts[0]), int(self.utime[-1] - INTERVAL_US * cuts[1])
        for block, start in enumerate(range(first, max(last, first + 1), BLOCK * INTERVAL_US)):
            rng = stream(self.seed, f"ground truth {self.date}", block)
            clock = np.arange(start, min(start + BLOCK * INTERVAL_US, last + 1), TRUTH_STEP_US)
            clock = clock + rng.integers(-2_000, 2_000, len(clock))
            position, north, east, yaw, pitch, roll = self.poses(clock)
            rows = np.stack([clock, north, east, 0.4 * np.sin(position / 60), roll, pitch, yaw], axis=1)
            unknown = rng.random(len(rows)) < NAN_SHARE
            burst = rng.integers(0, max(1, len(rows) - 10))
            unknown[burst : burst + rng.integers(2, 8)] = len(rows) > 20
            unknown[: NAN_FIRST if block == 0 else 0] = len(rows) > 20
            rows[unknown, 1:] = np.nan
            yield rows


def _block_moves(rng: np.random.Generator, length_m: float) -> Array:
    """[100] metres moved after each frame of a block; they add up to its length, standing still included."""
    pace = np.exp(0.18 * smooth_line(rng, np.arange(BLOCK) / 6))
    for _ in range(2):
        if rng.random() < 0.7:
            first = int(rng.integers(5, BLOCK - 15))
            pace[first : first + int(rng.integers(3, 7))] = 0.0
    return np.asarray(pace * (length_m / pace.sum()), np.float64)
