"""What an object detector and a person say of a drive's pictures: `detections.jsonl` and `captions.csv` beside them.

The renderer knows every object, so a detector is imitated from its boxes: what is small or stands behind something is
missed more often, boxes jitter, some labels are wrong, some detections are of nothing. A person names the largest few,
by other words each time, leaves some out and is wrong about some.
"""

import csv
import io
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import lru_cache
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from deepsimbad_campus import things
from deepsimbad_campus.camera import FOCAL_PX, HALF_VIEW, HEIGHT, NEAR_M, SEEN_SIZE, WIDTH, Array, View, project
from deepsimbad_campus.route import Drive, stream
from deepsimbad_campus.season import Season, season_of
from deepsimbad_campus.world import BUSH, FIRST_CONIFER, SIGHT_M, SIGN_COLOURS, Style, World

DETECTIONS, CAPTIONS = "detections.jsonl", "captions.csv"
LEAST_SIDE, LEAST_SHOWN = 0.012, 0.35  # of the image's, and of a box that nothing hides
SECTIONS = 8  # that are kept furnished
CELLS = (64, 84)  # columns and rows that tell what hides what
HIDING = ("building", "wall", "car")
FALSE_ALARMS = 0.6  # a picture, on average
MISSED, WRONG, JITTER = 0.06, 0.03, 0.06  # of objects seen well; of labels; of a box's sides
NAMED, OMITTED, MISTAKEN = 7, 0.15, 0.08  # by a person: at most so many; shares
WORDS = {
    "brick building": ("red brick building", "brick house", "old brick building"),
    "sandstone building": ("sandstone building", "yellow stone building", "sand-coloured stone house"),
    "concrete building": ("grey concrete building", "concrete block", "modern concrete house"),
    "plaster building": ("white plastered building", "white house", "pale building"),
    "glass building": ("glass building", "glass-fronted office", "glazed building"),
    "wall": ("long wall", "concrete wall", "plain wall"),
    "tree": ("tree", "broad-leaved tree", "deciduous tree"), "conifer": ("conifer", "fir tree", "evergreen tree"),
    "bush": ("bush", "shrub"), "lamp": ("street lamp", "lamp post", "lantern"),
    "bollard": ("bollard", "short post"), "bench": ("wooden bench", "park bench", "seat"),
    "car": ("parked car", "car", "vehicle"), "person": ("person", "pedestrian", "walker"),
}  # fmt: skip
SIGNS = ("red sign", "blue sign", "green sign", "yellow sign", "white sign")  # by the renderer's colours
GROUNDS = {"concrete": "a concrete path", "asphalt": "an asphalt path", "paving": "a paved walkway"}
NUMBERS = ("no", "a", "two", "three", "four", "several")
SKIES = {"winter": "Snow lies around.", "spring": "It is spring.", "summer": "Sunny.", "autumn": "Leaves have fallen."}


class Thing(NamedTuple):
    """An object in a picture: its box is left, top, right, bottom, in shares of the picture's sides."""

    label: str
    box: tuple[float, float, float, float]
    score: float = 1.0

    @property
    def area(self) -> float:
        """Of its box."""
        left, top, right, bottom = self.box
        return (right - left) * (bottom - top)

    @property
    def side(self) -> str:
        """Where in the picture it is."""
        middle = (self.box[0] + self.box[2]) / 2
        return "on the left" if middle < 0.38 else "on the right" if middle > 0.62 else "ahead"


class Observer:
    """Looks at any frame of a drive; equal frames are seen equally."""

    def __init__(self, world: World, drive: Drive) -> None:
        self._world, self._drive = world, drive
        self._season: Season = season_of(drive.date, world.seed)
        self._still = lru_cache(SECTIONS)(self._furnished)

    def seen(self, frame: int) -> list[Thing]:
        """All that stands in a picture, nearest first, but for what others hide or hardly shows."""
        view, position_m = self._drive.view(frame), float(self._drive.position_m[frame])
        hidden = np.zeros(CELLS, np.bool_)
        shown: list[Thing] = []
        for _, label, box in sorted(self._standing(view, position_m, frame), key=itemgetter(0)):
            left, top, right, bottom = np.clip(box, 0, 1).tolist()
            if right - left < LEAST_SIDE or bottom - top < LEAST_SIDE:
                continue
            columns = slice(int(left * CELLS[0]), int(np.ceil(right * CELLS[0])))
            rows = slice(int(top * CELLS[1]), int(np.ceil(bottom * CELLS[1])))
            if 1 - hidden[columns, rows].mean() >= LEAST_SHOWN:
                shown.append(Thing(label, (left, top, right, bottom)))
            if label.endswith(HIDING):
                hidden[columns, rows] = True
        return shown

    def files(self, names: list[str]) -> tuple[bytes, bytes]:
        """`detections.jsonl`, a line a picture, and `captions.csv`, of pictures by their files' names."""
        lines, table = list[str](), io.StringIO()
        rows = csv.writer(table, lineterminator="\n")
        rows.writerow(("name", "text"))
        for frame, name in enumerate(names):
            seen = self.seen(frame)
            objects = [
                {"label": thing.label, "box": [round(side, 4) for side in thing.box], "score": round(thing.score, 2)}
                for thing in self.detected(frame, seen)
            ]
            lines.append(json.dumps({"name": name, "objects": objects}) + "\n")
            rows.writerow((name, self.told(frame, seen)))
        return "".join(lines).encode(), table.getvalue().encode()

    def detected(self, frame: int, seen: list[Thing]) -> list[Thing]:
        """What a detector makes of a picture."""
        rng = stream(self._drive.seed, f"detector {self._drive.date}", frame)
        harder = 0.12 * self._season.snow + 4 * self._season.haze_per_m
        things_: list[Thing] = []
        for label, box, _ in seen:
            sides = np.array([box[2] - box[0], box[3] - box[1]])
            missed = MISSED + harder + 0.35 * np.exp(-float(sides.min()) / 0.03)
            missed += 0.25 * (1 - self._season.leaf_share) * (label in {"tree", "bush"})
            draws, moved = rng.random(3), rng.normal(0, JITTER, 4) * np.tile(sides, 2)
            if draws[0] < missed:
                continue
            wrong = (*WORDS, *SIGNS)[int(draws[2] * (len(WORDS) + len(SIGNS)))]
            score = float(np.clip(rng.normal(0.95 - 0.6 * missed, 0.08), 0.3, 0.99))
            things_.append(_thing(wrong if draws[1] < WRONG else label, np.array(box) + moved, score))
        for _ in range(rng.poisson(FALSE_ALARMS)):
            label, centre, size = rng.choice(list(WORDS)), rng.uniform(0.1, 0.9, 2), rng.uniform(0.03, 0.3, 2)
            things_.append(
                _thing(str(label), np.concatenate([centre - size / 2, centre + size / 2]), rng.uniform(0.3, 0.6))
            )
        return things_

    def told(self, frame: int, seen: list[Thing]) -> str:
        """What a person says of a picture."""
        rng = stream(self._drive.seed, f"caption {self._drive.date}", frame)
        largest = sorted(seen, key=lambda thing: -thing.area)
        counts = Counter((thing.label, thing.side) for thing in largest)
        phrases = []
        for label, side in list(counts)[:NAMED]:
            word = rng.choice(WORDS.get(label, (label,)))
            omitted, mistaken = rng.random(2)
            if mistaken < MISTAKEN:
                word = rng.choice(WORDS[list(WORDS)[rng.integers(0, len(WORDS))]])
            if omitted < OMITTED:
                continue
            n = min(counts[label, side], len(NUMBERS) - 1)
            plural = "" if n < 2 else "es" if word.endswith("h") else "s"
            phrases.append(f"{NUMBERS[n]} {word}{plural} {side}")
        section = self._world.ahead(float(self._drive.position_m[frame]))[0]
        if rng.random() < 0.5:
            phrases.insert(0, f"{GROUNDS[section.path_surface]}")
        order = ("", "I see ", "There is ", "In front of me: ")[rng.integers(0, 4)]
        ending = f" {SKIES[self._season.name]}" if rng.random() < 0.4 else ""
        return f"{order}{', '.join(phrases) or 'an open field'}.{ending}"

    def _standing(self, view: View, position_m: float, frame: int) -> Iterator[tuple[float, str, Array]]:
        """(metres ahead, label, box) of all that is in view."""
        drive, time_s = self._drive, int(self._drive.utime[frame] - self._drive.utime[0]) / 1e6
        for section in self._world.ahead(position_m):
            yield from self._still(section.stretch.number).seen_by(view)
            for car in things.driving(section, drive, self._world.route, time_s):
                yield from Standing.of([(car[0], "car", 1.7, 1.5)]).seen_by(view)
        people = [(place, "person", 0.3, 1.75) for place, *_ in
                  things.walking(drive, self._world.route, position_m, time_s)]  # fmt: skip
        yield from Standing.of(people).seen_by(view)

    def _furnished(self, number: int) -> "Standing":
        """What stands still in a section during the drive."""
        section = self._world.sections[number]
        trees = [
            (place, "bush" if kind == BUSH else "conifer" if kind >= FIRST_CONIFER else "tree", 0.35 * high, high)
            for place, high, kind, _ in section.trees
        ]
        posts = [(place, *_of_post(kind, size, colour)) for place, kind, size, colour in section.posts]
        cars = [(place, "car", 1.7, 1.5) for place, *_ in things.parked(section, self._drive)]
        return Standing.of([*trees, *posts, *cars], section.facades)


class Standing(NamedTuple):
    """Things on the ground: k upright ones, seen equally from all sides, and m walls."""

    labels: list[str]  # [k + m]
    places: Array  # [k, 2]
    half_m: Array  # [k] of their width
    feet: Array  # [m, 2, 2] left and right edge of walls, seen from outside
    height_m: Array  # [k + m]

    @classmethod
    def of(
        cls, upright: Sequence[tuple[Array, str, float, float]], walls: Sequence[tuple[Array, Style]] = ()
    ) -> "Standing":
        """Of places, labels, half widths and heights; and of walls."""
        named = ["wall" if style.material == "wall" else f"{style.material} building" for _, style in walls]
        return cls(
            [label for _, label, _, _ in upright] + named,
            np.array([place for place, *_ in upright]).reshape(-1, 2),
            np.array([half for _, _, half, _ in upright]),
            np.array([feet for feet, _ in walls]).reshape(-1, 2, 2),
            np.array([height for *_, height in upright] + [style.height_m for _, style in walls]),
        )

    def seen_by(self, view: View) -> Iterator[tuple[float, str, Array]]:
        """(metres ahead, label, box) of those in view."""
        k, side = len(self.places), self.half_m[:, None] * (1.0, 0.0)
        at = view.to_camera(self.places)
        walls = view.to_camera(self.feet.reshape(-1, 2)).reshape(-1, 2, 2)
        ends = np.concatenate([np.stack([at - side, at + side], axis=1), walls])
        (x0, z0), (x1, z1) = ends[:, 0].T, ends[:, 1].T
        in_front = (np.maximum(z0, z1) > 2 * NEAR_M) & (np.minimum(z0, z1) < SIGHT_M) & (x1 * z0 - x0 * z1 > 0)
        apart = z1 - z0
        for end, z in ((0, z0), (1, z1)):  # a wall that goes past the camera is cut off before it
            cut = in_front & (z < NEAR_M)
            share = (NEAR_M - z0[cut]) / apart[cut]
            ends[cut, end] = ends[cut, 0] * (1 - share[:, None]) + ends[cut, 1] * share[:, None]
        slope = ends[:, :, 0] / np.maximum(ends[:, :, 1], 1e-3)
        in_view = in_front & (slope[:, 0] < HALF_VIEW) & (slope[:, 1] > -HALF_VIEW)
        in_view[:k] &= at[:, 1] > 2 * NEAR_M
        for thing in np.flatnonzero(in_view):
            box = _box(view, ends[thing], float(self.height_m[thing]))
            yield float(ends[thing, :, 1].min()), self.labels[thing], box


def _of_post(kind: str, size_m: float, colour: tuple[float, ...]) -> tuple[str, float, float]:
    """Its label, half its width and its height."""
    if kind == "sign":
        return SIGNS[SIGN_COLOURS.index(tuple(colour))], 0.38, size_m
    return {"lamp": ("lamp", 0.26, size_m + 0.5), "bollard": ("bollard", 0.1, size_m)}.get(
        kind, ("bench", size_m / 2, 0.88)
    )


def _box(view: View, ends: Array, height_m: float) -> Array:
    """[4] of what stands between two feet [2, 2] (right, ahead), as the picture shows it, its lean left away."""
    low, high = project(ends), project(ends, height_m)
    middle = (WIDTH / 2, HEIGHT / 2 - FOCAL_PX * np.tan(view.pitch_rad))
    corners = np.stack([np.minimum(low, high).min(axis=0), np.maximum(low, high).max(axis=0)])
    return np.asarray(((corners - middle) / SEEN_SIZE + 0.5).ravel(), np.float64)


def _thing(label: str, box: Array, score: float) -> Thing:
    """With its box inside the picture, and not empty."""
    left, top, right, bottom = np.clip(box, 0, 1).tolist()
    left, top = min(left, 0.99), min(top, 0.99)
    return Thing(label, (left, top, max(right, left + 0.005), max(bottom, top + 0.005)), score)
