"""How often the guard of the second season takes drives of two places for one route, and one route for two.

    python -m bench.guard [FOLDER]

FOLDER keeps the encodings for the next run; rendering and encoding take most of the time. The numbers of
`deepsimbad.core.drive` were chosen on half of the places, which is reported apart from the other half.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.measurement import RESULTS, Command, machine, markdown, print_page, work_folder
from bench.recordings import NETVLAD, encoded, netvlad_drives, real_recordings
from deepsimbad.core.descriptor import LandmarkStatistics, rank_landmarks
from deepsimbad.core.drive import LEAST_CORRELATION, LEAST_PLACES, SIGNIFICANCE, Drive, judge
from deepsimbad.core.landmark_model import select_landmarks
from deepsimbad.core.route import same_places
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad_campus.writer import write_campus

EXTRACTORS = ("gradient_grid", "efficientnet_lite0")
SEASONS = ("summer", "winter")
N_LANDMARKS = 300
PAIRS = 300  # of every kind
SHORTEST, LONGEST = 60, 300  # frames of a slice
OLD_LEAST_CORRELATION = 0.15  # of the rule that this one replaced
CHOSEN_ON, REPORTED = "chosen on", "reported only"
CAMPUS_FRAMES = dict.fromkeys(range(8), 160) | dict.fromkeys(range(8, 24), 100)  # by seed
CAMPUSES = {CHOSEN_ON: (*range(4), *range(8, 16)), REPORTED: (*range(4, 8), *range(16, 24))}
SLICED_CAMPUSES = {CHOSEN_ON: range(4), REPORTED: range(4, 8)}  # long enough for two slices
ROWS = {CHOSEN_ON: (0.0, 0.5), REPORTED: (0.5, 1.0)}  # share of a railway drive


def slice_of(drive: Drive, first: int, stop: int) -> Drive:
    """The drive's frames from `first` to before `stop`, which keep their positions."""
    return drive.at(np.arange(first, stop))


def restarted(drive: Drive) -> Drive:
    """The same frames as a recording that begins with them: positions from 0, and no plane."""
    return replace(drive, position_m=drive.position_m - drive.position_m[0], x_m=None, y_m=None)


def with_errors(drive: Drive, error_m: NDArray[np.float64]) -> Drive:
    """The drive with errors [n] in its positions, in the plane along x; never backwards along the route."""
    return replace(drive, position_m=np.maximum.accumulate(drive.position_m + error_m), x_m=drive.x_m + error_m)


class World:
    """Recordings under one encoder, every frame compared with every other once.

    Attributes:
        drives: By name; a frame's index is its row among all frames.
    """

    def __init__(self, drives: Mapping[str, Drive]) -> None:
        first_rows = np.cumsum([0, *(drive.n_frames for drive in drives.values())])
        self.drives = {
            name: replace(drive, index=np.arange(first, first + drive.n_frames))
            for (name, drive), first in zip(drives.items(), first_rows[:-1], strict=True)
        }
        encodings = np.concatenate([drive.encodings for drive in drives.values()])
        evaluator = FeatureL2("none")
        self._dissimilarities = evaluator.dissimilarities(encodings, evaluator.fit_landmarks(encodings))

    def verdicts(self, map_drive: Drive, other: Drive) -> tuple[bool, bool]:
        """Whether the old and the new rule take both for drives of one route; landmarks are of the other drive."""
        landmarks = other.index[select_landmarks(other.encodings, min(N_LANDMARKS, other.n_frames))]
        map_dissimilarities, other_dissimilarities = (
            self._dissimilarities[np.ix_(drive.index, landmarks)] for drive in (map_drive, other)
        )
        places = same_places(other.route(), map_drive.route())
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
        map_drive, other = (
            slice_of(world.drives[name], *ends) for name, *ends in zip((first, second), starts, stops, strict=True)
        )
        return restarted(map_drive), restarted(other)

    def of_two(rng: np.random.Generator) -> tuple[str, str]:
        first, second = rng.choice(len(names), 2, replace=False)
        return names[first], names[second]

    def one_stretch(rng: np.random.Generator) -> tuple[Drive, Drive]:
        n_frames = length(rng, high - low)
        start = int(rng.integers(low, high - n_frames + 1))
        first, second = (slice_of(world.drives[name], start, start + n_frames) for name in of_two(rng))
        return first, second

    def inexact(rng: np.random.Generator) -> tuple[Drive, Drive]:
        first, second = one_stretch(rng)
        return first, with_errors(second, rng.integers(-1, 2, second.n_frames).astype(np.float64))

    def reversed_drive(rng: np.random.Generator) -> tuple[Drive, Drive]:
        first, second = one_stretch(rng)
        backwards = second.at(np.arange(second.n_frames)[::-1])
        return restarted(first), restarted(replace(backwards, position_m=-backwards.position_m))

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
    return map_drive, slice_of(other, first, first + n_frames)


def corridor_pairs(world: World, part: str) -> Iterator[tuple[str, bool, Draw]]:
    """As `railway_pairs`, of the corridor and the railway."""
    low, high = (round(share * world.drives["nordland_summer"].n_frames) for share in ROWS[part])

    def corridor_and_railway(rng: np.random.Generator) -> tuple[Drive, Drive]:
        corridor = world.drives[("corridor_ref", "corridor_query")[rng.integers(2)]]
        n_frames = int(rng.integers(SHORTEST, corridor.n_frames + 1))
        first = int(rng.integers(0, corridor.n_frames - n_frames + 1))
        start = int(rng.integers(low, high - n_frames + 1))
        railway = slice_of(world.drives[f"nordland_{SEASONS[rng.integers(2)]}"], start, start + n_frames)
        drives = restarted(slice_of(corridor, first, first + n_frames)), restarted(railway)
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
        return restarted(slice_of(first, 0, n_frames)), restarted(slice_of(second, 0, n_frames))

    def two_slices(rng: np.random.Generator) -> tuple[Drive, Drive]:
        seed = int(rng.choice(sliced))
        first, second = drive(rng, seed), drive(rng, seed)
        n_frames = int(rng.integers(SHORTEST, min(first.n_frames, second.n_frames) // 2 + 1))
        start = int(rng.integers(0, min(first.n_frames, second.n_frames) - 2 * n_frames + 1))
        gap = int(rng.integers(n_frames, min(first.n_frames, second.n_frames) - start - n_frames + 1))
        drives = (
            restarted(slice_of(first, start, start + n_frames)),
            restarted(slice_of(second, start + gap, start + gap + n_frames)),
        )
        return drives if rng.integers(2) else drives[::-1]

    def one_stretch(rng: np.random.Generator) -> tuple[Drive, Drive]:
        seed, season = int(rng.choice(seeds)), int(rng.integers(2))
        first, second = drive(rng, seed, season), drive(rng, seed, 1 - season)
        n_frames = int(rng.integers(SHORTEST, first.n_frames + 1))
        start = int(rng.integers(0, first.n_frames - n_frames + 1))
        return slice_of(first, start, start + n_frames), second

    def inexact(rng: np.random.Generator) -> tuple[Drive, Drive]:
        first, second = one_stretch(rng)
        return first, with_errors(second, rng.normal(0, 1.5, second.n_frames))

    def adrift(rng: np.random.Generator) -> tuple[Drive, Drive]:
        first, second = one_stretch(rng)
        walk = np.cumsum(rng.normal(0, 0.3, second.n_frames))
        return first, with_errors(second, np.clip(walk - walk.mean(), -3, 3))

    def in_part(rng: np.random.Generator) -> tuple[Drive, Drive]:
        map_drive, other = one_stretch(rng)
        first, stop = np.searchsorted(other.position_m, map_drive.position_m[[0, -1]])
        return overlapping(rng, map_drive, slice_of(other, int(first), int(stop)))

    yield "two rendered campuses", False, two_campuses
    yield "two places of one rendered campus", False, two_slices
    yield "one stretch of a rendered campus", True, one_stretch
    yield "one stretch of a rendered campus, positions wrong by 1.5 m", True, inexact
    yield "one stretch of a rendered campus, positions adrift by up to 3 m", True, adrift
    yield "one stretch of a rendered campus, overlap in part", True, in_part


def worlds(folder: Path) -> Iterator[tuple[str, World]]:
    """The railway in three seasons as ready NetVLAD encodings, then all images under every extractor."""
    yield "netvlad", World(dict(zip(NETVLAD, netvlad_drives(), strict=True)))
    for extractor in EXTRACTORS:
        drives = {}
        for path in sorted(folder.glob(f"*.{extractor}.npz")):
            with np.load(path) as arrays:
                drives[path.name.split(".")[0]] = Drive(**arrays)
        yield extractor, World(drives)


def encode(folder: Path, data: Path) -> None:
    """Encode every recording that the folder lacks."""

    def is_there(name: str) -> bool:
        return all((folder / f"{name}.{extractor}.npz").exists() for extractor in EXTRACTORS)

    def keep(name: str, source: str) -> None:
        for extractor in EXTRACTORS:
            drive = encoded(source, extractor)
            arrays = {of: getattr(drive, of) for of in ("encodings", "position_m", "x_m", "y_m")}
            np.savez(folder / f"{name}.{extractor}.npz", **arrays)

    for kind, walks in (("nordland", SEASONS), ("corridor", ("ref", "query"))):
        for walk in walks:
            if not is_there(f"{kind}_{walk}"):
                keep(f"{kind}_{walk}", str(data / kind / walk))
    for seed, n_frames in CAMPUS_FRAMES.items():
        names = [f"campus{seed}_{season}" for season in SEASONS]
        if not all(map(is_there, names)):
            with work_folder() as root:
                for name, source in zip(names, write_campus(root, SEASONS, n_frames, seed), strict=True):
                    keep(name, source)


@dataclass(frozen=True)
class Row:
    """How many pairs of one kind either rule took for one route."""

    kind: str
    encoder: str
    is_one_route: bool
    part: str
    n_old: int
    n_new: int


def rows_of(world: World, encoder: str, part: str) -> Iterator[Row]:
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
    """The lines of the page."""
    lines = [
        "# The guard of the second season",
        "",
        "Made by `python -m bench.guard`. A map learns from a second drive only where both saw one route "
        "([0015](../decisions/0015-same-route.md)). Here the positions of every pair are said to be comparable, so the "
        f"test alone decides; it asks for a significance of {SIGNIFICANCE:g} and a mean correlation of at least "
        f"{LEAST_CORRELATION:g}. The old rule: a mean correlation of at least {OLD_LEAST_CORRELATION:g}.",
        "",
        "Dissimilarities are squared L2 to landmarks by the paper's rule, as a remap judges for every relevance but "
        "`composed`: for that, the default, it judges unit vectors and landmarks chosen farthest first.",
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


def measure(folder: Path | None) -> None:
    """Measure, print, write `docs/results/guard.md`."""
    data = real_recordings()
    with work_folder(folder) as work:
        encode(work, data)
        rows = [row for name, world in worlds(work) for part in ROWS for row in rows_of(world, name, part)]
    print_page(report(rows), RESULTS / "guard.md")


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("folder", type=Path, nargs="?", metavar="FOLDER")
    command.run(lambda arguments: measure(arguments.folder))
