"""The front camera: an upright pinhole 1.2 m above the ground, and the canvas it sees the world on."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]  # [height, width, 3] blue, green, red, where nothing else is said
Colour = Sequence[float]  # blue, green, red, 0..255
Pair = Array | tuple[float, float]

UPRIGHT_SIZE = (1232, 1616)  # width and height of a picture the right way up; it is stored turned counter-clockwise
WIDTH, HEIGHT = 560, 728  # of the canvas
SEEN_SIZE = (528, 693)  # of the part of it that is seen: a little less, so that the robot may nod
FOCAL_PX, EYE_M, NEAR_M = 300.0, 1.2, 0.35
CENTRE_X, HORIZON_Y = WIDTH / 2, HEIGHT * 0.47
HALF_VIEW = CENTRE_X / FOCAL_PX + 0.02
# Where the canvas's pixels look: [560] columns, sky rows from the top, ground rows from the first below the horizon.
SLOPE = (np.arange(WIDTH) - CENTRE_X) / FOCAL_PX
RISE = (HORIZON_Y - np.arange(int(np.ceil(HORIZON_Y)) + 1))[:, None] / FOCAL_PX
AZIMUTH_DEG = np.rad2deg(np.arctan(SLOPE))
ELEVATION_DEG = np.rad2deg(np.arctan2(RISE, np.sqrt(1 + SLOPE * SLOPE)))
GROUND_ROW = int(HORIZON_Y) + 2
AHEAD_M = np.asarray(FOCAL_PX * EYE_M / (np.arange(GROUND_ROW, HEIGHT) - HORIZON_Y), np.float64)


class View(NamedTuple):
    """The camera's place, its heading (clockwise from north), pitch (up) and roll (leaning right)."""

    north_m: float
    east_m: float
    heading_rad: float
    pitch_rad: float = 0.0
    roll_rad: float = 0.0

    def to_camera(self, points: Array) -> Array:
        """[..., 2] metres to the right of and ahead of the camera, of [..., 2] north and east."""
        cos, sin = np.cos(self.heading_rad), np.sin(self.heading_rad)
        return np.asarray((points - (self.north_m, self.east_m)) @ np.array([[-sin, cos], [cos, sin]]), np.float64)


def project(right_ahead: Array, height_m: Array | float = 0.0) -> Array:
    """[..., 2] canvas pixels (x right, y down) of [..., 2] points right and ahead, before the view's pitch and roll."""
    per_m = FOCAL_PX / np.maximum(right_ahead[..., 1], 1e-3)
    return np.stack([CENTRE_X + right_ahead[..., 0] * per_m, HORIZON_Y + (EYE_M - height_m) * per_m], axis=-1)


def clip_near(polygon: Array) -> Array:
    """The part of an [n, 2] ground polygon (right, ahead) that lies ahead of the camera; may be empty."""
    ahead_m, following = polygon[:, 1] - NEAR_M, np.roll(polygon, -1, axis=0)
    crossing = (ahead_m < 0) != (following[:, 1] < NEAR_M)
    share = ahead_m / np.where(crossing, ahead_m - (following[:, 1] - NEAR_M), 1.0)
    cuts = polygon + share[:, None] * (following - polygon)
    return np.asarray(np.stack([polygon, cuts], axis=1)[np.stack([ahead_m >= 0, crossing], axis=1)], np.float64)


def near_cut(ends: Array) -> Array:
    """[2] the ends of the part of a wall that is ahead of the camera, as shares of the way between its feet [2, 2]."""
    z0, z1 = ends[:, 1]
    return np.array([(NEAR_M - z0) / (z1 - z0) if z < NEAR_M else end for z, end in ((z0, 0.0), (z1, 1.0))])


def sixteenths(pixels: Array) -> NDArray[np.int32]:
    """Pixels as OpenCV takes those of polygons with a shift of 4."""
    return np.clip(np.round(pixels * 16), -400_000, 400_000).astype(np.int32)


def fill(image: Image, ground: Array, ink: Colour) -> None:
    """Fill a convex [n, 2] ground polygon (right, ahead) on the canvas, or on a mask of the ground."""
    polygon, is_mask = clip_near(ground), image.ndim == 2
    if len(polygon) >= 3:
        outline = sixteenths(project(polygon) - (0, GROUND_ROW if is_mask else 0))
        cv2.fillConvexPoly(image, outline, ink, cv2.LINE_8 if is_mask else cv2.LINE_AA, 4)


def window(canvas: Image, low: Pair, high: Pair) -> tuple[tuple[int, int], Image]:
    """The first pixel (x, y) of the part of the canvas between two corners, and the part, which may be empty."""
    left, right = (min(max(int(x), 0), WIDTH) for x in (low[0], high[0]))
    top, bottom = (min(max(int(y), 0), HEIGHT) for y in (low[1], high[1]))
    return (left, top), canvas[top:bottom, left:right]


def ink(colour: ArrayLike) -> list[int]:
    """A colour as OpenCV draws with it."""
    return [min(max(int(value), 0), 255) for value in np.asarray(colour).tolist()]
