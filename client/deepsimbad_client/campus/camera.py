"""The front camera: an upright pinhole 1.2 m above the ground, and the frame it sees the world in."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

UPRIGHT_SIZE = (1232, 1616)
"""Width and height of a picture the right way up; it is stored turned 90 degrees counter-clockwise."""

CANVAS_SIZE = (560, 728)
"""Width and height pictures are drawn at: a little more than is seen, so that the robot may nod."""

SEEN_SIZE = (528, 693)
"""Width and height of the part of the canvas that is seen."""

FOCAL_PX = 300.0
CENTRE_X = CANVAS_SIZE[0] / 2
HORIZON_Y = CANVAS_SIZE[1] * 0.47
EYE_M = 1.2
NEAR_M = 0.35


@dataclass(frozen=True)
class View:
    """Where the camera is and what it looks along.

    Attributes:
        north_m: Place.
        east_m: Place.
        heading_rad: Clockwise from north.
        pitch_rad: Positive looks up.
        roll_rad: Positive leans right.
    """

    north_m: float
    east_m: float
    heading_rad: float
    pitch_rad: float = 0.0
    roll_rad: float = 0.0

    def to_camera(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """[n, 2] metres to the right of and ahead of the camera, of [n, 2] north and east."""
        cos, sin = np.cos(self.heading_rad), np.sin(self.heading_rad)
        turn = np.array([[-sin, cos], [cos, sin]])
        return np.asarray((points - (self.north_m, self.east_m)) @ turn, np.float64)


def project(right_ahead: NDArray[np.float64], height_m: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """[n, 2] canvas pixels (x right, y down) of points right of, ahead of and above the ground.

    The pitch and roll of a view are applied to the finished picture; heights are above the ground.
    """
    per_m = FOCAL_PX / np.maximum(right_ahead[:, 1], 1e-3)
    pixels = np.empty((len(right_ahead), 2))
    pixels[:, 0] = CENTRE_X + right_ahead[:, 0] * per_m
    pixels[:, 1] = HORIZON_Y + (EYE_M - height_m) * per_m
    return pixels


def clip_near(polygon: NDArray[np.float64]) -> NDArray[np.float64]:
    """The part of an [n, 2] ground polygon (right, ahead) that lies ahead of the camera; may be empty."""
    ahead = polygon[:, 1] - NEAR_M
    if (ahead >= 0).all():
        return polygon
    kept: list[NDArray[np.float64]] = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if ahead[i] >= 0:
            kept.append(polygon[i])
        if (ahead[i] >= 0) != (ahead[j] >= 0):
            t = ahead[i] / (ahead[i] - ahead[j])
            kept.append(polygon[i] + t * (polygon[j] - polygon[i]))
    return np.array(kept) if kept else np.zeros((0, 2))
