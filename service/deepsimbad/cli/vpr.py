"""`deepsimbad experiment vpr`."""

from pathlib import Path

import click
from rich.table import Table

from deepsimbad.cli.options import RELEVANCES
from deepsimbad.cli.terminal import console, progress_bar
from deepsimbad.cli.triplet import READING_STAGES, read_triplet, triplet_options, written
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.core.true_images import true_images_of
from deepsimbad.evaluators.registry import EvaluatorConfig
from deepsimbad.jobs.experiment_vpr import VprConfig, VprReport, run_vpr, vpr_stages
from deepsimbad.jobs.ground_truth import read_ground_truth


@click.command()
@triplet_options
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
    help="FILE.npy of accepted training frames for every test frame, in place of --tolerance.",
)
def vpr(
    landmarks: str,
    training: str,
    test: str,
    evaluator: EvaluatorConfig,
    spacing_m: float,
    n_landmarks: int,
    list_length: int,
    json_file: Path | None,
    names: tuple[str, ...],
    tolerance: float,
    ground_truth: Path | None,
) -> None:
    """Single-view place recognition (III, Fig. 6): ANR and recall of every relevance."""
    relevances = tuple(Relevance(name) for name in names) or tuple(Relevance)
    config = VprConfig(n_landmarks, list_length, tolerance, relevances)
    with progress_bar(READING_STAGES | vpr_stages(config), "experiment") as progress:
        triplet = read_triplet(landmarks, training, test, evaluator, spacing_m, progress)
        if ground_truth is None:
            truth = true_images_of(triplet.test.route, triplet.training.route, tolerance)
        else:
            truth = read_ground_truth(ground_truth, triplet.test.frames.index, triplet.training.frames.index)
        report = run_vpr(config, triplet.evaluator, triplet.landmarks, triplet.training, triplet.test, truth, progress)
    sources = triplet.sources | {"ground_truth": None if ground_truth is None else str(ground_truth)}
    if not written(report.as_dict(sources), json_file):
        _print_table(report)


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
