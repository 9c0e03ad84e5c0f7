"""`deepsimbad experiment`: the paper's experiments on a landmark-training-test triplet of recordings."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any, Self

import click
import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from deepsimbad.cli.local import list_length_option, seed_option, training_episodes_option
from deepsimbad.cli.terminal import (
    RELEVANCES,
    Command,
    config_option,
    evaluator_option,
    evaluators_option,
    folder_option,
    given_settings,
    print_table,
    progress_bar,
    spacing_option,
    write_json,
)
from deepsimbad.core.belief.particles import FilterKind
from deepsimbad.core.drive import Drive, SameRoute
from deepsimbad.core.landmark_model import fitting_number
from deepsimbad.core.metrics import RetrievalScores
from deepsimbad.core.planners import DEFAULT_PLANNER
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance, UpdateRule
from deepsimbad.core.route import true_images_of
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.registry import EvaluatorConfig, make_evaluator
from deepsimbad.jobs.build import EncodedRecording, encode_recording
from deepsimbad.jobs.experiments.calibration import VIEWS, CalibrationConfig, calibration_stages, run_calibration
from deepsimbad.jobs.experiments.nbv import NbvConfig, NbvReport, nbv_stages, run_nbv
from deepsimbad.jobs.experiments.passive import WINDOWS, PassiveScores
from deepsimbad.jobs.experiments.truth import read_ground_truth, test_drive_warnings
from deepsimbad.jobs.experiments.vpr import RANKS, VprConfig, VprReport, run_vpr, vpr_stages
from deepsimbad.jobs.fitting import Pictures, RecordingPictures
from deepsimbad.jobs.progress import Progress
from deepsimbad_client.recordings import Recording, left_out_lines
from deepsimbad_client.recordings.sources import open_source

_N_LANDMARKS = 300
_ROLES = ("landmarks", "training", "test")
_READING_STAGES = {f"read {role}": 2.0 for role in _ROLES}
STANDARD_OUTPUT = Path("-")
DEFAULT_TOLERANCE_M = 2.0
json_file_option = click.option(
    "--json",
    "json_file",
    type=click.Path(dir_okay=False, path_type=Path),
    is_flag=False,
    flag_value=STANDARD_OUTPUT,
    help="Write the result as JSON to FILE; without FILE to standard output.",
)
tolerance_option = click.option(
    "--tolerance",
    type=click.FloatRange(min=0),
    help=f"Metres within which a match is true.  [default: as papers on a known set, else {DEFAULT_TOLERANCE_M:g}]",
)


def _triplet_options(command: Command) -> Command:
    """The options that every experiment has; commands take their values as `options`."""
    options = (
        click.option("--landmarks", required=True, help="SOURCE landmarks are selected from."),
        click.option("--training", required=True, help="SOURCE that becomes the map."),
        click.option("--test", required=True, help="SOURCE of the live views, in the order they were driven."),
        spacing_option,
        click.option(
            "--n-landmarks",
            type=click.IntRange(min=1),
            help=f"How many landmarks.  [default: {_N_LANDMARKS}, or every frame of a shorter recording]",
        ),
        list_length_option,
        click.option(
            "--same-route/--no-same-route",
            default=None,
            help="Whether landmarks and training count their positions along one route, as test and training do.  "
            "[default: they do]",
        ),
        json_file_option,
        config_option,
        # As every command does, so that a script may give it to all of them
        folder_option("--data-dir", "Taken as by every command; an experiment reads and keeps nothing there.", None),
    )
    return reduce(lambda inner_command, option: option(inner_command), reversed(options), command)


@click.group()
def experiment() -> None:
    """Measure: the paper's tables on your recordings."""


@experiment.command()
@_triplet_options
@evaluators_option
@click.option("--relevance", "names", type=RELEVANCES, multiple=True, help="Only this one; may be repeated.")
@tolerance_option
@click.option("--stateless", is_flag=True, help="Every view by itself, in place of one session over the test drive.")
@click.option(
    "--bar-own-place",
    is_flag=True,
    help="No map image lists a landmark seen within 2 m of it: of composed alone, to tell how much lists owe to those.",
)
@click.option(
    "--ground-truth",
    type=click.Path(path_type=Path),
    help="FILE.npy of accepted training frames for every test frame, in place of --tolerance; positions then count as "
    "comparable only where x, y are known or --same-route is given.",
)
def vpr(
    evaluators: tuple[EvaluatorConfig, ...],
    names: tuple[str, ...],
    tolerance: float | None,
    ground_truth: Path | None,
    **options: Any,
) -> None:
    """Single-view place recognition (III, figure 6): ANR and recall of every relevance.

    Beside it the drive in order: what composed's belief makes of the last 1 to 20 views, and what sums make of them.
    """
    relevances = tuple(Relevance(name) for name in names) or tuple(Relevance)
    if options["bar_own_place"]:
        if set(names) - {Relevance.COMPOSED.value}:
            raise click.UsageError("--bar-own-place is of composed alone")
        relevances = (Relevance.COMPOSED,)
    same_route = options["same_route"]
    if same_route is None and ground_truth is None:
        same_route = True  # test and training are scored by their positions: they count along one route
    config = VprConfig(
        list_length=options["list_length"],
        relevances=relevances,
        stateless=options["stateless"],
        same_route=same_route,
        bar_own_place=options["bar_own_place"],
    )
    documents: dict[str, Any] = {}
    reports: dict[str, VprReport] = {}
    for evaluator in evaluators:
        extractor = evaluator.extractor
        with progress_bar(_READING_STAGES | vpr_stages(config), extractor) as progress:
            triplet = _Triplet.read(options, evaluator, progress)
            tolerance_m = triplet.tolerance_m if tolerance is None else tolerance
            config = replace(config, n_landmarks=triplet.n_landmarks, tolerance_m=tolerance_m)
            landmarks, training, test = triplet.drives
            truth = true_images(test, training, tolerance_m, ground_truth)
            report = run_vpr(
                config, triplet.evaluator, landmarks, training, triplet.test, truth, progress, triplet.pictures
            )
        sources = {**triplet.sources, "ground_truth": None if ground_truth is None else str(ground_truth)}
        documents[extractor] = {**report.as_dict(sources), "warnings": [*triplet.warnings, *report.warnings]}
        reports[extractor] = report
    if len(reports) > 1:
        document = {"extractors": documents, "warnings": triplet.warnings}
        tell(document, options["json_file"], lambda: _print_extractors(reports))
    else:
        tell(documents[extractor], options["json_file"], lambda: _print_relevances(report))


@experiment.command()
@_triplet_options
@evaluator_option
@click.option("--relevance", type=RELEVANCES, help=f"Of our set-up.  [default: {DEFAULT_RELEVANCE.value}]")
@click.option(
    "--update",
    type=click.Choice([rule.value for rule in UpdateRule]),
    help="How a view changes the belief.  [default: as suits the relevance]",
)
@training_episodes_option
@click.option(
    "--episodes", type=click.IntRange(min=2), help="Test episodes of every planner, drawn.  [default: from every start]"
)
@seed_option
def nbv(evaluator: EvaluatorConfig, relevance: str | None, update: str | None, **options: Any) -> None:
    """Active self-localization (III, figure 7): ANR of every planner over episodes of ten moves.

    Every planner has the same starts. The paper's set-up (rrf, additive relevance) is measured beside ours.
    """
    our_relevance = Relevance(relevance) if relevance else DEFAULT_RELEVANCE
    config = NbvConfig(
        relevance=our_relevance,
        update=UpdateRule(update) if update else our_relevance.traits.update,
        same_route=options["same_route"] is not False,
        **{name: options[name] for name in ("list_length", "training_episodes", "episodes", "seed")},
    )
    with progress_bar(_READING_STAGES | nbv_stages(config), "experiment") as progress:
        triplet = _Triplet.read(options, evaluator, progress)
        config = replace(config, n_landmarks=triplet.n_landmarks)
        report = run_nbv(config, triplet.evaluator, *triplet.drives, progress, triplet.pictures)
    document = {**report.as_dict(triplet.sources), "warnings": triplet.warnings}
    tell(document, options["json_file"], lambda: _print_planners(report, document))


@experiment.command()
@_triplet_options
@evaluator_option
@click.option(
    "--relevance", type=RELEVANCES, default=DEFAULT_RELEVANCE.value, show_default=True, help="How views find places."
)
@click.option(
    "--filter",
    "filter_name",
    type=click.Choice([kind.value for kind in FilterKind]),
    default=FilterKind.GRID.value,
    show_default=True,
    help="How beliefs are kept.",
)
@seed_option
def calibration(evaluator: EvaluatorConfig, relevance: str, filter_name: str, **options: Any) -> None:
    """How far a belief can be trusted: its 95 % sets and its sure answers against the truth.

    Of robots that drive, stand still, are carried, leave the route, or misjudge their moves; on 250 m at least.
    """
    config = CalibrationConfig(
        relevance=Relevance(relevance),
        filter=FilterKind(filter_name),
        same_route=options["same_route"] is not False,
        **{name: options[name] for name in ("list_length", "seed")},
    )
    with progress_bar(_READING_STAGES | calibration_stages(), "experiment") as progress:
        triplet = _Triplet.read(options, evaluator, progress)
        config = replace(config, n_landmarks=triplet.n_landmarks)
        report = run_calibration(config, triplet.evaluator, *triplet.drives, progress, triplet.pictures)
    document = {**report.as_dict(triplet.sources), "warnings": triplet.warnings}
    tell(document, options["json_file"], lambda: _print_calibration(document, report.same_route))


@dataclass(frozen=True)
class _Triplet:
    """Three recordings, read."""

    evaluator: Evaluator
    drives: tuple[Drive, Drive, Drive]  # landmarks, training, test
    test: EncodedRecording
    n_landmarks: int  # as many as are asked for, or fit
    tolerance_m: float  # as `usual_tolerance_m`
    sources: dict[str, Any]  # what was read, for the result's `config`
    warnings: list[str]
    pictures: Pictures  # of the landmark recording

    @classmethod
    def read(cls, options: dict[str, Any], config: EvaluatorConfig, progress: Progress) -> Self:
        """Open all recordings, then encode them: a mistake in what was typed should cost no minutes."""
        settings = given_settings()
        evaluator = make_evaluator(config, settings.compute())
        recordings = [open_source(options[role], spacing_m=options["spacing_m"]) for role in _ROLES]
        fitting_number(options["n_landmarks"], len(recordings[0].frames), _N_LANDMARKS)
        recordings[2] = recordings[2].shown_by(recordings[1].grey_levels)  # as live views are
        encoded_recordings = []
        for stage, recording in zip(_READING_STAGES, recordings, strict=True):
            progress.stage(stage)
            encoded_recordings.append(encode_recording(recording, evaluator, settings.max_pixels, progress.update))
        landmarks, training, test = (recording.drive for recording in encoded_recordings)
        sources = {
            **{role: options[role] for role in _ROLES},
            "evaluator": config.as_dict(),
            "spacing_m": options["spacing_m"],
            "left_out": {role: recording.left_out for role, recording in zip(_ROLES, encoded_recordings, strict=True)},
        }
        n_landmarks = fitting_number(options["n_landmarks"], landmarks.n_frames, _N_LANDMARKS)
        warnings = test_drive_warnings(test, landmarks=landmarks, training=training)
        for role, recording, encoded_recording in zip(_ROLES, recordings, encoded_recordings, strict=True):
            warnings += [f"{role}: {remark}" for remark in recording.remarks]
            warnings += [f"{role}: {line}" for line in left_out_lines(encoded_recording.left_out_names, verbose=False)]
        pictures = RecordingPictures(recordings[0], settings.max_pixels)
        tolerance_m = usual_tolerance_m(*recordings)
        drives = landmarks, training, test
        return cls(evaluator, drives, encoded_recordings[2], n_landmarks, tolerance_m, sources, warnings, pictures)


def usual_tolerance_m(*recordings: Recording) -> float:
    """The strictest tolerance of papers on the sets that the recordings are of; else our own."""
    tolerances_m = [recording.tolerance_m for recording in recordings if recording.tolerance_m is not None]
    return min(tolerances_m, default=DEFAULT_TOLERANCE_M)


def true_images(test: Drive, training: Drive, tolerance_m: float, file: Path | None) -> list[NDArray[np.int64]]:
    """For every test frame the map images that are true: by a file of ground truth, else by positions."""
    if file is not None:
        return read_ground_truth(file, test.index, training.index)
    return true_images_of(test.route(), training.route(), tolerance_m)


def resume_note(out: Path) -> str:
    """What is said after a Ctrl-C of an experiment that keeps what it has done."""
    return f"; the same command goes on where it stopped ({out} keeps what is done)"


def tell(document: dict[str, Any], json_file: Path | None, print_for_people: Callable[[], None]) -> None:
    """Report a result: JSON where it is asked for, else or beside it a print; warnings go to standard error.

    Where `--json` is standard output, that holds nothing else.
    """
    for warning in document.get("warnings", ()):
        click.echo(f"warning: {warning}", err=True)
    if json_file is not None:
        write_json(document, None if json_file == STANDARD_OUTPUT else json_file)
    if json_file != STANDARD_OUTPUT:
        print_for_people()


def _print_extractors(reports: dict[str, VprReport]) -> None:
    """Print scores, a row an extractor."""
    scores = next(iter(reports.values())).scores
    titles = (f"{relevance}: ANR / R@1 / R@5 / R@10" for relevance in scores)
    table = Table("extractor", "numbers", "bytes", "ms an image", *titles)
    for extractor, report in reports.items():
        time_ms = "-" if report.encode_ms is None else f"{report.encode_ms:.1f}"
        cells = (
            " / ".join([f"{score.anr:.2f}", *(f"{score.recall_at[k]:.0f}" for k in RANKS)])
            for score in report.scores.values()
        )
        table.add_row(extractor, str(report.encoding_dim), str(report.bytes_per_encoding), time_ms, *cells)
    print_table(table, _queries(scores), numbers=True)


def _print_relevances(report: VprReport) -> None:
    table = Table("relevance", "ANR %", *(f"R@{k} %" for k in RANKS))
    for name, score in report.scores.items():
        label = f"{name} (default)" if name == DEFAULT_RELEVANCE.value else name
        table.add_row(label, f"{score.anr:.2f}", *(f"{score.recall_at[k]:.1f}" for k in RANKS))
    bits = f"{report.config.n_landmarks} landmarks; index {report.index_bits_per_map_image:.1f} bits a map image"
    tolerance = f"true within {report.config.tolerance_m:g} m"
    print_table(
        table, f"{_queries(report.scores)}; {tolerance}; {bits}", *_no_second_season(report.same_route), numbers=True
    )
    if report.passive is not None:
        _print_passive(report.passive)


def _print_passive(passive: PassiveScores) -> None:
    """Print the scores of the drive in order, the belief and its rivals a row each."""
    table = Table("in order", *(f"{views} view{'s' if views > 1 else ''}: ANR / R@1" for views in WINDOWS))
    for name, scores in passive.by_window.items():
        table.add_row(name, *(f"{score.anr:.2f} / {score.recall_at[1]:.1f}" for score in scores.values()))
    drive = passive.whole_drive
    print_table(
        table,
        f"filter over the whole drive, after every view: ANR {drive.anr:.2f}, R@1 {drive.recall_at[1]:.1f}",
        "sums: relevances of the last views, moved along by odometry, at one or the best of five speeds; "
        "sum_brute_force_u: with nothing left out",
        numbers=True,
    )


def _queries(scores: dict[str, RetrievalScores]) -> str:
    first = next(iter(scores.values()))
    return f"{first.n_queries} queries scored, {first.n_left_out} left out (no true image)"


def _print_planners(report: NbvReport, document: dict[str, Any]) -> None:
    at_distance = document["anr_at_distance_m"]
    distances_m = next(iter(at_distance.values()))
    views, metres, wrong_shares = (
        document[f"{figure}_confident"] for figure in ("views_to", "metres_to", "wrong_when")
    )
    titles = ("planner", "views", "95 %", "metres", "wrong %", "ANR %", "ANR % as in the paper")
    table = Table(*titles, *(f"after {metres} m" for metres in distances_m))
    for name, anr in sorted(document["anr"].items(), key=lambda item: float(views[item[0]])):
        low, high = views["interval_95"][name]
        table.add_row(
            f"{name} (default)" if name == DEFAULT_PLANNER else name,
            f"{views[name]:.2f}",
            f"{low:.2f} .. {high:.2f}",
            f"{metres[name]:.0f}",
            f"{wrong_shares[name]:.1f}",
            f"{anr:.3f}",
            f"{document['anr_paper'][name]:.2f}",
            *("-" if value is None else f"{value:.2f}" for value in at_distance[name].values()),
        )
    pairs = document["views_difference_95"].items()
    print_table(
        table,
        "views until the robot is 99 % sure of its place within 5 m; 20 more where it is mistaken or never sure",
        *(f"{pair}: {low:+.2f} .. {high:+.2f} views (paired, 95 %)" for pair, (low, high) in pairs),
        *_no_second_season(report.same_route),
        numbers=True,
    )


def _print_calibration(document: dict[str, Any], same_route: SameRoute | None) -> None:
    """Print moves, a row each; other robots in lines below."""
    table = Table("moves, m", *(f"{views} views: % / m" for views in VIEWS), "wrong %")
    for move, coverage in document["coverage_95"].items():
        sizes_m = document["set_m"][move]
        cells = (f"{coverage[views]:.1f} / {sizes_m[views]:.0f}" for views in coverage)
        table.add_row(move, *cells, f"{document['wrong_when_confident'][move]:.1f}")
    print_table(
        table,
        "% / m: how many 95 % sets hold the truth, and their size; wrong: 99 % sure of a place more than 5 m off",
        *_other_robots(document),
        *_no_second_season(same_route),
        numbers=True,
    )


def _other_robots(document: dict[str, Any]) -> list[str]:
    reliability, views_to_found, within_5_m = (
        document[part] for part in ("reliability", "carried", "odometry_within_5_m")
    )
    bins = zip(reliability["near_mode"], reliability["within_5_m"], strict=True)
    coverage_95 = {name: f"{share:.1f}" for name, share in document["standing_coverage_95"].items()}
    lost_percent = "-" if document["lost_their_place"] is None else f"{document['lost_their_place']:.1f}"
    off_route = (f"{share:.1f} {stage}" for stage, share in document["off_route"].items())
    return [
        "within 5 m of the mode, % believed: % true: "
        + ", ".join(f"{belief:.0f}: {true_share:.0f}" for belief, true_share in bins if belief is not None),
        f"150 views standing still: {coverage_95['unknown']} % covered from an unknown start, "
        f"{coverage_95['tracked']} % after 50 m, where {lost_percent} % lost their place",
        f"carried 100 m or more: found after {views_to_found['views_median']:.0f} views, "
        f"95 of 100 after {views_to_found['views_95']:.0f}",
        f"probability of being lost after ten views, %: {', '.join(off_route)}",
        *(
            f"odometry times {factor}: {coverage:.1f} % covered, {within_5_m[factor]:.1f} % within 5 m"
            for factor, coverage in document["odometry_coverage_95"].items()
        ),
        f"{sum(document['views_refused'].values())} views refused",
    ]


def _no_second_season(verdict: SameRoute | None) -> tuple[str, ...]:
    if verdict is None or verdict.why is None:
        return () if verdict is None else verdict.remarks()
    return (f"no second season was learnt from: {verdict.why}",)
