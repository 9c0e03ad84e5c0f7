import datetime

import cv2
import numpy as np
import pytest

from deepsimbad_client.campus.camera import CANVAS_SIZE, EYE_M, HORIZON_Y, View, clip_near, project
from deepsimbad_client.campus.drive import Drive, drive_length_m
from deepsimbad_client.campus.facades import draw_facade
from deepsimbad_client.campus.light import Light
from deepsimbad_client.campus.render import Renderer
from deepsimbad_client.campus.scenery import Facade, FacadeStyle
from deepsimbad_client.campus.season import PAPER_DATES, drive_date, season_of
from deepsimbad_client.campus.trees import draw_trees
from deepsimbad_client.campus.upright import Facades, wall_normal
from deepsimbad_client.campus.world import World
from deepsimbad_client.errors import InvalidArgumentError

N_FRAMES = 60


@pytest.fixture(scope="module")
def renderers():
    world = World(0, drive_length_m(N_FRAMES, 1.75))
    made = {}
    for name in PAPER_DATES:
        date = drive_date(name)
        made[name] = Renderer(world, Drive(world.route, 0, date, N_FRAMES, 1.75), date)
    return made


def _upright(renderer, frame):
    return cv2.rotate(renderer.stored(frame), cv2.ROTATE_90_CLOCKWISE)


def test_the_eye_is_at_the_height_of_the_horizon_and_right_is_right():
    view = View(10.0, 20.0, heading_rad=np.pi / 2)  # looks east
    ahead, right = view.to_camera(np.array([[10.0, 50.0], [5.0, 50.0]]))
    np.testing.assert_allclose(ahead, [0, 30], atol=1e-9)
    np.testing.assert_allclose(right, [5, 30], atol=1e-9)
    assert project(ahead[None], EYE_M)[0] == pytest.approx([CANVAS_SIZE[0] / 2, HORIZON_Y])
    assert project(ahead[None], 0.0)[0, 1] > HORIZON_Y > project(ahead[None], 3.0)[0, 1]
    assert project(right[None], 0.0)[0, 0] > CANVAS_SIZE[0] / 2


def test_only_what_lies_ahead_is_left_of_a_polygon():
    square = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    far = square + np.array([0, 5])
    clipped = clip_near(square)
    assert clipped[:, 1].min() == pytest.approx(0.35)
    assert clip_near(square - (0, 5)).shape == (0, 2)
    np.testing.assert_array_equal(clip_near(far), far)


def test_pictures_are_stored_turned_counter_clockwise_with_the_sky_up_when_upright(renderers):
    stored = renderers["summer"].stored(20)
    assert stored.shape == (1232, 1616, 3)
    assert stored.dtype == np.uint8
    upright = _upright(renderers["summer"], 20).astype(int)
    assert upright.shape == (1616, 1232, 3)
    sky, ground = upright[:200].mean((0, 1)), upright[-300:].mean((0, 1))
    assert sky[0] > sky[2] + 40  # blue
    assert ground[0] < ground[1] + 25
    assert sky.mean() > ground.mean() * 0.9


def test_winter_ground_is_whiter_and_summer_trees_are_fuller(renderers):
    ground = {name: _upright(r, 8)[900:1250].astype(float) for name, r in renderers.items()}
    white = {name: (part.min(axis=2) > 150).mean() for name, part in ground.items()}
    assert white["winter"] > 0.25
    assert white["winter"] > 3 * max(white["spring"], white["autumn"])
    solid = {name: [s.solidity for s in draw_trees(season_of(drive_date(name), 0), 0)[:11]] for name in PAPER_DATES}
    assert np.mean(solid["winter"]) < np.mean(solid["autumn"]) < np.mean(solid["summer"])


def test_a_frame_does_not_depend_on_what_was_drawn_before(renderers):
    first = renderers["autumn"].stored(33)
    for frame in (2, 50, 11):
        renderers["autumn"].stored(frame)
    np.testing.assert_array_equal(renderers["autumn"].stored(33), first)


def test_drives_of_one_season_differ_too():
    world = World(0, drive_length_m(10, 1.75))
    pictures = []
    for date in (datetime.date(2012, 8, 4), datetime.date(2012, 8, 20)):
        drive = Drive(world.route, 0, date, 10, 1.75)
        pictures.append(Renderer(world, drive, date).stored(5).astype(int))
    assert np.abs(pictures[0] - pictures[1]).mean() > 4


def test_moving_forward_makes_things_grow(renderers):
    """The picture ahead, scaled up about the horizon, matches the next one better than unscaled."""
    renderer = renderers["spring"]
    drive = renderer._drive
    frame = next(f for f in range(24, 40) if drive.position_m[f + 2] - drive.position_m[f] > 3)
    view = drive.view(frame)
    ahead = View(
        view.north_m + 4 * np.cos(view.heading_rad), view.east_m + 4 * np.sin(view.heading_rad), view.heading_rad
    )
    near = renderer.canvas(frame, ahead)
    far = renderer.canvas(frame, View(view.north_m, view.east_m, view.heading_rad))
    centre = (CANVAS_SIZE[0] / 2, HORIZON_Y)
    errors = []
    for scale in (1.0, 1.12):
        grow = np.array([[scale, 0, centre[0] * (1 - scale)], [0, scale, centre[1] * (1 - scale)]])
        grown = cv2.warpAffine(far, grow, CANVAS_SIZE)
        band = slice(int(HORIZON_Y) - 80, int(HORIZON_Y) - 4), slice(40, -40)
        errors.append(np.abs(cv2.blur(grown, (3, 3))[band].astype(int) - cv2.blur(near, (3, 3))[band]).mean())
    assert errors[1] < errors[0]


STYLE = FacadeStyle(5, "brick", 10.0, 6.0, 2, 3.0, True)


def _facade_on_black(left, right):
    season = season_of(datetime.date(2012, 8, 4), 0)
    facades = Facades(lambda style: draw_facade(style, season, 1))
    canvas = np.zeros((CANVAS_SIZE[1], CANVAS_SIZE[0], 3), np.uint8)
    view = View(0.0, 0.0, 0.0)
    facade = Facade(np.array(left, float), np.array(right, float), STYLE)
    light = Light(season, 1.0, 1.0)
    for _, feet, span in facades.panels(facade, view):
        facades.draw(canvas, STYLE, feet, span, light, light.on_ground)
    return canvas, facade


@pytest.mark.parametrize(("left", "right"), [((20, -5), (20, 5)), ((12, -6), (20, 0)), ((0.5, -3), (40, -3))])
def test_a_wall_covers_exactly_its_outline(left, right):
    canvas, facade = _facade_on_black(left, right)
    camera = View(0, 0, 0).to_camera(np.stack([facade.left, facade.right]))
    foot, top = project(camera, 0.0), project(camera, STYLE.height_m)
    wanted = np.zeros(canvas.shape[:2], np.uint8)
    outline = np.array([foot[0], foot[1], top[1], top[0]])
    cv2.fillConvexPoly(wanted, np.round(outline * 16).astype(np.int32), 1, cv2.LINE_8, 4)
    drawn = canvas.any(axis=2)
    assert (drawn != wanted.astype(bool)).mean() < 0.012  # edges alone


def test_walls_are_not_seen_from_inside():
    canvas, facade = _facade_on_black((20, 5), (20, -5))
    assert not canvas.any()
    assert wall_normal(facade) == pytest.approx((1.0, 0.0))


def test_low_sun_lights_only_the_walls_that_face_it():
    season = season_of(drive_date("autumn"), 0)
    light = Light(season, 1.0, 1.0)
    north, east, up = light.sun_direction
    assert np.hypot(np.hypot(north, east), up) == pytest.approx(1)
    assert light.facing(north, east).mean() > 1.3 * light.facing(-north, -east).mean()
    assert (light.facing(-north, -east) == light.in_shade).all()


@pytest.mark.parametrize("season", ["", "Winter", "monsoon", "2012-13-01", "22.1.2012"])
def test_other_seasons_are_refused(season):
    with pytest.raises(InvalidArgumentError, match="season"):
        drive_date(season)
