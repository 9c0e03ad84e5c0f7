"""`deepsimbad experiment`: the paper's experiments on a landmark-training-test triplet of recordings."""

from pathlib import Path

import click
from rich.table import Table

from deepsimbad.cli.options import RELEVANCES, evaluator_option, spacing_option
from deepsimbad.cli.terminal import console, progress_bar, write_json
from deepsimbad.core.metrics import true_images_of
from deepsimbad.core.relevance import Relevance
from deepsimbad.evaluators.registry import EvaluatorConfig, make_evaluator
from deepsimbad.jobs.encoded_traverse import encode_recording
from deepsimbad.jobs.experiment_vpr import VprConfig, VprReport, run_vpr, vpr_stages
from deepsimbad.jobs.ground_truth import read_ground_truth
from deepsimbad.settings import load_settings
from deepsimbad_client.sources import open_source

_READING = {"read landmarks": 2.0, "read training": 2.0, "read test": 2.0}


@click.group()
def experiment() -> None:
    """Measure: the paper's tables on your recordings."""


@experiment.command()
@click.option("--landmarks", required=True, help="SOURCE landmarks are selected from.")
@click.option("--training", required=True, help="SOURCE that becomes the map.")
@click.option("--test", required=True, help="SOURCE of the queries, in the order they were driven.")
@evaluator_option
@click.option("--relevance", "names", type=RELEVANCES, multiple=True, help="Only this one; may be repeated.")
@spacing_option
@click.option("--n-landmarks", type=click.IntRange(min=1), default=300, show_default=True)
@click.option("--list-length", type=click.IntRange(min=1), default=4, show_default=True)
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
@click.option(
    "--json",
    "json_file",
    type=click.Path(dir_okay=False, path_type=Path),
    is_flag=False,
    flag_value=Path("-"),
    help="Write the result as JSON to FILE; without FILE to standard output.",
)
def vpr(
    landmarks: str,
    training: str,
    test: str,
    evaluator: EvaluatorConfig,
    names: tuple[str, ...],
    spacing_m: float,
    n_landmarks: int,
    list_length: int,
    tolerance: float,
    ground_truth: Path | None,
    json_file: Path | None,
) -> None:
    """Single-view place recognition (III, Fig. 6): ANR and recall of every relevance."""
    relevances = tuple(Relevance(name) for name in names) or tuple(Relevance)
    config = VprConfig(n_landmarks, list_length, tolerance, relevances)
    judge = make_evaluator(evaluator)
    with progress_bar(_READING | vpr_stages(config), "experiment") as progress:
        traverses = []
        for stage, source in zip(_READING, (landmarks, training, test), strict=True):
            progress.stage(stage)
            recording = open_source(source, spacing_m=spacing_m)
            traverses.append(encode_recording(recording, judge, load_settings().max_pixels, progress.update))
        candidates, mapped, queries = traverses
        if ground_truth is None:
            truth = true_images_of(queries.route, mapped.route, tolerance)
        else:
            truth = read_ground_truth(ground_truth, queries.frames.index, mapped.frames.index)
        report = run_vpr(config, judge, candidates, mapped, queries, truth, progress)
    sources = {
        "landmarks": landmarks,
        "training": training,
        "test": test,
        "evaluator": evaluator.as_dict(),
        "spacing_m": spacing_m,
        "ground_truth": None if ground_truth is None else str(ground_truth),
        "left_out": {
            role: traverse.left_out for role, traverse in zip(("landmarks", "training", "test"), traverses, strict=True)
        },
    }
    document = report.as_dict(sources)
    if json_file == Path("-"):
        write_json(document)
        return
    if json_file is not None:
        write_json(document, json_file)
    _print_table(report)


def _print_table(report: VprReport) -> None:
    table = Table("relevance", "ANR %", "R@1 %", "R@5 %", title=None)
    for name, score in report.scores.items():
        table.add_row(name.value, f"{score.anr:.2f}", f"{score.recall_at[1]:.1f}", f"{score.recall_at[5]:.1f}")
    for column in table.columns[1:]:
        column.justify = "right"
    first = next(iter(report.scores.values()))
    output = console()
    output.print(table)
    output.print(
        f"{first.n_queries} queries scored, {first.n_left_out} left out (no true image); "
        f"index {report.index_bits_per_map_image:.1f} bits a map image"
    )
