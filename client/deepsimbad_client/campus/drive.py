"""One drive along the route: where the robot is at every frame, how it holds its head, and when it stands still."""

import datetime
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.camera import View
from deepsimbad_client.campus.noise import smooth_line, stream
from deepsimbad_client.campus.route import Route

BLOCK = 100
"""Frames drawn from one block of randomness; a longer drive begins like a shorter one."""

INTERVAL_US = 700_000
START_M = 2.0
WIDEST_M = 1.2


def drive_length_m(n_frames: int, spacing_m: float) -> float:
    """Route positions a drive of so many frames never goes beyond."""
    return START_M + -(-n_frames // BLOCK) * BLOCK * spacing_m + 1


@dataclass(frozen=True)
class Pose:
    """Where the robot is at [n] moments; the vectors have one element per moment."""

    position_m: NDArray[np.float64]
    right_m: NDArray[np.float64]
    yaw_rad: NDArray[np.float64]
    pitch_rad: NDArray[np.float64]
    roll_rad: NDArray[np.float64]


class Drive:
    """The motion of one drive.

    Args:
        route: The centre line.
        seed: Seed of the campus.
        date: The drive's date; drives of different dates move differently.
        n_frames: How many pictures are taken.
        spacing_m: Metres between two pictures on average.
    """

    def __init__(self, route: Route, seed: int, date: datetime.date, n_frames: int, spacing_m: float) -> None:
        self._route, self.spacing_m = route, spacing_m
        name = date.isoformat()
        blocks = -(-n_frames // BLOCK)
        moves = [_block_moves(stream(seed, f"moves {name}", k), BLOCK * spacing_m) for k in range(blocks)]
        jitter = [stream(seed, f"clock {name}", k).integers(-20_000, 20_000, BLOCK) for k in range(blocks)]
        position = START_M + np.concatenate([[0.0], np.cumsum(np.concatenate(moves))])[:-1]
        self.position_m = position[:n_frames]
        noon = datetime.datetime.combine(date, datetime.time(16), datetime.UTC)
        rng = stream(seed, f"drive {name}")
        start = int(noon.timestamp()) * 1_000_000 + int(rng.integers(0, 3_600_000_000))
        self.utime = (start + np.arange(blocks * BLOCK) * INTERVAL_US + np.concatenate(jitter))[:n_frames]
        """[n] int64 microseconds, strictly rising."""
        along = position[:n_frames]
        bias = rng.uniform(-0.5, 0.5)
        right = bias + 0.6 * smooth_line(stream(seed, f"right {name}"), along / 19)
        self._right = np.clip(right, -WIDEST_M, WIDEST_M)
        lean = rng.normal(0, np.deg2rad(2.6), 2)
        self._turn = lean[0] + np.deg2rad(6.0) * smooth_line(stream(seed, f"turn {name}"), along / 11)
        self._pitch = lean[1] * 0.2 + np.deg2rad(0.55) * smooth_line(stream(seed, f"pitch {name}"), along / 2.3)
        self._roll = np.deg2rad(0.5) * smooth_line(stream(seed, f"roll {name}"), along / 3.1)
        frames = np.arange(n_frames, dtype=np.float64)
        cloud = smooth_line(stream(seed, f"cloud {name}"), frames / 17)
        self.sunniness = cloud
        """[n] smooth noise: how free of clouds the sun is, compared within the drive."""
        self.exposure = np.exp(0.11 * smooth_line(stream(seed, f"exposure {name}"), frames / 7))
        """[n] the camera's gain, about 1."""

    def pose_at(self, utime: NDArray[np.float64]) -> Pose:
        """The pose at [n] moments between the first and the last picture."""
        clock = self.utime.astype(np.float64)
        position = np.interp(utime, clock, self.position_m)

        def held(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(np.interp(utime, clock, values), np.float64)

        yaw = self._route.heading(position) + held(self._turn)
        yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
        return Pose(position, held(self._right), yaw, held(self._pitch), held(self._roll))

    def view(self, frame: int) -> View:
        """What the camera's place is at a frame."""
        pose = self.pose_at(self.utime[frame : frame + 1].astype(np.float64))
        north, east = self._route.place(pose.position_m, pose.right_m)[0]
        return View(
            float(north), float(east), float(pose.yaw_rad[0]), float(pose.pitch_rad[0]), float(pose.roll_rad[0])
        )


def _block_moves(rng: np.random.Generator, length_m: float) -> NDArray[np.float64]:
    """[100] metres moved after each frame of a block; they add up to its length, standing still included."""
    pace = np.exp(0.18 * smooth_line(rng, np.arange(BLOCK) / 6))
    for _ in range(2):
        if rng.random() < 0.7:
            first = int(rng.integers(5, BLOCK - 15))
            pace[first : first + int(rng.integers(3, 7))] = 0.0
    moves: NDArray[np.float64] = pace * (length_m / pace.sum())
    return moves
