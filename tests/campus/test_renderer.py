"""What the camera sees: perspective, light, seasons."""

import cv2
import numpy as np
import pytest

from deepsimbad_campus import camera
from deepsimbad_campus.camera import HEIGHT, WIDTH, View, clip_near, project
from deepsimbad_campus.pictures import draw_facade, draw_trees
from deepsimbad_campus.renderer import Renderer
from deepsimbad_campus.route import Drive, drive_length_m
from deepsimbad_campus.season import PAPER_DATES, Light, Season, drive_date
from deepsimbad_campus.things import Shot, draw_panel, panels
from deepsimbad_campus.world import Style, World
from deepsimbad_campus.writer import JPEG_TIFF


def test_only_what_lies_ahead_is_left_of_a_polygon():
    square = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    np.testing.assert_allclose(clip_near(square), [[1, 0.35], [1, 1], [-1, 1], [-1, 0.35]])
    assert clip_near(square - np.array([0, 5])).shape == (0, 2)
    np.testing.assert_array_equal(clip_near(square + np.array([0, 5])), square + np.array([0, 5]))


def files_of(rendered, season):
    return sorted((rendered / PAPER_DATES[season] / "lb3" / "Cam5").iterdir())


def upright(rendered, season, frame):
    stored = cv2.imread(str(files_of(rendered, season)[frame]))
    assert stored.shape == (616, 808, 3)
    return cv2.rotate(stored, cv2.ROTATE_90_CLOCKWISE).astype(int)


def test_pictures_are_stored_turned_counter_clockwise_with_the_sky_up_when_upright(rendered):
    picture = upright(rendered, "summer", 20)
    sky, ground = picture[:100].mean((0, 1)), picture[-150:].mean((0, 1))
    assert sky[0] > sky[2] + 40  # blue
    assert ground[0] < ground[1] + 25
    assert sky.mean() > ground.mean() * 0.9


def test_winter_ground_is_whiter_and_summer_trees_are_fuller(rendered):
    ground = {name: upright(rendered, name, 8)[450:625] for name in PAPER_DATES}
    white = {name: (part.min(axis=2) > 150).mean() for name, part in ground.items()}
    assert white["winter"] > 0.25
    assert white["winter"] > 3 * max(white["spring"], white["autumn"])
    opaque = []
    for name in ("winter", "autumn", "summer"):
        trees = draw_trees(Season(drive_date(name), 0), 0)
        opaque.append(np.mean([levels[0][:300, :, 3] > 128 for levels in trees[:11]]))
    assert opaque == sorted(opaque)


def test_a_picture_is_equal_in_a_longer_drive_and_another_on_another_day(rendered, monkeypatch):
    monkeypatch.setattr(camera, "UPRIGHT_SIZE", (616, 808))
    world, bodies, pictures = World(0, drive_length_m(60, 1.75)), [], []
    for name in ("summer", "2012-08-20"):
        picture = Renderer(world, Drive(world.route, 0, drive_date(name), 60, 1.75)).stored_picture(5)
        bodies.append(cv2.imencode(".tiff", picture, JPEG_TIFF)[1].tobytes())
        pictures.append(cv2.resize(picture, None, fx=1 / 8, fy=1 / 8, interpolation=cv2.INTER_AREA).astype(int))
    assert bodies[0] == files_of(rendered, "summer")[5].read_bytes()
    assert np.abs(pictures[0] - pictures[1]).mean() > 10, "more than the grain, which is averaged away"


STYLE = Style(5, "brick", 10.0, 6.0, True)


def _wall_on_black(feet):
    season, view, canvas = Season(drive_date("summer"), 0), View(0, 0, 0), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    shot, levels = Shot(canvas, view, Light(season, 1.0, 1.0)), draw_facade(STYLE, season, 1)
    for ends, span in panels(np.array(feet, float), view):
        draw_panel(shot, levels, STYLE.height_m, shot.light.on_ground(1.0), ends, span)
    return canvas


@pytest.mark.parametrize("feet", [((20, -5), (20, 5)), ((12, -6), (20, 0)), ((0.5, -3), (40, -3))])
def test_a_wall_covers_exactly_its_outline_and_is_not_seen_from_inside(feet):
    right_ahead = View(0, 0, 0).to_camera(np.array(feet, float))
    foot, top = project(right_ahead, 0.0), project(right_ahead, STYLE.height_m)
    expected = np.zeros((HEIGHT, WIDTH), np.uint8)
    outline = np.round(np.array([foot[0], foot[1], top[1], top[0]]) * 16).astype(np.int32)
    cv2.fillConvexPoly(expected, outline, 1, cv2.LINE_8, 4)
    assert (_wall_on_black(feet).any(axis=2) != expected.astype(bool)).mean() < 0.012  # edges alone
    assert not _wall_on_black(feet[::-1]).any()
