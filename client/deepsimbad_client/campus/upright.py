"""Walls and trees on the canvas: pictures put in perspective, lit and hazed."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.camera import CANVAS_SIZE, FOCAL_PX, NEAR_M, View, project
from deepsimbad_client.campus.light import Light
from deepsimbad_client.campus.scenery import Facade, FacadeStyle
from deepsimbad_client.campus.trees import HEIGHT, WIDTH, Sprite
from deepsimbad_client.campus.world import SIGHT_M

Image = NDArray[np.uint8]

KEPT = 96
"""Pictures of facades kept; about 1 MB each."""

HALF_VIEW = CANVAS_SIZE[0] / 2 / FOCAL_PX + 0.02


class Facades:
    """Puts walls on canvases; draws each wall's picture once and keeps the latest.

    Args:
        draw: Makes the picture of a style and its halvings.
    """

    def __init__(self, draw: Callable[[FacadeStyle], tuple[Image, ...]]) -> None:
        self._draw = draw
        self._kept: OrderedDict[FacadeStyle, tuple[Image, ...]] = OrderedDict()
        self._lock = threading.Lock()

    def panels(self, facade: Facade, view: View) -> Iterator[tuple[float, NDArray[np.float64], tuple[float, float]]]:
        """Cut the part of a wall that is in view into panels short enough to be sorted by distance.

        Yields:
            Distance ahead in metres, [2, 2] (right, ahead) of the panel's left and right foot, and where these lie
            along the wall, 0 its left and 1 its right edge.
        """
        ends = view.to_camera(np.stack([facade.left, facade.right]))
        (x0, z0), (x1, z1) = ends
        if x1 * z0 - x0 * z1 <= 0 or max(z0, z1) < NEAR_M or min(z0, z1) > SIGHT_M:
            return
        first, last = 0.0, 1.0
        if z0 < NEAR_M:
            first = (NEAR_M - z0) / (z1 - z0)
        elif z1 < NEAR_M:
            last = (NEAR_M - z0) / (z1 - z0)
        near = max(NEAR_M, min(z0, z1))
        length = (last - first) * float(np.hypot(x1 - x0, z1 - z0))
        cuts = np.linspace(first, last, int(np.ceil(length / max(5.0, 0.4 * near))) + 1)
        feet = ends[0] + cuts[:, None] * (ends[1] - ends[0])
        ahead = np.maximum(feet[:, 1], 1e-3)
        slope = feet[:, 0] / ahead
        for k in range(len(cuts) - 1):
            if slope[k] < HALF_VIEW and slope[k + 1] > -HALF_VIEW:
                yield float((ahead[k] + ahead[k + 1]) / 2), feet[k : k + 2], (float(cuts[k]), float(cuts[k + 1]))

    def draw(
        self,
        canvas: Image,
        style: FacadeStyle,
        feet: NDArray[np.float64],
        span: tuple[float, float],
        light: Light,
        gain: NDArray[np.float64],
    ) -> None:
        """Draw one panel of a wall."""
        low, high = project(feet, 0.0), project(feet, style.height_m)
        tall = float(max(low[0, 1] - high[0, 1], low[1, 1] - high[1, 1]))
        levels = self._pictures(style)
        level = int(np.clip(np.log2(max(levels[0].shape[0] / max(tall, 1.0), 1.0)), 0, len(levels) - 1))
        picture = levels[level]
        height, width = picture.shape[:2]
        first, last = max(0, int(span[0] * width) - 1), min(width, int(np.ceil(span[1] * width)) + 1)
        xs, ys = [low[0, 0], low[1, 0]], [low[0, 1], low[1, 1], high[0, 1], high[1, 1]]
        left, right = max(0, int(min(xs)) - 2), min(CANVAS_SIZE[0], int(max(xs)) + 3)
        top, bottom = max(0, int(min(ys)) - 1), min(CANVAS_SIZE[1], int(max(ys)) + 2)
        if left >= right or top >= bottom:
            return
        part = light.shine_on(np.ascontiguousarray(picture[:, first:last]), gain, float(feet[:, 1].mean()))
        u0, u1 = span[0] * width - first - 0.5, span[1] * width - first - 0.5
        source = np.array([(u0, -0.5), (u1, -0.5), (u1, height - 0.5), (u0, height - 0.5)], np.float32)
        target = np.stack([high[0], high[1], low[1], low[0]]) - (left, top)
        bend = cv2.getPerspectiveTransform(source, target.astype(np.float32))
        roi = canvas[top:bottom, left:right]
        size = (right - left, bottom - top)
        cv2.warpPerspective(part, bend, size, dst=roi, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_TRANSPARENT)

    def _pictures(self, style: FacadeStyle) -> tuple[Image, ...]:
        with self._lock:
            if style in self._kept:
                self._kept.move_to_end(style)
                return self._kept[style]
        levels = self._draw(style)
        with self._lock:
            self._kept[style] = levels
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        return levels


def wall_normal(facade: Facade) -> tuple[float, float]:
    """North and east of a wall's outward unit normal."""
    north, east = facade.right - facade.left
    length = float(np.hypot(north, east))
    # From left to right seen from outside: outward is a quarter turn clockwise from above.
    return -float(east) / length, float(north) / length


def draw_sprite(
    canvas: Image,
    sprite: Sprite,
    foot: NDArray[np.float64],
    height_m: float,
    mirrored: bool,
    light: Light,
) -> None:
    """Draw a tree whose foot is at metres right and ahead."""
    ahead = float(foot[1])
    x, y = project(foot[None], 0.0)[0]
    tall = FOCAL_PX * height_m / ahead
    scale = tall / HEIGHT
    wide = WIDTH * scale
    left, right = max(0, int(x - wide / 2)), min(CANVAS_SIZE[0], int(x + wide / 2) + 1)
    top, bottom = max(0, int(y - tall)), min(CANVAS_SIZE[1], int(y) + 1)
    if left >= right or top >= bottom:
        return
    level = int(np.clip(np.log2(max(1.0, 1 / scale)), 0, len(sprite.levels) - 1))
    picture = sprite.levels[level]
    grow_x, grow_y = wide / picture.shape[1], tall / picture.shape[0]
    if mirrored:
        grow_x = -grow_x
    corner = x + wide / 2 if mirrored else x - wide / 2
    place = np.array([[grow_x, 0, corner - left], [0, grow_y, y - tall - top]])
    part = cv2.warpAffine(picture, place, (right - left, bottom - top), flags=cv2.INTER_LINEAR)
    colour = np.asarray(cv2.cvtColor(part, cv2.COLOR_BGRA2BGR), np.uint8)
    alpha = np.asarray(cv2.merge([part[:, :, 3]] * 3), np.uint8)
    gain = light.in_shade + 0.55 * (light.on_ground - light.in_shade)
    share = light.haze(ahead)
    table = np.clip(np.arange(256)[:, None] * gain * (1 - share), 0, 255).astype(np.uint8)[None]
    colour = np.asarray(cv2.LUT(colour, table), np.uint8)
    if share > 0.03:
        table = np.clip(np.arange(256)[:, None] * light.air / 255 * share, 0, 255).astype(np.uint8)[None]
        cv2.add(colour, cv2.LUT(alpha, table), dst=colour)
    roi = canvas[top:bottom, left:right]
    cv2.multiply(roi, cv2.bitwise_not(alpha), dst=roi, scale=1 / 255)
    cv2.add(roi, colour, dst=roi)
