"""How often the guard of the second season takes drives of two places for one route, and one route for two.

    python -m bench.guard [FOLDER]

FOLDER keeps the encodings for the next run; rendering and encoding take most of the time. The numbers of
`deepsimbad.core.drive` were chosen on half of the places, which is reported apart from the other half.
"""

import math
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.measurement import machine, markdown, real_recordings, write_page
from deepsimbad.core.descriptor import LandmarkStatistics, rank_landmarks
from deepsimbad.core.drive import LEAST_CORRELATION, LEAST_PLACES, SIGNIFICANCE, judge
from deepsimbad.core.landmark_model import select_landmarks
from deepsimbad.core.route import Route, same_places
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.image import decode_image
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad_campus.writer import write_campus
from deepsimbad_client.recordings.sources import open_source

EXTRACTORS = ("gradient_grid", "efficientnet_lite0")
NETVLAD = ("nr", "nq", "nq2")
SEASONS = ("summer", "winter")
N_LANDMARKS = 300
PAIRS = 300  # of every kind
SHORTEST, LONGEST = 60, 300  # frames of a slice
OLD_LEAST_CORRELATION = 0.15  # of the rule that this one replaced
MAX_PIXELS = 50_000_000
CHOSEN_ON, REPORTED = "chosen on", "reported only"
CAMPUS_FRAMES = dict.fromkeys(range(8), 160) | dict.fromkeys(range(8, 24), 100)  # by seed
CAMPUSES = {CHOSEN_ON: (*range(4), *range(8, 16)), REPORTED: (*range(4, 8), *range(16, 24))}
SLICED_CAMPUSES = {CHOSEN_ON: range(4), REPORTED: range(4, 8)}  # long enough for two slices
ROWS = {CHOSEN_ON: (0.0, 0.5), REPORTED: (0.5, 1.0)}  # share of a railway drive


@dataclass(frozen=True)
class Drive:
    """Frames of a recording, as one drive.

    Attributes:
        frames: [n] their rows in all frames of the world.
        position_m: [n] as the drive's own recorder would say.
        x_m, y_m: [n] where known.
    """

    frames: NDArray[np.int64]
    position_m: NDArray[np.float64]
    x_m: NDArray[np.float64] | None = None
    y_m: NDArray[np.float64] | None = None

    def part(self, first: int, stop: int) -> "Drive":
        """The drive's frames from `first` to before `stop`, which keep their positions."""
        frames = slice(first, stop)
        plane = [None if axis is None else axis[frames] for axis in (self.x_m, self.y_m)]
        return Drive(self.frames[frames], self.position_m[frames], *plane)

    def restarted(self) -> "Drive":
        """The same frames as a recording that begins with them: positions from 0, and no plane."""
        return Drive(self.frames, self.position_m - self.position_m[0])

    def with_errors(self, error_m: NDArray[np.float64]) -> "Drive":
        """The drive with errors [n] in its positions, in the plane along x; never backwards along the route."""
        x_m = None if self.x_m is None else self.x_m + error_m
        return Drive(self.frames, np.maximum.accumulate(self.position_m + error_m), x_m, self.y_m)

    @property
    def n_frames(self) -> int:
        """n."""
        return int(self.frames.size)


class World:
    """Recordings under one encoder, every frame compared with every other once."""

    def __init__(self, encodings: dict[str, NDArray[np.float32]], plane: dict[str, NDArray[np.float64]]) -> None:
        self.encodings = np.concatenate(list(encodings.values())).astype(np.float32)
        evaluator = FeatureL2("none")
        self._dissimilarities = evaluator.dissimilarities(self.encodings, evaluator.fit_landmarks(self.encodings))
        self.drives: dict[str, Drive] = {}
        first = 0
        for name, rows in encodings.items():
            measured = plane.get(name, [np.arange(len(rows), dtype=np.float64)])
            self.drives[name] = Drive(np.arange(first, first + len(rows)), *measured)
            first += len(rows)

    def verdicts(self, map_drive: Drive, other: Drive) -> tuple[bool, bool]:
        """Whether the old and the new rule take both for drives of one route; landmarks are of the other drive."""
        encodings = self.encodings[other.frames]
        landmarks = other.frames[select_landmarks(encodings, min(N_LANDMARKS, other.n_frames))]
        map_dissimilarities, other_dissimilarities = (
            self._dissimilarities[np.ix_(drive.frames, landmarks)] for drive in (map_drive, other)
        )
        map_route, other_route = (Route(drive.position_m, x_m=drive.x_m, y_m=drive.y_m) for drive in (map_drive, other))
        places = same_places(other_route, map_route)
        return _old_rule(map_dissimilarities, other_dissimilarities, places), judge(
            map_dissimilarities, other_dissimilarities, places, map_drive.position_m
        ).accepted


def _old_rule(
    map_dissimilarities: NDArray[np.float32], other_dissimilarities: NDArray[np.float32], places: NDArray[np.int64]
) -> bool:
    if len(places) < LEAST_PLACES:
        return False
    z = []
    for dissimilarities in (map_dissimilarities, other_dissimilarities):
        ranks = rank_landmarks(dissimilarities)
        z.append(LandmarkStatistics.of_map(ranks).standardise(ranks))
    return float((z[0][places[:, 0]] * z[1][places[:, 1]]).mean()) >= OLD_LEAST_CORRELATION


Draw = Callable[[np.random.Generator], tuple[Drive, Drive]]


def railway_pairs(world: World, names: Sequence[str], part: str) -> Iterator[tuple[str, bool, Draw]]:
    """(kind, whether it is one route, how to draw a pair) of slices of the railway; one frame counts as a metre."""
    n = world.drives[names[0]].n_frames
    low, high = (round(share * n) for share in ROWS[part])

    def length(rng: np.random.Generator, n_most: int) -> int:
        return int(rng.integers(SHORTEST, min(LONGEST, n_most) + 1))

    def two_places(rng: np.random.Generator, first: str, second: str) -> tuple[Drive, Drive]:
        n_frames = length(rng, (high - low) // 2)
        gap = int(rng.integers(n_frames, high - low - n_frames + 1))
        start = int(rng.integers(low, high - n_frames - gap + 1))
        starts = (start, start + gap) if rng.integers(2) else (start + gap, start)
        stops = (starts[0] + n_frames, starts[1] + n_frames)
        map_drive, other = world.drives[first].part(starts[0], stops[0]), world.drives[second].part(starts[1], stops[1])
        return map_drive.restarted(), other.restarted()

    def of_two(rng: np.random.Generator) -> tuple[str, str]:
        first, second = rng.choice(len(names), 2, replace=False)
        return names[first], names[second]

    def one_stretch(rng: np.random.Generator) -> tuple[Drive, Drive]:
        n_frames = length(rng, high - low)
        start = int(rng.integers(low, high - n_frames + 1))
        first, second = (world.drives[name].part(start, start + n_frames) for name in of_two(rng))
        return first, second

    def inexact(rng: np.random.Generator) -> tuple[Drive, Drive]:
        first, second = one_stretch(rng)
        return first, second.with_errors(rng.integers(-1, 2, second.n_frames).astype(np.float64))

    def reversed_drive(rng: np.random.Generator) -> tuple[Drive, Drive]:
        first, second = one_stretch(rng)
        return first.restarted(), Drive(second.frames[::-1], second.position_m[-1] - second.position_m[::-1])

    yield "two places of the railway, one season", False, lambda rng: two_places(rng, *(of_two(rng)[0],) * 2)
    yield "two places of the railway, two seasons", False, lambda rng: two_places(rng, *of_two(rng))
    yield "one stretch of the railway, driven backwards", False, reversed_drive
    yield "one stretch of the railway", True, one_stretch
    yield "one stretch of the railway, positions wrong by up to a frame", True, inexact
    yield "one stretch of the railway, overlap in part", True, lambda rng: overlapping(rng, *one_stretch(rng))


def overlapping(rng: np.random.Generator, map_drive: Drive, other: Drive) -> tuple[Drive, Drive]:
    """The other drive reduced to half or more of its frames, 45 at least."""
    n_frames = int(rng.integers(min(max(45, other.n_frames // 2), other.n_frames), other.n_frames + 1))
    first = int(rng.integers(0, other.n_frames - n_frames + 1))
    return map_drive, other.part(first, first + n_frames)


def corridor_pairs(world: World, part: str) -> Iterator[tuple[str, bool, Draw]]:
    """As `railway_pairs`, of the corridor and the railway."""
    low, high = (round(share * world.drives["nordland_summer"].n_frames) for share in ROWS[part])

    def corridor_and_railway(rng: np.random.Generator) -> tuple[Drive, Drive]:
        corridor = world.drives[("corridor_ref", "corridor_query")[rng.integers(2)]]
        n_frames = int(rng.integers(SHORTEST, corridor.n_frames + 1))
        first = int(rng.integers(0, corridor.n_frames - n_frames + 1))
        start = int(rng.integers(low, high - n_frames + 1))
        railway = world.drives[f"nordland_{SEASONS[rng.integers(2)]}"].part(start, start + n_frames)
        drives = corridor.part(first, first + n_frames).restarted(), railway.restarted()
        return drives if rng.integers(2) else drives[::-1]

    yield "corridor and railway", False, corridor_and_railway


def campus_pairs(world: World, part: str) -> Iterator[tuple[str, bool, Draw]]:
    """As `railway_pairs`, of rendered campuses; one seed and season is one drive."""
    seeds, sliced = CAMPUSES[part], SLICED_CAMPUSES[part]

    def drive(rng: np.random.Generator, seed: int, season: int | None = None) -> Drive:
        season_number = int(rng.integers(2)) if season is None else season
        return world.drives[f"campus{seed}_{SEASONS[season_number]}"]

    def two_campuses(rng: np.random.Generator) -> tuple[Drive, Drive]:
        first, second = (drive(rng, int(seed)) for seed in rng.choice(seeds, 2, replace=False))
        n_frames = int(rng.integers(SHORTEST, min(first.n_frames, second.n_frames) + 1))
        return first.part(0, n_frames).restarted(), second.part(0, n_frames).restarted()

    def two_slices(rng: np.random.Generator) -> tuple[Drive, Drive]:
        seed = int(rng.choice(sliced))
        first, second = drive(rng, seed), drive(rng, seed)
        n_frames = int(rng.integers(SHORTEST, min(first.n_frames, second.n_frames) // 2 + 1))
        start = int(rng.integers(0, min(first.n_frames, second.n_frames) - 2 * n_frames + 1))
        gap = int(rng.integers(n_frames, min(first.n_frames, second.n_frames) - start - n_frames + 1))
        drives = first.part(start, start + n_frames), second.part(start + gap, start + gap + n_frames)
        ordered = drives if rng.integers(2) else drives[::-1]
        return ordered[0].restarted(), ordered[1].restarted()

    def one_stretch(rng: np.random.Generator) -> tuple[Drive, Drive]:
        seed, season = int(rng.choice(seeds)), int(rng.integers(2))
        first, second = drive(rng, seed, season), drive(rng, seed, 1 - season)
        n_frames = int(rng.integers(SHORTEST, first.n_frames + 1))
        start = int(rng.integers(0, first.n_frames - n_frames + 1))
        return first.part(start, start + n_frames), second

    def inexact(rng: np.random.Generator) -> tuple[Drive, Drive]:
        first, second = one_stretch(rng)
        return first, second.with_errors(rng.normal(0, 1.5, second.n_frames))

    def adrift(rng: np.random.Generator) -> tuple[Drive, Drive]:
        first, second = one_stretch(rng)
        walk = np.cumsum(rng.normal(0, 0.3, second.n_frames))
        return first, second.with_errors(np.clip(walk - walk.mean(), -3, 3))

    def in_part(rng: np.random.Generator) -> tuple[Drive, Drive]:
        map_drive, other = one_stretch(rng)
        first, stop = np.searchsorted(other.position_m, map_drive.position_m[[0, -1]])
        return overlapping(rng, map_drive, other.part(int(first), int(stop)))

    yield "two rendered campuses", False, two_campuses
    yield "two places of one rendered campus", False, two_slices
    yield "one stretch of a rendered campus", True, one_stretch
    yield "one stretch of a rendered campus, positions wrong by 1.5 m", True, inexact
    yield "one stretch of a rendered campus, positions adrift by up to 3 m", True, adrift
    yield "one stretch of a rendered campus, overlap in part", True, in_part


def worlds(folder: Path, data: Path) -> Iterator[tuple[str, World]]:
    """The railway in three seasons as ready NetVLAD encodings, then all images under every extractor."""
    yield "netvlad", World({name: np.load(data / "nordland_netvlad64" / f"{name}.npy") for name in NETVLAD}, {})
    for extractor in EXTRACTORS:
        arrays = {path.name.split(".")[0]: np.load(path) for path in sorted(folder.glob(f"*.{extractor}.npz"))}
        plane = {name: np.stack([rows[axis] for axis in "pxy"]) for name, rows in arrays.items() if "p" in rows.files}
        yield extractor, World({name: rows["e"] for name, rows in arrays.items()}, plane)


def encode(folder: Path, data: Path) -> None:
    """Encode every recording that the folder lacks."""
    evaluators = {
        name: make_evaluator(evaluator_config({"kind": "feature_l2", "extractor": name})) for name in EXTRACTORS
    }

    def is_there(name: str) -> bool:
        return all((folder / f"{name}.{extractor}.npz").exists() for extractor in EXTRACTORS)

    def keep(name: str, bodies: Iterable[bytes], **plane: NDArray[np.float64]) -> None:
        images = [decode_image(body, MAX_PIXELS) for body in bodies]
        for extractor, evaluator in evaluators.items():
            rows = np.concatenate([evaluator.encode(images[first : first + 64]) for first in range(0, len(images), 64)])
            np.savez(folder / f"{name}.{extractor}.npz", e=rows, **plane)

    folders = {f"nordland_{season}": data / "nordland" / season for season in SEASONS}
    folders |= {f"corridor_{walk}": data / "corridor" / walk for walk in ("ref", "query")}
    for name, pictures in folders.items():
        if not is_there(name):
            paths = sorted(path for path in pictures.iterdir() if path.suffix in {".png", ".jpg"})
            keep(name, (path.read_bytes() for path in paths))
    for seed, n_frames in CAMPUS_FRAMES.items():
        names = [f"campus{seed}_{season}" for season in SEASONS]
        if all(map(is_there, names)):
            continue
        with tempfile.TemporaryDirectory() as root:
            for name, source in zip(names, write_campus(Path(root), SEASONS, n_frames, seed), strict=True):
                drive = open_source(source)
                places = np.array([(frame.position_m, frame.x_m, frame.y_m) for frame in drive.frames], np.float64)
                bodies = (drive.image(frame, (224, 224)).body for frame in drive.frames)
                keep(name, bodies, **dict(zip("pxy", places.T, strict=True)))


@dataclass(frozen=True)
class Row:
    """How many pairs of one kind either rule took for one route."""

    kind: str
    encoder: str
    is_one_route: bool
    part: str
    n_old: int
    n_new: int


def measure(world: World, encoder: str, part: str) -> Iterator[Row]:
    """Every kind's row."""
    names = NETVLAD if encoder == "netvlad" else [f"nordland_{season}" for season in SEASONS]
    kinds = list(railway_pairs(world, names, part))
    if encoder != "netvlad":
        kinds += [*corridor_pairs(world, part), *campus_pairs(world, part)]
    for number, (kind, is_one_route, draw) in enumerate(kinds):
        rng = np.random.default_rng([number, list(ROWS).index(part)])
        verdicts = np.array([world.verdicts(*draw(rng)) for _ in range(PAIRS)])
        yield Row(kind, encoder, is_one_route, part, *verdicts.sum(axis=0).tolist())


def share_text(n_accepted: int, n: int) -> str:
    """A share and Wilson's 95 % interval of it, in percent."""
    z, share = 1.96, n_accepted / n
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    reach = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return f"{100 * share:.1f} ({100 * max(0.0, centre - reach):.1f} .. {100 * min(1.0, centre + reach):.1f})"


def table(rows: Sequence[Row]) -> Iterator[str]:
    """Markdown lines, with all kinds together last."""
    cells = [(row.kind, row.encoder, PAIRS, share_text(row.n_old, PAIRS), share_text(row.n_new, PAIRS)) for row in rows]
    n, n_old, n_new = PAIRS * len(rows), sum(row.n_old for row in rows), sum(row.n_new for row in rows)
    everything = ("**all**", "", n, share_text(n_old, n), f"**{share_text(n_new, n)}**")
    return markdown(("pairs", "encoder", "n", "old rule accepts, %", "accepts, %"), [*cells, everything])


def shortfalls(rows: Sequence[Row]) -> Iterator[str]:
    """Markdown items: the kinds of pairs that are judged wrongly more often than all kinds together show."""
    parts = {REPORTED: "nothing was chosen on", CHOSEN_ON: "the numbers were chosen on"}
    for row in rows:
        share = row.n_new / PAIRS
        if share < 0.95 if row.is_one_route else share > 0.01:
            accepted = share_text(row.n_new, PAIRS)
            yield f"- {row.kind}, {row.encoder}, places that {parts[row.part]}: accepts {accepted} %."


def report(rows: Sequence[Row]) -> list[str]:
    """The whole document."""
    lines = [
        "# The guard of the second season",
        "",
        "Made by `python -m bench.guard`. A map learns from a second drive only where both saw one route "
        "([0015](../decisions/0015-same-route.md)). Here the positions of every pair are said to be comparable, so the "
        f"test alone decides; it asks for a significance of {SIGNIFICANCE:g} and a mean correlation of at least "
        f"{LEAST_CORRELATION:g}. The old rule: a mean correlation of at least {OLD_LEAST_CORRELATION:g}.",
        "",
        f"Slices of {SHORTEST} to {LONGEST} frames (of {len(CAMPUS_FRAMES)} campuses up to 155), r at most "
        f"{N_LANDMARKS}, {PAIRS} pairs of every kind. The 95 % intervals take pairs as independent; slices overlap, so "
        "the true ones are wider. Positions of the railway count a metre a frame, which is some 20 m of it.",
        "",
        "What was seen before: the form of the test was chosen after a look at slices of the whole railway, its "
        "numbers on one half of the places. A first report, without the least correlation, accepted 2.7 % of NetVLAD's "
        "pairs of one season in the other half (eight of them, seven at one distance of the two places); so the least "
        "correlation came in, its number from the first half again.",
        "",
        machine(),
    ]
    heads = {
        REPORTED: "## Places that nothing was chosen on",
        CHOSEN_ON: "## Places that the numbers of the test were chosen on",
    }
    for part, head in heads.items():
        for is_one_route, title in ((False, "Drives of two places"), (True, "Drives of one route, in two seasons")):
            part_rows = [row for row in rows if row.part == part and row.is_one_route is is_one_route]
            lines += ["", *([head, ""] if not is_one_route else []), f"{title}:", "", *table(part_rows)]
    hidden = (
        "What **all** hides: kinds of which more than 1 % of two places are accepted, or fewer than 95 % of one route."
    )
    return [*lines, "", "## What falls short", "", hidden, "", *shortfalls(rows)]


def main() -> None:
    """Measure, print, write `docs/results/guard.md`."""
    data = real_recordings()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        encode(folder, data)
        rows = [row for name, world in worlds(folder, data) for part in ROWS for row in measure(world, name, part)]
    write_page("guard.md", report(rows))


if __name__ == "__main__":
    main()
