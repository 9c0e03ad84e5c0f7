"""Pictures as a robot's camera of NCLT's kind gives them, from the rendered campus."""

import cv2
import numpy as np

from deepsimbad_campus.renderer import Renderer
from deepsimbad_campus.route import Drive, drive_length_m
from deepsimbad_campus.season import PAPER_DATES, drive_date
from deepsimbad_campus.world import World

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
