"""`deepsimbad try`: two drives are enough. One is mapped, the other localized on it, and a page shows how that went."""

import re
from pathlib import Path
from typing import Any

import click
from rich.table import Table

from deepsimbad.cli.experiment import json_file_option, tell, tolerance_option, true_images, usual_tolerance_m
from deepsimbad.cli.terminal import (
    data_dir_option,
    evaluator_option,
    given_settings,
    print_table,
    progress_bar,
)
from deepsimbad.cli.trial_page import Album, write_page
from deepsimbad.core.relevance import DEFAULT_RELEVANCE
from deepsimbad.errors import CancelledError
from deepsimbad.evaluators.registry import EvaluatorConfig, make_evaluator
from deepsimbad.jobs.build import EncodedRecording, encode_recording
from deepsimbad.jobs.experiments.kept import kept_encodings
from deepsimbad.jobs.experiments.trial import TRIAL_STAGES, TrialConfig, TrialReport, run_trial
from deepsimbad.jobs.experiments.truth import known_drives
from deepsimbad.jobs.experiments.vpr import BRUTE_FORCE_U
from deepsimbad.jobs.fitting import RecordingPictures
from deepsimbad_client.recordings.options import accounting, opened, reading, tell_left_out

_FRAMES_A_SECOND = 150.0  # that are encoded, against which the other stages are weighed
_STRETCHES_TOLD = 5


@click.command("try")
@click.argument("database")
@click.argument("queries")
@click.option("--landmarks", help="SOURCE of another drive, to choose landmarks from and learn from.  [default: none]")
@tolerance_option
@click.option(
    "--ground-truth",
    type=click.Path(path_type=Path),
    help="FILE.npy of accepted DATABASE frames for every query, in place of --tolerance.",
)
@evaluator_option
@reading
@accounting
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder of the page, and of what a second run need not do again.  [default: try-DATABASE-QUERIES]",
)
@json_file_option
@data_dir_option
def try_(
    database: str,
    queries: str,
    landmarks: str | None,
    tolerance: float | None,
    ground_truth: Path | None,
    evaluator: EvaluatorConfig,
    reading: dict[str, Any],
    allow_missing: bool,
    verbose: bool,
    out: Path | None,
    json_file: Path | None,
) -> None:
    """Map one drive, localize another on it, and show what came of it, with pictures.

    DATABASE and QUERIES are SOURCEs: a folder of images, nclt:ROOT/DATE, or a .npy or .csv of ready encodings. No
    server and no landmarks from elsewhere are needed. Interrupted, the same command goes on where it stopped.
    """
    settings = given_settings()
    measure = make_evaluator(evaluator, settings.compute())
    sources = {"database": database, "queries": queries} | ({} if landmarks is None else {"landmarks": landmarks})
    recordings = {role: opened(source, allow_missing, **reading) for role, source in sources.items()}
    recordings["queries"] = recordings["queries"].shown_by(recordings["database"].grey_levels)  # as live views are
    names = {role: recording.name for role, recording in recordings.items()}
    tolerance_m = usual_tolerance_m(*recordings.values()) if tolerance is None else tolerance
    out = out or Path(re.sub(r"[^\w.-]+", "_", f"try-{names['database']}-{names['queries']}"))
    stages = {f"read {role}": len(recording.frames) / _FRAMES_A_SECOND for role, recording in recordings.items()}
    encoded: dict[str, EncodedRecording] = {}
    try:
        with progress_bar(stages | TRIAL_STAGES | {"pictures": 2.0}, "try") as progress:
            for role, recording in recordings.items():
                progress.stage(f"read {role}")
                made_of = {
                    "source": sources[role],
                    "levels": recording.grey_levels,
                    "weights": measure.weights_sha256,
                    **evaluator.as_dict(),
                    **reading,
                }
                with kept_encodings(out, role, **made_of) as kept:
                    encoded[role] = encode_recording(
                        *(recording, measure, settings.max_pixels, progress.update),
                        kept=kept,
                        allow_missing=allow_missing,
                    )
            drives = {role: each.drive for role, each in encoded.items()}
            truth = true_images(drives["queries"], drives["database"], tolerance_m, ground_truth)
            config = TrialConfig(tolerance_m, same_route=True if ground_truth is None else None)
            ordered = (drives.get("landmarks"), drives["database"], drives["queries"])
            pictures = RecordingPictures(recordings["landmarks" if landmarks else "database"], settings.max_pixels)
            report = run_trial(config, measure, *ordered, truth, progress, pictures)
            document = report.as_dict(
                {
                    **sources,
                    "landmarks": landmarks,
                    "ground_truth": None if ground_truth is None else str(ground_truth),
                    "evaluator": evaluator.as_dict(),
                    "spacing_m": reading["spacing_m"],
                    "left_out": {role: each.left_out for role, each in encoded.items()},
                }
            )
            others = {role: drive for role, drive in drives.items() if role != "queries"}
            shown = [why for role in ("database", "queries") for why in drives[role].picture_warnings(f"of the {role}")]
            document["warnings"] = [*known_drives(drives["queries"], **others), *report.warnings, *shown]
            progress.stage("pictures")
            places, views = (
                Album(recordings[role], drives[role], settings.max_pixels) for role in ("database", "queries")
            )
            document["page"] = str(write_page(out / "index.html", document, report, places, views, progress.update))
    except CancelledError as error:
        raise CancelledError(
            f"{error}; the same command goes on where it stopped ({out} keeps what is done)"
        ) from error
    for role, each in encoded.items():
        tell_left_out(each.left_out_names, role, verbose=verbose)
    tell(document, json_file, lambda: _print(document, report))


def _print(document: dict[str, Any], report: TrialReport) -> None:
    table = Table("places compared by", "ANR %", "R@1 %", "R@5 %")
    for name, label in (
        (DEFAULT_RELEVANCE.value, "the map"),
        (BRUTE_FORCE_U, "whole vectors (all that a map could hold)"),
    ):
        figures = (document[figure][name] for figure in ("anr", "recall_at_1", "recall_at_5"))
        table.add_row(label, *(f"{figure:.{digits}f}" for figure, digits in zip(figures, (2, 1, 1), strict=True)))
    fails = [
        f"it fails at {stretch.from_m:.0f} .. {stretch.to_m:.0f} m: {stretch.n_wrong} of {stretch.n_queries} wrong, "
        f"typically {stretch.median_error_m:.0f} m off"
        for stretch in report.stretches[:_STRETCHES_TOLD]
    ]
    print_table(
        table,
        f"{document['n_queries']} queries scored, {document['n_left_out']} left out (no true image); "
        f"{document['n_landmarks']} landmarks, {report.map.list_length} of them a map image",
        f"driving along, the likeliest place is within 5 m after {document['belief_within_5_m']:.1f} % of the views",
        *(fails or ["it fails nowhere: every first answer is true"] * (document["n_queries"] > 0)),
        f"page: {document['page']}",
        numbers=True,
    )
