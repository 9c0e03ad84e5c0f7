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
from typing import Any

import numpy as np

from deepsimbad_campus.camera import FOCAL_PX, HALF_VIEW, HEIGHT, NEAR_M, SEEN_SIZE, WIDTH, Array, near_cut, project
from deepsimbad_campus.route import Drive, stream
from deepsimbad_campus.season import Season
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
Sighting = tuple[str, tuple[float, ...]]  # an object: its label; left, top, right, bottom in shares of picture's sides


def observe(world: World, drive: Drive, names: list[str]) -> tuple[bytes, bytes]:
    """`detections.jsonl`, a line a picture, and `captions.csv`, of a drive's pictures by their files' names."""
    season, lines, table = Season(drive.date, world.seed), list[str](), io.StringIO()
    rows = csv.writer(table, lineterminator="\n")
    rows.writerow(("name", "text"))
    for frame, name in enumerate(names):
        sections, sightings = world.ahead(drive.position_m[frame]), _sightings(world, drive, frame)
        objects = list(_detections(stream(drive.seed, f"detector {drive.date}", frame), season, sightings))
        lines.append(json.dumps({"name": name, "objects": objects}) + "\n")
        rng = stream(drive.seed, f"caption {drive.date}", frame)
        rows.writerow((name, _caption(rng, season, GROUNDS[sections[0].path_surface], sightings)))
    return "".join(lines).encode(), table.getvalue().encode()


def _sightings(world: World, drive: Drive, frame: int) -> list[Sighting]:
    """The objects in a frame's picture, nearest first, without those that are hidden or tiny."""
    view = drive.view(frame)
    upright: list[tuple[str, Array, float]] = []  # label, [2, 2] left and right foot (right, ahead), height
    for feet, style in (facade for section in world.ahead(drive.position_m[frame]) for facade in section.facades):
        (x0, z0), (x1, z1) = ends = view.to_camera(feet)
        if max(z0, z1) > 2 * NEAR_M and min(z0, z1) < SIGHT_M and x1 * z0 - x0 * z1 > 0:
            label, span = f"{style.material} building".replace("wall building", "wall"), near_cut(ends)[:, None]
            upright.append((label, ends[0] * (1 - span) + ends[1] * span, style.height_m))
    for thing in around(world, drive, frame):
        foot = view.to_camera(thing.place)
        if 2 * NEAR_M < foot[1] < SIGHT_M:
            half, height = np.array(KINDS[thing.kind].sides) @ (1, thing.size_m)
            upright.append((thing.kind, foot + np.array([[-half, 0], [half, 0]]), height))
    hidden, sightings = np.zeros(CELLS, np.bool_), list[Sighting]()
    # The middle of the picture in the canvas; that the robot leans is left out.
    middle = (WIDTH / 2, HEIGHT / 2 - FOCAL_PX * np.tan(view.pitch_rad))
    for label, ends, height in sorted(upright, key=lambda thing: thing[1][:, 1].min()):
        slope = ends[:, 0] / ends[:, 1]
        corners = np.concatenate([project(ends), project(ends, height)])
        sides = (np.stack([corners.min(axis=0), corners.max(axis=0)]) - middle) / SEEN_SIZE + 0.5
        left, top, right, bottom = np.clip(sides, 0, 1).ravel().tolist()
        if slope[0] >= HALF_VIEW or slope[1] <= -HALF_VIEW or min(right - left, bottom - top) < LEAST_SIDE:
            continue
        columns = slice(int(left * CELLS[0]), int(np.ceil(right * CELLS[0])))
        rows = slice(int(top * CELLS[1]), int(np.ceil(bottom * CELLS[1])))
        if 1 - hidden[columns, rows].mean() >= LEAST_SHOWN:
            sightings.append((label, (left, top, right, bottom)))
        if label.endswith(HIDING):
            hidden[columns, rows] = True
    return sightings


def _detections(rng: np.random.Generator, season: Season, sightings: list[Sighting]) -> Iterator[dict[str, Any]]:
    """The objects of a picture in `detections.jsonl`, by an imitated detector."""
    weather_misses, detections = 0.12 * season.snow + 4 * season.haze_per_m, list[tuple[str, Array, float]]()
    for label, box in sightings:
        sides = np.array([box[2] - box[0], box[3] - box[1]])
        miss_chance = MISSED + weather_misses + 0.35 * np.exp(-float(sides.min()) / 0.03)
        miss_chance += 0.25 * (1 - season.leaf_share) * (label in {"tree", "bush"})
        draws, offsets = rng.random(3), rng.normal(0, JITTER, 4) * np.tile(sides, 2)
        if draws[0] >= miss_chance:
            wrong_label = (*WORDS, *SIGNS)[int(draws[2] * (len(WORDS) + len(SIGNS)))]
            score = np.clip(rng.normal(0.95 - 0.6 * miss_chance, 0.08), 0.3, 0.99)
            detections.append((wrong_label if draws[1] < WRONG else label, np.array(box) + offsets, score))
    for _ in range(rng.poisson(FALSE_ALARMS)):
        label, centre, size = rng.choice(list(WORDS)), rng.uniform(0.1, 0.9, 2), rng.uniform(0.03, 0.3, 2)
        detections.append((label, np.concatenate([centre - size / 2, centre + size / 2]), rng.uniform(0.3, 0.6)))
    for label, corners, score in detections:
        start = np.clip(corners[:2], 0, 0.99)
        sides = np.concatenate([start, np.maximum(np.clip(corners[2:], 0, 1), start + 0.005)])  # inside, not empty
        yield {"label": label, "box": [round(side, 4) for side in sides.tolist()], "score": round(float(score), 2)}


def _caption(rng: np.random.Generator, season: Season, ground: str, sightings: list[Sighting]) -> str:
    """The caption of a picture by an imitated person."""
    largest = sorted(sightings, key=lambda thing: (thing[1][0] - thing[1][2]) * (thing[1][3] - thing[1][1]))
    counts, phrases = Counter[tuple[str, str]](), list[str]()
    for label, (left, _, right, _) in largest:
        middle = (left + right) / 2
        counts[label, "on the left" if middle < 0.38 else "on the right" if middle > 0.62 else "ahead"] += 1
    for (label, side), count in list(counts.items())[:NAMED]:
        word = rng.choice(WORDS.get(label, (label,)))
        omission, mistake = rng.random(2)
        if mistake < MISTAKEN:
            word = rng.choice(list(WORDS.values())[rng.integers(0, len(WORDS))])
        if omission >= OMITTED:
            plural = "" if count < 2 else "es" if word.endswith("h") else "s"
            phrases.append(f"{NUMBERS[min(count, len(NUMBERS) - 1)]} {word}{plural} {side}")
    if rng.random() < 0.5:
        phrases.insert(0, ground)
    order = ("", "I see ", "There is ", "In front of me: ")[rng.integers(0, 4)]
    ending = f" {SKIES[season.name]}" if rng.random() < 0.4 else ""
    return f"{order}{', '.join(phrases) or 'an open field'}.{ending}"
