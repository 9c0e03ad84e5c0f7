"""Cars, people and street furniture: small solids drawn with flat faces."""

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.camera import FOCAL_PX, NEAR_M, View, project
from deepsimbad_client.campus.light import Light
from deepsimbad_client.campus.scenery import Post

Image = NDArray[np.uint8]
Colour = tuple[int, ...]

CAR_COLOURS: tuple[Colour, ...] = (
    (40, 40, 44), (190, 192, 196), (225, 228, 230), (40, 36, 150), (140, 84, 40), (96, 100, 104), (60, 96, 62),
)  # fmt: skip
COAT_COLOURS: tuple[Colour, ...] = (
    (36, 34, 34), (140, 70, 40), (44, 40, 160), (70, 110, 60), (40, 150, 200), (170, 170, 175), (110, 60, 110),
)  # fmt: skip

# A car's side, from the rear: (metres along, metres up); the cabin stands on the body.
_BODY = ((-2.1, 0.28), (-2.1, 0.95), (2.05, 0.82), (2.15, 0.28))
_CABIN = ((-1.8, 0.93), (-1.35, 1.48), (0.35, 1.46), (1.05, 0.86))
_HALF_WIDTH_M = 0.86


def draw_car(
    canvas: Image, view: View, place: NDArray[np.float64], heading_rad: float, paint: Colour, light: Light
) -> None:
    """Draw a car standing at a place, its nose along a heading."""
    centre = view.to_camera(place[None])[0]
    if centre[1] < NEAR_M + 2.8:
        return
    turn = heading_rad - view.heading_rad
    nose = np.array([np.sin(turn), np.cos(turn)])  # right, ahead
    side = np.array([np.cos(turn), -np.sin(turn)])
    distance = float(centre[1])
    shadow = [centre + nose * a + side * b for a, b in ((-2.3, -1), (2.3, -1), (2.3, 1), (-2.3, 1))]
    _face(canvas, np.array(shadow), np.zeros(4), light.colour((46, 46, 48), light.in_shade, distance))
    glass = (74, 66, 58)
    for outline, ink, top in ((_BODY, paint, 0.86), (_CABIN, glass, 1.0)):
        _prism(canvas, centre, nose, side, outline, ink, paint if top == 1.0 else ink, light)
    near = -1.0 if float(centre @ side) > 0 else 1.0
    for along in (-1.35, 1.35) if distance < 45 else ():
        hub = centre + nose * along + side * near * _HALF_WIDTH_M
        ring = np.linspace(0, 2 * np.pi, 14, endpoint=False)
        rim = np.stack([hub + nose * 0.33 * np.cos(a) for a in ring])
        _face(canvas, rim, 0.33 + 0.33 * np.sin(ring), light.colour((24, 24, 26), light.in_shade, distance))


def _prism(
    canvas: Image,
    centre: NDArray[np.float64],
    nose: NDArray[np.float64],
    side: NDArray[np.float64],
    outline: tuple[tuple[float, float], ...],
    ink: Colour,
    roof: Colour,
    light: Light,
) -> None:
    distance = float(centre[1])
    along = np.array([p[0] for p in outline])
    up = np.array([p[1] for p in outline])
    feet = centre + along[:, None] * nose
    flanks = {s: feet + s * _HALF_WIDTH_M * side for s in (-1.0, 1.0)}
    faces: list[tuple[float, NDArray[np.float64], NDArray[np.float64], Colour]] = []
    base = np.asarray(light.in_shade + 0.45 * (light.on_ground - light.in_shade), np.float64)
    for k, tone in ((0, 0.8), (1, 1.12), (2, 0.9)):
        pair = (k, k + 1)
        quad = np.stack([flanks[-1.0][pair[0]], flanks[-1.0][pair[1]], flanks[1.0][pair[1]], flanks[1.0][pair[0]]])
        own = roof if k == 1 else ink
        heights = up[[pair[0], pair[1], pair[1], pair[0]]]
        faces.append((float(np.hypot(*quad.mean(0))), quad, heights, light.colour(own, base * tone, distance)))
    for s in (-1.0, 1.0):
        flank_ink = light.colour(ink, base * (0.92 if s > 0 else 1.0), distance)
        faces.append((float(np.hypot(*flanks[s].mean(0))), flanks[s], up, flank_ink))
    for _, ground, heights, colour in sorted(faces, key=lambda face: -face[0]):
        _face(canvas, ground, heights, colour)


def draw_person(canvas: Image, look: int, stride: float, light: Light, right_ahead: NDArray[np.float64]) -> None:
    """Draw somebody walking, at metres right and ahead; `look` chooses clothes and build."""
    ahead = float(right_ahead[1])
    if ahead < 0.9:
        return
    rng = np.random.default_rng(look)
    tall = float(rng.uniform(1.58, 1.9))
    coat = COAT_COLOURS[int(rng.integers(0, len(COAT_COLOURS)))]
    legs = (70, 52, 40) if rng.random() < 0.6 else (44, 44, 46)
    gain = np.asarray(light.in_shade + 0.5 * (light.on_ground - light.in_shade), np.float64)
    x, foot = project(right_ahead[None], 0.0)[0]
    unit = FOCAL_PX / ahead * tall / 1.75

    def box(left: float, right: float, low: float, high: float, ink: Colour) -> None:
        corners = np.array([(left, low), (right, low), (right * 0.9, high), (left * 0.9, high)])
        polygon = np.round((np.array([x, foot]) + corners * (unit, -unit)) * 16).astype(np.int32)
        cv2.fillConvexPoly(canvas, polygon, light.colour(ink, gain, ahead), cv2.LINE_AA, 4)

    swing = 0.16 * float(np.sin(stride))
    box(-0.14 - swing, 0.0 - swing, 0.0, 0.85, legs)
    box(0.0 + swing, 0.14 + swing, 0.0, 0.85, legs)
    box(-0.25, 0.25, 0.78, 1.46, coat)
    box(-0.33, -0.22, 0.8 + swing, 1.42, coat)
    box(0.22, 0.33, 0.8 - swing, 1.42, coat)
    skin = light.colour((120, 150, 196), gain, ahead)
    hair = light.colour((38, 46, 60), gain, ahead)
    head = (round(x), round(foot - 1.6 * unit))
    cv2.circle(canvas, head, max(1, round(0.13 * unit)), hair, -1, cv2.LINE_AA)
    cv2.circle(canvas, (head[0], head[1] + round(0.03 * unit)), max(1, round(0.1 * unit)), skin, -1, cv2.LINE_AA)


def draw_post(canvas: Image, post: Post, light: Light, right_ahead: NDArray[np.float64]) -> None:
    """Draw a lamp, sign, bollard or bench at metres right and ahead."""
    ahead = float(right_ahead[1])
    if ahead < 0.8:
        return
    x, foot = project(right_ahead[None], 0.0)[0]
    unit = FOCAL_PX / ahead
    gain = np.asarray(light.in_shade + 0.4 * (light.on_ground - light.in_shade), np.float64)
    metal = light.colour((48, 50, 48), gain, ahead)
    own = light.colour(post.colour, gain, ahead)

    def box(left: float, right: float, low: float, high: float, ink: Colour) -> None:
        corners = np.array([(left, low), (right, low), (right, high), (left, high)])
        polygon = np.round((np.array([x, foot]) + corners * (unit, -unit)) * 16).astype(np.int32)
        cv2.fillConvexPoly(canvas, polygon, ink, cv2.LINE_AA, 4)

    size = post.size_m
    if post.kind == "lamp":
        box(-0.06, 0.06, 0, size, metal)
        box(-0.16, 0.16, 0, 0.35, metal)
        box(-0.22, 0.22, size, size + 0.45, light.colour((205, 215, 220), gain, ahead))
        box(-0.26, 0.26, size + 0.42, size + 0.52, metal)
    elif post.kind == "sign":
        box(-0.04, 0.04, 0, size, metal)
        box(-0.38, 0.38, size - 0.75, size, own)
        box(-0.28, 0.28, size - 0.45, size - 0.32, light.colour((230, 230, 230), gain, ahead))
    elif post.kind == "bollard":
        box(-0.1, 0.1, 0, size, metal)
        box(-0.1, 0.1, size * 0.7, size * 0.82, light.colour((60, 200, 220), gain, ahead))
    else:
        wood = light.colour((60, 96, 130), gain, ahead)
        box(-size / 2, size / 2, 0.42, 0.5, wood)
        box(-size / 2, size / 2, 0.62, 0.88, wood)
        for leg in (-0.42, 0.36):
            box(leg * size, leg * size + 0.07, 0, 0.88, metal)


def _face(canvas: Image, ground: NDArray[np.float64], heights: NDArray[np.float64], ink: Colour) -> None:
    polygon = np.clip(np.round(project(ground, heights) * 16), -400_000, 400_000).astype(np.int32)
    cv2.fillPoly(canvas, [polygon], ink, cv2.LINE_AA, 4)
