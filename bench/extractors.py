"""Which extractor: the default one, the gradient grid and SqueezeNet on real recordings and the rendered campus.

    python -m bench.extractors

Every row comes of `deepsimbad experiment vpr --evaluator all`, which takes whatever weights lie in its folder:
SqueezeNet's, where they are beside the real recordings. Writes docs/results/extractors.md.
"""

import itertools
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.measurement import RESULTS, Command, machine, markdown, print_page, work_folder
from bench.nordland import kept_frames, season_folder
from bench.recordings import real_recordings
from deepsimbad.cli import run
from deepsimbad_campus.writer import write_campus
from deepsimbad_client.recordings.sources import open_source

N_LANDMARKS, N_CAMPUS_LANDMARKS = 300, 290  # a campus of 300 frames has a few without ground truth
CORRIDOR = "corridor halves"
CAMPUS_SEASONS = ("winter", "summer", "autumn")
CAMPUS_TOLERANCE_M = 3.5  # two of its frames


@dataclass(frozen=True)
class Split:
    """One landmark-training-test triplet of SOURCEs; splits of one group are averaged."""

    group: str
    landmarks: str
    training: str
    test: str
    n_landmarks: int
    options: tuple[str, ...] = ()


def railway(data: Path, work: Path) -> Iterator[Split]:
    """The railway in two seasons; frames that show nothing in either are left out. Landmarks come from elsewhere."""
    seasons, drives = (data / "nordland" / "summer", data / "nordland" / "winter"), {}
    for half, numbers in (("first", range(1000)), ("second", range(1000, 2000))):
        frames = kept_frames(seasons, numbers)
        for season in seasons:
            folder = season_folder(work / f"{season.name}-{half}", season, frames, numbers.start)
            drives[season.name, half] = str(folder)
    for group, map_season, live_season, half, other in (
        ("railway, map summer 0..999, live winter", "summer", "winter", "first", "second"),
        ("railway, map summer 1000..1999, live winter", "summer", "winter", "second", "first"),
        ("railway, map winter 0..999, live summer", "winter", "summer", "first", "second"),
    ):
        yield Split(
            group,
            drives[map_season, other],
            drives[map_season, half],
            drives[live_season, half],
            N_LANDMARKS,
            ("--no-same-route",),
        )


def corridor(data: Path) -> Iterator[Split]:
    """The corridor walked twice: the map is one half of the first walk, the landmarks are the other half."""
    ref, query, accepted = (str(data / "corridor" / name) for name in ("ref", "query", "ground_truth_new.npy"))
    for map_half, landmark_half, n_landmarks in (("0:56", "56:111", 55), ("56:111", "0:56", 56)):
        options = ("--ground-truth", accepted)
        yield Split(CORRIDOR, f"{ref}#{landmark_half}", f"{ref}#{map_half}", query, n_landmarks, options)


def campus(work: Path) -> Iterator[Split]:
    """The client's rendered campus in three seasons, all six triplets; the landmark drive is of the same route."""
    drives = [_as_sent(work, source) for source in write_campus(work, CAMPUS_SEASONS, 300, 0)]
    for landmarks, training, test in itertools.permutations(drives):
        options = ("--tolerance", str(CAMPUS_TOLERANCE_M))
        yield Split("campus, six triplets", landmarks, training, test, N_CAMPUS_LANDMARKS, options)


def _as_sent(work: Path, source: str) -> str:
    """A drive's images as a client sends them, in a folder of their own: read once from TIFF, not by every split."""
    recording, folder = open_source(source), work / f"sent-{Path(source).name}"
    folder.mkdir()
    lines = ["name,x_m,y_m"]
    for frame in recording.frames:
        (folder / f"{frame.index:05}.jpg").write_bytes(recording.image(frame, (224, 224)).body)
        lines.append(f"{frame.index:05}.jpg,{frame.x_m},{frame.y_m}")
    (folder / "positions.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return str(folder)


def documents(split: Split, work: Path) -> dict[str, Any]:
    """The result of every extractor."""
    into = work / "vpr.json"
    sources = ("--landmarks", split.landmarks, "--training", split.training, "--test", split.test)
    relevances = ("--relevance", "composed", "--relevance", "rrf", "--relevance", "brute_force")
    counted = ("--n-landmarks", str(split.n_landmarks), "--json", str(into))
    if code := run(["experiment", "vpr", *sources, *relevances, *counted, "--evaluator", "all", *split.options]):
        raise RuntimeError(f"the experiment on {split.group} ended with exit code {code}")
    return dict(json.loads(into.read_text(encoding="utf-8"))["extractors"])


def report(splits: list[Split], work: Path) -> Iterator[str]:
    """The lines of the page."""
    grouped: dict[str, list[dict[str, Any]]] = {}
    for split in splits:
        print(f"{split.group}: {split.training}", file=sys.stderr)
        grouped.setdefault(split.group, []).append(documents(split, work))
    extractors = list(next(iter(grouped.values()))[0])
    yield from (
        "# Extractors",
        "",
        "Made by `DEEPSIMBAD_REAL_DATA=... python -m bench.extractors`, which runs `deepsimbad experiment vpr "
        "--evaluator all` on every split.",
        "",
        machine(),
        "",
        "ANR in percent of `composed` / `rrf` / `brute_force`, and R@1 of `brute_force` in percent behind them. One "
        f"session over the test drive, h = 4, r = {N_LANDMARKS} or all candidates, tolerance two frames.",
        "",
    )
    rows, ratios = [], []
    for group, of_splits in grouped.items():
        cells, best = [], _mean(of_splits, "gradient_grid", "anr", "composed")
        for extractor in extractors:
            anr = [_mean(of_splits, extractor, "anr", name) for name in ("composed", "rrf", "brute_force")]
            recall = _mean(of_splits, extractor, "recall_at_1", "brute_force")
            cells.append(" / ".join(f"{value:.2f}" for value in anr) + f" ({recall:.0f})")
        rows.append([group, *cells])
        ratios.append([_mean(of_splits, extractor, "anr", "composed") / best for extractor in extractors])
    is_elsewhere = [group != CORRIDOR for group in grouped]
    for title, counted_ratios in (
        ("geometric mean of `composed` against the gradient grid", np.array(ratios)),
        (f"the same without {CORRIDOR}", np.array(ratios)[is_elsewhere]),
    ):
        rows.append([title, *(f"{mean:.2f}" for mean in np.exp(np.log(counted_ratios).mean(axis=0)))])
    yield from markdown(("split", *extractors), rows)
    yield ""
    costs_more = zip(grouped, np.array(ratios)[:, 0] - 1, strict=True)
    worse = [f"{group} (+{100 * cost:.0f} %)" for group, cost in costs_more if cost > 0]
    yield (
        f"Of {extractors[0]} a mean of at most 0.6 was asked for, and no split worse than the gradient grid's. "
        f"Worse: {', '.join(worse) or 'none'}."
    )
    yield ""
    costs = []
    for extractor in extractors:
        of_splits = [document[extractor] for document in grouped[CORRIDOR]]
        took_ms = float(np.median([document["encode_ms"] for document in of_splits]))
        costs.append([extractor, of_splits[0]["encoding_dim"], of_splits[0]["bytes_per_encoding"], f"{took_ms:.1f}"])
    yield from markdown(("extractor", "numbers", "bytes a frame", "ms an image, read and encoded"), costs)
    yield from (
        "",
        "Times are of the corridor's JPEGs, 160 x 120, on a machine that may have had other work; "
        "[encode.md](encode.md) has those of larger pictures and of every runtime.",
        "",
        "The railway's frames are 64 x 32 pixels and grey, one metre stands for a frame; frames that show nothing "
        "(grey levels' standard deviation at most 8) in either season are left out. Parameters of the default "
        "extractor were chosen on these very splits ([0014](../decisions/0014-default-extractor.md), "
        "[0040](../decisions/0040-gradients-weigh-more.md)).",
    )


def _mean(of_splits: list[dict[str, Any]], extractor: str, figure: str, name: str) -> float:
    return float(np.mean([document[extractor][figure][name] for document in of_splits]))


def lines() -> Iterator[str]:
    """Measure; the lines of the page."""
    data = real_recordings()
    with work_folder() as work:
        weights = work / "weights"
        weights.mkdir()
        squeezenet = data.parent / "weights" / "squeezenet1_0" / "squeezenet1_0_caffe.npz"
        if squeezenet.is_file():
            (weights / squeezenet.name).symlink_to(squeezenet)
        os.environ["DEEPSIMBAD_WEIGHTS_DIR"] = str(weights)
        splits = [*railway(data, work), *corridor(data), *campus(work / "campus")]
        yield from report(splits, work)


if __name__ == "__main__":
    Command(__doc__).run(lambda _: print_page(lines(), RESULTS / "extractors.md"))
