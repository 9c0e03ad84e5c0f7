"""The ground as the camera sees it: surfaces, joints and markings, and the shadows that fall on it."""

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.camera import (
    CANVAS_SIZE,
    CENTRE_X,
    EYE_M,
    FOCAL_PX,
    HORIZON_Y,
    View,
    clip_near,
    project,
)
from deepsimbad_client.campus.light import Light
from deepsimbad_client.campus.scenery import Surface
from deepsimbad_client.campus.turf import TILE_M, TILE_PX
from deepsimbad_client.campus.world import Section, World

Image = NDArray[np.uint8]

TOP = int(HORIZON_Y) + 2
BANDS_M = (0.0, 4.0, 10.0, 24.0, 55.0, 1e9)
"""Distances at which a coarser picture of the ground takes over."""

_LABEL: dict[Surface, int] = {"concrete": 1, "asphalt": 2, "paving": 3}
LONGEST_SHADOW_M = 45.0


class Ground:
    """Paints the lower part of pictures of one drive.

    Args:
        world: What lies on the ground.
        tiles: Pictures of every surface, as `turf.draw_ground` makes them.
    """

    def __init__(self, world: World, tiles: dict[str, tuple[Image, ...]]) -> None:
        self._world = world
        self._tiles = (tiles["grass"], tiles["concrete"], tiles["asphalt"], tiles["paving"])
        width, height = CANVAS_SIZE
        rows = np.arange(TOP, height, dtype=np.float64)
        ahead = FOCAL_PX * EYE_M / (rows - HORIZON_Y)
        self._ahead = np.repeat(ahead[:, None], width, axis=1).astype(np.float32)
        self._right = (self._ahead * ((np.arange(width) - CENTRE_X) / FOCAL_PX)[None, :]).astype(np.float32)
        self._bands = [
            (int(np.argmax(ahead < far)), int(np.argmax(ahead < near)) if near else len(rows), level)
            for level, (near, far) in enumerate(pairwise(BANDS_M))
        ]
        haze = ahead[:, None, None]
        self._distance = np.asarray(haze, np.float64)

    def paint(self, canvas: Image, view: View, position_m: float, light: Light) -> None:
        """Fill everything below the horizon."""
        part = canvas[TOP:]
        label = self._labels(view, position_m)
        shade = self._shadows(view, position_m, light)
        for first, last, level in self._bands:
            if first >= last:
                continue
            rows = slice(first, last)
            painted = self._surfaces(rows, level, view, label[rows])
            distance = float(self._distance[rows].mean())
            part[rows] = light.shine_on(painted, light.on_ground, min(distance, 90.0))
            mask = shade[rows]
            if mask.any():
                dark = light.shine_on(painted, light.in_shade, min(distance, 90.0))
                cv2.copyTo(dark, mask, part[rows])
        self._markings(canvas, view, position_m, light)

    def _surfaces(self, rows: slice, level: int, view: View, label: Image) -> Image:
        scale = TILE_PX / TILE_M / (1 << level)
        cos, sin = np.float32(np.cos(view.heading_rad)), np.float32(np.sin(view.heading_rad))
        ahead, right = self._ahead[rows], self._right[rows]
        north = (ahead * cos - right * sin + np.float32(view.north_m % TILE_M)) * np.float32(scale)
        east = (ahead * sin + right * cos + np.float32(view.east_m % TILE_M)) * np.float32(scale)
        # Coordinates of a remap are 16 bits wide; the picture repeats anyway.
        side = np.float32(TILE_PX >> level)
        if level == 0 or np.abs(north).max() < 15_000 > np.abs(east).max():
            pass
        else:
            north, east = north % side, east % side
        painted: Image | None = None
        for kind in np.flatnonzero(np.bincount(label.ravel(), minlength=4)):
            tile = self._tiles[kind][level]
            layer = cv2.remap(tile, east, north, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
            if painted is None:
                painted = np.asarray(layer, np.uint8)
            else:
                cv2.copyTo(layer, (label == kind).view(np.uint8), painted)
        return painted if painted is not None else np.zeros((*label.shape, 3), np.uint8)

    def _labels(self, view: View, position_m: float) -> Image:
        label = np.zeros((CANVAS_SIZE[1] - TOP, CANVAS_SIZE[0]), np.uint8)
        sections = self._world.ahead(position_m)
        for section in sections:
            for patch in section.scene.patches:
                fill(label, view.to_camera(patch.outline), _LABEL[patch.surface])
        for section in reversed(sections):
            left, right = self._edges(section, view, position_m)
            kind = _LABEL[section.scene.path_surface]
            for k in range(len(left) - 1):
                fill(label, np.stack([left[k], left[k + 1], right[k + 1], right[k]]), kind)
        return label

    def _edges(
        self, section: Section, view: View, position_m: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        stretch = section.stretch
        end = stretch.start_m + stretch.straight_m + stretch.bend_m
        first, last = max(stretch.start_m, position_m - 4), min(end, position_m + 125)
        if last <= first:
            return np.zeros((0, 2)), np.zeros((0, 2))
        # Short pieces near by, where a bend shows; long ones far away.
        offsets = np.concatenate([np.arange(-4, 21, 1.5), np.arange(23, 60, 4), np.arange(62, 125, 9)])
        where = position_m + offsets
        where = np.concatenate([[first], where[(where > first) & (where < last)], [last]])
        half = section.scene.path_half_width_m
        route = self._world.route
        return view.to_camera(route.place(where, -half)), view.to_camera(route.place(where, half))

    def _shadows(self, view: View, position_m: float, light: Light) -> Image:
        mask = np.zeros((CANVAS_SIZE[1] - TOP, CANVAS_SIZE[0]), np.uint8)
        sun = light.sun_direction
        if light.sunshine < 0.15:
            return mask
        away = -np.array(sun[:2]) / max(sun[2], 0.05)
        ring = np.linspace(0, 2 * np.pi, 10, endpoint=False)
        circle = np.stack([np.cos(ring), np.sin(ring)], axis=1)
        for section in self._world.ahead(position_m):
            for block in section.scene.blocks:
                reach = away * block.height_m
                reach = reach * min(1.0, LONGEST_SHADOW_M / max(np.hypot(*reach), 1e-6))
                corners = np.concatenate([block.corners, block.corners + reach]).astype(np.float32)
                hull = np.asarray(cv2.convexHull(corners), np.float64)[:, 0]
                fill(mask, view.to_camera(hull), 255)
            for tree in section.scene.trees:
                reach = away * tree.height_m * 0.62
                ahead = float(view.to_camera(tree.place[None])[0, 1])
                if np.hypot(*reach) > LONGEST_SHADOW_M or not -30 < ahead < 70:
                    continue
                side = np.array([-away[1], away[0]]) / max(np.hypot(*away), 1e-6) * 0.12
                trunk = np.stack([tree.place - side, tree.place + side, *(tree.place + reach + [side, -side])])
                fill(mask, view.to_camera(trunk), 255)
                bare = light.season.leaf_share < 0.15 and tree.species < 11
                crown = tree.height_m * (0.12 if bare else 0.16 + 0.12 * light.season.leaf_share)
                stretch = 1 + 0.5 * np.hypot(*away)
                spread = circle * crown
                along = away / max(np.hypot(*away), 1e-6)
                spread = spread + np.outer(spread @ along * (stretch - 1), along)
                fill(mask, view.to_camera(tree.place + reach + spread), 255)
        return mask

    def _markings(self, canvas: Image, view: View, position_m: float, light: Light) -> None:
        route = self._world.route
        for section in self._world.ahead(position_m):
            half, start = section.scene.path_half_width_m, section.stretch.start_m
            end = start + section.stretch.straight_m + section.stretch.bend_m
            if section.scene.path_surface == "concrete":
                ink = light.colour((112, 116, 118), light.on_ground, 0)
                for where in np.arange(start + 2, min(end, position_m + 30), 2.5):
                    if where > position_m - 2:
                        at = np.array([where, where])
                        self._line(canvas, view, route.place(at, np.array([-half, half])), 0.03, ink)
            road = section.scene.road_right_m
            if road is not None:
                ink = light.colour((170, 200, 205), light.on_ground, 0)
                for where in np.arange(start, start + section.stretch.straight_m, 6.0):
                    if position_m - 4 < where < position_m + 70:
                        at = np.array([where, where + 3.0])
                        self._line(canvas, view, route.place(at, np.array([road, road])), 0.12, ink)

    @staticmethod
    def _line(canvas: Image, view: View, ends: NDArray[np.float64], width_m: float, ink: tuple[int, ...]) -> None:
        across = ends[1] - ends[0]
        side = np.array([-across[1], across[0]]) / max(np.hypot(*across), 1e-6) * width_m / 2
        outline = clip_near(view.to_camera(np.stack([ends[0] - side, ends[1] - side, ends[1] + side, ends[0] + side])))
        if len(outline) >= 3:
            polygon = np.clip(np.round(project(outline, 0.0) * 16), -400_000, 400_000).astype(np.int32)
            cv2.fillConvexPoly(canvas, polygon, ink, cv2.LINE_AA, 4)


def fill(mask: Image, outline: NDArray[np.float64], value: int) -> None:
    """Fill a convex ground polygon (right, ahead, in metres) on a mask whose first row is `TOP`."""
    seen = clip_near(outline)
    if len(seen) < 3:
        return
    polygon = project(seen, 0.0) - (0, TOP)
    if polygon[:, 0].max() < 0 or polygon[:, 0].min() > mask.shape[1] or polygon[:, 1].max() < 0:
        return
    whole = np.clip(np.round(polygon * 16), -400_000, 400_000).astype(np.int32)
    cv2.fillConvexPoly(mask, whole, value, cv2.LINE_8, 4)
