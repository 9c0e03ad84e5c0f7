"""What stands and moves on the ground, and how it is drawn: walls and trees in perspective, cars, people and posts."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from deepsimbad_campus import camera
from deepsimbad_campus.camera import FOCAL_PX, HALF_VIEW, NEAR_M, Array, Colour, Image, View, project, sixteenths
from deepsimbad_campus.pictures import TREE_HEIGHT, TREE_WIDTH, Levels
from deepsimbad_campus.route import INTERVAL_US, START_M, Drive, Route, stream
from deepsimbad_campus.season import SHADES, Light
from deepsimbad_campus.world import SIGHT_M, SIGNS, Section, Thing, World

CELL_M = 18.0  # people come in groups, one group or none for every so many metres of route
PARKED_SHARE, PEOPLE_SHARE = 0.6, 0.8
LANE_M, LOOP_M = 1.8, 150.0
CARS: tuple[Colour, ...] = (
    (40, 40, 44), (190, 192, 196), (225, 228, 230), (40, 36, 150), (140, 84, 40), (96, 100, 104), (60, 96, 62),
)  # fmt: skip
COATS: tuple[Colour, ...] = (
    (36, 34, 34), (140, 70, 40), (44, 40, 160), (70, 110, 60), (40, 150, 200), (170, 170, 175), (110, 60, 110),
)  # fmt: skip
METAL, WOOD, GLASS = (48, 50, 48), (60, 96, 130), (74, 66, 58)
# A car's side, from the rear, [4] metres forward and up; the cabin stands on the body.
BODY = np.array([(-2.1, 0.28), (-2.1, 0.95), (2.05, 0.82), (2.15, 0.28)]).T
CABIN = np.array([(-1.8, 0.93), (-1.35, 1.48), (0.35, 1.46), (1.05, 0.86)]).T
HALF_WIDTH_M = 0.86

Box = tuple[float, float, float, float, Colour]  # left, right, low and high in metres


class Shot(NamedTuple):
    """One picture being painted: its canvas, what the camera sees of the world, and by what light."""

    canvas: Image
    view: View
    light: Light
    position_m: float = 0.0  # along the route
    sections: Sequence[Section] = ()  # in sight, nearest first
    trees: Sequence[Levels] = ()  # every species


def around(world: World, drive: Drive, frame: int) -> Iterator[Thing]:
    """The things that stand or move in sight of a frame, without walls."""
    position_m, time_s = drive.position_m[frame], int(drive.utime[frame] - drive.utime[0]) / 1e6
    for section in world.ahead(position_m):
        for thing in section.things:
            if thing.kind != "bay":
                yield thing
                continue
            rng = stream(drive.seed, f"bay {drive.date}", thing.look)
            if rng.random() < PARKED_SHARE:
                turn = rng.normal(0, 0.03) + (np.pi if rng.random() < 0.3 else 0)
                yield Thing(thing.place, "car", 1.5, int(rng.integers(0, len(CARS))), thing.turn + turn)
        if section.road_right_m is not None:
            yield from _traffic(section, section.road_right_m, drive, world.route, time_s)
    yield from _people(drive, world.route, position_m, time_s)


def _traffic(section: Section, road_right_m: float, drive: Drive, route: Route, time_s: float) -> Iterator[Thing]:
    rng = stream(drive.seed, f"traffic {drive.date}", section.stretch.number)
    for _ in range(rng.integers(1, 4)):
        speed = rng.uniform(6, 11) * rng.choice([-1, 1])
        loop_m, paint = (rng.uniform(0, LOOP_M) + speed * time_s) % LOOP_M, int(rng.integers(0, len(CARS)))
        if loop_m <= section.stretch.straight_m:
            position_m = section.stretch.start_m + loop_m
            place = route.place(position_m, road_right_m + np.sign(speed) * LANE_M)
            yield Thing(place, "car", 1.5, paint, float(route.heading(position_m)) + (np.pi if speed < 0 else 0.0))


def _people(drive: Drive, route: Route, position_m: float, time_s: float) -> Iterator[Thing]:
    first, last = int(max(0.0, position_m - 2 * CELL_M) / CELL_M), int((position_m + SIGHT_M / 2) / CELL_M)
    for cell in range(first, last + 1):
        rng = stream(drive.seed, f"people {drive.date}", cell)
        if rng.random() <= PEOPLE_SHARE:
            home_m = (cell + rng.random()) * CELL_M
            met_s = (home_m - START_M) / (drive.spacing_m / (INTERVAL_US / 1e6)) + rng.normal(0, 6)
            speed, side = rng.uniform(0.9, 1.5) * rng.choice([-1, 0, 1]), rng.choice([-1, 1])
            for k in range(rng.integers(1, 5)):
                right_m, look = side * rng.uniform(0.9, 3.0), int(rng.integers(0, 1 << 31))
                walker_m = home_m + speed * float(np.clip(time_s - met_s, -40, 40)) + 0.9 * k
                if walker_m > 0:
                    yield Thing(route.place(walker_m, right_m), "person", 1.75, look, 2.2 * walker_m if speed else 0.4)


def panels(feet: Array, view: View) -> Iterator[tuple[Array, Array]]:
    """Cut the part of a wall that is in view into panels short enough to be sorted by distance.

    Yields of each [2, 2] (right, ahead) of its left and right foot, and [2] where these lie along the wall, 0 its left
    and 1 its right edge.
    """
    (x0, z0), (x1, z1) = ends = view.to_camera(feet)
    if x1 * z0 - x0 * z1 <= 0 or max(z0, z1) < NEAR_M or min(z0, z1) > SIGHT_M:
        return
    first, last = camera.near_cut(ends)
    length, near = (last - first) * np.hypot(x1 - x0, z1 - z0), max(NEAR_M, min(z0, z1))
    cuts = np.linspace(first, last, int(np.ceil(length / max(5.0, 0.4 * near))) + 1)
    feet = ends[0] + cuts[:, None] * (ends[1] - ends[0])
    slope = feet[:, 0] / feet[:, 1]
    for k in np.flatnonzero((slope[:-1] < HALF_VIEW) & (slope[1:] > -HALF_VIEW)):
        yield feet[k : k + 2], cuts[k : k + 2]


def _level(levels: Levels, reduction: float) -> Image:
    return levels[int(min(np.log2(max(1.0, reduction)), len(levels) - 1))]


def draw_panel(shot: Shot, levels: Levels, height_m: float, gain: Array, feet: Array, span: Array) -> None:
    """Draw one panel of a wall."""
    low, high = project(feet), project(feet, height_m)
    level = _level(levels, len(levels[0]) / max(1.0, (low - high)[:, 1].max()))
    height, width = level.shape[:2]
    outline = np.stack([high[0], high[1], low[1], low[0]])
    pixels = outline.astype(int)
    (left, top), roi = camera.window(shot.canvas, pixels.min(0) - (2, 1), np.add(pixels.max(0), (3, 2)))
    if not roi.size:
        return
    first, last = max(0, int(span[0] * width) - 1), min(width, int(np.ceil(span[1] * width)) + 1)
    part = shot.light.shine_on(np.ascontiguousarray(level[:, first:last]), gain, feet[:, 1].mean())
    u0, u1 = span * width - first - 0.5
    source = np.array([(u0, -0.5), (u1, -0.5), (u1, height - 0.5), (u0, height - 0.5)], np.float32)
    bend = cv2.getPerspectiveTransform(source, (outline - (left, top)).astype(np.float32))
    cv2.warpPerspective(part, bend, roi.shape[1::-1], roi, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)


def _draw_tree(shot: Shot, tree: Thing, foot: Array) -> None:
    (x, y), ahead, light, levels = project(foot), foot[1], shot.light, shot.trees[tree.look]
    tall = FOCAL_PX * tree.size_m / ahead
    wide = TREE_WIDTH * tall / TREE_HEIGHT
    (left, top), roi = camera.window(shot.canvas, (x - wide / 2, y - tall), (int(x + wide / 2) + 1, int(y) + 1))
    if not roi.size:
        return
    picture = _level(levels, TREE_HEIGHT / tall)
    grow_x, grow_y = wide / picture.shape[1], tall / picture.shape[0]
    place = np.array([[tree.turn * grow_x, 0, x - tree.turn * wide / 2 - left], [0, grow_y, y - tall - top]])
    part = cv2.warpAffine(picture, place, roi.shape[1::-1], flags=cv2.INTER_LINEAR)
    colour, alpha = cv2.cvtColor(part, cv2.COLOR_BGRA2BGR), cv2.merge([part[:, :, 3]] * 3)
    share = light.haze(ahead)
    lit = np.clip(SHADES * light.on_ground(0.55) * (1 - share), 0, 255).astype(np.uint8)
    colour = cv2.LUT(colour, lit)
    if share > 0.03:
        hazy = np.clip(SHADES * light.air / 255 * share, 0, 255).astype(np.uint8)
        cv2.add(colour, cv2.LUT(alpha, hazy), dst=colour)
    cv2.multiply(roi, cv2.bitwise_not(alpha), dst=roi, scale=1 / 255)
    cv2.add(roi, colour, dst=roi)


def _draw_car(shot: Shot, car: Thing, centre: Array) -> None:
    paint, light, distance = CARS[car.look], shot.light, centre[1]
    if distance < NEAR_M + 2.8:
        return
    turn = car.turn - shot.view.heading_rad
    nose, side = np.array([np.sin(turn), np.cos(turn)]), np.array([np.cos(turn), -np.sin(turn)])

    def face(ground: Array, heights: Array, colour: Colour, gain: Array) -> None:
        ink = light.tones(colour, gain, distance).tolist()
        cv2.fillPoly(shot.canvas, [sixteenths(project(ground, heights))], ink, cv2.LINE_AA, 4)

    shadow, base = np.array([(-2.3, -1), (2.3, -1), (2.3, 1), (-2.3, 1)]), light.on_ground(0.45)
    face(centre + shadow @ np.stack([nose, side]), np.zeros(4), (46, 46, 48), light.gain(0))
    for (forward, up), colour in ((BODY, paint), (CABIN, GLASS)):
        feet = centre + forward[:, None] * nose
        left, right = feet - HALF_WIDTH_M * side, feet + HALF_WIDTH_M * side
        faces = [(left, up, colour, base), (right, up, colour, base * 0.92)]
        for k, face_colour, tone in ((0, colour, 0.8), (1, paint, 1.12), (2, colour, 0.9)):  # rear, top and front
            quad = np.stack([left[k], left[k + 1], right[k + 1], right[k]])
            faces.append((quad, up[[k, k + 1, k + 1, k]], face_colour, base * tone))
        for args in sorted(faces, key=lambda args: -np.hypot(*args[0].mean(0))):
            face(*args)
    near, ring = -1.0 if centre @ side > 0 else 1.0, np.linspace(0, 2 * np.pi, 14, endpoint=False)
    for axle_m in (-1.35, 1.35) if distance < 45 else ():
        hub = centre + nose * axle_m + side * near * HALF_WIDTH_M
        face(hub + nose * 0.33 * np.cos(ring)[:, None], 0.33 + 0.33 * np.sin(ring), (24, 24, 26), light.gain(0))


def _draw_person(shot: Shot, walker: Thing, foot: Array) -> None:
    if foot[1] < 0.9:
        return
    rng, swing, gain = np.random.default_rng(walker.look), 0.16 * np.sin(walker.turn), shot.light.on_ground(0.5)
    unit, coat = FOCAL_PX / foot[1] * rng.uniform(1.58, 1.9) / 1.75, COATS[rng.integers(0, len(COATS))]
    legs = (70, 52, 40) if rng.random() < 0.6 else (44, 44, 46)
    feet: list[Box] = [(-0.14 - swing, -swing, 0.0, 0.85, legs), (swing, 0.14 + swing, 0.0, 0.85, legs)]
    arms: list[Box] = [(-0.33, -0.22, 0.8 + swing, 1.42, coat), (0.22, 0.33, 0.8 - swing, 1.42, coat)]
    _draw_boxes(shot, [*feet, (-0.25, 0.25, 0.78, 1.46, coat), *arms], foot, unit, gain, taper=0.9)
    x, y = np.round(project(foot) - (0, 1.6 * unit)).astype(int).tolist()
    for colour, drop_m, size_m in (((38, 46, 60), 0.0, 0.13), ((120, 150, 196), 0.03, 0.1)):  # hair and face
        ink = shot.light.tones(colour, gain, foot[1]).tolist()
        centre, radius = (x, y + round(drop_m * unit)), max(1, round(size_m * unit))
        cv2.circle(shot.canvas, centre, radius, ink, -1, cv2.LINE_AA)


def _draw_post(shot: Shot, post: Thing, foot: Array) -> None:
    size, boxes = post.size_m, list[Box]()
    if post.kind == "lamp":
        boxes = [(-0.06, 0.06, 0, size, METAL), (-0.16, 0.16, 0, 0.35, METAL)]
        boxes += [(-0.22, 0.22, size, size + 0.45, (205, 215, 220)), (-0.26, 0.26, size + 0.42, size + 0.52, METAL)]
    elif post.kind == "bollard":
        boxes = [(-0.1, 0.1, 0, size, METAL), (-0.1, 0.1, size * 0.7, size * 0.82, (60, 200, 220))]
    elif post.kind == "bench":
        boxes = [(-size / 2, size / 2, 0.42, 0.5, WOOD), (-size / 2, size / 2, 0.62, 0.88, WOOD)]
        boxes += [(leg * size, leg * size + 0.07, 0, 0.88, METAL) for leg in (-0.42, 0.36)]
    else:
        boxes = [(-0.04, 0.04, 0, size, METAL), (-0.38, 0.38, size - 0.75, size, SIGNS[post.kind])]
        boxes += [(-0.28, 0.28, size - 0.45, size - 0.32, (230, 230, 230))]
    if foot[1] >= 0.8:
        _draw_boxes(shot, boxes, foot, FOCAL_PX / foot[1], shot.light.on_ground(0.4))


def _draw_boxes(shot: Shot, boxes: Sequence[Box], foot: Array, unit: float, gain: Array, taper: float = 1.0) -> None:
    """Draw upright boxes around a foot, so many pixels a metre."""
    for left, right, low, high, colour in boxes:
        corners = np.array([(left, low), (right, low), (right * taper, high), (left * taper, high)])
        ink = shot.light.tones(colour, gain, foot[1]).tolist()
        cv2.fillConvexPoly(shot.canvas, sixteenths(project(foot) + corners * (unit, -unit)), ink, cv2.LINE_AA, 4)


class Kind(NamedTuple):
    """How a thing is drawn, given its foot in metres right and ahead, and what an observer takes it for."""

    draw: Callable[[Shot, Thing, Array], None]
    margin_m: float  # how far beside the view it may stand and still reach into it
    sides: tuple[tuple[float, float], tuple[float, float]]  # half its width, its height: metres, and share of its size


KINDS = {
    **dict.fromkeys(("tree", "conifer", "bush"), Kind(_draw_tree, 5.0, ((0, 0.35), (0, 1)))),
    **dict.fromkeys(SIGNS, Kind(_draw_post, 1.5, ((0.38, 0), (0, 1)))),
    "lamp": Kind(_draw_post, 1.5, ((0.26, 0), (0.5, 1))),
    "bollard": Kind(_draw_post, 1.5, ((0.1, 0), (0, 1))),
    "bench": Kind(_draw_post, 1.5, ((0, 0.5), (0.88, 0))),
    "car": Kind(_draw_car, 3.0, ((1.7, 0), (0, 1))),
    "person": Kind(_draw_person, 1.0, ((0.3, 0), (0, 1))),
}
