"""Pictures of one drive, painted from back to front: sky, ground, and what stands on it."""

from functools import lru_cache, partial
from itertools import pairwise
from operator import itemgetter

import cv2
import numpy as np

from deepsimbad_campus import camera, pictures, things
from deepsimbad_campus.camera import FOCAL_PX, GROUND_ROW, HEIGHT, HORIZON_Y, WIDTH, Array, Colour, Image, View, fill
from deepsimbad_campus.route import Drive, stream
from deepsimbad_campus.season import Light, Season
from deepsimbad_campus.things import Shot
from deepsimbad_campus.world import SIGHT_M, World

GRAIN = 4.0
FACADES = 96  # pictures of walls kept; about 1 MB each
GLARE_PX, DRIFT_DEG_PER_FRAME = 420, 0.06
BANDS_M = (0.0, 4.0, 10.0, 24.0, 55.0, 1e9)  # distances at which a coarser picture of the ground takes over
LONGEST_SHADOW_M = 45.0
LABELS = {name: label for label, name in enumerate(("grass", *pictures.PAVING))}
GROUND_SHAPE = (HEIGHT - GROUND_ROW, WIDTH)
Line = tuple[tuple[float, float], tuple[float, float], float, Colour]  # metres along and right of its ends; width, ink


class Renderer:
    """Paints any frame of a drive; safe to use from several threads at once."""

    def __init__(self, world: World, drive: Drive) -> None:
        self._world, self._drive = world, drive
        date, seed, number = drive.date.isoformat(), world.seed, drive.date.toordinal()
        self._season = season = Season(drive.date, seed)
        self._skyline, self._dome = world.skyline(), pictures.draw_sky(season, stream(seed, f"sky {date}"))
        radius = np.hypot(*np.mgrid[-GLARE_PX:GLARE_PX, -GLARE_PX:GLARE_PX]) / GLARE_PX
        self._glare = np.clip(1 - radius, 0, 1)[:, :, None] ** 3.0 * np.array(season.sun)
        self._tiles, self.trees = pictures.draw_ground(season, date, seed), pictures.draw_trees(season, seed)
        self._facade = lru_cache(FACADES)(partial(pictures.draw_facade, season=season, drive=number))
        width, height = camera.UPRIGHT_SIZE
        grain = stream(seed, f"grain {date}").normal(0, GRAIN, (width + 64, height + 64, 1))
        self._grain = np.clip(np.repeat(grain, 3, axis=2) + 128, 0, 255).astype(np.uint8)

    def stored_picture(self, frame: int) -> Image:
        """[1232, 1616, 3] BGR, the picture of a frame as it is stored: turned counter-clockwise."""
        view = self._drive.view(frame)
        # What is drawn, seen from the middle, leans and nods and turns: a stored column is an upright row, and stored
        # rows count the upright columns from the right. Enlarging comes last because it is dearest.
        cos, sin = np.cos(view.roll_rad), -np.sin(view.roll_rad)
        x, y = WIDTH / 2, HEIGHT / 2 - FOCAL_PX * np.tan(view.pitch_rad)
        (wide, tall), (width, height) = camera.SEEN_SIZE, camera.UPRIGHT_SIZE
        turn = np.array([[sin, cos, tall / 2 - sin * x - cos * y], [-cos, sin, wide / 2 + cos * x - sin * y]])
        window = cv2.warpAffine(self._canvas(frame, view), turn, (tall, wide), flags=cv2.INTER_LINEAR)
        picture = cv2.resize(window, (height, width), interpolation=cv2.INTER_LINEAR)
        row, column = stream(self._world.seed + self._drive.date.toordinal(), "grain", frame).integers(0, 64, 2)
        grain = self._grain[row : row + width, column : column + height]
        return np.asarray(cv2.addWeighted(picture, 1.0, grain, 1.0, -128), np.uint8)

    def _canvas(self, frame: int, view: View) -> Image:
        """[728, 560, 3] BGR, the picture of a frame as drawn: upright, level and without grain."""
        season, drive, canvas = self._season, self._drive, np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        sunshine = float(np.clip(0.5 + 1.6 * (drive.sunniness[frame] - 2.4 * (season.cloud_share - 0.5)), 0, 1))
        light, position_m = Light(season, sunshine, float(drive.exposure[frame])), float(drive.position_m[frame])
        shot = Shot(canvas, view, light, position_m, self._world.ahead(position_m), self.trees)
        self._paint_sky(shot, frame)
        turn = (np.deg2rad(season.sun_azimuth_deg) - view.heading_rad + np.pi) % (2 * np.pi) - np.pi
        x = int(camera.CENTRE_X + FOCAL_PX * np.tan(turn))
        y = int(HORIZON_Y - FOCAL_PX * np.tan(np.deg2rad(season.sun_elevation_deg)) / np.cos(turn))
        is_dazzling = abs(turn) <= 1.05 and sunshine > 0.3
        if is_dazzling:
            self._glow(canvas, x, y, 1.5 * sunshine)
        self._paint_ground(shot)
        self._draw_things(shot, frame)
        if is_dazzling and 0 <= x < WIDTH and 0 <= y < HEIGHT and canvas[y, x].min() > 200:  # nothing stands before it
            self._glow(canvas, x, y, 0.8 * sunshine)
            rows = canvas[max(0, y - 1) : y + 2]  # it bleeds along the sensor's columns, which lie level
            cv2.add(rows, np.full_like(rows, 110), dst=rows)
        return canvas

    def _paint_sky(self, shot: Shot, frame: int) -> None:
        season, light, heading = self._season, shot.light, np.rad2deg(shot.view.heading_rad)
        rows = (pictures.SKY_TOP_DEG - camera.ELEVATION_DEG) * pictures.SKY_PX_PER_DEG
        rows = np.clip(rows, 0, len(self._dome) - 1).astype(np.float32)
        azimuth = camera.AZIMUTH_DEG + (heading + DRIFT_DEG_PER_FRAME * frame) % 360
        columns = np.broadcast_to((azimuth * pictures.SKY_PX_PER_DEG).astype(np.float32), rows.shape)
        sky = cv2.remap(self._dome, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        shot.canvas[: len(sky)] = cv2.convertScaleAbs(sky, alpha=light.exposure * (0.86 + 0.14 * light.sunshine))
        woods = np.array(season.leaves[0]) * 0.5 + np.array(season.grass) * 0.2 + 30 * season.snow
        for lift, share in ((1.0, 0.62), (0.55, 0.38)):
            angles = ((camera.AZIMUTH_DEG + heading) % 360 * (2 - lift)) % 360
            height = np.deg2rad(np.interp(angles, np.arange(361), self._skyline) * lift)
            top = HORIZON_Y - FOCAL_PX * np.tan(height) / np.cos(np.deg2rad(camera.AZIMUTH_DEG))
            corners = [[WIDTH - 1, HORIZON_Y + 3], [0, HORIZON_Y + 3]]
            outline = np.concatenate([np.stack([np.arange(WIDTH), top], axis=1), corners])
            colour = camera.ink(woods * light.gain(0) * (1 - share) + light.air * share)
            cv2.fillPoly(shot.canvas, [np.round(outline).astype(np.int32)], colour)

    def _glow(self, canvas: Image, x: int, y: int, strength: float) -> None:
        """Add the sun's glow around a pixel that may lie outside of the canvas."""
        (left, top), roi = camera.window(canvas, (x - GLARE_PX, y - GLARE_PX), (x + GLARE_PX, y + GLARE_PX))
        part = self._glare[top - y + GLARE_PX :, left - x + GLARE_PX :][: roi.shape[0], : roi.shape[1]]
        if roi.size:
            cv2.add(roi, np.clip(part * strength, 0, 255).astype(np.uint8), dst=roi)

    def _draw_things(self, shot: Shot, frame: int) -> None:
        queue: list[tuple[float, partial[None]]] = []
        for feet, style in (facade for section in shot.sections for facade in section.facades):
            north, east = (feet[1] - feet[0]) / np.hypot(*(feet[1] - feet[0]))
            gain = shot.light.gain(-east * shot.light.sun[0] + north * shot.light.sun[1])  # its normal points right
            for ends, span in things.panels(feet, shot.view):
                draw = partial(things.draw_panel, shot, self._facade(style), style.height_m, gain, ends, span)
                queue.append((float(ends[0, 1] + ends[1, 1]) / 2, draw))
        for thing in things.around(self._world, self._drive, frame):
            kind, foot = things.KINDS[thing.kind], shot.view.to_camera(thing.place)
            if camera.NEAR_M < foot[1] < SIGHT_M and abs(foot[0]) < foot[1] * camera.HALF_VIEW + kind.margin_m:
                queue.append((foot[1], partial(kind.draw, shot, thing, foot)))
        for _, draw in sorted(queue, key=itemgetter(0), reverse=True):
            draw()

    def _paint_ground(self, shot: Shot) -> None:
        view, light, ground = shot.view, shot.light, shot.canvas[GROUND_ROW:]
        labels, shadows = self._labels(shot), _shadows(shot)
        cos, sin = np.float32(np.cos(view.heading_rad)), np.float32(np.sin(view.heading_rad))
        ahead = camera.AHEAD_M[:, None].astype(np.float32)
        right = (ahead * camera.SLOPE).astype(np.float32)
        north = ahead * cos - right * sin + np.float32(view.north_m % pictures.TILE_M)
        east = ahead * sin + right * cos + np.float32(view.east_m % pictures.TILE_M)
        for level, (near_m, far_m) in enumerate(pairwise(BANDS_M)):
            first, *_, last = np.flatnonzero((near_m <= camera.AHEAD_M) & (far_m > camera.AHEAD_M))
            band, per_m = slice(first, last + 1), np.float32(pictures.TILE_PX / pictures.TILE_M / (1 << level))
            x, y, paved = east[band] * per_m, north[band] * per_m, np.zeros_like(ground[band])
            for label, levels in enumerate(self._tiles):
                mask = (labels[band] == label).view(np.uint8)
                if mask.any():
                    layer = cv2.remap(levels[level], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
                    cv2.copyTo(layer, mask, paved)
            distance = min(camera.AHEAD_M[band].mean(), 90.0)
            ground[band] = light.shine_on(paved, light.on_ground(1.0), distance)
            cv2.copyTo(light.shine_on(paved, light.gain(0), distance), shadows[band], ground[band])
        self._mark(shot)

    def _labels(self, shot: Shot) -> Image:
        """[HEIGHT - GROUND_ROW, WIDTH] index of the tile that every pixel below the horizon is paved with."""
        labels, route = np.zeros(GROUND_SHAPE, np.uint8), self._world.route
        patches = [patch for section in shot.sections for patch in section.patches]
        # Short pieces of path near by, where a bend shows; long ones far away.
        cuts_m = np.concatenate([np.arange(-4, 21, 1.5), np.arange(23, 60, 4), np.arange(62, 126, 9)])
        for section in reversed(shot.sections):
            path_m = np.clip(shot.position_m + cuts_m, section.stretch.start_m, section.stretch.end_m)
            left, right = (route.place(np.unique(path_m), side * section.path_half_width_m) for side in (-1, 1))
            quads = np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)
            patches += [(quad, section.path_surface) for quad in quads]
        for outline, surface in patches:
            fill(labels, shot.view.to_camera(outline), (LABELS[surface],))
        return labels

    def _mark(self, shot: Shot) -> None:
        """Draw the path's joints and the road's broken line."""
        position_m, light, lines = shot.position_m, shot.light, list[Line]()
        joint, paint = light.tones([(112, 116, 118), (170, 200, 205)], light.on_ground(1.0), 0).tolist()
        for section in shot.sections:
            start_m, half, road_m = section.stretch.start_m, section.path_half_width_m, section.road_right_m
            if section.path_surface == "concrete":
                joints = np.arange(start_m + 2, min(section.stretch.end_m, position_m + 30), 2.5)
                lines += [((m, m), (-half, half), 0.03, joint) for m in joints if m > position_m - 2]
            if road_m is not None:
                dashes = np.arange(start_m, min(start_m + section.stretch.straight_m, position_m + 70), 6.0)
                lines += [((m, m + 3.0), (road_m, road_m), 0.12, paint) for m in dashes if m > position_m - 4]
        for along_m, right_m, width_m, ink in lines:
            first, last = shot.view.to_camera(self._world.route.place(np.array(along_m), np.array(right_m)))
            right, ahead = last - first
            side = np.array([ahead, -right]) / np.hypot(right, ahead) * width_m / 2
            fill(shot.canvas, np.stack([first - side, last - side, last + side, first + side]), ink)


def _shadows(shot: Shot) -> Image:
    """[HEIGHT - GROUND_ROW, WIDTH] 255 where the ground is in shade, else 0."""
    mask, light, outlines = np.zeros(GROUND_SHAPE, np.uint8), shot.light, list[Array]()
    reach_per_m, ring = -light.sun[:2] / light.sun[2], np.linspace(0, 2 * np.pi, 10, endpoint=False)
    length_per_m, circle = np.hypot(*reach_per_m), np.stack([np.cos(ring), np.sin(ring)], axis=1)
    direction, leaves = reach_per_m / length_per_m, light.season.leaf_share
    side = np.array([-direction[1], direction[0]]) * 0.12
    for section in shot.sections if light.sunshine >= 0.15 else ():
        for block in section.blocks:
            reach = reach_per_m * min(block.height_m, LONGEST_SHADOW_M / length_per_m)
            corners = np.concatenate([block.corners(), block.corners() + reach]).astype(np.float32)
            outlines.append(np.asarray(cv2.convexHull(corners), np.float64)[:, 0])
        for place, kind, height, *_ in section.things:
            reach, ahead = reach_per_m * height * 0.62, shot.view.to_camera(place)[1]
            if kind in ("tree", "conifer") and np.hypot(*reach) <= LONGEST_SHADOW_M and -30 < ahead < 70:
                outlines.append(place + np.stack([-side, side, reach + side, reach - side]))
                crown = circle * height * (0.12 if leaves < 0.15 and kind == "tree" else 0.16 + 0.12 * leaves)
                stretch = np.outer(crown @ direction * 0.5 * length_per_m, direction)
                outlines.append(place + reach + crown + stretch)
    for outline in outlines:
        fill(mask, shot.view.to_camera(outline), (255,))
    return mask
