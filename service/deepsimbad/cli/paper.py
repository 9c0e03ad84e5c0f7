"""`deepsimbad experiment paper`: section III of the paper on four drives of NCLT, a page of it, tables and JSON."""

import math
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import click
from rich.table import Table

from deepsimbad import release
from deepsimbad.cli.experiment import (
    DEFAULT_TOLERANCE_M,
    experiment,
    json_file_option,
    resume_note,
    tell,
    tolerance_option,
)
from deepsimbad.cli.local import seed_option, training_episodes_option
from deepsimbad.cli.paper_page import write_report
from deepsimbad.cli.terminal import data_dir_option, evaluator_option, given_settings, print_table, progress_bar
from deepsimbad.core.composed import MOST_DIMENSIONS
from deepsimbad.core.drive import Drive
from deepsimbad.errors import InvalidSourceError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.compute import available_cores
from deepsimbad.evaluators.registry import EvaluatorConfig, make_evaluator
from deepsimbad.jobs.build import EncodedRecording, encode_recording
from deepsimbad.jobs.experiments.cache import ResultCache, drive_digest, open_encoding_cache
from deepsimbad.jobs.experiments.paper import (
    SEASONS,
    TRIPLETS,
    PaperConfig,
    measure_paper,
    runnable,
    seconds_to_measure,
)
from deepsimbad.jobs.experiments.paper_report import paper_document
from deepsimbad.jobs.experiments.vpr import bytes_per_encoding
from deepsimbad.jobs.fitting import RecordingPictures
from deepsimbad.jobs.progress import Shares, in_threads
from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings import Recording
from deepsimbad_client.recordings.options import open_recording, reading
from deepsimbad_client.recordings.sources import ENCODING_SUFFIXES, NCLT_PREFIX

_ENCODE_S = 0.05  # a frame, on one core of a server's
_MOST_POINTS = 400  # of a trajectory as it is drawn


@experiment.command()
@click.option(
    "--nclt", "root", required=True, type=click.Path(file_okay=False, path_type=Path), help="Folder of drives."
)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("paper-output"),
    show_default=True,
    help="Folder of the page, and of what a second run need not do again.",
)
@evaluator_option
@click.option("--n-landmarks", type=click.IntRange(min=1), default=500, show_default=True, help="How many landmarks.")
@training_episodes_option
@click.option("--episodes", type=click.IntRange(min=2), default=150, show_default=True, help="Of every planner, drawn.")
@seed_option
@tolerance_option
@reading
@json_file_option
@data_dir_option
def paper(
    root: Path,
    out: Path,
    evaluator: EvaluatorConfig,
    tolerance: float | None,
    reading: dict[str, Any],
    json_file: Path | None,
    **options: Any,
) -> None:
    """The paper's section III: eight triplets of four drives, figures 5 to 7, and what is better.

    ROOT holds NCLT as downloaded or rendered, or ready encodings DATE.npy, of 2012-01-22, 2012-03-31, 2012-08-04 and
    2012-11-17. What lacks a drive is not run, and said. DIR gets index.html, report.md, figures.csv and paper.json, and
    keeps what a second run need not do again. NCLT whole takes a night: --every-m 1 takes one frame a metre.
    """
    settings = given_settings()
    first_m = DEFAULT_TOLERANCE_M if tolerance is None else tolerance
    config = PaperConfig(
        tolerances_m=tuple(sorted({first_m, 5.0, 10.0, 25.0}, key=lambda m: (m != first_m, m))), **options
    )
    measure = make_evaluator(evaluator, settings.compute())
    recordings, missing = _open_drives(root, config.nbv().episode_m, reading)
    triplets = runnable(recordings)
    if not triplets:
        raise InvalidSourceError(
            f"{root} has the drives of no triplet: "
            + "; ".join(f"{season}: {reason}" for season, reason in missing.items())
        )
    n_frames = {season: len(recording.frames) for season, recording in recordings.items()}
    encode_s = sum(_ENCODE_S * n_frames[season] for season, drive in recordings.items() if drive.encodings is None)
    measure_s = sum(seconds_to_measure(config, n_frames).values())
    not_run = ["-".join(triplet) for triplet in TRIPLETS if triplet not in triplets]
    _tell_plan(recordings, missing, not_run, (encode_s + measure_s) / available_cores(), out)
    ingredients = {"weights": measure.weights_sha256, **evaluator.as_dict(), **reading}
    stages = {"encode": encode_s + 1, "measure": measure_s, "write": 2.0}
    with progress_bar(stages, "paper", cancel_note=resume_note(out)) as progress:
        progress.stage("encode")
        encoded_drives = _encode_drives(recordings, measure, settings.max_pixels, out, ingredients, progress.update)
        drives = {season: encoded_drive.drive for season, encoded_drive in encoded_drives.items()}
        progress.stage("measure")
        results = measure_paper(
            config,
            measure,
            drives,
            out / "results",
            {"evaluator": evaluator.as_dict()},
            _with_log(progress.update),
            {season: RecordingPictures(drive, settings.max_pixels) for season, drive in recordings.items()},
        )
        progress.stage("write")
        widths = measure.halves or (next(iter(drives.values())).encoding_dim,)
        document = {
            **paper_document(config, results),
            "seasons": {
                season: {
                    "date": SEASONS[season],
                    "n_frames": drive.n_frames,
                    "length_m": float(drive.position_m[-1] - drive.position_m[0]),
                    "left_out": encoded_drives[season].left_out,
                    "encode_ms": encoded_drives[season].encode_ms,
                    "trajectory": _trajectory(drive),
                }
                for season, drive in drives.items()
            },
            "missing": missing,
            "not_run": not_run,
            "config": {
                **asdict(config),
                "nclt": str(root),
                "evaluator": evaluator.as_dict(),
                **{name: value for name, value in reading.items() if value is not None},
            },
            "bits_per_encoding": 8 * bytes_per_encoding(next(iter(drives.values()))),
            "bits_per_unit_vector": 32 * sum(min(MOST_DIMENSIONS, width) for width in widths),
            "machine": machine(),
            "release": release(),
        }
        document["files"] = [str(file) for file in write_report(out, document)]
    tell(document, json_file, lambda: _print(document))


def _with_log(update: Callable[[float], None]) -> Callable[[str, float], None]:
    """A function that updates a bar and, where there is no terminal for one, logs every tenth and the time left."""
    started_s, last_tenth = time.monotonic(), [0]

    def tell(name: str, share: float) -> None:
        update(share)
        tenth = int(10 * share)
        if tenth > last_tenth[0] and not sys.stderr.isatty():
            last_tenth[0] = tenth
            left_s = (time.monotonic() - started_s) * (1 - share) / share
            click.echo(f"{share:.0%} measured, at {name}; about {left_s / 60:.0f} minutes left", err=True)

    return tell


def _open_drives(root: Path, least_m: float, reading: Mapping[str, Any]) -> tuple[dict[str, Recording], dict[str, str]]:
    """The drives by season that are there and long enough, and why others are not."""
    recordings, missing = dict[str, Recording](), dict[str, str]()
    for season, date in SEASONS.items():
        files = (root / f"{date}{suffix}" for suffix in sorted(ENCODING_SUFFIXES, reverse=True))
        source = next((str(file) for file in files if file.is_file()), f"{NCLT_PREFIX}{root / date}")
        try:
            drive = open_recording(source, **reading)
        except SourceError as error:
            missing[season] = f"{date}: {' '.join(str(error).split())}"
            continue
        length_m = drive.frames[-1].position_m - drive.frames[0].position_m
        if length_m < least_m:
            missing[season] = f"{date}: it is {length_m:.0f} m long, and an episode takes {least_m:g} m"
        else:
            recordings[season] = drive
    return recordings, missing


def _tell_plan(
    recordings: Mapping[str, Recording], missing: Mapping[str, str], not_run: list[str], seconds: float, out: Path
) -> None:
    """Print what will be done, on standard error."""
    for season, recording in recordings.items():
        length_m = recording.frames[-1].position_m - recording.frames[0].position_m
        click.echo(f"{season} {SEASONS[season]}: {len(recording.frames)} frames, {length_m:.0f} m", err=True)
    for season, reason in missing.items():
        click.echo(f"{season} is missing: {reason}", err=True)
    triplets = ", ".join("-".join(triplet) for triplet in runnable(recordings))
    click.echo(
        f"landmark-training-test: {triplets}" + (f"; not run: {', '.join(not_run)}" if not_run else ""), err=True
    )
    minutes = f"{max(seconds / 60, 1):.0f} min" if seconds < 5400 else f"{seconds / 3600:.0f} h"
    click.echo(f"about {minutes} on {available_cores()} cores, less what {out} keeps of earlier runs", err=True)


def _encode_drives(
    recordings: Mapping[str, Recording],
    evaluator: Evaluator,
    max_pixels: int,
    out: Path,
    ingredients: Mapping[str, Any],
    on_progress: Callable[[float], None],
) -> dict[str, EncodedRecording]:
    """Encode every drive, several at once."""
    shares = Shares(
        lambda _, share: on_progress(share), {season: len(drive.frames) for season, drive in recordings.items()}
    )
    results, encoded_drives = ResultCache(out / "results", ingredients), dict[str, EncodedRecording]()

    def encode(season: str) -> None:
        report, date = shares.report(season), SEASONS[season]
        with open_encoding_cache(out / "encodings", date, source=date, **ingredients) as encodings:
            drive = encode_recording(recordings[season], evaluator, max_pixels, report, encoding_cache=encodings)
        digest = drive_digest(drive.drive)
        timing = results.get(f"{season}-encode", lambda: {"ms": drive.encode_ms}, digest=digest)  # of who encoded it
        encoded_drives[season] = replace(drive, encode_ms=timing["ms"])
        report(1.0)

    in_threads([partial(encode, season) for season in recordings])
    return {season: encoded_drives[season] for season in recordings}


def _trajectory(drive: Drive) -> list[list[float]]:
    """Points [x, y] along a drive; none where it does not know them."""
    step = -(-drive.n_frames // _MOST_POINTS)
    points = zip(drive.x_m[::step].tolist(), drive.y_m[::step].tolist(), strict=True)
    return [[x, y] for x, y in points if math.isfinite(x) and math.isfinite(y)]


def machine() -> str:
    """The processor, the cores and the Python that this runs on."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    model = next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine()
    )
    return f"{model}, {available_cores()} of {os.cpu_count()} cores, Python {platform.python_version()}"


def _print(document: dict[str, Any]) -> None:
    h, lengths = str(document["list_length"]), list(document["anr"])
    table = Table("ANR %, h =", *lengths)
    for name in document["methods"]:
        cells = (document["anr"][length].get(name) for length in lengths)
        table.add_row(name, *("" if figure is None else f"{figure['mean']:.2f}" for figure in cells))
    bits = document["index_bits_per_map_image"]["rrf"]
    print_table(
        table,
        f"{len(document['by_triplet'])} triplets, {document['n_queries']} queries, {document['n_left_out']} left out; "
        f"rrf at h = {h}: {bits:.1f} bits a map image",
        *(
            f"{claim['verdict']}: {claim['claim']} ({claim['n_agree']} of {claim['n_triplets']} triplets)"
            for claim in document["claims"]
        ),
        f"page: {document['files'][0]}",
        numbers=True,
    )
