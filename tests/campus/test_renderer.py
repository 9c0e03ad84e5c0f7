"""What the camera sees: perspective, light, seasons."""

import cv2
import numpy as np
import pytest

from deepsimbad_campus.camera import HEIGHT, WIDTH, View, clip_near, project
from deepsimbad_campus.pictures import draw_facade
from deepsimbad_campus.renderer import Renderer
from deepsimbad_campus.route import Drive, drive_length_m
from deepsimbad_campus.season import PAPER_DATES, Light, drive_date, season_of
from deepsimbad_campus.things import Shot, draw_panel, panels
from deepsimbad_campus.world import Style, World

N_FRAMES = 60


@pytest.fixture(scope="module")
def renderers():
    world = World(0, drive_length_m(N_FRAMES, 1.75))
    drives = {name: Drive(world.route, 0, drive_date(name), N_FRAMES, 1.75) for name in (*PAPER_DATES, "2012-08-20")}
    return {name: Renderer(world, drive) for name, drive in drives.items()}


def _upright(renderer, frame):
    return cv2.rotate(renderer.stored_picture(frame), cv2.ROTATE_90_CLOCKWISE)


def test_only_what_lies_ahead_is_left_of_a_polygon():
    square = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    np.testing.assert_allclose(clip_near(square), [[1, 0.35], [1, 1], [-1, 1], [-1, 0.35]])
    assert clip_near(square - np.array([0, 5])).shape == (0, 2)
    np.testing.assert_array_equal(clip_near(square + np.array([0, 5])), square + np.array([0, 5]))


def test_pictures_are_stored_turned_counter_clockwise_with_the_sky_up_when_upright(renderers):
    stored = renderers["summer"].stored_picture(20)
    assert (stored.shape, stored.dtype) == ((1232, 1616, 3), np.uint8)
    upright = _upright(renderers["summer"], 20).astype(int)
    sky, ground = upright[:200].mean((0, 1)), upright[-300:].mean((0, 1))
    assert sky[0] > sky[2] + 40  # blue
    assert ground[0] < ground[1] + 25
    assert sky.mean() > ground.mean() * 0.9


def test_winter_ground_is_whiter_and_summer_trees_are_fuller(renderers):
    ground = {name: _upright(renderers[name], 8)[900:1250].astype(float) for name in PAPER_DATES}
    white = {name: (part.min(axis=2) > 150).mean() for name, part in ground.items()}
    assert white["winter"] > 0.25
    assert white["winter"] > 3 * max(white["spring"], white["autumn"])
    opaque = {
        name: np.mean([levels[0][:300, :, 3] > 128 for levels in renderers[name].trees[:11]]) for name in PAPER_DATES
    }
    assert opaque["winter"] < opaque["autumn"] < opaque["summer"]


def test_drives_of_one_season_differ_too(renderers):
    pictures = [renderers[name].stored_picture(5).astype(int) for name in ("summer", "2012-08-20")]
    assert np.abs(pictures[0] - pictures[1]).mean() > 4


STYLE = Style(5, "brick", 10.0, 6.0, 2, 3.0, True)


def _wall_on_black(feet):
    season, view, canvas = season_of(drive_date("summer"), 0), View(0, 0, 0), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    shot, levels = Shot(canvas, view, Light(season, 1.0, 1.0)), draw_facade(STYLE, season, 1)
    for _, ends, span in panels(np.array(feet, float), view):
        draw_panel(shot, lambda style: levels, STYLE, shot.light.on_ground, ends, span)
    return canvas


@pytest.mark.parametrize("feet", [((20, -5), (20, 5)), ((12, -6), (20, 0)), ((0.5, -3), (40, -3))])
def test_a_wall_covers_exactly_its_outline_and_is_not_seen_from_inside(feet):
    camera = View(0, 0, 0).to_camera(np.array(feet, float))
    foot, top = project(camera, 0.0), project(camera, STYLE.height_m)
    expected = np.zeros((HEIGHT, WIDTH), np.uint8)
    outline = np.round(np.array([foot[0], foot[1], top[1], top[0]]) * 16).astype(np.int32)
    cv2.fillConvexPoly(expected, outline, 1, cv2.LINE_8, 4)
    assert (_wall_on_black(feet).any(axis=2) != expected.astype(bool)).mean() < 0.012  # edges alone
    assert not _wall_on_black(feet[::-1]).any()
