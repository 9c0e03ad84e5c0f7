"""Pictures of one drive, painted from back to front."""

import datetime
from collections.abc import Callable
from functools import partial
from operator import itemgetter

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.camera import CANVAS_SIZE, FOCAL_PX, NEAR_M, SEEN_SIZE, UPRIGHT_SIZE, View
from deepsimbad_client.campus.drive import Drive
from deepsimbad_client.campus.facades import draw_facade
from deepsimbad_client.campus.ground import Ground
from deepsimbad_client.campus.light import Light
from deepsimbad_client.campus.noise import stream
from deepsimbad_client.campus.passing import Car, Passing
from deepsimbad_client.campus.props import draw_car, draw_person, draw_post
from deepsimbad_client.campus.scenery import Post, Tree
from deepsimbad_client.campus.season import season_of
from deepsimbad_client.campus.sky import Sky
from deepsimbad_client.campus.trees import BUSH, draw_trees
from deepsimbad_client.campus.turf import draw_ground
from deepsimbad_client.campus.upright import HALF_VIEW, Facades, draw_sprite, wall_normal
from deepsimbad_client.campus.world import SIGHT_M, World

Image = NDArray[np.uint8]

GRAIN = 4.0


class Renderer:
    """Paints any frame of a drive; safe to use from several threads at once.

    Args:
        world: What stands on the campus.
        drive: How the robot moves.
        date: The drive's date, which decides its season and everything that differs between drives.
    """

    def __init__(self, world: World, drive: Drive, date: datetime.date) -> None:
        self._world, self._drive = world, drive
        name, seed = date.isoformat(), world.seed
        self._season = season_of(date, seed)
        self._number = date.toordinal()
        self._sky = Sky(self._season, name, seed, world.skyline())
        self._ground = Ground(world, draw_ground(self._season, name, seed))
        self._trees = draw_trees(self._season, seed)
        self._passing = Passing(world, seed, date, drive.spacing_m)
        self._facades = Facades(partial(draw_facade, season=self._season, drive=date.toordinal()))
        grain = stream(seed, f"grain {name}").normal(0, GRAIN, (UPRIGHT_SIZE[0] + 64, UPRIGHT_SIZE[1] + 64, 1))
        self._grain = np.clip(np.repeat(grain, 3, axis=2) + 128, 0, 255).astype(np.uint8)

    def stored(self, frame: int) -> Image:
        """[1232, 1616, 3] BGR, the picture of a frame as it is stored: turned counter-clockwise."""
        view = self._drive.view(frame)
        canvas = self.canvas(frame, view)
        # What is drawn, seen from the middle, leans and nods and turns: a stored column is an upright row, and stored
        # rows count the upright columns from the right. Enlarging comes last because it is dearest.
        lean, nod = -view.roll_rad, FOCAL_PX * np.tan(view.pitch_rad)
        cos, sin = np.cos(lean), np.sin(lean)
        middle_x, middle_y = CANVAS_SIZE[0] / 2, CANVAS_SIZE[1] / 2 - nod
        wide, tall = SEEN_SIZE
        column = [sin, cos, tall / 2 - sin * middle_x - cos * middle_y]
        row = [-cos, sin, wide / 2 + cos * middle_x - sin * middle_y]
        seen = cv2.warpAffine(canvas, np.array([column, row]), (tall, wide), flags=cv2.INTER_LINEAR)
        width, height = UPRIGHT_SIZE
        picture = cv2.resize(seen, (height, width), interpolation=cv2.INTER_LINEAR)
        shift = stream(self._world.seed + self._number, "grain", frame).integers(0, 64, 2)
        grain = self._grain[shift[0] : shift[0] + width, shift[1] : shift[1] + height]
        return np.asarray(cv2.addWeighted(picture, 1.0, grain, 1.0, -128), np.uint8)

    def canvas(self, frame: int, view: View) -> Image:
        """[728, 560, 3] BGR, the picture of a frame as drawn: upright, level and without grain."""
        light = self._light(frame)
        position = float(self._drive.position_m[frame])
        canvas = np.zeros((CANVAS_SIZE[1], CANVAS_SIZE[0], 3), np.uint8)
        self._sky.paint(canvas, view, light, frame)
        sun = self._sky.sun_pixel(view)
        if sun is not None and light.sunshine > 0.3:
            self._sky.glow(canvas, sun, 1.5 * light.sunshine)
        self._ground.paint(canvas, view, position, light)
        self._things(canvas, view, position, light, int(self._drive.utime[frame] - self._drive.utime[0]) / 1e6)
        if sun is not None and light.sunshine > 0.3:
            inside = 0 <= sun[0] < canvas.shape[1] and 0 <= sun[1] < canvas.shape[0]
            if inside and int(canvas[sun[1], sun[0]].min()) > 200:
                self._sky.glow(canvas, sun, 0.8 * light.sunshine)
                self._sky.smear(canvas, sun)
        return canvas

    def _light(self, frame: int) -> Light:
        bar = 2.4 * (self._season.cloud_share - 0.5)
        sunshine = float(np.clip(0.5 + 1.6 * (self._drive.sunniness[frame] - bar), 0, 1))
        return Light(self._season, sunshine, float(self._drive.exposure[frame]))

    def _things(self, canvas: Image, view: View, position_m: float, light: Light, time_s: float) -> None:
        queue: list[tuple[float, Callable[[], None]]] = []

        def stand(place: NDArray[np.float64], margin_m: float, draw: Callable[[NDArray[np.float64]], None]) -> None:
            foot = view.to_camera(place[None])[0]
            ahead = float(foot[1])
            if NEAR_M < ahead < SIGHT_M and abs(foot[0]) < ahead * HALF_VIEW + margin_m:
                queue.append((ahead, partial(draw, foot)))

        for section in self._world.ahead(position_m):
            scene = section.scene
            for facade in scene.facades:
                gain = light.facing(*wall_normal(facade))
                for ahead, feet, span in self._facades.panels(facade, view):
                    paint = partial(self._facades.draw, canvas, facade.style, feet, span, light, gain)
                    queue.append((ahead, paint))
            for tree in scene.trees:
                stand(tree.place, 5.0, partial(self._tree, canvas, light, tree))
            for post in scene.posts:
                if post.kind == "bush":
                    stand(post.place, 1.5, partial(self._bush, canvas, light, post))
                else:
                    stand(post.place, 1.5, partial(draw_post, canvas, post, light))
            for car in self._passing.parked(section):
                stand(car.place, 3.0, partial(self._car, canvas, view, light, car))
        for car in self._passing.driving(position_m, time_s):
            stand(car.place, 3.0, partial(self._car, canvas, view, light, car))
        for walker in self._passing.walking(position_m, time_s):
            stand(walker.place, 1.0, partial(draw_person, canvas, walker.look, walker.stride, light))
        for _, draw in sorted(queue, key=itemgetter(0), reverse=True):
            draw()

    def _tree(self, canvas: Image, light: Light, tree: Tree, foot: NDArray[np.float64]) -> None:
        draw_sprite(canvas, self._trees[tree.species], foot, tree.height_m, tree.mirrored, light)

    def _bush(self, canvas: Image, light: Light, bush: Post, foot: NDArray[np.float64]) -> None:
        draw_sprite(canvas, self._trees[BUSH], foot, bush.size_m, False, light)

    @staticmethod
    def _car(canvas: Image, view: View, light: Light, car: Car, _: NDArray[np.float64]) -> None:
        draw_car(canvas, view, car.place, car.heading_rad, car.paint, light)
