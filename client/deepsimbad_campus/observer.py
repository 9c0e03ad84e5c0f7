"""What an object detector and a person say of a drive's pictures: `detections.jsonl` and `captions.csv` beside them.

The renderer knows every object, so a detector is imitated from its boxes: what is small or stands behind something is
missed more often, boxes jitter, some labels are wrong, some detections are of nothing. A person names the largest few,
by other words each time, leaves some out and is wrong about some.
"""

import csv
import io
import json
from collections import Counter
from collections.abc import Iterator
from operator import itemgetter
from typing import Any

import numpy as np

from deepsimbad_campus import camera
from deepsimbad_campus.camera import HALF_VIEW, NEAR_M, Array, View, project
from deepsimbad_campus.route import Drive, stream
from deepsimbad_campus.season import season_of
from deepsimbad_campus.things import KINDS, around
from deepsimbad_campus.world import SIGHT_M, SIGNS, World

DETECTIONS, CAPTIONS = "detections.jsonl", "captions.csv"
LEAST_SIDE, LEAST_SHOWN = 0.012, 0.35  # a box's sides as shares of the image's; share of a box that nothing hides
CELLS = (64, 84)  # columns and rows that tell what hides what
HIDING = ("building", "wall", "car")
FALSE_ALARMS = 0.6  # a picture, on average
MISSED, WRONG, JITTER = 0.06, 0.03, 0.06  # shares of objects seen well, of labels, of a box's sides
NAMED, OMITTED, MISTAKEN = 7, 0.15, 0.08  # by a person: phrases at most; shares of them left out, and misnamed
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
GROUNDS = {"concrete": "a concrete path", "asphalt": "an asphalt path", "paving": "a paved walkway"}
NUMBERS = ("no", "a", "two", "three", "four", "several")
SKIES = {"winter": "Snow lies around.", "spring": "It is spring.", "summer": "Sunny.", "autumn": "Leaves have fallen."}


Box = tuple[float, float, float, float]  # left, top, right, bottom, in shares of the picture's sides
Sighting = tuple[str, Box]  # label and box of an object in a picture


class Observer:
    """Looks at any frame of a drive; equal frames are seen equally."""

    def __init__(self, world: World, drive: Drive) -> None:
        self._world, self._drive = world, drive
        self._season = season_of(drive.date, world.seed)

    def _sightings(self, frame: int) -> list[Sighting]:
        """The objects in a frame's picture, nearest first, without those that are hidden or tiny."""
        hidden = np.zeros(CELLS, np.bool_)
        sightings: list[Sighting] = []
        for _, label, box in sorted(self._standing(self._drive.view(frame), frame), key=itemgetter(0)):
            left, top, right, bottom = np.clip(box, 0, 1).tolist()
            if right - left < LEAST_SIDE or bottom - top < LEAST_SIDE:
                continue
            columns = slice(int(left * CELLS[0]), int(np.ceil(right * CELLS[0])))
            rows = slice(int(top * CELLS[1]), int(np.ceil(bottom * CELLS[1])))
            if 1 - hidden[columns, rows].mean() >= LEAST_SHOWN:
                sightings.append((label, (left, top, right, bottom)))
            if label.endswith(HIDING):
                hidden[columns, rows] = True
        return sightings

    def files(self, names: list[str]) -> tuple[bytes, bytes]:
        """`detections.jsonl`, a line a picture, and `captions.csv`, of pictures by their files' names."""
        lines, table = list[str](), io.StringIO()
        rows = csv.writer(table, lineterminator="\n")
        rows.writerow(("name", "text"))
        for frame, name in enumerate(names):
            sightings = self._sightings(frame)
            lines.append(json.dumps({"name": name, "objects": list(self._detections(frame, sightings))}) + "\n")
            rows.writerow((name, self._caption(frame, sightings)))
        return "".join(lines).encode(), table.getvalue().encode()

    def _detections(self, frame: int, sightings: list[Sighting]) -> Iterator[dict[str, Any]]:
        """The detections of a picture by an imitated detector."""
        rng = stream(self._drive.seed, f"detector {self._drive.date}", frame)
        weather_misses = 0.12 * self._season.snow + 4 * self._season.haze_per_m
        for label, box in sightings:
            sides = np.array([box[2] - box[0], box[3] - box[1]])
            miss_chance = MISSED + weather_misses + 0.35 * np.exp(-float(sides.min()) / 0.03)
            miss_chance += 0.25 * (1 - self._season.leaf_share) * (label in {"tree", "bush"})
            draws, offsets = rng.random(3), rng.normal(0, JITTER, 4) * np.tile(sides, 2)
            if draws[0] < miss_chance:
                continue
            wrong_label = (*WORDS, *SIGNS)[int(draws[2] * (len(WORDS) + len(SIGNS)))]
            score = float(np.clip(rng.normal(0.95 - 0.6 * miss_chance, 0.08), 0.3, 0.99))
            yield _detection(wrong_label if draws[1] < WRONG else label, np.array(box) + offsets, score)
        for _ in range(rng.poisson(FALSE_ALARMS)):
            label, centre, size = rng.choice(list(WORDS)), rng.uniform(0.1, 0.9, 2), rng.uniform(0.03, 0.3, 2)
            yield _detection(label, np.concatenate([centre - size / 2, centre + size / 2]), rng.uniform(0.3, 0.6))

    def _caption(self, frame: int, sightings: list[Sighting]) -> str:
        """The caption of a picture by an imitated person."""
        rng = stream(self._drive.seed, f"caption {self._drive.date}", frame)
        largest = sorted(sightings, key=lambda thing: (thing[1][0] - thing[1][2]) * (thing[1][3] - thing[1][1]))
        counts = Counter((label, _side(box)) for label, box in largest)
        phrases = []
        for label, side in list(counts)[:NAMED]:
            word = rng.choice(WORDS.get(label, (label,)))
            omission, mistake = rng.random(2)
            if mistake < MISTAKEN:
                word = rng.choice(WORDS[list(WORDS)[rng.integers(0, len(WORDS))]])
            if omission < OMITTED:
                continue
            n = min(counts[label, side], len(NUMBERS) - 1)
            plural = "" if n < 2 else "es" if word.endswith("h") else "s"
            phrases.append(f"{NUMBERS[n]} {word}{plural} {side}")
        section = self._world.ahead(self._drive.position_m[frame])[0]
        if rng.random() < 0.5:
            phrases.insert(0, GROUNDS[section.path_surface])
        order = ("", "I see ", "There is ", "In front of me: ")[rng.integers(0, 4)]
        ending = f" {SKIES[self._season.name]}" if rng.random() < 0.4 else ""
        return f"{order}{', '.join(phrases) or 'an open field'}.{ending}"

    def _standing(self, view: View, frame: int) -> Iterator[tuple[float, str, Array]]:
        """(metres ahead, label, box) of all that is in view."""
        upright: list[tuple[str, Array, float]] = []  # label, [2, 2] left and right foot (right, ahead), height
        for section in self._world.ahead(self._drive.position_m[frame]):
            for feet, style in section.facades:
                (x0, z0), (x1, z1) = ends = view.to_camera(feet)
                if max(z0, z1) > 2 * NEAR_M and min(z0, z1) < SIGHT_M and x1 * z0 - x0 * z1 > 0:
                    span = camera.near_cut(ends)[:, None]
                    label = "wall" if style.material == "wall" else f"{style.material} building"
                    upright.append((label, ends[0] * (1 - span) + ends[1] * span, style.height_m))
        for thing in around(self._world, self._drive, frame):
            kind, foot = KINDS[thing.kind], view.to_camera(thing.place)
            if 2 * NEAR_M < foot[1] < SIGHT_M:
                (half, height), side = kind.measures(thing.size_m), np.array([1.0, 0.0])
                upright.append((thing.kind, np.stack([foot - half * side, foot + half * side]), height))
        for label, ends, height in upright:
            slope = ends[:, 0] / ends[:, 1]
            if slope[0] < HALF_VIEW and slope[1] > -HALF_VIEW:
                yield float(ends[:, 1].min()), label, _box(view, ends, height)


def _box(view: View, ends: Array, height_m: float) -> Array:
    """[4] the box of what stands between two feet [2, 2] (right, ahead), in shares of the picture; roll is ignored."""
    low, high = project(ends), project(ends, height_m)
    middle = (camera.WIDTH / 2, camera.HEIGHT / 2 - camera.FOCAL_PX * np.tan(view.pitch_rad))
    corners = np.stack([np.minimum(low, high).min(axis=0), np.maximum(low, high).max(axis=0)])
    return np.asarray(((corners - middle) / camera.SEEN_SIZE + 0.5).ravel(), np.float64)


def _side(box: Box) -> str:
    """Where in the picture a box lies, in words."""
    middle = (box[0] + box[2]) / 2
    return "on the left" if middle < 0.38 else "on the right" if middle > 0.62 else "ahead"


def _detection(label: str, box: Array, score: float) -> dict[str, Any]:
    """An object of `detections.jsonl`, its box inside the picture, and not empty."""
    left, top, right, bottom = np.clip(box, 0, 1).tolist()
    left, top = min(left, 0.99), min(top, 0.99)
    sides = left, top, max(right, left + 0.005), max(bottom, top + 0.005)
    return {"label": label, "box": [round(side, 4) for side in sides], "score": round(score, 2)}
