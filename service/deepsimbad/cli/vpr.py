"""`deepsimbad experiment vpr`."""

from pathlib import Path
from typing import Any

import click
from rich.table import Table

from deepsimbad.cli.options import RELEVANCES, evaluators_option
from deepsimbad.cli.terminal import console, progress_bar
from deepsimbad.cli.triplet import READING_STAGES, read_triplet, triplet_options, written
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.core.true_images import true_images_of
from deepsimbad.evaluators.registry import EvaluatorConfig
from deepsimbad.jobs.experiment_vpr import VprConfig, VprReport, run_vpr, vpr_stages
from deepsimbad.jobs.ground_truth import read_ground_truth


@click.command()
@triplet_options
@evaluators_option
@click.option("--relevance", "names", type=RELEVANCES, multiple=True, help="Only this one; may be repeated.")
@click.option(
    "--tolerance",
    type=click.FloatRange(min=0),
    default=2.0,
    show_default=True,
    help="Metres within which a match is true.",
)
@click.option(
    "--ground-truth",
    type=click.Path(path_type=Path),
    help="FILE.npy of accepted training frames for every test frame, in place of --tolerance; positions then count as "
    "comparable only where x, y are known or --same-route is given.",
)
def vpr(
    landmarks: str,
    training: str,
    test: str,
    evaluators: tuple[EvaluatorConfig, ...],
    spacing_m: float,
    n_landmarks: int,
    list_length: int,
    same_route: bool | None,
    json_file: Path | None,
    names: tuple[str, ...],
    tolerance: float,
    ground_truth: Path | None,
) -> None:
    """Single-view place recognition (III, Fig. 6): ANR and recall of every relevance."""
    relevances = tuple(Relevance(name) for name in names) or tuple(Relevance)
    if same_route is None and ground_truth is None:
        same_route = True  # test and training are scored by their positions: they count along one route
    config = VprConfig(n_landmarks, list_length, tolerance, relevances, same_route=same_route)
    documents, tables = {}, []
    for evaluator in evaluators:
        with progress_bar(READING_STAGES | vpr_stages(config), evaluator.options["extractor"]) as progress:
            triplet = read_triplet(landmarks, training, test, evaluator, spacing_m, progress)
            if ground_truth is None:
                truth = true_images_of(triplet.test.route, triplet.training.route, tolerance)
            else:
                truth = read_ground_truth(ground_truth, triplet.test.frames.index, triplet.training.frames.index)
            report = run_vpr(
                config, triplet.evaluator, triplet.landmarks, triplet.training, triplet.test, truth, progress
            )
        sources = triplet.sources | {"ground_truth": None if ground_truth is None else str(ground_truth)}
        documents[evaluator.options["extractor"]] = report.as_dict(sources)
        tables.append((evaluator.options["extractor"], report))
    whole: dict[str, Any] = {"extractors": documents} if len(documents) > 1 else next(iter(documents.values()))
    if written(whole, json_file):
        return
    if len(tables) == 1:
        _print_table(report)
    else:
        _print_extractors(tables)


def _print_extractors(reports: list[tuple[str, VprReport]]) -> None:
    """One extractor a row."""
    relevances = list(reports[0][1].scores)
    table = Table(
        "extractor", "numbers", "bytes", "ms an image", *(f"{each.value}: ANR / R@1 / R@5" for each in relevances)
    )
    for extractor, report in reports:
        time_ms = "-" if report.encode_ms is None else f"{report.encode_ms:.1f}"
        scores = (
            f"{score.anr:.2f} / {score.recall_at[1]:.0f} / {score.recall_at[5]:.0f}" for score in report.scores.values()
        )
        table.add_row(extractor, str(report.encoding_dim), str(report.bytes_per_encoding), time_ms, *scores)
    for column in table.columns[1:]:
        column.justify = "right"
    output = console()
    output.print(table)
    first = next(iter(reports[0][1].scores.values()))
    output.print(f"{first.n_queries} queries scored, {first.n_left_out} left out (no true image)")


def _print_table(report: VprReport) -> None:
    table = Table("relevance", "ANR %", "R@1 %", "R@5 %")
    for name, score in report.scores.items():
        shown = f"{name.value} (default)" if name is DEFAULT_RELEVANCE else name.value
        table.add_row(shown, f"{score.anr:.2f}", f"{score.recall_at[1]:.1f}", f"{score.recall_at[5]:.1f}")
    for column in table.columns[1:]:
        column.justify = "right"
    first = next(iter(report.scores.values()))
    output = console()
    output.print(table)
    output.print(
        f"{first.n_queries} queries scored, {first.n_left_out} left out (no true image); "
        f"index {report.index_bits_per_map_image:.1f} bits a map image"
    )
    if report.same_route.why is not None:
        output.print(f"no second season was learnt from: {report.same_route.why}")
